"""The memory of the χ² gate."""

import jax
import jax.numpy as jnp

from gnio_jax import filtering
from gnio_jax.filtering.displacement import innovation_gate


def test_gate_boundaries_count_samples():
    """Strict comparisons at exact multiples of dt = 0.1 s, where a running sum of dt errs:
    convergence, age of success, end of pause."""
    seconds = dict(convergence_seconds=0.3, success_seconds=0.7, pause_seconds=1.2)
    config = filtering.FilterConfig(0.1, 1, 1, **seconds)
    gate = jax.jit(lambda memory, *arguments: innovation_gate(memory, config, *arguments))

    def step(memory, now, nis=20.0, tested=True):
        memory = filtering.GateState(*map(jnp.asarray, memory))
        memory, weight = gate(memory, *map(jnp.asarray, (now, nis, tested)))
        return tuple(int(value) for value in memory), weight == 1

    # The oldest clone is exactly 0.3 s old: not yet converged, a success; then older.
    assert step((False, -1, 0), 4) == ((0, 4, 0), True)
    assert step((False, -1, 0), 5) == ((1, -1, 0), False)
    assert step((False, -1, 0), 5, tested=False) == ((0, -1, 0), False)  # nothing to judge by
    assert step((True, 10, 0), 17) == ((1, 10, 0), False)  # exactly 0.7 s old: still active
    assert step((True, 10, 0), 18) == ((1, 18, 30), True)  # older: passes, pause of 1.2 s
    assert step((True, 18, 30), 29) == ((1, 29, 30), True)  # inside the pause
    assert step((True, 29, 30), 30) == ((1, 29, 30), False)  # exactly at its end
    assert step((True, 29, 30), 30, nis=11.3) == ((1, 30, 30), True)
    # no measurement: the last success moves along, if there was one
    assert step((True, 10, 0), 40, tested=False) == ((1, 11, 0), False)
    assert step((True, -1, 0), 40, tested=False) == ((1, -1, 0), False)
    assert step((True, -1, 0), 40) == ((1, -1, 0), False)
