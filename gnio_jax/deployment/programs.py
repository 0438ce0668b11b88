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

import functools
from collections.abc import Callable, Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp

from gnio_jax.deployment.flat_state import PREFIX, DeployedState, FlatState, flat_state, started
from gnio_jax.evaluation.inference import Network
from gnio_jax.filtering import Pose, level_state
from gnio_jax.filtering.displacement import scaled_measurement
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.network import network_window
from gnio_jax.filtering.online import ACCEL, GYRO, advance_filter
from gnio_jax.filtering.options import FilterSetup
from gnio_jax.types import Array

NETWORK, START, WINDOW, STEP = "network", "filter_start", "filter_window", "filter_step"
NEXT = "next."
"""Begins the name of an array of the state after a step."""
REST_SECONDS = 1.0
"""Of samples at rest from which `filter_start` makes a state, s."""
POSE = "pose."
"""Begins the name of what a step tells besides the state: the fields of `filtering.Pose`."""
_POSE_FIELDS = tuple(name for name in Pose._fields if name != "time")

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
    n, flat = setup.config.samples_per_clone, flat_state(setup.config, setup.noise)
    stride = {"gyro": _float64(n, 3), "accel": _float64(n, 3)}
    rest = round(REST_SECONDS / setup.config.dt)
    measured = {"displacement": _float64(3), "covariance": _float64(3, 3)}
    window = jax.ShapeDtypeStruct((1, setup.config.seen, 6), jnp.float32)
    read = {f"{PREFIX}{name}": flat.shapes[f"{PREFIX}{name}"] for name in _READ_BY_WINDOW}
    with_setup = functools.partial(functools.partial, setup=setup, flat=flat)
    return [
        Program(NETWORK, functools.partial(_network, network=network), {"window": window}),
        Program(START, with_setup(_start), {"gyro": _float64(rest, 3), "accel": _float64(rest, 3)}),
        Program(WINDOW, with_setup(_window), read | stride),
        Program(STEP, with_setup(_step), flat.shapes | stride | measured),
    ]


def _float64(*shape: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct(shape, jnp.float64)


def _network(arrays: Arrays, network: Network) -> dict[str, Array]:
    prediction = network.apply(network.variables, arrays["window"])
    return {"displacement": prediction.displacement, "log_std": prediction.log_std}


def _start(arrays: Arrays, setup: FilterSetup, flat: FlatState) -> dict[str, Array]:
    """`level_state` of samples at rest."""
    state = level_state(setup.config, arrays["gyro"], arrays["accel"], setup.initial_std)
    return flat.arrays(started(state, setup))


_READ_BY_WINDOW = ("clone_rotation", "gyro_bias", "accel_bias", "step", "samples")


def _window(arrays: Arrays, setup: FilterSetup, flat: FlatState) -> dict[str, Array]:
    """`network_window` between the oldest clone that the next step will have and its end."""
    state, config = flat.state(arrays), setup.config
    samples = _with_latest(state.samples, arrays)
    oldest = (state.filter.step + 1) % config.clones
    rotation = state.filter.clone_rotation[oldest]
    signals = samples[:, GYRO], samples[:, ACCEL]
    return {"window": network_window(state.filter, rotation, *signals, config)}


def _step(arrays: Arrays, setup: FilterSetup, flat: FlatState) -> dict[str, Array]:
    """`advance_filter` with a given displacement."""
    state, config = flat.state(arrays), setup.config
    stream = Imu(arrays["gyro"], arrays["accel"], None)
    given = arrays["displacement"], arrays["covariance"]
    measurement = scaled_measurement(*given, config, setup.noise)
    filtered, history = advance_filter(
        state.filter,
        stream,
        jnp.zeros(config.samples_per_clone),
        lambda state, oldest: (measurement, {}),
        state.filter.step % config.clones,
        config,
        setup.noise,
    )
    following = flat.arrays(DeployedState(filtered, _with_latest(state.samples, arrays)))
    renamed = {NEXT + name.removeprefix(PREFIX): value for name, value in following.items()}
    return renamed | {POSE + name: getattr(history, name)[0] for name in _POSE_FIELDS}


def _with_latest(samples: Array, arrays: Arrays) -> Array:
    """The stored samples moved on by those of a clone interval."""
    latest = jnp.concatenate([arrays["gyro"], arrays["accel"]], axis=1)
    return jnp.concatenate([samples, latest])[len(latest) :]
