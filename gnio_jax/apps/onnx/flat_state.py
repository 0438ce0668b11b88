"""The state of a deployed filter as named arrays, because other programs know no NamedTuples.

The name of an array is its path in the state, e.g. `state.gate.converged`. The clones are a ring,
as in `filtering.scan`: clone step k writes slot k mod (W + 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.filtering import FilterState
from gnio_jax.filtering.checks import checked_state
from gnio_jax.filtering.settings import FilterSetup
from gnio_jax.filtering.state import state_shapes
from gnio_jax.types import Array

PREFIX = "state."
"""Begins the name of each array of the state."""
_OF_GAPS = ("imu.gyro", "imu.accel", "imu.missing")
"""What bridges holes; the stream of a deployed filter has none."""


class DeployedState(NamedTuple):
    """What one clone step hands to the next."""

    filter: FilterState
    """Its clones are a ring."""
    samples: Float[Array, "r 6"]
    """The last `FilterConfig.reach` samples, gyro rad/s and accel m/s², raw; zeros at first."""


def started(state: FilterState, setup: FilterSetup) -> DeployedState:
    """A deployed filter before its first sample."""
    state = checked_state(state, setup.config, setup.noise)
    return DeployedState(state, jnp.zeros((setup.config.reach, 6)))


def state_shape(setup: FilterSetup) -> DeployedState:
    """Shapes and types of the state of a filter, in float64."""
    samples = jax.ShapeDtypeStruct((setup.config.reach, 6), jnp.float64)
    return DeployedState(state_shapes(setup.config, setup.noise, jnp.float64), samples)


def to_arrays(state: DeployedState) -> dict[str, Any]:
    """The arrays of a state, or their shapes, by name: those that have entries and that a step
    reads."""
    return {
        name: leaf
        for name, leaf in _named_leaves(state).items()
        if leaf.size > 0 and name.removeprefix(PREFIX) not in _OF_GAPS
    }


def from_arrays(arrays: Mapping[str, Array], shape: DeployedState) -> DeployedState:
    """The state of these arrays. Those that are left out are zero: nothing may need them."""
    leaves = [
        arrays[name] if name in arrays else jnp.zeros(leaf.shape, leaf.dtype)
        for name, leaf in _named_leaves(shape).items()
    ]
    return jax.tree.unflatten(jax.tree.structure(shape), leaves)


def start_arrays(state: FilterState, setup: FilterSetup) -> dict[str, np.ndarray]:
    """The arrays of a filter that begins with `state`, of `initial_state` or `level_state`.

    Raises `ValueError` for a state that a run has left: its clones are ordered by age and measured
    from the present anchor, and are not the ring that the next step writes into.
    """
    if state.step > 0:
        problem = f"is one after {int(state.step)} clone intervals of a run"
        raise ValueError(f"state: {problem}; a deployed filter begins with one without clones")
    return {name: np.asarray(value) for name, value in to_arrays(started(state, setup)).items()}


def _named_leaves(state: DeployedState) -> dict[str, Any]:
    leaves = jax.tree_util.tree_leaves_with_path(state)
    paths = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in leaves]
    names = [PREFIX + path.removeprefix("filter.") for path in paths]
    return {name: leaf for name, (_, leaf) in zip(names, leaves, strict=True)}
