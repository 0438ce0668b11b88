"""AirIMU (Qiu et al., "AirIMU: Learning Uncertainty Propagation for Inertial Odometry", 2023): a
corrector of the IMU, which comes before any network (`model.corrector: airimu`) and before the
filter (`Corrector`). It learns from its preintegration (`preintegration_loss`).
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from jaxtyping import Array, Float, Int

from gnio_jax import geometry
from gnio_jax.errors import InputError
from gnio_jax.models.airio import (
    LOG_VARIANCE_SHIFT,
    STRIDE,
    Decoder,
    StridedEncoder,
    body_axes,
    rotation_vector,
)
from gnio_jax.models.bidirectional import Recurrence
from gnio_jax.models.layers import checked_windows
from gnio_jax.types import GRAVITY, Prediction

ACCEL_UNIT, GYRO_UNIT = 0.1, np.pi / 180
"""A correction is the decoder's output times this, m/s² and rad/s."""
LABEL_STRIDE = 50
"""Samples from one target of the preintegration to the next."""
HUBER = 0.005
"""Size of an error from which its loss grows linearly."""
WEIGHTS = (1e3, 1e1, 1e2)
"""Weights of the rotation (rad), velocity (m/s) and position (m)."""
LIKELIHOOD_WEIGHT = 1e-4
"""Weight of e²/σ² + ln σ²."""
LEAST_VARIANCE = 1e-12
"""Added to the propagated variances in the likelihood (ours): they are zero at the start."""


class Corrections(NamedTuple):
    """The output of a corrector for every sample, in the body."""

    imu: Float[Array, "b n 6"]
    """What is added to [accel m/s², gyro rad/s]."""
    variance: Float[Array, "b n 6"]
    """Variances of the corrected samples, (m/s²)² and (rad/s)²."""


class BlockMemory(NamedTuple):
    """What a corrector carries from one block of samples to the next."""

    states: tuple[Float[Array, "b u"], Float[Array, "b w"]]
    """Outputs of both layers of GRU."""
    block: Int[Array, ""]
    """Number of the next block."""


class AirIMU(nn.Module):
    """Samples [accel, gyro] of the body to their corrections and variances: an encoder of two
    strided convolutions, two layers of GRU forwards in time, four decoders (520,044 parameters).

    An output holds for 9 samples, and the first 9 samples are context only: nothing is added to
    them. Output j sees the samples from 9 j − 12 to 9 j + 12 and, by the GRU, all before them.
    Published: it holds from 9 j − 4 to 9 j + 4, in the middle of these. Ours: from 9 j to 9 j + 8,
    4 samples later (40 ms at 100 Hz, 20 ms at 200 Hz), in training as in use. It is no delay of the
    correction: an output sees its whole block, with 12 samples before it and 4 after it in the
    place of 8 and 8. So all blocks of a stream are alike, and a stream waits for 12 samples in the
    place of 16. Weights that were trained with the published hold would be 4 samples late here.
    Training needs the random stream `dropout`.
    """

    width: int = 64
    dropout: float = 0.1

    def __call__(self, imu: Float[Array, "b n 6"], train: bool = False) -> Corrections:
        return self.advance(imu, None, train)[1]

    def begin(self, batch: int) -> BlockMemory:
        """The memory before the first block."""
        units = 2 * self.width, 4 * self.width
        states = tuple(jnp.zeros((batch, count), jnp.float32) for count in units)
        return BlockMemory(states, jnp.int32(0))

    @nn.compact
    def advance(
        self, imu: Float[Array, "b n 6"], memory: BlockMemory | None, train: bool = False
    ) -> tuple[BlockMemory | None, Corrections]:
        """All corrections of a whole signal, or with a memory those of the next block of 9 samples
        alone: its 25 samples are the 12 before its first sample, that sample, and 12 after it,
        zeros before the start."""
        samples = imu.shape[1]
        output, starts = (None, (None, None)) if memory is None else (memory.block, memory.states)
        encoder = StridedEncoder(self.width, self.dropout, True, name="encoder")
        x = encoder(imu.astype(jnp.float32), train, output)
        states = []
        units = 2 * self.width, 4 * self.width
        for layer, count, start in zip(("gru1", "gru2"), units, starts, strict=True):
            x, state = Recurrence(count, "gru", name=layer)(x, start)
            states.append(state)
        parts = ("accel", "gyro", "accel_log_variance", "gyro_log_variance")
        accel, gyro, *log_variances = (Decoder(2 * self.width, name=name)(x) for name in parts)
        correction = jnp.concatenate([ACCEL_UNIT * accel, jnp.float32(GYRO_UNIT) * gyro], axis=-1)
        variance = jnp.exp(jnp.concatenate(log_variances, axis=-1) - LOG_VARIANCE_SHIFT)
        correction, variance = (
            jnp.repeat(y, STRIDE, axis=1)[:, :samples] for y in (correction, variance)
        )
        first = jnp.int32(0) if memory is None else STRIDE * memory.block
        corrected = (first + jnp.arange(correction.shape[1]))[None, :, None] >= STRIDE
        corrections = Corrections(jnp.where(corrected, correction, 0.0), variance)
        if memory is None:
            return None, corrections
        return BlockMemory((states[0], states[1]), memory.block + 1), corrections


