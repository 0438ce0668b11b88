"""One clone step: propagate, clone, measure, update."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax.config import NoiseModel
from gnio_jax.filtering.clones import move_anchor
from gnio_jax.filtering.config import FilterConfig, YawFrame
from gnio_jax.filtering.displacement import Measurement, update_with_correction
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.history import StepRecord
from gnio_jax.filtering.lasting_errors import lasting_motion
from gnio_jax.filtering.propagation import integrate_interval, propagate, transition
from gnio_jax.filtering.state import FilterState, core_covariance
from gnio_jax.filtering.update import Correction
from gnio_jax.filtering.zero_velocity import detect_rest, no_rest, update_at_rest
from gnio_jax.types import Array

Measure = Callable[[FilterState, Array | int], tuple[Measurement, dict]]
"""From the state and the slot of its oldest clone to the measurement and the network's
diagnostics."""


def _keep(primitive: Any, *_: Any, **__: Any) -> bool:
    """What the backward pass keeps of a step: all but other forms of what it has."""
    return primitive.name not in {
        "broadcast_in_dim",
        "convert_element_type",
        "neg",
        "reshape",
        "squeeze",
        "transpose",
    }


# To write, and on the way back to read, the numbers that a backward pass keeps costs more than to
# compute the interval again.
_integrate_interval = jax.checkpoint(integrate_interval, static_argnums=3, prevent_cse=False)
_propagate = jax.checkpoint(propagate, policy=_keep, prevent_cse=False)
_update_with_correction = jax.checkpoint(
    update_with_correction, policy=_keep, static_argnums=(4, 5), prevent_cse=False
)


class StepTrace(NamedTuple):
    """What happened to the error in one clone interval, as smoothing needs it."""

    transition: Float[Array, "9 15"]
    """See `propagation.transition`."""
    decay: Float[Array, "e"]
    """See `lasting_errors.LastingMotion`."""
    corrections: tuple[Correction, ...]
    """The updates in the order in which they were made."""


def clone_step(
    state: FilterState,
    imu: Imu,
    measure: Measure,
    slot: Array | int,
    config: FilterConfig,
    noise: NoiseModel,
    frame: YawFrame,
) -> tuple[FilterState, StepRecord]:
    """One clone interval: propagate, clone into `slot` of the ring, measure, update.

    `imu` are the interval's samples; the measured displacement is told in `frame`.
    """
    state, record, _ = traced_clone_step(state, imu, measure, slot, config, noise, frame)
    return state, record


def traced_clone_step(
    state: FilterState,
    imu: Imu,
    measure: Measure,
    slot: Array | int,
    config: FilterConfig,
    noise: NoiseModel,
    frame: YawFrame,
) -> tuple[FilterState, StepRecord, StepTrace]:
    """`clone_step` and its trace."""
    # A ring of clones: the newest takes the place of the one that has served as oldest, and the
    # next slot is the oldest now. The anchor moves once in a round of the ring.
    newest, oldest = slot, (slot + 1) % config.clones
    anchored = newest == 0

    state = move_anchor(state, anchored)
    motion = _integrate_interval(state, imu, noise, config.dt)
    moved = transition(state, motion, anchored)
    lasting = lasting_motion(noise.correlation, config.clone_seconds, state.offset.dtype)
    state = _propagate(state, motion, lasting, anchored, newest)

    measurement, diagnostics = measure(state, oldest)
    state, update, *corrections = _update_with_correction(
        state, measurement, newest, oldest, config, frame, noise.correlation
    )
    rest = no_rest(update.nis.dtype)
    if config.zero_velocity_std > 0:
        state, quiet = detect_rest(state, imu, config)
        state, rest, correction = update_at_rest(state, quiet, update.tested, newest, config)
        corrections.append(correction)

    covariance = core_covariance(state.core_covariance)
    if config.history == "diagonal":
        covariance = jnp.diagonal(covariance)
    record = StepRecord(
        state.mean, covariance, measurement, update, rest, state.lasting, diagnostics
    )
    return state, record, StepTrace(moved, lasting.decay, tuple(corrections))
