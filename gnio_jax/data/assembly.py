"""From the streams of a recording to sequences, for all readers and importers.

A reader gives gyro and accelerometer, each on stamps of its own, and the reference, if there is
one: poses or waypoints. `assemble` puts rows in order, checks units, rates and gaps, resamples to
one uniform clock, and sets `valid` where the reference can be trusted.
"""

from __future__ import annotations

import itertools
import warnings
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.data.dataset import Refusal
from gnio_jax.data.parsing.stamps import check_seconds, in_order, rounded_rate
from gnio_jax.data.reference import Poses as Poses
from gnio_jax.data.reference import Reference, reference_at
from gnio_jax.data.resampling import interpolate_attitudes, is_uniform, resample_imu, uniform_clock
from gnio_jax.data.sensors import readings_within
from gnio_jax.data.validation import (
    FARTHEST,
    FEWEST_WAYPOINTS,
    WINDOW_SECONDS,
    check_accel,
    check_gyro,
    validate,
)
from gnio_jax.errors import InputError
from gnio_jax.numerics import spans, stretches
from gnio_jax.types import Readings, Sequence, Waypoints

RECORDED_RATE = "recorded_rate"
"""Attribute of every assembled sequence: the rate of the faster sensor, Hz, independent of the
sequence's own clock. The samples have no content above half of it."""
STAMP_ROUNDING = 1e-6
"""Tolerance for differences of unix stamps in float64, s."""


class Samples(NamedTuple):
    """A sensor's samples on its own stamps; rows may be out of order."""

    time: Float[np.ndarray, " n"]
    """s since `Streams.start`."""
    values: Float[np.ndarray, "n w"]
    source: str
    """File, for messages."""


class Streams(NamedTuple):
    """A recording in SI units, before it has one clock."""

    name: str
    source: str
    """File or folder of the whole recording, for messages."""
    gyro: Samples
    """rad/s."""
    accel: Samples
    """Specific force, m/s²."""
    attributes: dict[str, Any] = {}
    start: float = 0.0
    """Epoch of time 0, s."""
    poses: Poses | None = None
    """The reference, its stamps in s since `start`."""
    waypoints: Samples | None = None
    """The horizontal positions (n, 2) of a recording without poses, m."""
    device: Samples | None = None
    """The device's own attitude, wxyz."""
    readings: dict[str, Readings] = {}
    """The readings of other sensors, their stamps in s since `start`."""

    @classmethod
    def of_imu(
        cls, name: str, source: object, time: np.ndarray, gyro: np.ndarray, accel: np.ndarray
    ) -> Streams:
        """Streams of an IMU whose two sensors share their stamps."""
        sensors = (Samples(time, values, str(source)) for values in (gyro, accel))
        return cls(name, str(source), *sensors)


