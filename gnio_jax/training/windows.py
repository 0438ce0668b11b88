"""Training windows: recordings that are stored once, an index of where windows start, and their
random changes.

Overlapping windows are never copied: a second of IMU belongs to ten windows and is stored once.
`window_source` prepares the recordings on the host. `shift_windows`, `gather`, `low_pass` and
`augment` are called inside the jitted step, and `gnio_jax.windows` defines a window.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from types import MappingProxyType
from typing import NamedTuple, NoReturn

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int, PRNGKeyArray

from gnio_jax import geometry
from gnio_jax.config import AugmentConfig, DataConfig
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations, yaw
from gnio_jax.types import GRAVITY, Array, Sequence, Windows
from gnio_jax.windows import (
    align_recording,
    rotate_channels,
    rotate_vectors,
    true_displacement,
    window_rows,
    window_starts,
    without_any,
)

STRONGEST_ROCKING = 1.25
"""Largest factor of `random_rocking`."""
NO_MOTION = MappingProxyType(
    {"tilt_degrees": 0.0, "rocking_share": 0.0, "vertical_gain": (1.0, 1.0)}
)
"""The random changes that alter the samples and not the motion that they measure, switched off. A
corrector, which learns from this motion, would learn to undo them."""


class WindowSource(NamedTuple):
    """All recordings of a split, end to end, and where windows may start in them. float32."""

    imu: Float[Array, "t c"]
    """[accel m/s², gyro rad/s] and perhaps the body's axes, as in
    `gnio_jax.windows.AlignedRecording`."""
    start: Int[Array, "m"]
    """Row of `imu` at which each window begins, with its context."""
    rotation: Float[Array, "m 3 3"]
    """Rotation from the frame of `imu` to the gravity-aligned frame in which the window's start,
    after the context, has zero yaw."""
    displacement: Float[Array, "m 3"]
    """Target in that frame, m: from the stamp of the first sample after the context to one interval
    after the last (paper eq. 1)."""
    step: Float[Array, "t 3"]
    """Displacement from each sample's stamp to the next in the world, m; NaN where the reference
    has none."""
    unyaw: Float[Array, "m 2"]
    """Cosine and sine of the yaw that `rotation` removes: from the world to the window's frame."""
    stretch: Int[Array, "m 2"]
    """First and last row of the stretch without an invalid sample from which each window is cut."""
    visited: Int[Array, "v"]
    """Numbers of the windows that an epoch visits: all of them, unless they are shifted (see
    `shift_windows`)."""


def window_source(
    sequences: Iterable[Sequence], config: DataConfig, stride: int, shift: int = 0
) -> WindowSource:
    """Cut `sequences` (all at `config.rate`) into windows every `stride` samples.

    With `shift` there is a window at every sample, to which those of an epoch can be shifted. A
    window of C + N samples from i, context included, needs the reference at i … i+C+N, all of it
    valid, and no sample across a gap of the IMU. Attitude and biases come from the reference
    (biases zero). Differences of positions are taken in float64, before they are stored in float32.
    Raises `InputError` if no window fits.
    """
    parts: list[WindowSource] = []
    for sequence in sequences:
        if sequence.waypoints is not None and not sequence.valid.any():
            problem = "has waypoints, no poses"
            raise InputError(sequence.name, problem, "windows need a pose at every sample")
        part = _recording_windows(sequence, config, stride, 1 if shift else stride)
        if part.start.size:
            parts.append(part)
    if not parts:
        refuse_no_window(config)
    return join_windows(parts)


def refuse_no_window(config: DataConfig) -> NoReturn:
    """Raise `InputError` for recordings in which no window fits."""
    length = f"{config.context_seconds + config.window_seconds:g} s"
    raise InputError("data", f"no window of {length} with a valid reference in any sequence")


