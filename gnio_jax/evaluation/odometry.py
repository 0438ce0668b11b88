"""From recordings to trajectories: the network with an estimator around it, batched over sequences.

`ekf` filters (`tight`: the network inside the filter, its windows cut with the filter's own state;
`loose`: the network over all windows first, with a given orientation); `integrate` sums
displacements, as RoNIN-type baselines do; `imu_only` integrates the IMU alone. The filter runs in
float64 (JAX's x64 must be on), the network in float32.

A trajectory has a row at the start and one at the end of every stride (clone interval): row k is at
sample k·n after the start, which is the first sample with a trusted reference.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Iterable
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.config import DataConfig, FilterOptions
from gnio_jax.data.windows import WindowSource, gather
from gnio_jax.evaluation.metrics import Trajectory, finite_rows, rotation_z
from gnio_jax.filtering import (
    FilterConfig,
    FilterHistory,
    InitialStd,
    NoiseModel,
    initial_state,
    level_state,
    over_sequences,
    run_filter,
    run_odometry,
)
from gnio_jax.numerics import cumulative_rotation
from gnio_jax.types import Array, InputError, Prediction, Sequence

Estimator = Literal["ekf", "integrate", "imu_only"]
Orientation = Literal["filter", "device", "reference"]
Progress = Callable[[float], None]
"""Told the share of the work that is done, from 0 to 1."""

PERFECT_STD = 0.01
"""Standard deviation given to the filter with true displacements, m per axis, before
`measurement_scale`."""
REST_GYRO_STD = 0.01
"""Largest standard deviation of each gyro axis at rest, rad/s: a phone on a table, not in a hand.
"""
REST_ACCEL_STD = 0.1
"""Largest standard deviation of each accelerometer axis at rest, m/s²."""
REST_SECONDS = 1.0
"""Shortest rest from which a bias is taken, s."""
REFERENCE_BIAS_SECONDS = 10.0
"""How long `gyro_bias="reference"` looks at the reference, s."""

_WINDOWS_AT_ONCE = 512
_KEPT = ("gate", "scale")


class Setup(NamedTuple):
    """How a trajectory is estimated; everything that changes what a result means."""

    estimator: Estimator = "ekf"
    coupling: Literal["tight", "loose"] = "tight"
    """Of the ekf."""
    orientation: Orientation | None = None
    """Whose attitude rotates the network's windows; None: the filter's where it is in the loop,
    else the reference's."""
    init: Literal["reference", "static"] = "reference"
    """Start from the reference's pose and velocity, or from the gravity of the first second, yaw,
    velocity and position zero."""
    gyro_bias: Literal["zero", "rest", "reference"] = "zero"
    """First estimate of the gyro bias: none, the mean of a rest at the start, or the first 10 s
    against the reference."""


DEFAULT_SETUP = Setup()


class Network(NamedTuple):
    """A network with its parameters."""

    apply: Callable[[Any, Any], Prediction]
    """(variables, windows (b, N, 6) float32) -> `Prediction`; hashable, as a Flax module's `apply`
    is."""
    variables: Any


class Recording(NamedTuple):
    """A sequence ready for an estimator: at the network's rate, cut to whole strides from its
    start."""

    sequence: Sequence
    """K·n + 1 samples: K strides and the stamp at the end of the last."""
    rotation: Float[np.ndarray, "3 3"]
    """Start, body→world."""
    velocity: Float[np.ndarray, "3"]
    """Start, m/s."""
    position: Float[np.ndarray, "3"]
    """Start, m."""
    gyro_bias: Float[np.ndarray, "3"]
    """First estimate, rad/s."""
    notes: tuple[str, ...]
    """What a reader of the result should know."""
    start_std: tuple[float, float] | None = None
    """Of the start's tilt, rad, and velocity, m/s, where it was made without a reference; None: the
    filter's options say."""