class Corrected(nn.Module):
    """A network after a corrector. The network sees the same windows of 12 channels with corrected
    samples, or only their first six channels.

    The parameters of the network keep their names. The diagnostics have the corrected samples and
    their variances, from which the corrector learns by `preintegration_loss` alone, as published:
    no gradient of the network's losses reaches it. They would make it another encoder, whose
    samples are no longer those of an IMU.
    """

    network: nn.Module
    channels = 12

    def setup(self) -> None:
        nn.share_scope(self, self.network)
        self.corrector = AirIMU()

    def __call__(
        self, windows: Float[Array, "b n 12"], train: bool = False, **constants: Any
    ) -> Prediction:
        windows = checked_windows(windows, self.channels)
        rotation, shape = body_axes(windows), windows.shape
        vectors = windows[..., :6].reshape(*shape[:2], 2, 3)
        body = jnp.einsum("bnij,bnki->bnkj", rotation, vectors).reshape(*shape[:2], 6)
        corrections = self.corrector(body, train)
        body = body + corrections.imu
        vectors = jax.lax.stop_gradient(body).reshape(*shape[:2], 2, 3)
        imu = jnp.einsum("bnij,bnkj->bnki", rotation, vectors)
        imu = imu.reshape(*shape[:2], 6)
        if getattr(self.network, "channels", 6) == 12:
            imu = jnp.concatenate([imu, windows[..., 6:]], axis=-1)
        prediction = self.network(imu, train, **constants)
        corrected = {"corrected": body, "corrected_variance": corrections.variance}
        return prediction._replace(diagnostics={**prediction.diagnostics, **corrected})

    @nn.nowrap
    def constants(self, variables: Any) -> dict[str, Any]:
        """Arguments of `apply` that depend on the variables alone: those of the network."""
        constants = getattr(self.network, "constants", None)
        return constants(variables) if constants else {}


class CorrectedSamples(NamedTuple):
    """Samples of the body after a corrector."""

    accel: Float[np.ndarray, "n 3"]
    """m/s²."""
    gyro: Float[np.ndarray, "n 3"]
    """rad/s."""
    variance: Float[np.ndarray, "n 6"]
    """Variances of [accel, gyro], (m/s²)² and (rad/s)²."""


class Corrector:
    """A trained corrector before the filter and the network, for whole recordings (`correct`) and
    while samples come (`begin`, `step`), at the rate at which it was trained.

    `variables` are those of `AirIMU`.
    """

    block, before, after = STRIDE, 12, 12

    def __init__(self, variables: Any):
        self.variables = variables

    def correct(
        self, accel: Float[np.ndarray, "n 3"], gyro: Float[np.ndarray, "n 3"]
    ) -> CorrectedSamples:
        """The corrected samples of a recording, m/s² and rad/s."""
        imu = jnp.asarray(np.concatenate([accel, gyro], axis=1)[None], jnp.float32)
        corrections = jax.device_get(_correct(self.variables, imu))
        added, variance = (np.asarray(part[0], float) for part in corrections)
        return CorrectedSamples(accel + added[:, :3], gyro + added[:, 3:], variance)

    def begin(self) -> BlockMemory:
        """The memory before the first block."""
        return AirIMU().begin(1)

    def step(
        self, memory: BlockMemory, samples: Float[np.ndarray, "25 6"]
    ) -> tuple[BlockMemory, Float[np.ndarray, "9 6"], Float[np.ndarray, "9 6"]]:
        """The memory after the next block, what is added to its samples, and their variances."""
        imu = jnp.asarray(samples[None], jnp.float32)
        memory, corrections = _correct_block(self.variables, imu, memory)
        added, variance = (np.asarray(part[0], float) for part in corrections)
        return memory, added, variance


_correct = jax.jit(AirIMU().apply)
_correct_block = jax.jit(functools.partial(AirIMU().apply, method="advance"))


# Preintegration
# ------------------------------------------------------------------------------------------------


class Motion(NamedTuple):
    """Motion with the covariance of its error: rotation in the body (R ← R exp φ), velocity,
    position."""

    rotation: Float[Array, "3 3"]
    velocity: Float[Array, "3"]
    position: Float[Array, "3"]
    covariance: Float[Array, "9 9"]