def usable_starts(sequence: Sequence, config: DataConfig, spacing: int) -> Int[np.ndarray, "m"]:
    """First samples of the windows of a recording, `spacing` samples apart, that have a reference
    and no sample across a gap of the IMU."""
    start = window_starts(len(sequence.time), config.input_samples, spacing)
    start = start[without_any(~sequence.valid, start, config.input_samples + 1)]
    if sequence.imu_valid is not None:
        start = start[without_any(~sequence.imu_valid, start, config.input_samples)]
    return start


def join_windows(sources: list[WindowSource]) -> WindowSource:
    """The recordings of all sources, one source after the other, as host arrays."""
    parts: list[WindowSource] = []
    rows = windows = 0
    for source in sources:
        parts.append(
            source._replace(
                start=source.start + np.int32(rows),
                stretch=source.stretch + np.int32(rows),
                visited=source.visited + np.int32(windows),
            )
        )
        rows += len(source.imu)
        windows += len(source.start)
    return WindowSource(*(np.concatenate(field) for field in zip(*parts, strict=True)))


def _recording_windows(
    sequence: Sequence, config: DataConfig, stride: int, spacing: int
) -> WindowSource:
    """One recording's windows `spacing` samples apart, of which an epoch visits those at `stride`;
    rows and numbers count from 0."""
    start, usable = usable_starts(sequence, config, spacing), sequence.valid
    if sequence.imu_valid is not None:
        usable = usable & sequence.imu_valid
    # Stretches without an invalid sample begin and end where this changes.
    changes = np.flatnonzero(np.diff(usable, prepend=False, append=False)).reshape(-1, 2)
    stretch = changes[np.searchsorted(changes[:, 0], start, "right") - 1] - [0, 1]
    # An invalid row may have NaN. No window and no margin of a window touches it, so its rotation
    # may be arbitrary.
    orientation = np.where(sequence.valid[:, None], sequence.orientation, [1.0, 0.0, 0.0, 0.0])
    attitude, after_context = rotations(orientation).as_matrix(), start + config.context
    imu, rotation = align_recording(
        sequence.accel, sequence.gyro, attitude, after_context, config.window_rotation
    )
    displacement = true_displacement(orientation, sequence.position, after_context, config.window)
    heading = yaw(attitude[after_context])
    return WindowSource(
        imu=imu,
        start=start.astype(np.int32),
        rotation=rotation,
        displacement=displacement.astype(np.float32),
        step=np.diff(sequence.position, axis=0, append=np.nan).astype(np.float32),
        unyaw=np.column_stack([np.cos(heading), np.sin(heading)]).astype(np.float32),
        stretch=stretch.astype(np.int32).reshape(-1, 2),
        visited=np.flatnonzero(start % stride == 0).astype(np.int32),
    )


def gather(
    source: WindowSource, indices: Int[jax.Array, "b"], length: int, margin: int = 0
) -> Windows:
    """Windows number `indices` of `source`, each `length` samples, in their own frames. Jittable.

    `imu` has `margin` more samples on either side, for `low_pass`; where the valid samples end, the
    last one is repeated.
    """
    start = source.start[indices]
    rows = window_rows(start - margin, margin + length + margin)
    first, last = source.stretch[indices].T[:, :, None]
    imu = source.imu[jnp.clip(rows, first, last) if margin else rows]
    cosine, sine = source.unyaw[indices][:, :, None].swapaxes(0, 1)
    # The compiler removes the steps if they are not used.
    x, y, z = jnp.moveaxis(source.step[window_rows(start, length)], -1, 0)
    return Windows(
        imu=rotate_channels(source.rotation[indices], imu),
        displacement=source.displacement[indices],
        steps=jnp.stack([cosine * x + sine * y, cosine * y - sine * x, z], axis=-1),
    )


def shift_windows(
    key: PRNGKeyArray, source: WindowSource, indices: Int[jax.Array, "b"], samples: int
) -> Int[jax.Array, "b"]:
    """Numbers of the windows up to `samples` later or earlier than `indices`.

    A window stays where the recording has none at the drawn distance.
    """
    if samples == 0:
        return indices
    shift = jax.random.randint(key, indices.shape, -samples, samples + 1, jnp.int32)
    candidate = jnp.clip(indices + shift, 0, source.start.shape[0] - 1)
    in_recording = source.start[candidate] - source.start[indices] == shift
    return jnp.where(in_recording, candidate, indices)


