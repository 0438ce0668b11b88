"""The state of a deployed filter, and its arrays by name.

Other programs know no NamedTuples: the name of an array of the state is its path in it, e.g.
`state.gate.converged`. The clones are a ring, as in `filtering.scan`: clone step k writes slot
k mod (W + 1).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax.filtering import FilterState
from gnio_jax.types import Array, Memory

STATE, NEXT, POSE = "state.", "next.", "pose."
"""Prefixes of the names of arrays of the state, of the state after a step, and of the fields of
`filtering.Pose`."""
_OF_GAPS = (STATE + "imu.gyro", STATE + "imu.accel", STATE + "imu.missing")
"""Arrays that bridge holes; the stream of a deployed filter has none."""

Arrays = Mapping[str, Array]


class DeployedState(NamedTuple):
    """The state between two clone steps."""

    filter: FilterState
    """The filter's state, whose clones are a ring."""
    samples: Float[Array, "r 6"]
    """The last samples on which a window depends, gyro rad/s and accel m/s², raw; zeros at first.
    A network with memory needs none."""
    memory: Memory | None
    """The memory of a network that has one."""


def to_arrays(state: DeployedState) -> dict[str, Any]:
    """The arrays of a state, or their shapes, by name; only those that have entries and that a step
    reads."""
    leaves = _named_state(state).items()
    return {name: leaf for name, leaf in leaves if leaf.size > 0 and name not in _OF_GAPS}


def from_arrays(arrays: Arrays, shape: DeployedState) -> DeployedState:
    """The state of these arrays. Arrays that are left out are zero, because nothing needs them."""
    leaves = [
        arrays[name] if name in arrays else jnp.zeros(leaf.shape, leaf.dtype)
        for name, leaf in _named_state(shape).items()
    ]
    return jax.tree.unflatten(jax.tree.structure(shape), leaves)


def next_arrays(arrays: dict[str, Any]) -> dict[str, Any]:
    """Arrays of a state under the names of those after a step."""
    return {NEXT + name.removeprefix(STATE): value for name, value in arrays.items()}


def name_leaves(tree: Any, prefix: str) -> dict[str, Any]:
    """The leaves of a tree by the prefix and their path."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {
        prefix + jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in leaves
    }


def _named_state(state: DeployedState) -> dict[str, Any]:
    """The leaves in the order of the tree; those of the filter are the state's own."""
    return name_leaves(state.filter, STATE) | name_leaves(state._replace(filter=None), STATE)