class Estimate(NamedTuple):
    """A trajectory with what the estimator knows beside it: K + 1 rows for K strides, a measurement
    in the row where its window ends."""

    name: str
    trajectory: Trajectory
    """NaN from where the filter was no longer healthy (`FilterHistory.healthy`): it has diverged.
    """
    reference: Trajectory
    """At the same rows, NaN where it cannot be trusted."""
    displacement: Float[np.ndarray, "k 3"] | None = None
    """Of the window, m, in the yaw frame of its start; NaN where none."""
    displacement_std: Float[np.ndarray, "k 3"] | None = None
    """As the filter uses it, or as the network says it where there is no filter, m."""
    diagnostics: dict[str, Float[np.ndarray, "k 3"]] = {}
    """The network's `gate` and `scale`, where it has them; NaN where it had no window."""
    velocity: Float[np.ndarray, "k 3"] | None = None
    """m/s."""
    gyro_bias: Float[np.ndarray, "k 3"] | None = None
    """rad/s."""
    accel_bias: Float[np.ndarray, "k 3"] | None = None
    """m/s²."""
    std: Float[np.ndarray, "k 15"] | None = None
    """Of the filter's error in θ, v, p, b_g, b_a."""
    position_covariance: Float[np.ndarray, "k 3 3"] | None = None
    """m²."""
    accepted: Float[np.ndarray, "k"] | None = None
    """1 the measurement was used, 0 it was rejected, NaN there was none."""
    nis: Float[np.ndarray, "k"] | None = None
    """Normalised innovation squared; NaN where no measurement."""
    notes: tuple[str, ...] = ()


def resolve(setup: Setup) -> Setup:
    """`setup` with its orientation filled in. Raises `InputError` for an orientation that the
    estimator cannot use."""
    inside = setup.estimator == "imu_only" or (
        setup.estimator == "ekf" and setup.coupling == "tight"
    )
    if inside and setup.orientation not in (None, "filter"):
        what = "the tight coupling" if setup.estimator == "ekf" else "imu_only"
        raise InputError(
            f"--orientation {setup.orientation}",
            f"{what} uses the filter's own attitude",
            "leave it out, or choose --coupling loose or --estimator integrate",
        )
    return setup._replace(orientation=setup.orientation or ("filter" if inside else "reference"))


def filter_config(config: DataConfig, options: FilterOptions) -> FilterConfig:
    """The filter for windows and strides of `config`."""
    return FilterConfig(
        dt=1.0 / config.rate,
        samples_per_clone=config.stride,
        clones_per_window=config.window // config.stride,
        mahalanobis_fail_scale=options.mahalanobis_fail_scale,
        measurement_scale=options.measurement_scale,
        history="core",
        window_rotation=options.window_rotation or config.window_rotation,
    )


def prepare(
    sequences: Iterable[Sequence], config: DataConfig, setup: Setup = DEFAULT_SETUP
) -> tuple[list[Recording], dict[str, str]]:
    """Recordings to estimate, and the names of those left out with the reason (shorter than a
    window and a stride).

    Raises `InputError` if `setup` needs a reference, a device orientation or more data where a
    sequence has none.
    """
    setup = resolve(setup)
    recordings, left_out = [], {}
    for sequence in sequences:
        sequence = data.resample(sequence, config.rate)
        trusted = (
            sequence.valid & finite_rows(sequence.position) & finite_rows(sequence.orientation)
        )
        if not trusted.any() and (setup.init == "reference" or setup.gyro_bias == "reference"):
            wanted = "--init static" if setup.init == "reference" else "--gyro-bias zero"
            raise InputError(sequence.name, "has no reference to start from", f"give {wanted}")
        if setup.orientation == "reference" and not trusted.any():
            raise InputError(
                sequence.name, "has no reference orientation", "give --orientation filter or device"
            )
        if setup.orientation == "device" and sequence.device_orientation is None:
            raise InputError(
                sequence.name, "has no device orientation", "give --orientation filter or reference"
            )
        first = int(np.argmax(trusted)) if trusted.any() else 0
        strides = (len(sequence.time) - 1 - first) // config.stride
        if strides <= config.window // config.stride:
            seconds = max(0, len(sequence.time) - first) / config.rate
            left_out[sequence.name] = (
                f"{seconds:.2f} s from its first trusted sample on, too short for a window and a stride"
            )
            continue
        rows = slice(first, first + strides * config.stride + 1)
        uncut = sequence._replace(valid=trusted)
        cut = uncut._replace(
            **{
                name: value[rows]
                for name, value in uncut._asdict().items()
                if isinstance(value, np.ndarray)
            }
        )
        bias, notes = _gyro_bias(cut, config.rate, setup.gyro_bias)
        start_std = None
        if setup.init == "reference":
            rotation = Rotation.from_quat(cut.orientation[0], scalar_first=True).as_matrix()
            velocity = cut.velocity[0] if np.isfinite(cut.velocity[0]).all() else np.zeros(3)
            position = cut.position[0]
        else:
            second = slice(round(config.rate))
            spread = cut.accel[second].std(0).max()
            if spread > 0.5:
                notes = (
                    *notes,
                    f"start: not standing still (accel varies by {spread:.1f} m/s²), so its tilt is rough",
                )
            level = level_state(
                filter_config(config, FilterOptions()), cut.gyro[second], cut.accel[second]
            )
            rotation, velocity, position = np.asarray(level.rotation), np.zeros(3), np.zeros(3)
            variance = np.diag(level.core_covariance)
            start_std = float(np.sqrt(variance[0])), float(np.sqrt(variance[3]))
        recordings.append(Recording(cut, rotation, velocity, position, bias, notes, start_std))
    return recordings, left_out


