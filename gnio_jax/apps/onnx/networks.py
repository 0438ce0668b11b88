"""The two kinds of networks as the exported programs have them: on windows, and with memory."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax.apps.onnx.state import STATE, Arrays, DeployedState, next_arrays, to_arrays
from gnio_jax.filtering import Filter, FilterState
from gnio_jax.filtering.displacement import Displacement, scaled_displacement
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.network import interval_samples, network_window, turned_displacement
from gnio_jax.filtering.resampler import ACCEL, GYRO
from gnio_jax.models import Network
from gnio_jax.models.memory import advance_interval, express_samples
from gnio_jax.types import Array, Memory, Prediction

OF_NETWORK = STATE + "memory.network"
"""Arrays of the state that the network alone reads and changes."""


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
    measure: Callable[
        [DeployedState, Imu, Arrays], Callable[[FilterState, Array | int], Displacement]
    ]
    """What the filter measures, as a function of its state and of the slot of the oldest clone,
    given the state before an interval and the inputs `displacement` and `covariance`."""
    remember: Callable[[DeployedState, Imu], Memory | None]
    """The memory after an interval, given the state before it."""


def deploy_network(network: Network, ekf: Filter) -> DeployedNetwork:
    """The network of an export. JAX's x64 must be on."""
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
        state: DeployedState, imu: Imu, arrays: Arrays
    ) -> Callable[[FilterState, Array | int], Displacement]:
        prediction = arrays["displacement"], arrays["covariance"]
        measured = scaled_displacement(*prediction, ekf.noise, config.displacement_frame)
        return lambda state, oldest: measured

    shape = 1, config.input_samples, config.channels
    return DeployedNetwork(
        samples=config.reach,
        memory=None,
        first_inferred=config.first_measured,
        inputs={"window": jax.ShapeDtypeStruct(shape, jnp.float32)},
        infer=infer,
        read_by_window=("clone_rotation", "gyro_bias", "accel_bias", "step", "samples"),
        window=window,
        measure=measure,
        remember=lambda state, imu: None,
    )


def _with_memory(network: Network, ekf: Filter) -> DeployedNetwork:
    """The memory's frame is the filter's part: it follows the corrections of the attitude. The
    state in it is the network's."""
    apply: Any = network.apply
    variables, constants = network.variables
    empty: Memory = network.predict().begin(jnp.float64)
    leaves, tree = jax.tree.flatten(empty.network)
    nothing = DeployedState(None, jnp.zeros((0, 6)), empty)  # type: ignore[arg-type]
    names = [name for name in to_arrays(nothing) if name.startswith(OF_NETWORK)]

    def infer(arrays: Arrays) -> dict[str, Array]:
        state = jax.tree.unflatten(tree, [arrays[name] for name in names])
        signals = arrays["window"][0]
        state, prediction = advance_interval(apply.model, variables, state, signals, **constants)
        after = next_arrays(dict(zip(names, jax.tree.leaves(state), strict=True)))
        return _outputs(jax.tree.map(lambda leaf: leaf[None], prediction)) | after

    def express(state: DeployedState, imu: Imu) -> tuple[Array, Array, Array]:
        """Signals and heading of the memory's frame, and the attitude at the end."""
        assert state.memory is not None
        samples, attitude = interval_samples(state.filter, imu, ekf.config)
        return *express_samples(state.memory, samples, attitude), attitude[:, :, -1]

    def measure(
        before: DeployedState, imu: Imu, arrays: Arrays
    ) -> Callable[[FilterState, Array | int], Displacement]:
        _, heading, _ = express(before, imu)
        predicted = arrays["displacement"], arrays["covariance"], heading
        return lambda state, oldest: turned_displacement(ekf, *predicted, state, oldest)

    def remember(state: DeployedState, imu: Imu) -> Memory:
        assert state.memory is not None
        _, heading, attitude = express(state, imu)
        return Memory(state.memory.network, heading, attitude, state.memory.intervals + 1)

    window = jax.ShapeDtypeStruct((1, ekf.config.samples_per_clone, 6), jnp.float32)
    shapes = [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves]
    frame = "memory.heading", "memory.attitude", "memory.intervals"
    return DeployedNetwork(
        samples=0,
        memory=empty,
        first_inferred=0,
        inputs={"window": window, **dict(zip(names, shapes, strict=True))},
        infer=infer,
        read_by_window=("rotation", "gyro_bias", "accel_bias", *frame),
        window=lambda state, imu: express(state, imu)[0][None].astype(jnp.float32),
        measure=measure,
        remember=remember,
    )


def append_samples(samples: Float[Array, "r 6"], imu: Imu) -> Float[Array, "r 6"]:
    """The samples that a state keeps, shifted by those of a clone interval."""
    latest = jnp.concatenate([imu.gyro, imu.accel], axis=1)
    return jnp.concatenate([samples, latest])[len(latest) :]


def _outputs(prediction: Prediction) -> dict[str, Array]:
    outputs = {"displacement": prediction.displacement, "log_std": prediction.log_std}
    return outputs if prediction.axes is None else {**outputs, "axes": prediction.axes}