def low_pass(key: PRNGKeyArray, windows: Windows, config: AugmentConfig, rate: float) -> Windows:
    """Windows, a random share of them low-passed (`random_low_pass`), without the margins of
    `low_pass_margin`.

    The samples are those of `gather`, already rotated. Attitude changes slowly compared with 4 Hz,
    gravity is not changed, and biases, tilt and yaw may come after the filter.
    """
    margin = low_pass_margin(config, rate)
    if not margin:
        return windows
    return windows._replace(imu=random_low_pass(key, windows.imu, config, rate)[:, margin:-margin])


def random_low_pass(
    key: PRNGKeyArray, imu: Float[jax.Array, "b n c"], config: AugmentConfig, rate: float
) -> Float[jax.Array, "b n c"]:
    """Signals of which a random share is low-passed (ours).

    The network must not recognise a dataset by the spectrum that a phone's filter leaves.
    Accelerometer and gyro pass the same Butterworth filter forward and back,
    |H(f)|² = 1/(1 + (f/f_c)^2n), of order n from 1 to 3 and cut-off f_c uniform in its logarithm,
    drawn anew for every signal. Its phase is zero although a phone's filter is causal: readers
    align the clocks of IMU and reference by their motion, which removes a constant delay, and a
    delay of the IMU alone would shift the IMU relative to the reference. The signal is taken as
    periodic, so it needs a margin on either side.
    """
    count, length, _ = imu.shape
    share_key, order_key, cutoff_key = jax.random.split(key, 3)
    chosen = _uniform(share_key, (count,), 0.0, 1.0) < config.low_pass_share
    order = jax.random.randint(order_key, (count,), 1, 4, jnp.int32)
    low, high = map(math.log, config.low_pass_hertz)
    cutoff = jnp.exp(_uniform(cutoff_key, (count,), low, high))
    frequency = np.fft.rfftfreq(length, 1 / rate).astype(np.float32)
    power = (frequency[None] / cutoff[:, None]) ** (2 * order[:, None])
    spectrum = jnp.fft.rfft(imu[..., :6], axis=1) / (1 + power)[:, :, None]
    smooth = jnp.fft.irfft(spectrum, length, axis=1)
    smooth = jnp.where(chosen[:, None, None], smooth, imu[..., :6])
    return jnp.concatenate([smooth, imu[..., 6:]], axis=-1)


def random_mirror(key: PRNGKeyArray, count: int, share: float) -> Float[jax.Array, "b 3"]:
    """Factors of the three components of a vector in a frame with gravity on z: −1 for x in a
    random share of the signals, otherwise 1.

    The x axis of a window is that of the phone, from its left to its right in portrait. So a phone
    that looks ahead does so in the mirrored walk, too, where it is in the other hand.
    """
    mirrored = _uniform(key, (count,), 0.0, 1.0) < share
    ones = jnp.ones(count, jnp.float32)
    return jnp.stack([jnp.where(mirrored, -1.0, ones), ones, ones], axis=1)


def mirror_channels(
    mirror: Float[jax.Array, "b 3"], imu: Float[jax.Array, "b n c"]
) -> Float[jax.Array, "b n c"]:
    """Signals of a mirrored walk (ours). A specific force changes its sign across the mirror, an
    angular rate along it, because a rate is an axial vector. The mirrored body has its x axis on
    the other side, so that its axes are right-handed again."""
    axial = mirror * mirror[:, :1]
    factors = jnp.concatenate([mirror, axial, axial, mirror], axis=1)  # axial: the x axis, too
    return imu * factors[:, None, : imu.shape[-1]]