def estimate(
    recordings: list[Recording],
    network: Network | None,
    config: DataConfig,
    options: FilterOptions,
    setup: Setup = DEFAULT_SETUP,
    batch_size: int = 16,
    progress: Progress | None = None,
) -> list[Estimate]:
    """Trajectories of the recordings, `batch_size` of them side by side.

    `network` may be None for `imu_only`. A run of the same recordings in other batches gives the
    same trajectories to rounding.
    """
    setup = resolve(setup)
    if setup.estimator == "imu_only":
        nothing = np.zeros((0, 3))
        return _filtered(
            recordings,
            config,
            options,
            batch_size,
            progress,
            measurements=[_measurements(r, nothing, nothing, config) for r in recordings],
        )
    if network is None:
        raise ValueError(f"estimator '{setup.estimator}' needs a network")
    if setup.estimator == "ekf" and setup.coupling == "tight":
        return _filtered(recordings, config, options, batch_size, progress, network=network)
    attitudes = [attitude(r, config, setup.orientation or "reference") for r in recordings]
    predictions = predict_windows(
        network, recordings, attitudes, config, progress if setup.estimator == "integrate" else None
    )
    if setup.estimator == "integrate":
        return [
            _integrated(*of_one, config)
            for of_one in zip(recordings, attitudes, predictions, strict=True)
        ]
    lowest = filter_config(config, options).log_std_min
    measurements = [
        _measurements(r, p.displacement, np.exp(np.maximum(p.log_std, lowest)), config)
        for r, p in zip(recordings, predictions, strict=True)
    ]
    estimates = _filtered(
        recordings, config, options, batch_size, progress, measurements=measurements
    )
    return [
        e._replace(
            diagnostics={
                key: _at_window_end(value, len(e.trajectory.time))
                for key, value in p.diagnostics.items()
            }
        )
        for e, p in zip(estimates, predictions, strict=True)
    ]


def perfect_displacements(
    recordings: list[Recording],
    config: DataConfig,
    options: FilterOptions,
    setup: Setup = DEFAULT_SETUP,
    batch_size: int = 16,
    progress: Progress | None = None,
) -> list[Estimate]:
    """The same estimator fed with the reference's displacements: the error that no network can take
    away.

    The filter (also in the place of `imu_only`) is told a standard deviation of 1 cm per axis.
    """
    setup = resolve(setup)
    truths = [true_displacements(r, config) for r in recordings]
    if setup.estimator == "integrate":
        return [
            _integrated(
                r,
                attitude(r, config, setup.orientation or "reference"),
                Prediction(d, np.zeros_like(d)),
                config,
            )
            for r, d in zip(recordings, truths, strict=True)
        ]
    measurements = [
        _measurements(r, d, np.full_like(d, PERFECT_STD), config)
        for r, d in zip(recordings, truths, strict=True)
    ]
    return _filtered(recordings, config, options, batch_size, progress, measurements=measurements)


def never_moves(estimates: list[Estimate]) -> list[Estimate]:
    """The start pose throughout: what an estimator must beat, above all in a small room."""
    still = []
    for e in estimates:
        path = Trajectory(
            e.trajectory.time, *(np.repeat(field[:1], len(field), 0) for field in e.trajectory[1:])
        )
        still.append(Estimate(e.name, path, e.reference))
    return still


