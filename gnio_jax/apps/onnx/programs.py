"""The functions that are exported, over named arrays: network, start, window, filter step.

They combine the package's own functions and compute nothing themselves. A clone interval of a
deployed filter is

    window = filter_window(state, gyro, accel),
    displacement, log_std = network(window),
    state, pose = filter_step(state, gyro, accel, displacement, covariance),

with covariance = diag(exp(2 max(log_std, log_std_min))), turned about z by the angle whose cosine
and sine are the network's output `axes`, if it has one. The window can be cut before the step,
because a step changes neither the attitude of the oldest clone nor the biases before it measures.

Other programs know no NamedTuples: the name of an array of the state is its path in it, e.g.
`state.gate.converged`. The clones are a ring, as in `filtering.scan`: clone step k writes slot
k mod (W + 1).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.errors import InputError
from gnio_jax.filtering import Filter, FilterState, Pose, level_state
from gnio_jax.filtering.checks import checked_state
from gnio_jax.filtering.displacement import scaled_displacement
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.network import network_window
from gnio_jax.filtering.resampler import ACCEL, GYRO
from gnio_jax.filtering.start import REST_SECONDS
from gnio_jax.filtering.state import invariant_errors, state_shapes
from gnio_jax.filtering.tracker import advance_filter
from gnio_jax.models import Network, predicts_displacement
from gnio_jax.types import Array

STATE, NEXT, POSE = "state.", "next.", "pose."
"""Prefixes of the names of arrays of the state, of the state after a step, and of the fields of
`filtering.Pose`."""
_READ_BY_WINDOW = ("clone_rotation", "gyro_bias", "accel_bias", "step", "samples")
_OF_GAPS = ("imu.gyro", "imu.accel", "imu.missing")
"""Settings that bridge holes; the stream of a deployed filter has none."""

Arrays = Mapping[str, Array]


class Program(NamedTuple):
    """A pure function from named arrays to named arrays."""

    name: str
    function: Callable[[Arrays], dict[str, Array]]
    inputs: dict[str, jax.ShapeDtypeStruct]

    @property
    def outputs(self) -> dict[str, jax.ShapeDtypeStruct]:
        """Shapes and types of the function's results."""
        return jax.eval_shape(self.function, self.inputs)


class DeployedState(NamedTuple):
    """The state between two clone steps."""

    filter: FilterState
    """The filter's state, whose clones are a ring."""
    samples: Float[Array, "r 6"]
    """The last `FilterConfig.reach` samples, gyro rad/s and accel m/s², raw; zeros at first."""