def random_rocking(
    key: PRNGKeyArray, imu: Float[jax.Array, "b n c"], share: float
) -> Float[jax.Array, "b n c"]:
    """Signals in a frame with gravity on z, of which a random share is of a phone that rocks
    otherwise in the hand (ours).

    The angular rate about horizontal axes is turned about the vertical by a uniform angle and
    scaled by a uniform factor from 0 to `STRONGEST_ROCKING`. If each sample is rotated with its own
    attitude, this is exact: the specific force in the world is that of the place of the IMU,
    however the phone turns about this place. The body's axes remain as they are. How a hand lets a
    phone nod with each step differs between people, even in its sign, while the relation of the
    accelerations to the direction of travel is that of the gait.
    """
    if not share:
        return imu
    share_key, angle_key, factor_key = jax.random.split(key, 3)
    count = len(imu)
    chosen = _uniform(share_key, (count,), 0.0, 1.0) < share
    angle = _uniform(angle_key, (count,), 0.0, 2 * math.pi)
    factor = _uniform(factor_key, (count,), 0.0, STRONGEST_ROCKING)
    cosine = jnp.where(chosen, factor * jnp.cos(angle), 1.0)[:, None]
    sine = jnp.where(chosen, factor * jnp.sin(angle), 0.0)[:, None]
    x, y = imu[..., 3], imu[..., 4]
    turned = jnp.stack([cosine * x - sine * y, sine * x + cosine * y], axis=-1)
    return jnp.concatenate([imu[..., :3], turned, imu[..., 5:]], axis=-1)


def low_pass_margin(config: AugmentConfig, rate: float) -> int:
    """Number of samples on either side that `random_low_pass` needs: 0.25 s, beyond which
    there are at most 2.4 % of the impulse response (of its absolute values) from 4 Hz on, and 6.6 %
    at 3 Hz. 0 without the filter."""
    return math.ceil(0.25 * rate) if config.low_pass_share else 0


def augment(key: PRNGKeyArray, windows: Windows, config: AugmentConfig) -> Windows:
    """The random changes that `config` (static) switches on, in TLIO's order, each with its own
    key. GNIO's paper does not mention any.

    A share of the windows is of a phone at rest, and each sensor has a scale factor (both ours).
    Each window has a constant bias, uniform in ± its half-width on each axis. It is tilted by up to
    `tilt_degrees` about a random horizontal axis, which is an error of gravity's direction and does
    not change the target. Window and target are turned together by a uniform yaw, because the
    network must not depend on the choice of heading. The axes of the body are hidden in a share of
    the windows (ours). White noise is added last. Everything is float32.
    """
    bias_key, tilt_key, yaw_key, noise_key = jax.random.split(key, 4)
    if config.rest_share:
        windows = _at_rest(jax.random.fold_in(key, 5), windows, config.rest_share)
    imu, count = windows.imu, len(windows.imu)
    imu = random_rocking(jax.random.fold_in(key, 6), imu, config.rocking_share)
    if config.mirror_share:
        mirror = random_mirror(jax.random.fold_in(key, 8), count, config.mirror_share)
        imu = mirror_channels(mirror, imu)
        windows = windows._replace(
            displacement=windows.displacement * mirror, steps=windows.steps * mirror[:, None]
        )
    if config.vertical_gain != (1.0, 1.0):
        imu = _with_bounce(jax.random.fold_in(key, 7), imu, config.vertical_gain)
    if any(config.scale):
        error = _uniform(jax.random.fold_in(key, 4), (count, 1, 2), -1.0, 1.0)
        imu = on_samples(
            imu, lambda x: x * (1 + error.repeat(3, axis=2) * _channels(*config.scale))
        )
    if config.gyro_bias or config.accel_bias:
        offset = _uniform(bias_key, (count, 1, 6), -1.0, 1.0)
        offset = offset * _channels(config.gyro_bias, config.accel_bias)
        imu = on_samples(imu, lambda x: x + offset)
    if config.tilt_degrees:
        heading_key, angle_key = jax.random.split(tilt_key)
        heading = _uniform(heading_key, (count,), 0.0, 2 * math.pi)
        angle = _uniform(angle_key, (count,), 0.0, math.radians(config.tilt_degrees))
        axis = jnp.stack([jnp.cos(heading), jnp.sin(heading), jnp.zeros_like(heading)], axis=1)
        imu = rotate_channels(jax.vmap(geometry.exp)(angle[:, None] * axis), imu)
    windows = windows._replace(imu=imu)
    if config.yaw:
        turn = jax.vmap(geometry.rotation_z)(_uniform(yaw_key, (count,), 0.0, 2 * math.pi))
        windows = Windows(
            rotate_channels(turn, imu),
            rotate_vectors(turn, windows.displacement[:, None, None])[:, 0, 0],
            rotate_vectors(turn, windows.steps[:, :, None])[:, :, 0],
        )
    if config.hidden_axes_share:
        hide_key, share = jax.random.fold_in(key, 9), config.hidden_axes_share
        windows = windows._replace(imu=hide_axes(hide_key, windows.imu, share))
    if any(config.noise):
        noise = jax.random.normal(noise_key, (*imu.shape[:2], 6), jnp.float32)
        noise = noise * _channels(*config.noise)
        windows = windows._replace(imu=on_samples(windows.imu, lambda x: x + noise))
    return windows