def assemble(
    streams: Streams,
    rate: float | None = None,
    *,
    divide: bool = False,
    whole: bool = False,
    max_speed: float = np.inf,
    max_drift: float = np.inf,
) -> list[Sequence]:
    """The recording at `rate` Hz (None: the faster sensor's own, to four digits), validated but not
    self-checked.

    `divide`
        Makes a sequence of each piece between gaps longer than a window (`WINDOW_SECONDS`), because
        a filter integrates everything between its first and last sample. Pieces without a window
        that has a valid reference are lost, and a warning says what was kept. Without this option
        such a gap is an error.
    `whole`
        Keeps the IMU before the first pose and after the last, which is otherwise cut off.
    `max_speed`
        Speed in m/s: near steps of the position that are faster, poses without a velocity are not
        valid.
    `max_drift`
        Distance in m: where position and integrated velocity of the poses differ by more within a
        second, they are not valid.

    Raises `InputError` naming a damaged file, and `Refusal` for a recording without a window of IMU
    and reference.
    """
    streams = sort_streams(streams)
    gyro, accel = streams.gyro, streams.accel
    for sensor in (gyro, accel):
        check_seconds(sensor.time, sensor.source)
    intervals = _shared_spans(streams, whole)
    if len(intervals) > 1 and not divide:
        last, first = intervals[0][1], intervals[1][0]
        problem = f"has a gap of {first - last:.3f} s after {last - gyro.time[0]:.2f} s"
        problem = f"field 'time' {problem}, longer than {WINDOW_SECONDS:g} s"
        raise InputError(gyro.source, problem, "cut the recording there")
    recorded = max(rounded_rate(gyro.time), rounded_rate(accel.time))
    streams = streams._replace(attributes=streams.attributes | {RECORDED_RATE: recorded})
    rate = rate or recorded
    pieces = [_sequence_on_clock(streams, rate, *span, max_speed, max_drift) for span in intervals]
    shortest = WINDOW_SECONDS - STAMP_ROUNDING
    usable = [piece for piece in pieces if _seconds_of_use(streams, piece, whole) >= shortest]
    problem = f"no {WINDOW_SECONDS:g} s of it have an IMU and a reference that can be trusted"
    if len(intervals) > 1:
        gaps = [after[0] - before[1] for before, after in itertools.pairwise(intervals)]
        problem = f"field 'time' has gaps longer than {WINDOW_SECONDS:g} s"
        problem += f" ({len(gaps)}, up to {max(gaps):.1f} s)"
    if not usable:
        advice = ", and no piece between them holds a window with a reference"
        raise Refusal(streams.source, problem + advice * (len(intervals) > 1))
    if len(intervals) > 1:
        seconds, total = sum(piece.time[-1] for piece in usable), intervals[-1][1] - intervals[0][0]
        pieces = f"{len(usable)} of {len(pieces)} pieces"
        problem += f"; kept: {seconds:.1f} of {total:.1f} s, {pieces}"
        warnings.warn(f"{streams.source}: {problem}", stacklevel=2)
    if len(usable) > 1:
        usable = [
            piece._replace(name=f"{piece.name}_piece{n}") for n, piece in enumerate(usable, 1)
        ]
    return [validate(piece, streams.source) for piece in usable]


def sort_streams(streams: Streams) -> Streams:
    """The streams with their rows sorted by stamps, without poses beyond `FARTHEST`, and with the
    counts of the gyro's repaired rows as attributes. Raises `InputError` for samples that cannot be
    those of an IMU in SI units."""

    def by_stamps(samples: Samples) -> tuple[Samples, dict[str, float]]:
        rows, repairs = in_order(samples.time, samples.values, samples.source)
        if len(rows) < 2:
            raise InputError(samples.source, f"holds {len(rows)} samples", "record for longer")
        if repairs:
            samples = samples._replace(time=samples.time[rows], values=samples.values[rows])
        return samples, repairs

    (gyro, repairs), (accel, _) = by_stamps(streams.gyro), by_stamps(streams.accel)
    check_accel(accel.values, accel.source, accel.time)
    check_gyro(gyro.values, gyro.source, gyro.time)
    poses, device = streams.poses, streams.device
    if poses is not None:
        # An impossible position would cost all poses near it their digits.
        near = ~(np.abs(poses.position) > FARTHEST).any(axis=1)
        if not near.any():
            problem = f"field 'position' is beyond {FARTHEST:g} m in all rows"
            raise InputError(poses.source, problem, "give positions in m")
        poses = poses if near.all() else poses.rows(near)
        rows, changed = in_order(poses.time, poses.position, poses.source)
        if len(rows) < 2:
            raise InputError(poses.source, f"holds {len(rows)} poses", "copy it again")
        poses = poses.rows(rows) if changed else poses
    return streams._replace(
        gyro=gyro,
        accel=accel,
        poses=poses,
        device=device and by_stamps(device)[0],
        attributes=streams.attributes | repairs,
    )


# --- on one clock