def true_displacements(recording: Recording, config: DataConfig) -> Float[np.ndarray, "m 3"]:
    """Reference displacement of every window, m, in the yaw frame of the reference at its start;
    NaN where it cannot be trusted."""
    sequence, n, length = recording.sequence, config.stride, config.window
    start = np.arange(0, len(sequence.time) - length, n)
    moved = sequence.position[start + length] - sequence.position[start]
    good = np.asarray(sequence.valid[start] & sequence.valid[start + length])
    result = np.full_like(moved, np.nan)
    turn = (
        Rotation.from_quat(sequence.orientation[start[good]], scalar_first=True).as_matrix()
        if good.any()
        else np.zeros((0, 3, 3))
    )
    result[good] = np.einsum("mji,mj->mi", _yaw_rotation(turn), moved[good])
    return result


def attitude(
    recording: Recording, config: DataConfig, source: Orientation
) -> Float[np.ndarray, "t 3 3"]:
    """Body→world at every sample: the gyro integrated from the start (`filter`), the reference, or
    the device's own estimate turned about z to the start's yaw. Where the latter two are missing,
    the gyro carries on from the last known attitude."""
    sequence = recording.sequence
    turned = cumulative_rotation(
        Rotation.from_rotvec((sequence.gyro[:-1] - recording.gyro_bias) / config.rate)
    ).as_matrix()
    integrated = recording.rotation @ turned
    if source == "filter":
        return integrated
    given = sequence.orientation if source == "reference" else sequence.device_orientation
    assert given is not None  # `prepare` has seen to it
    known = finite_rows(given) & (sequence.valid if source == "reference" else True)
    if not known[0]:
        raise InputError(
            sequence.name, f"has no {source} orientation at its start", "give --orientation filter"
        )
    matrices = Rotation.from_quat(
        np.where(known[:, None], given, [1.0, 0, 0, 0]), scalar_first=True
    ).as_matrix()
    if source == "device":
        start = _yaw_rotation(np.stack([recording.rotation, matrices[0]]))
        matrices = start[0] @ start[1].T @ matrices
    last = np.maximum.accumulate(np.where(known, np.arange(len(known)), 0))
    bridged = matrices[last] @ np.einsum("tji,tjk->tik", integrated[last], integrated)
    return np.where(known[:, None, None], matrices, bridged)


def predict_windows(
    network: Network,
    recordings: list[Recording],
    attitudes: list[Float[np.ndarray, "_ 3 3"]],
    config: DataConfig,
    progress: Progress | None = None,
    keep: tuple[str, ...] = _KEPT,
) -> list[Prediction]:
    """What the network says of every window of the recordings, cut with the given attitudes, in
    large batches over all of them.

    Of its diagnostics only those named in `keep`, if it has them."""
    parts, counts, offset = [], [], 0
    for recording, rotation in zip(recordings, attitudes, strict=True):
        sequence = recording.sequence
        imu = np.stack([sequence.accel, sequence.gyro - recording.gyro_bias], 1)
        start = np.arange(0, len(sequence.time) - config.window, config.stride)
        level = np.swapaxes(_yaw_rotation(rotation[start]), 1, 2)
        if config.window_rotation == "per_sample":
            imu = np.einsum("tij,tkj->tki", rotation, imu)
        else:
            level = level @ rotation[start]
        parts.append(
            (
                imu.reshape(-1, 6).astype(np.float32),
                (start + offset).astype(np.int32),
                level.astype(np.float32),
            )
        )
        counts.append(len(start))
        offset += len(imu)
    imu, start, level = (jnp.asarray(np.concatenate(part)) for part in zip(*parts, strict=True))
    nothing = jnp.zeros((len(start), 3), jnp.float32)  # no targets here
    source = WindowSource(
        imu, start, level, nothing, jnp.zeros_like(imu[:, :3]), nothing[:, :2], start
    )
    total, size, found = len(start), min(_WINDOWS_AT_ONCE, len(start)), []
    for begin in range(0, total, size):
        which = np.minimum(np.arange(begin, begin + size), total - 1).astype(
            np.int32
        )  # the last batch is filled up: one compilation
        found.append(
            jax.device_get(
                _predict(network.apply, network.variables, source, which, config.window, keep)
            )
        )
        if progress:
            progress(min(1.0, (begin + size) / total))
    whole = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:total].astype(np.float64), *found)
    ends = np.cumsum(counts)
    return [
        jax.tree.map(lambda leaf, a=end - count, b=end: leaf[a:b], whole)
        for end, count in zip(ends, counts, strict=True)
    ]