def _with_bounce(
    key: PRNGKeyArray, imu: Float[jax.Array, "b n c"], bounds: tuple[float, float]
) -> Float[jax.Array, "b n c"]:
    """The windows, with the vertical acceleration about its mean times a factor, which is uniform
    in its logarithm.

    The displacement remains. A height h(t) is the sum of a part with constant acceleration, which
    is the mean, and an alternating part, whose velocity may be chosen so that it has the same value
    at both ends of the window. The factor multiplies the second part.
    """
    low, high = map(math.log, bounds)
    factor = jnp.exp(_uniform(key, (len(imu), 1), low, high))
    vertical = imu[..., 2]
    mean = jnp.mean(vertical, axis=1, keepdims=True)
    return imu.at[..., 2].set(mean + factor * (vertical - mean))


def _at_rest(key: PRNGKeyArray, windows: Windows, share: float) -> Windows:
    """The windows, with a random share of them replaced by those of a phone at rest."""
    lies = jax.random.bernoulli(key, jnp.float32(share), (len(windows.imu), 1, 1))
    return Windows(
        jnp.where(lies, signals_at_rest(windows.imu), windows.imu),
        jnp.where(lies[:, 0], 0, windows.displacement),
        jnp.where(lies, 0, windows.steps),
    )


def hide_axes(
    key: PRNGKeyArray, imu: Float[jax.Array, "b n 12"], share: float
) -> Float[jax.Array, "b n 12"]:
    """Signals of which a random share has zeros in the place of the body's axes."""
    hidden = jax.random.bernoulli(key, jnp.float32(share), (len(imu), 1, 1))
    return jnp.concatenate([imu[..., :6], jnp.where(hidden, 0, imu[..., 6:])], axis=-1)


def signals_at_rest(imu: Float[jax.Array, "b n c"]) -> Float[jax.Array, "b n c"]:
    """Signals of a phone that lies still, in the attitude that it had at the first sample, and
    measures only gravity."""
    still = jnp.broadcast_to(imu[:, :1], imu.shape)
    return on_samples(still, lambda _: jnp.zeros_like(imu[..., :6]).at[..., 2].set(GRAVITY))


def on_samples(
    imu: Float[jax.Array, "b n c"], change: Callable[[jax.Array], jax.Array]
) -> Float[jax.Array, "b n c"]:
    """The windows with [accel, gyro] changed, and the body's axes as they are."""
    return jnp.concatenate([change(imu[..., :6]), imu[..., 6:]], axis=-1)


def _channels(gyro: float, accel: float) -> Float[jax.Array, "1 1 6"]:
    """One number for each sensor's three channels."""
    return jnp.array([[[accel] * 3 + [gyro] * 3]], jnp.float32)


def _uniform(key: PRNGKeyArray, shape: tuple[int, ...], low: float, high: float) -> jax.Array:
    # Plain numbers as limits would be float64 inside if x64 is switched on.
    return jax.random.uniform(key, shape, jnp.float32, jnp.float32(low), jnp.float32(high))
