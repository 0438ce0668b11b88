"""The χ² gate on innovations (after TLIO): which measurements the filter accepts.

It has nothing to do with the gate of the network's head, which scales a displacement.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.state import GateState
from gnio_jax.types import Array


class GateActivity(NamedTuple):
    """Whether the gate judges at one time."""

    active: Bool[Array, ""]
    stale: Bool[Array, ""]
    """It would be active but for a last success that is too old."""


def gate_activity(memory: GateState, config: FilterConfig, now: Array) -> GateActivity:
    """Whether the gate is active at sample `now`."""
    ready = memory.converged & (now >= memory.pause_end)
    old = now - memory.last_success > config.whole_samples(config.success_seconds)
    stale = ready & (memory.last_success >= 0) & old
    return GateActivity(ready & ~stale, stale)


def innovation_gate(
    memory: GateState,
    config: FilterConfig,
    now: Array,
    oldest: Array,
    nis: Float[Array, ""],
    tested: Array,
) -> tuple[GateState, Float[Array, ""]]:
    """TLIO's gate: the weight of the measurement, 1 if it passes as it is and 0 if not, and the
    gate's memory after it.

    `now` and `oldest` are the samples of the newest and the oldest clone. Where no measurement is
    `tested`, an earlier last success moves along (ours): absence is not staleness, or the first
    second after any hole would pass unchecked. TLIO has a measurement at every clone. Comparisons
    are strict ("more than", "older"); at the very end of a pause the gate is active again.
    With `gate_softness` the active gate weighs instead (ours); its memory still takes what is above
    the threshold for a failure.
    """
    old_enough = oldest > config.whole_samples(config.convergence_seconds)
    memory = memory._replace(converged=memory.converged | (tested & old_enough))
    active, stale = gate_activity(memory, config, now)
    passed = tested & (~active | (nis <= config.gate_threshold))
    weight = passed.astype(nis.dtype)
    if config.gate_softness > 0:
        slope = jax.nn.sigmoid((config.gate_threshold - nis) / config.gate_softness)
        weight = jnp.where(tested, jnp.where(active, slope, 1.0), 0.0)
    nothing_tested = ~tested & (memory.last_success >= 0)
    waited = config.samples_per_clone * nothing_tested.astype(jnp.int32)
    # Until a pause is over, rounded up whatever rounding does to pause / dt.
    pause_end = now - int(np.floor(-config.pause_seconds / config.dt + 1e-6))
    memory = GateState(
        converged=memory.converged,
        last_success=jnp.where(passed, now, memory.last_success + waited),
        pause_end=jnp.where(tested & stale, pause_end, memory.pause_end),
    )
    return memory, weight