# The filter
# -----------------------------------------------------------------------------------------------------------


class _Start(NamedTuple):
    rotation: Any
    velocity: Any
    position: Any
    gyro_bias: Any
    std: InitialStd


def _start(recording: Recording, options: FilterOptions) -> _Start:
    tilt, velocity = recording.start_std or (
        math.radians(options.tilt_std_degrees),
        options.velocity_std,
    )
    std = InitialStd(
        tilt,
        math.radians(options.yaw_std_degrees),
        velocity,
        options.position_std,
        options.gyro_bias_std,
        options.accel_bias_std,
    )
    return _Start(
        recording.rotation, recording.velocity, recording.position, recording.gyro_bias, std
    )


@functools.partial(jax.jit, static_argnames=("apply", "length", "keep"))
def _predict(
    apply: Callable,
    variables: Any,
    source: WindowSource,
    which: Any,
    length: int,
    keep: tuple[str, ...],
) -> Prediction:
    return _lean(apply(variables, gather(source, which, length).imu), keep)


@functools.partial(jax.jit, static_argnames=("apply", "config"))
def _run_tight(
    apply: Callable,
    variables: Any,
    start: _Start,
    gyro: Any,
    accel: Any,
    config: FilterConfig,
    noise: NoiseModel,
) -> FilterHistory:
    def one(start: _Start, gyro: Any, accel: Any) -> FilterHistory:
        state = initial_state(config, **start._asdict())
        return _lean_history(
            run_odometry(
                lambda windows: _lean(apply(variables, windows)), state, gyro, accel, config, noise
            )[1]
        )

    return over_sequences(one)(start, gyro, accel)


@functools.partial(jax.jit, static_argnames="config")
def _run_given(
    start: _Start,
    gyro: Any,
    accel: Any,
    displacement: Any,
    std_of_it: Any,
    config: FilterConfig,
    noise: NoiseModel,
) -> FilterHistory:
    def one(
        start: _Start, gyro: Any, accel: Any, displacement: Any, std_of_it: Any
    ) -> FilterHistory:
        covariance = jax.vmap(jnp.diag)(std_of_it**2)
        return _lean_history(
            run_filter(
                initial_state(config, **start._asdict()),
                gyro,
                accel,
                displacement,
                covariance,
                config,
                noise,
            )[1]
        )

    return over_sequences(one)(start, gyro, accel, displacement, std_of_it)


def _lean(prediction: Prediction, keep: tuple[str, ...] = _KEPT) -> Prediction:
    """With these diagnostics only: attention and the like are too large to keep for every window."""
    return prediction._replace(
        diagnostics={key: value for key, value in prediction.diagnostics.items() if key in keep}
    )


def _lean_history(history: FilterHistory) -> FilterHistory:
    assert history.covariance is not None
    return history._replace(covariance=history.covariance[:, 6:9, 6:9])


