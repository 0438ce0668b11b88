"""The functions that are exported, over named arrays: network, start, window, filter step.

They put the package's own functions together and compute nothing themselves. A clone interval of a
deployed filter is

    window = filter_window(state, gyro, accel),
    displacement, log_std = network(window),
    state, pose = filter_step(state, gyro, accel, displacement, covariance),

with covariance = diag(exp(2 max(log_std, log_std_min))). The window is cut before the step: a step
corrects neither the attitude of the oldest clone nor the biases before it measures.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from gnio_jax.apps.onnx import flat_state
from gnio_jax.apps.onnx.flat_state import PREFIX, DeployedState, from_arrays, to_arrays
from gnio_jax.filtering import Pose, level_state
from gnio_jax.filtering.displacement import scaled_displacement
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.network import network_window
from gnio_jax.filtering.resampler import ACCEL, GYRO
from gnio_jax.filtering.settings import FilterSetup
from gnio_jax.filtering.start import REST_SECONDS
from gnio_jax.filtering.tracker import advance_filter
from gnio_jax.models import Network
from gnio_jax.types import Array

NETWORK, START, WINDOW, STEP = "network", "filter_start", "filter_window", "filter_step"
NEXT = "next."
"""Begins the name of an array of the state after a step."""
POSE = "pose."
"""Begins the name of what a step returns besides the state: the fields of `filtering.Pose`."""
_READ_BY_WINDOW = ("clone_rotation", "gyro_bias", "accel_bias", "step", "samples")

Arrays = Mapping[str, Array]


class Program(NamedTuple):
    """A pure function from named arrays to named arrays."""

    name: str
    function: Callable[[Arrays], dict[str, Array]]
    inputs: dict[str, jax.ShapeDtypeStruct]

    @property
    def outputs(self) -> dict[str, jax.ShapeDtypeStruct]:
        """Shape and type of what the function returns."""
        return jax.eval_shape(self.function, self.inputs)


def programs(network: Network, setup: FilterSetup) -> list[Program]:
    """The four programs of a network and its filter. JAX's x64 must be on."""
    config, noise = setup.config, setup.noise
    shape, n = flat_state.state_shape(setup), config.samples_per_clone

    def infer(arrays: Arrays) -> dict[str, Array]:
        prediction = network.apply(network.variables, arrays["window"])
        return {"displacement": prediction.displacement, "log_std": prediction.log_std}

    def start(arrays: Arrays) -> dict[str, Array]:
        """`level_state` of a second at rest."""
        state = level_state(config, arrays["gyro"], arrays["accel"], setup.initial_std)
        return to_arrays(flat_state.started(state, setup))

    def window(arrays: Arrays) -> dict[str, Array]:
        """`network_window` between the oldest clone that the next step will have and its end."""
        state = from_arrays(arrays, shape)
        samples = _with_latest(state.samples, arrays)
        oldest = (state.filter.step + 1) % config.clones
        signals = samples[:, GYRO], samples[:, ACCEL]
        return {"window": network_window(state.filter, oldest, *signals, config)}

    def step(arrays: Arrays) -> dict[str, Array]:
        """`advance_filter` with a given displacement."""
        state = from_arrays(arrays, shape)
        given = arrays["displacement"], arrays["covariance"]
        measurement = scaled_displacement(*given, noise, config.displacement_frame)
        filtered, history = advance_filter(
            state.filter,
            Imu(arrays["gyro"], arrays["accel"], None),
            jnp.zeros(n),
            lambda state, oldest: (measurement, {}),
            state.filter.step % config.clones,
            config,
            noise,
        )
        after = to_arrays(DeployedState(filtered, _with_latest(state.samples, arrays)))
        state_after = {NEXT + name.removeprefix(PREFIX): value for name, value in after.items()}
        fields = (name for name in Pose._fields if name != "time")
        return state_after | {POSE + name: getattr(history, name)[0] for name in fields}

    state = to_arrays(shape)
    read_by_window = {PREFIX + name: state[PREFIX + name] for name in _READ_BY_WINDOW}
    interval = {"gyro": _float64(n, 3), "accel": _float64(n, 3)}
    rest = round(REST_SECONDS / config.dt)
    measured = {"displacement": _float64(3), "covariance": _float64(3, 3)}
    network_input = jax.ShapeDtypeStruct((1, config.seen, 6), jnp.float32)
    return [
        Program(NETWORK, infer, {"window": network_input}),
        Program(START, start, {"gyro": _float64(rest, 3), "accel": _float64(rest, 3)}),
        Program(WINDOW, window, read_by_window | interval),
        Program(STEP, step, state | interval | measured),
    ]


def _float64(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float64)


def _with_latest(samples: Array, arrays: Arrays) -> Array:
    """The stored samples moved on by those of a clone interval."""
    latest = jnp.concatenate([arrays["gyro"], arrays["accel"]], axis=1)
    return jnp.concatenate([samples, latest])[len(latest) :]
