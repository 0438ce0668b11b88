"""The functions that are exported, over named arrays: network, start, window, filter step.

They combine the package's own functions and compute nothing themselves. A clone interval of a
deployed filter is

    window = filter_window(state, gyro, accel),
    displacement, log_std, memory = network(window, state),
    state, pose = filter_step(state, gyro, accel, displacement, covariance),

with covariance = diag(exp(2 max(log_std, log_std_min))), turned about z by the angle whose cosine
and sine are the network's output `axes`, if it has one. The window can be cut before the step,
because a step changes neither the attitude of the oldest clone nor the biases before it measures.
A network with memory takes and gives the arrays `memory.network` of the state, and its window has
the samples of the interval alone; a network on windows has no such arrays.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax.apps.onnx.networks import (
    OF_NETWORK,
    DeployedNetwork,
    append_samples,
)
from gnio_jax.apps.onnx.state import (
    POSE,
    STATE,
    Arrays,
    DeployedState,
    from_arrays,
    next_arrays,
    to_arrays,
)
from gnio_jax.errors import InputError
from gnio_jax.filtering import Filter, FilterState, Pose, level_state
from gnio_jax.filtering.checks import checked_state
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.start import REST_SECONDS
from gnio_jax.filtering.state import invariant_errors, state_shapes
from gnio_jax.filtering.tracker import advance_filter
from gnio_jax.types import Array


class Program(NamedTuple):
    """A pure function from named arrays to named arrays."""

    name: str
    function: Callable[[Arrays], dict[str, Array]]
    inputs: dict[str, jax.ShapeDtypeStruct]

    @property
    def outputs(self) -> dict[str, jax.ShapeDtypeStruct]:
        """Shapes and types of the function's results."""
        return jax.eval_shape(self.function, self.inputs)


def programs(network: DeployedNetwork, ekf: Filter) -> list[Program]:
    """The four programs of a network and its filter. JAX's x64 must be on. The output
    `displacement` of the network is what the filter measures (`FilterConfig.measures`)."""
    config = ekf.config
    if config.low_pass_seconds:
        problem = "is not undone by an exported filter"
        raise InputError("filter.low_pass_seconds", problem, "set it to 0")
    deploy = functools.partial(_deploy_state, ekf=ekf, network=network)
    shape = jax.eval_shape(deploy, state_shapes(config, len(ekf.correlation_times), jnp.float64))

    def start(arrays: Arrays) -> dict[str, Array]:
        """`level_state` of a second at rest."""
        state = level_state(ekf, arrays["gyro"], arrays["accel"])
        return to_arrays(deploy(checked_state(state, ekf)))

    def window(arrays: Arrays) -> dict[str, Array]:
        """The network's input from the state before an interval and its samples."""
        return {"window": network.window(from_arrays(arrays, shape), _interval(arrays))}

    def step(arrays: Arrays) -> dict[str, Array]:
        """`advance_filter` with a given displacement."""
        state, imu = from_arrays(arrays, shape), _interval(arrays)
        memory = network.remember(state, imu)
        filtered, history = advance_filter(
            ekf,
            state.filter,
            imu,
            jnp.zeros(n),
            lambda state, oldest: (network.measure(arrays, memory, state, oldest), {}),
            state.filter.step % config.clones,
        )
        samples = append_samples(state.samples, imu)
        after = _read_by_step(to_arrays(DeployedState(filtered, samples, memory)))
        fields = (name for name in Pose._fields if name not in ("time", "failure", "quiet"))
        pose = {POSE + name: getattr(history, name)[0] for name in fields}
        return next_arrays(after) | pose | {"measured": history.displacement[0]}

    def float64(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, jnp.float64)

    state, n = to_arrays(shape), config.samples_per_clone
    rest_samples = round(REST_SECONDS / config.dt)
    read_by_window = {STATE + name: state[STATE + name] for name in network.read_by_window}
    interval = {"gyro": float64(n, 3), "accel": float64(n, 3)}
    measured = {"displacement": float64(3), "covariance": float64(3, 3)}
    return [
        Program("network", network.infer, network.inputs),
        Program(
            "filter_start",
            start,
            {"gyro": float64(rest_samples, 3), "accel": float64(rest_samples, 3)},
        ),
        Program("filter_window", window, read_by_window | interval),
        Program("filter_step", step, _read_by_step(state) | interval | measured),
    ]


def start_arrays(
    state: FilterState, network: DeployedNetwork, ekf: Filter
) -> dict[str, np.ndarray]:
    """The arrays of a filter that begins with `state`, from `initial_state` or `level_state`.

    Raises `ValueError` for the final state of a run: its clones are ordered by age and measured
    from the present anchor, and are not the ring that the next step writes into.
    """
    if state.step > 0:
        problem = f"is one after {int(state.step)} clone intervals of a run"
        raise ValueError(f"state: {problem}; a deployed filter begins with one without clones")
    deployed = _deploy_state(checked_state(state, ekf), ekf, network)
    return {name: np.asarray(value) for name, value in to_arrays(deployed).items()}


def _deploy_state(state: FilterState, ekf: Filter, network: DeployedNetwork) -> DeployedState:
    """A deployed filter before its first sample."""
    state = invariant_errors(state, ekf.config)
    # jax2onnx writes every constant of a program in float64 as float64, so float32 is converted.
    memory = jax.tree.map(
        lambda leaf: jnp.asarray(np.asarray(leaf, float)).astype(leaf.dtype), network.memory
    )
    return DeployedState(state, jnp.zeros((network.samples, 6)), memory)


def _interval(arrays: Arrays) -> Imu:
    return Imu(arrays["gyro"], arrays["accel"], None)


def _read_by_step(arrays: dict[str, Any]) -> dict[str, Any]:
    """The arrays of a state that the filter step takes and gives back."""
    return {name: value for name, value in arrays.items() if not name.startswith(OF_NETWORK)}