def _filtered(
    recordings: list[Recording],
    config: DataConfig,
    options: FilterOptions,
    batch_size: int,
    progress: Progress | None,
    network: Network | None = None,
    measurements: list[tuple] | None = None,
) -> list[Estimate]:
    """Run the filter with the network in the loop, or with measurements (displacement (K, 3), std
    (K, 3)) per recording."""
    n, compiled = config.stride, filter_config(config, options)
    noise = NoiseModel(
        options.gyro_density, options.accel_density, options.gyro_bias_walk, options.accel_bias_walk
    )
    strides = [(len(r.sequence.time) - 1) // n for r in recordings]
    order = sorted(
        range(len(recordings)), key=lambda i: -strides[i]
    )  # alike lengths together: little padding
    batches = -(-len(order) // batch_size)
    size = -(-len(order) // max(1, batches))
    results: dict[int, Estimate] = {}
    longest, done = max(strides, default=0), 0
    for begin in range(0, len(order), size):
        members = order[begin : begin + size]
        members = members + members[-1:] * (size - len(members))
        # Few distinct lengths, so few compilations: each is at most a quarter longer than it need
        # be.
        while 0.8 * longest >= strides[members[0]] and longest > 16:
            longest = math.ceil(0.8 * longest)
        start = jax.tree.map(
            lambda *leaves: np.stack(leaves), *(_start(recordings[i], options) for i in members)
        )
        gyro = np.stack(
            [_extended(recordings[i].sequence.gyro[:-1], longest * n, 0.0) for i in members]
        )
        accel = np.stack(
            [_extended(recordings[i].sequence.accel[:-1], longest * n, None) for i in members]
        )
        if network is not None:
            history = _run_tight(
                network.apply, network.variables, start, gyro, accel, compiled, noise
            )
        else:
            assert measurements is not None
            given = [
                np.stack([_extended(measurements[i][part], longest, np.nan) for i in members])
                for part in (0, 1)
            ]
            history = _run_given(start, gyro, accel, *given, compiled, noise)
        history = jax.device_get(history)
        for place, i in enumerate(members):
            if i not in results:
                results[i] = _from_filter(
                    recordings[i],
                    jax.tree.map(lambda x, p=place, k=strides[i]: x[p, :k], history),
                    options,
                    n,
                )
                done += strides[i]
        if progress:
            progress(done / sum(strides))
    return [results[i] for i in range(len(recordings))]


def _from_filter(
    recording: Recording, history: FilterHistory, options: FilterOptions, n: int
) -> Estimate:
    def rows(first: Any, rest: Any) -> np.ndarray:
        return np.concatenate(
            [np.broadcast_to(np.asarray(first, float), rest.shape[1:])[None], rest]
        )

    std = np.repeat(np.array(_start(recording, options).std), [2, 1, 3, 3, 3, 3])
    time, notes = recording.sequence.time[::n], recording.notes
    healthy = rows(1.0, history.healthy) > 0
    if not healthy.all():
        since = time[np.argmin(healthy)] - time[0]
        notes = (*notes, f"filter: not healthy from {since:.1f} s on, and all after it is void")
    position = rows(recording.position, history.position)
    orientation = _quaternions(rows(recording.rotation, history.rotation))
    poses = (np.where(healthy[:, None], part, np.nan) for part in (position, orientation))
    assert history.covariance is not None
    return Estimate(
        recording.sequence.name,
        Trajectory(time, *poses),
        _reference(recording, n),
        displacement=rows(np.nan, history.displacement),
        displacement_std=rows(np.nan, history.measurement_std),
        diagnostics={key: rows(np.nan, value) for key, value in history.diagnostics.items()},
        velocity=rows(recording.velocity, history.velocity),
        gyro_bias=rows(recording.gyro_bias, history.gyro_bias),
        accel_bias=rows(0.0, history.accel_bias),
        std=rows(std, np.sqrt(np.maximum(history.covariance_diagonal, 0.0))),
        position_covariance=rows(np.eye(3) * options.position_std**2, history.covariance),
        accepted=rows(np.nan, history.accepted),
        nis=rows(np.nan, history.nis),
        notes=notes,
    )


def _measurements(
    recording: Recording,
    displacement: Float[Array, "m 3"],
    std: Float[Array, "m 3"],
    config: DataConfig,
) -> tuple:
    """Of all windows, as `run_filter` takes them, a row per stride. It has no clone at its start,
    so the first window is of no use."""
    strides = (len(recording.sequence.time) - 1) // config.stride
    return _at_window_end(displacement[1:], strides), _at_window_end(std[1:], strides)


def _extended(values: np.ndarray, rows: int, filling: float | None) -> np.ndarray:
    """`values` with rows added at the end, of `filling` or (None) of the last one; what is added
    changes nothing before it."""
    added = values[-1:] if filling is None else np.full((1, *values.shape[1:]), filling)
    return np.concatenate([values, np.repeat(added, rows - len(values), 0)])


# Summing displacements
# ------------------------------------------------------------------------------------------------


def _integrated(
    recording: Recording,
    rotation: Float[np.ndarray, "t 3 3"],
    prediction: Prediction,
    config: DataConfig,
) -> Estimate:
    n, window = config.stride, config.window // config.stride
    k = (len(recording.sequence.time) - 1) // n
    steps = (
        np.einsum(
            "mij,mj->mi",
            _yaw_rotation(rotation[np.arange(len(prediction.displacement)) * n]),
            prediction.displacement,
        )
        / window
    )
    path = recording.position + np.concatenate(
        [np.zeros((1, 3)), np.cumsum(_mean_over_cover(steps, k, window), 0)]
    )
    return Estimate(
        recording.sequence.name,
        Trajectory(recording.sequence.time[::n], path, _quaternions(rotation[::n])),
        _reference(recording, n),
        displacement=_at_window_end(prediction.displacement, k + 1),
        displacement_std=_at_window_end(np.exp(prediction.log_std), k + 1),
        diagnostics={
            key: _at_window_end(value, k + 1) for key, value in prediction.diagnostics.items()
        },
        notes=recording.notes,
    )


def _mean_over_cover(
    steps: Float[np.ndarray, "m 3"], strides: int, window: int
) -> Float[np.ndarray, "k 3"]:
    """Movement in each stride: the mean of displacement × stride/window (`steps`) over the windows
    that cover it.

    Taking the one window that starts (or ends) at the stride instead puts the whole trajectory half
    a window ahead of (or behind) its time: 0.6 m at walking speed. A stride without any window
    keeps the movement of the one before.
    """
    good = finite_rows(steps)
    sums = np.concatenate([np.zeros((1, 3)), np.cumsum(np.where(good[:, None], steps, 0.0), 0)])
    counts = np.concatenate([[0], np.cumsum(good)])
    stride = np.arange(strides)
    first, last = np.clip(stride - window + 1, 0, len(steps)), np.minimum(stride + 1, len(steps))
    covering = counts[last] - counts[first]
    moved = np.divide(
        sums[last] - sums[first],
        covering[:, None],
        out=np.zeros((strides, 3)),
        where=covering[:, None] > 0,
    )
    return moved[np.maximum.accumulate(np.where(covering > 0, stride, 0))]


# Shared
# ---------------------------------------------------------------------------------------------------------------


def _gyro_bias(
    sequence: Sequence, rate: float, how: str
) -> tuple[Float[np.ndarray, "3"], tuple[str, ...]]:
    if how == "rest":
        second = round(REST_SECONDS * rate)
        rest = 0
        while rest + second <= len(sequence.time):
            upto = slice(rest, rest + second)
            if (
                sequence.gyro[upto].std(0).max() > REST_GYRO_STD
                or sequence.accel[upto].std(0).max() > REST_ACCEL_STD
            ):
                break
            rest += second
        if not rest:
            return np.zeros(3), ("gyro bias: no rest at the start, so it starts from zero",)
        return sequence.gyro[:rest].mean(0), (
            f"gyro bias: mean of {rest / rate:g} s of rest at the start",
        )
    if how == "reference":
        rows = np.arange(min(round(REFERENCE_BIAS_SECONDS * rate), len(sequence.time) - 1))
        rows = rows[sequence.valid[rows] & sequence.valid[rows + 1]]
        if len(rows) < rate:
            return np.zeros(3), (
                "gyro bias: under 1 s of reference at the start, so it starts from zero",
            )
        before, after = (
            Rotation.from_quat(sequence.orientation[r], scalar_first=True) for r in (rows, rows + 1)
        )
        turned = (before.inv() * after).as_rotvec() * rate
        return (sequence.gyro[rows] - turned).mean(0), (
            f"gyro bias: {len(rows) / rate:g} s against the reference orientation",
        )
    return np.zeros(3), ()


def _yaw_rotation(rotation: Float[np.ndarray, "m 3 3"]) -> Float[np.ndarray, "m 3 3"]:
    """R_γ: the rotation about z by the yaw atan2(R[1,0], R[0,0])."""
    return rotation_z(np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0]))


def _quaternions(rotation: Float[np.ndarray, "k 3 3"]) -> Float[np.ndarray, "k 4"]:
    finite = finite_rows(rotation.reshape(-1, 9))
    wxyz = Rotation.from_matrix(np.where(finite[:, None, None], rotation, np.eye(3))).as_quat(
        scalar_first=True
    )
    return np.where(finite[:, None], wxyz, np.nan)


def _reference(recording: Recording, n: int) -> Trajectory:
    sequence = recording.sequence
    good = sequence.valid[::n, None]
    return Trajectory(
        sequence.time[::n],
        np.where(good, sequence.position[::n], np.nan),
        np.where(good, sequence.orientation[::n], np.nan),
    )


def _at_window_end(values: Float[Array, "m 3"], rows: int) -> Float[np.ndarray, "k 3"]:
    """Values of the last m windows at the last m of `rows`, NaN before."""
    return np.concatenate([np.full((rows - len(values), *values.shape[1:]), np.nan), values])