def programs(network: Network, ekf: Filter) -> list[Program]:
    """The four programs of a network and its filter. JAX's x64 must be on. The output
    `displacement` of the network is what the filter measures (`FilterConfig.measures`)."""
    config, noise = ekf.config, ekf.noise
    if config.low_pass_seconds:
        problem = "is not undone by an exported filter"
        raise InputError("filter.low_pass_seconds", problem, "set it to 0")
    model = getattr(network.apply, "model", None)
    if model is not None and not predicts_displacement(model):
        problem = "predicts no displacement, and an exported filter takes nothing else"
        raise InputError("network", problem, "export another network")
    samples = jax.ShapeDtypeStruct((config.reach, 6), jnp.float64)
    inside = functools.partial(invariant_errors, config=config)
    shape = DeployedState(jax.eval_shape(inside, state_shapes(config, noise, jnp.float64)), samples)

    def infer(arrays: Arrays) -> dict[str, Array]:
        prediction = network.apply(network.variables, arrays["window"])
        prediction = prediction.with_quantity(config.measures)
        outputs = {"displacement": prediction.displacement, "log_std": prediction.log_std}
        return outputs if prediction.axes is None else {**outputs, "axes": prediction.axes}

    def start(arrays: Arrays) -> dict[str, Array]:
        """`level_state` of a second at rest."""
        state = level_state(ekf, arrays["gyro"], arrays["accel"])
        return _to_arrays(_deploy_state(state, ekf))

    def window(arrays: Arrays) -> dict[str, Array]:
        """`network_window` from the oldest clone of the next step to the end of that step."""
        state = _from_arrays(arrays, shape)
        samples = _append_samples(state.samples, arrays)
        oldest = (state.filter.step + 1) % config.clones
        signals = samples[:, GYRO], samples[:, ACCEL]
        return {"window": network_window(state.filter, oldest, *signals, config)}

    def step(arrays: Arrays) -> dict[str, Array]:
        """`advance_filter` with a given displacement."""
        state = _from_arrays(arrays, shape)
        prediction = arrays["displacement"], arrays["covariance"]
        measurement = scaled_displacement(*prediction, noise, config.displacement_frame)
        filtered, history = advance_filter(
            ekf,
            state.filter,
            Imu(arrays["gyro"], arrays["accel"], None),
            jnp.zeros(n),
            lambda state, oldest: (measurement, {}),
            state.filter.step % config.clones,
        )
        next_arrays = _to_arrays(DeployedState(filtered, _append_samples(state.samples, arrays)))
        next_state = {NEXT + name.removeprefix(STATE): value for name, value in next_arrays.items()}
        fields = (name for name in Pose._fields if name not in ("time", "failure", "quiet"))
        return next_state | {POSE + name: getattr(history, name)[0] for name in fields}

    def float64(*shape: int) -> jax.ShapeDtypeStruct:
        return jax.ShapeDtypeStruct(shape, jnp.float64)

    state, n, rest_samples = (
        _to_arrays(shape),
        config.samples_per_clone,
        round(REST_SECONDS / config.dt),
    )
    read_by_window = {STATE + name: state[STATE + name] for name in _READ_BY_WINDOW}
    interval = {"gyro": float64(n, 3), "accel": float64(n, 3)}
    measured = {"displacement": float64(3), "covariance": float64(3, 3)}
    network_input = jax.ShapeDtypeStruct((1, config.input_samples, config.channels), jnp.float32)
    return [
        Program("network", infer, {"window": network_input}),
        Program(
            "filter_start",
            start,
            {"gyro": float64(rest_samples, 3), "accel": float64(rest_samples, 3)},
        ),
        Program("filter_window", window, read_by_window | interval),
        Program("filter_step", step, state | interval | measured),
    ]


def start_arrays(state: FilterState, ekf: Filter) -> dict[str, np.ndarray]:
    """The arrays of a filter that begins with `state`, from `initial_state` or `level_state`.

    Raises `ValueError` for the final state of a run: its clones are ordered by age and measured
    from the present anchor, and are not the ring that the next step writes into.
    """
    if state.step > 0:
        problem = f"is one after {int(state.step)} clone intervals of a run"
        raise ValueError(f"state: {problem}; a deployed filter begins with one without clones")
    return {
        name: np.asarray(value) for name, value in _to_arrays(_deploy_state(state, ekf)).items()
    }


def _deploy_state(state: FilterState, ekf: Filter) -> DeployedState:
    """A deployed filter before its first sample."""
    state = invariant_errors(checked_state(state, ekf), ekf.config)
    return DeployedState(state, jnp.zeros((ekf.config.reach, 6)))


def _append_samples(samples: Array, arrays: Arrays) -> Array:
    """The stored samples, shifted by those of a clone interval."""
    latest = jnp.concatenate([arrays["gyro"], arrays["accel"]], axis=1)
    return jnp.concatenate([samples, latest])[len(latest) :]


def _to_arrays(state: DeployedState) -> dict[str, Any]:
    """The arrays of a state, or their shapes, by name; only those that have entries and that a step
    reads."""
    unread = {STATE + name for name in _OF_GAPS}
    leaves = _named_leaves(state).items()
    return {name: leaf for name, leaf in leaves if leaf.size > 0 and name not in unread}


def _from_arrays(arrays: Arrays, shape: DeployedState) -> DeployedState:
    """The state of these arrays. Arrays that are left out are zero, because nothing needs them."""
    leaves = [
        arrays[name] if name in arrays else jnp.zeros(leaf.shape, leaf.dtype)
        for name, leaf in _named_leaves(shape).items()
    ]
    return jax.tree.unflatten(jax.tree.structure(shape), leaves)


def _named_leaves(state: DeployedState) -> dict[str, Any]:
    leaves = jax.tree_util.tree_leaves_with_path(state)
    paths = [jax.tree_util.keystr(path, simple=True, separator=".") for path, _ in leaves]
    names = [STATE + path.removeprefix("filter.") for path in paths]
    return {name: leaf for name, (_, leaf) in zip(names, leaves, strict=True)}