def preintegrate(
    start: Motion, imu: Float[Array, "n 6"], variance: Float[Array, "n 6"], dt: float
) -> Motion:
    """The motion after each of n samples [accel, gyro] of the body, stacked along the first axis.
    Differentiable. The samples' errors are independent."""
    down = jnp.array([0.0, 0.0, -GRAVITY], imu.dtype)
    eye = jnp.eye(3, dtype=imu.dtype)

    def advance(motion: Motion, sample: tuple[Array, Array]) -> tuple[Motion, Motion]:
        rotation, velocity, position, covariance = motion
        (accel, gyro), (accel_variance, gyro_variance) = (jnp.split(part, 2) for part in sample)
        force, turn = rotation @ accel + down, geometry.exp(gyro * dt)
        lever = -rotation @ geometry.hat(accel) * dt
        transition = jnp.block(
            [
                [turn.T, 0 * eye, 0 * eye],
                [lever, eye, 0 * eye],
                [0.5 * dt * lever, dt * eye, eye],
            ]
        )
        by_accel = rotation * jnp.sqrt(accel_variance)[None] * dt
        by_gyro = geometry.right_jacobian(gyro * dt) * jnp.sqrt(gyro_variance)[None] * dt
        noise = jnp.block([[by_gyro, 0 * eye], [0 * eye, by_accel], [0 * eye, 0.5 * dt * by_accel]])
        after = Motion(
            rotation @ turn,
            velocity + force * dt,
            position + velocity * dt + 0.5 * force * dt**2,
            transition @ covariance @ transition.T + noise @ noise.T,
        )
        return after, after

    return jax.lax.scan(advance, start, (imu, variance))[1]


def preintegration_loss(
    prediction: Prediction,
    windows: Float[Array, "b n 12"],
    steps: Float[Array, "b n 3"],
    dt: float,
) -> Float[jax.Array, ""]:
    """AirIMU's loss: Huber's loss of rotation, velocity and position at every 50th sample, and the
    likelihood of these errors with the propagated covariance. The gradient passes through both.

    prediction: that of `Corrected`. windows: with the true attitude; steps: true displacements from
    sample to sample, m. Preintegration begins with the truth after the first 9 samples (ours: the
    velocity there is the mean of both neighbouring steps). Ours: the target of a window that is too
    short for the first of them, e.g. of 50 samples, is its last sample. Raises `InputError` for
    windows without a sample after the first 10.
    """
    truth, samples = body_axes(windows), windows.shape[1]
    if samples < STRIDE + 2:
        problem = f"needs windows of at least {STRIDE + 2} samples, and these have {samples}"
        raise InputError("loss.preintegration_weight", problem, "raise data.window_seconds")
    first = min(STRIDE + LABEL_STRIDE, samples - 1)
    labels = np.arange(first, samples, LABEL_STRIDE)
    corrected, variance = (
        prediction.diagnostics[name] for name in ("corrected", "corrected_variance")
    )
    position = jnp.cumsum(steps, axis=1)  # at sample k + 1
    velocity = 0.5 * (steps[:, 1:] + steps[:, :-1]) / dt  # at sample k + 1

    def of_window(
        truth: Array, velocity: Array, position: Array, imu: Array, variance: Array
    ) -> Array:
        start = Motion(
            truth[STRIDE], velocity[STRIDE - 1], 0 * velocity[0], jnp.zeros((9, 9), imu.dtype)
        )
        path = preintegrate(start, imu[STRIDE:], variance[STRIDE:], dt)
        rows = labels - STRIDE - 1  # the motion after sample k − 1 is that at sample k
        turned = jnp.einsum("kji,kjl->kil", path.rotation[rows], truth[labels])
        errors = (
            rotation_vector(turned),
            velocity[labels - 1] - path.velocity[rows],
            position[labels - 1] - position[STRIDE - 1][None] - path.position[rows],
        )
        spread = jnp.diagonal(path.covariance[rows], axis1=1, axis2=2) + LEAST_VARIANCE
        total = jnp.float32(0)
        for weight, error, part in zip(WEIGHTS, errors, jnp.split(spread, 3, axis=1), strict=True):
            huber = jnp.mean(huber_loss(error, HUBER))
            likelihood = jnp.mean(error**2 / part + jnp.log(part))
            total = total + weight * (huber + LIKELIHOOD_WEIGHT * likelihood)
        return total

    return jnp.mean(jax.vmap(of_window)(truth, velocity, position, corrected, variance))


def huber_loss(error: Float[Array, "*k"], bound: float) -> Float[Array, "*k"]:
    """½ e² up to |e| = bound, then linear with the same slope (PyTorch's huber_loss)."""
    size = jnp.abs(error)
    return jnp.where(size <= bound, 0.5 * error**2, bound * (size - 0.5 * bound))
