"""How the filter's state depends on the errors that it considers, carried from clone step to clone
step (see `considered`).

After K steps it is what `considered.sensitivity` finds of the whole run at its end, to rounding:
here, too, the displacements are held as the network gave them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax.filtering.considered import ENTRIES, OF_BIAS, disturbed, of_error
from gnio_jax.filtering.displacement import Measurement
from gnio_jax.filtering.state import FilterState, Mean
from gnio_jax.filtering.step import Measure
from gnio_jax.types import Array

T = TypeVar("T")

_CONTINUOUS = (
    "rotation",
    "velocity",
    "offset",
    "gyro_bias",
    "accel_bias",
    "anchor",
    "move",
    "lasting",
    "clone_rotation",
    "clone_offset",
    "core_covariance",
    "cross_covariance",
    "clone_covariance",
    "first",
)
"""Fields of `FilterState` that depend on c. The others count, decide or remember the IMU."""

Tangents = dict[str, Any]
"""∂x/∂c for each of these fields x, by its name; the 6 entries of c lead."""


def start_tangents(state: FilterState) -> Tangents:
    """At the start: c is no more yet than a bias of the gyro."""
    zeros = jax.tree.map(lambda leaf: jnp.zeros((ENTRIES, *leaf.shape), leaf.dtype), _parts(state))
    of_bias = jnp.eye(ENTRIES, dtype=state.gyro_bias.dtype)[:, OF_BIAS]
    return zeros | {"gyro_bias": of_bias}


def step_with_tangents(
    step: Callable[[FilterState, Measure], tuple[FilterState, T]],
    state: FilterState,
    tangents: Tangents,
    measure: Measure,
) -> tuple[FilterState, T, Tangents]:
    """One clone step by `step`, and the tangents after it.

    What `measure` gives is held: c disturbs it as a displacement, but the network is called once,
    and not differentiated.
    """

    def moved(parts: Tangents, c: Float[Array, "6"]) -> tuple[Tangents, tuple[FilterState, T]]:
        def measure_disturbed(
            state: FilterState, oldest: Array | int
        ) -> tuple[Measurement, dict[str, Array]]:
            measurement, diagnostics = measure(jax.lax.stop_gradient(state), oldest)
            told = disturbed(measurement.displacement[None], c)[0]
            return measurement._replace(displacement=told), diagnostics

        after, found = step(state._replace(**parts), measure_disturbed)
        return _parts(after), (after, found)

    parts, dtype = _parts(state), state.offset.dtype

    def along(tangent: Tangents, direction: Float[Array, "6"]) -> tuple:
        point = parts, jnp.zeros(ENTRIES, dtype)
        _, after, found = jax.jvp(moved, point, (tangent, direction), has_aux=True)
        return after, found

    # Only the tangents are mapped over: the step itself is made once.
    every_entry = jnp.eye(ENTRIES, dtype=dtype)
    after, (state, found) = jax.vmap(along, out_axes=(0, None))(tangents, every_entry)
    return state, found, after


def core_sensitivity(mean: Mean, tangents: Tangents) -> Float[jax.Array, "15 6"]:
    """S of θ, v, p, b_g, b_a."""
    derivatives = Mean(
        rotation=tangents["rotation"],
        velocity=tangents["velocity"],
        position=tangents["anchor"] + tangents["offset"],
        gyro_bias=tangents["gyro_bias"],
        accel_bias=tangents["accel_bias"],
    )
    last = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1)[None], derivatives)
    return of_error(mean.rotation[None], last)[0]


def _parts(state: FilterState) -> Tangents:
    return {name: getattr(state, name) for name in _CONTINUOUS}
