"""The two kinds of networks as the exported programs have them: on windows, and with memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax.apps.onnx.state import STATE, Arrays, DeployedState, name_leaves, next_arrays
from gnio_jax.errors import InputError
from gnio_jax.filtering import Filter, FilterState
from gnio_jax.filtering.displacement import Displacement, scaled_displacement
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.network import interval_samples, network_window, turned_displacement
from gnio_jax.filtering.resampler import ACCEL, GYRO
from gnio_jax.models import Network, predicts_displacement
from gnio_jax.models.memory import advance_frame, advance_interval, express_samples
from gnio_jax.types import Array, Memory, Prediction

OF_NETWORK = STATE + "memory.network."
"""Prefix of the arrays of the state that the network alone reads and changes."""


class DeployedNetwork(NamedTuple):
    """What the four programs have of a network. The samples of an interval are gyro and accel."""

    samples: int
    """Samples before an interval that the state keeps."""
    memory: Memory | None
    """The empty memory."""
    first_inferred: int
    """The first clone interval in which the network runs."""
    inputs: dict[str, jax.ShapeDtypeStruct]
    """Inputs of `infer`."""
    infer: Callable[[Arrays], dict[str, Array]]
    """The network."""
    read_by_window: tuple[str, ...]
    """Arrays of the state that `window` reads."""
    window: Callable[[DeployedState, Imu], Float[Array, "1 n c"]]
    """The network's input, float32, given the state before an interval."""
    remember: Callable[[DeployedState, Imu], Memory | None]
    """The memory after an interval, given the state before it, but for the network's part."""
    measure: Callable[[Arrays, Memory | None, FilterState, Array | int], Displacement]
    """What the filter measures, given the inputs `displacement` and `covariance`, the memory after
    the interval, the filter's state and the slot of the oldest clone."""


def deploy_network(network: Network, ekf: Filter) -> DeployedNetwork:
    """The network of an export. JAX's x64 must be on. Raises `InputError` for one that predicts no
    displacement."""
    model = getattr(network.apply, "model", None)
    if model is not None and not predicts_displacement(model):
        problem = "predicts no displacement, and an exported filter takes nothing else"
        raise InputError("network", problem, "export another network")
    return _with_memory(network, ekf) if network.has_memory else _on_windows(network, ekf)


def _on_windows(network: Network, ekf: Filter) -> DeployedNetwork:
    config = ekf.config

    def infer(arrays: Arrays) -> dict[str, Array]:
        prediction = network.apply(network.variables, arrays["window"])
        return _outputs(prediction.with_quantity(config.measures))

    def window(state: DeployedState, imu: Imu) -> Float[Array, "1 n c"]:
        """`network_window` from the oldest clone of the next step to the end of that step."""
        samples = append_samples(state.samples, imu)
        oldest = (state.filter.step + 1) % config.clones
        return network_window(state.filter, oldest, samples[:, GYRO], samples[:, ACCEL], config)

    def measure(
        arrays: Arrays, memory: None, state: FilterState, oldest: Array | int
    ) -> Displacement:
        prediction = arrays["displacement"], arrays["covariance"]
        return scaled_displacement(*prediction, ekf.noise, config.displacement_frame)

    shape = 1, config.input_samples, config.channels
    return DeployedNetwork(
        samples=config.reach,
        memory=None,
        first_inferred=config.first_measured,
        inputs={"window": jax.ShapeDtypeStruct(shape, jnp.float32)},
        infer=infer,
        read_by_window=("clone_rotation", "gyro_bias", "accel_bias", "step", "samples"),
        window=window,
        remember=lambda state, imu: None,
        measure=measure,
    )


def _with_memory(network: Network, ekf: Filter) -> DeployedNetwork:
    """The memory's frame is the filter's part: it follows the corrections of the attitude. The
    state in it is the network's."""
    apply: Any = network.apply
    variables, constants = network.variables
    empty: Memory = network.predict().begin(jnp.float64)
    leaves, tree = name_leaves(empty.network, OF_NETWORK), jax.tree.structure(empty.network)

    def infer(arrays: Arrays) -> dict[str, Array]:
        state = jax.tree.unflatten(tree, [arrays[name] for name in leaves])
        signals = arrays["window"][0]
        state, prediction = advance_interval(apply.model, variables, state, signals, **constants)
        after = next_arrays(name_leaves(state, OF_NETWORK))
        return _outputs(jax.tree.map(lambda leaf: leaf[None], prediction)) | after

    def window(state: DeployedState, imu: Imu) -> Float[Array, "1 n c"]:
        """The samples of the interval in the memory's frame."""
        assert state.memory is not None
        samples, attitude = interval_samples(state.filter, imu, ekf.config)
        heading = advance_frame(state.memory, attitude).heading
        return express_samples(heading, samples, attitude)[None].astype(jnp.float32)

    def remember(state: DeployedState, imu: Imu) -> Memory:
        assert state.memory is not None
        return advance_frame(state.memory, interval_samples(state.filter, imu, ekf.config)[1])

    def measure(
        arrays: Arrays, memory: Memory, state: FilterState, oldest: Array | int
    ) -> Displacement:
        prediction = arrays["displacement"], arrays["covariance"]
        return turned_displacement(ekf, *prediction, memory.heading, state, oldest)

    rows = jax.ShapeDtypeStruct((1, ekf.config.samples_per_clone, ekf.config.channels), jnp.float32)
    shapes = {name: jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for name, leaf in leaves.items()}
    frame = "memory.heading", "memory.attitude", "memory.intervals"
    return DeployedNetwork(
        samples=0,
        memory=empty,
        first_inferred=0,
        inputs={"window": rows, **shapes},
        infer=infer,
        read_by_window=("rotation", "gyro_bias", "accel_bias", *frame),
        window=window,
        remember=remember,
        measure=measure,
    )


def append_samples(samples: Float[Array, "r 6"], imu: Imu) -> Float[Array, "r 6"]:
    """The samples that a state keeps, shifted by those of a clone interval."""
    latest = jnp.concatenate([imu.gyro, imu.accel], axis=1)
    return jnp.concatenate([samples, latest])[len(latest) :]


def _outputs(prediction: Prediction) -> dict[str, Array]:
    outputs = {"displacement": prediction.displacement, "log_std": prediction.log_std}
    return outputs if prediction.axes is None else {**outputs, "axes": prediction.axes}