def _shared_spans(streams: Streams, whole: bool) -> list[tuple[float, float]]:
    """First and last time of the stretches in which no stream has a gap longer than a window."""
    gyro, accel, poses = streams.gyro, streams.accel, streams.poses
    clocks, outermost = [gyro.time, accel.time], (-np.inf, np.inf)
    imu_time = gyro.time[(gyro.time >= accel.time[0]) & (gyro.time <= accel.time[-1])]
    for stream, imu in ((accel, gyro.time), (streams.device, gyro.time), (poses, imu_time)):
        if stream is not None:
            _check_overlap(stream.time, stream.source, imu)
    if poses is not None and poses.ends_pieces:
        clocks.append(poses.time)
    elif poses is not None and not whole:
        outermost = (float(poses.time[0]), float(poses.time[-1]))
    intervals = [outermost]
    for time in clocks:
        unbroken = stretches(np.diff(time) > WINDOW_SECONDS)
        runs = [(time[run.start], time[run.stop - 1]) for run in unbroken]
        intervals = [
            (max(a, c), min(b, d)) for a, b in intervals for c, d in runs if min(b, d) > max(a, c)
        ]
    # Each begins and ends at a sample of the gyro, so that the clock has the gyro's stamps.
    inside = [gyro.time[(gyro.time >= a - 1e-9) & (gyro.time <= b + 1e-9)] for a, b in intervals]
    return [(float(time[0]), float(time[-1])) for time in inside if len(time) > 1]


def _check_overlap(time: np.ndarray, source: str, imu: np.ndarray) -> None:
    if len(imu) and min(time[-1], imu[-1]) > max(time[0], imu[0]):
        return
    first, last = (imu[0], imu[-1]) if len(imu) else (0.0, 0.0)
    span = f"{time[0] - first:.1f} to {time[-1] - first:.1f} s after the IMU's first stamp"
    problem = f"field 'time' ({span}) shares nothing with the IMU's (0.0 to {last - first:.1f} s)"
    raise InputError(source, problem, "check that the files are of one recording and one clock")


def _sequence_on_clock(
    streams: Streams, rate: float, first: float, last: float, max_speed: float, max_drift: float
) -> Sequence:
    gyro, accel, poses = streams.gyro, streams.accel, streams.poses
    device, waypoints = streams.device, streams.waypoints
    rows = slice(*np.searchsorted(gyro.time, [first, np.nextafter(last, np.inf)]))
    clock = gyro.time[rows]
    if np.array_equal(gyro.time, accel.time) and is_uniform(clock, rate):
        measured = np.ones(len(clock), dtype=bool)
        rates, forces = gyro.values[rows], accel.values[rows]
    else:
        clock = uniform_clock(first, last, rate)
        rates, measured = resample_imu(gyro.time, gyro.values, clock, rate)
        forces, accel_measured = resample_imu(accel.time, accel.values, clock, rate)
        measured &= accel_measured
    reference = Reference.none(len(clock))
    if poses is not None:
        reference = reference_at(clock, rates, poses, max_speed, max_drift)
    has_reference = reference.valid[:, None]
    if waypoints is not None:
        inside = (waypoints.time >= first) & (waypoints.time <= last)
        waypoints = Waypoints(waypoints.time[inside] - first, waypoints.values[inside])
    return Sequence(
        name=streams.name,
        time=clock - first,
        gyro=rates,
        accel=forces,
        orientation=np.where(has_reference, reference.orientation, np.nan),
        position=np.where(has_reference, reference.position, np.nan),
        velocity=np.where(has_reference, reference.velocity, np.nan),
        valid=reference.valid & measured,
        device_orientation=device and interpolate_attitudes(device.time, device.values, clock),
        imu_valid=None if measured.all() else measured,
        waypoints=waypoints,
        readings=readings_within(streams.readings, first, last),
        attributes=streams.attributes | {"start_time": streams.start + first},
    )


def _seconds_of_use(streams: Streams, piece: Sequence, whole: bool) -> float:
    """Duration of the longest stretch with a reference, s, or of the recording if it has none."""
    time, waypoints = piece.time, piece.waypoints
    if waypoints is not None and len(waypoints.time) < FEWEST_WAYPOINTS:
        return 0.0
    if streams.poses is None or (whole and piece.valid.any()):
        return float(time[-1])
    starts, stops = spans(piece.valid).T
    return float((time[stops - 1] - time[starts]).max(initial=0.0))
