"""The state of a deployed filter as named arrays: other programs know no NamedTuples.

An array's name is its path in the state, e.g. `state.gate.converged`. The clones are a ring, as in
`filtering.scan`: clone step k writes slot k mod (W + 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.filtering import FilterConfig, FilterState, NoiseModel
from gnio_jax.filtering.inputs import state_shapes
from gnio_jax.filtering.options import FilterSetup
from gnio_jax.filtering.start import with_lasting_errors
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


class FlatState(NamedTuple):
    """How a state is taken apart and put together."""

    template: DeployedState
    """Shapes and types."""

    def arrays(self, state: DeployedState) -> dict[str, Any]:
        """The arrays of a state by name."""
        return {name: leaf for name, leaf in _named(state) if _is_kept(name, leaf)}

    def state(self, arrays: Mapping[str, Array]) -> DeployedState:
        """The state of these arrays. Those that are left out are zero: nothing may need them."""
        leaves = [
            arrays[name] if name in arrays else jnp.zeros(leaf.shape, leaf.dtype)
            for name, leaf in _named(self.template)
        ]
        return jax.tree.unflatten(jax.tree.structure(self.template), leaves)

    @property
    def shapes(self) -> dict[str, jax.ShapeDtypeStruct]:
        """Shape and type of each array."""
        return self.arrays(self.template)


def flat_state(config: FilterConfig, noise: NoiseModel) -> FlatState:
    """For the states of one filter, in float64."""
    samples = jax.ShapeDtypeStruct((config.reach, 6), jnp.float64)
    return FlatState(DeployedState(state_shapes(config, noise, jnp.float64), samples))


def start_arrays(state: FilterState, setup: FilterSetup) -> dict[str, np.ndarray]:
    """The arrays of a filter that begins with `state`, as `filtering.initial_state` makes it."""
    flat = flat_state(setup.config, setup.noise)
    arrays = flat.arrays(started(state, setup))
    return {name: np.asarray(value) for name, value in arrays.items()}


def started(state: FilterState, setup: FilterSetup) -> DeployedState:
    """A deployed filter before its first sample."""
    if setup.noise.displacement is not None:
        state = with_lasting_errors(state, setup.noise.displacement)
    return DeployedState(state, jnp.zeros((setup.config.reach, 6)))


def _named(state: DeployedState) -> list[tuple[str, Any]]:
    leaves = jax.tree_util.tree_leaves_with_path(state)
    paths = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in leaves]
    names = [PREFIX + path.removeprefix("filter.") for path in paths]
    return [(name, leaf) for name, (_, leaf) in zip(names, leaves, strict=True)]


def _is_kept(name: str, leaf: Any) -> bool:
    """Not arrays without entries, and not what no step reads."""
    return leaf.size > 0 and name.removeprefix(PREFIX) not in _OF_GAPS
