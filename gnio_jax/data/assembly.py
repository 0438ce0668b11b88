"""From the streams of a recording to sequences: the one path of every reader and importer.

A reader gives gyro and accelerometer, each on stamps of its own, and the reference there is: poses,
waypoints, or nothing. `assemble` puts rows in order, checks units, rates and gaps, resamples to one
uniform clock, and marks what can be trusted.
"""

from __future__ import annotations

import itertools
import warnings
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.data.dataset import Refusal
from gnio_jax.data.parsing.stamps import RATES, in_order, rounded_rate
from gnio_jax.data.reference import Poses as Poses
from gnio_jax.data.reference import Reference, reference_at
from gnio_jax.data.resampling import is_uniform, resampled, slerped, uniform_clock
from gnio_jax.data.validation import (
    FARTHEST,
    FASTEST,
    FEWEST_WAYPOINTS,
    LARGEST_STEP,
    WINDOW_SECONDS,
    check_accel,
    check_gyro,
    validate,
)
from gnio_jax.errors import InputError
from gnio_jax.numerics import spans, stretches
from gnio_jax.types import Sequence, Waypoints

STAMP_ROUNDING = 1e-6
"""s: what float64 leaves of differences of unix stamps, and more."""


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


def assemble(
    streams: Streams,
    rate: float | None = None,
    *,
    native: float | None = None,
    divide: bool = False,
    whole: bool = False,
    max_speed: float = np.inf,
    max_drift: float = np.inf,
) -> list[Sequence]:
    """The recording at `rate` Hz (None: the faster sensor's own, to four digits), validated but not
    self-checked.

    `native`
        Rate (Hz) that the stamps must have to 5 %; None takes any of `RATES`.
    `divide`
        Makes a sequence of each piece between gaps longer than a window (`WINDOW_SECONDS`), since a
        filter integrates whatever lies between its first and last sample. Pieces that hold no
        window with a valid reference are lost, and a warning says what was kept. Without it such a
        gap is an error.
    `whole`
        Keeps the IMU before the first pose and after the last, which else is cut away.
    `max_speed`
        m/s: around steps of the position that are faster, poses without a velocity are not valid.
    `max_drift`
        m: where position and integrated velocity of the poses disagree by more within a second,
        they are not valid.

    Raises `InputError` naming the file where one is damaged, and `Refusal` for a recording of no
    use: without a window of IMU and reference.
    """
    gyro, repairs = _ordered(streams.gyro, native)
    accel, _ = _ordered(streams.accel, native)
    check_accel(accel.values, accel.source, accel.time)
    check_gyro(gyro.values, gyro.source, gyro.time)
    streams = streams._replace(
        gyro=gyro,
        accel=accel,
        poses=None if streams.poses is None else _checked(_in_order(streams.poses)),
        device=None if streams.device is None else _sorted(streams.device)[0],
        attributes=streams.attributes | repairs,
    )
    found = _shared_spans(streams, whole)
    if len(found) > 1 and not divide:
        gap = found[1][0] - found[0][1]
        raise InputError(
            gyro.source,
            f"field 'time' has a gap of {gap:.3f} s after {found[0][1] - gyro.time[0]:.2f} s, "
            f"longer than {WINDOW_SECONDS:g} s",
            "cut the recording there",
        )
    rate = rate or max(rounded_rate(gyro.time), rounded_rate(accel.time))
    pieces = [_on_clock(streams, rate, *span, max_speed, max_drift) for span in found]
    return _kept(streams, pieces, found, whole)


# --- in order


def _sorted(samples: Samples) -> tuple[Samples, dict[str, float]]:
    rows, repairs = in_order(samples.time, samples.values, samples.source)
    return samples._replace(time=samples.time[rows], values=samples.values[rows]), repairs


def _ordered(samples: Samples, native: float | None) -> tuple[Samples, dict[str, float]]:
    """(sorted samples, two or more at a rate that an IMU has; counts of repaired rows)."""
    if len(samples.time) < 2:
        problem = f"holds {len(samples.time)} samples"
        raise InputError(samples.source, problem, "record for longer")
    samples, repairs = _sorted(samples)
    steps = np.diff(samples.time)
    rate = 1.0 / float(np.median(steps)) if steps.size else 0.0
    slowest, fastest = RATES[0] * 0.99, RATES[1] * 1.01
    if native is not None:
        slowest, fastest = native * 0.95, native * 1.05
    if not slowest <= rate <= fastest:
        expected = f"{RATES[0]:g} to {RATES[1]:g}" if native is None else f"about {native:g}"
        raise InputError(
            samples.source,
            f"field 'time' runs at {rate:.4g} Hz, expected {expected} Hz",
            "check the unit of the stamps",
        )
    return samples, repairs


def _in_order(poses: Poses) -> Poses:
    rows = in_order(poses.time, poses.position, poses.source).rows
    if len(rows) < 2:
        raise InputError(poses.source, f"holds {len(rows)} poses", "copy it again")
    if len(rows) == len(poses.time) and (np.diff(rows) == 1).all():
        return poses
    velocity = None if poses.velocity is None else poses.velocity[rows]
    return poses._replace(
        time=poses.time[rows],
        attitude=poses.attitude[rows],
        position=poses.position[rows],
        velocity=velocity,
    )


def _checked(poses: Poses) -> Poses:
    """Poses that come with a velocity are taken as they are: they move as something does."""
    if poses.velocity is None:
        return poses
    time = poses.time
    farthest_step = np.maximum(FASTEST * np.diff(time), LARGEST_STEP)[:, None]
    wrong = (
        ("velocity", np.abs(poses.velocity) > FASTEST, f"is beyond {FASTEST:g} m/s"),
        ("position", np.abs(poses.position) > FARTHEST, f"is beyond {FARTHEST:g} m"),
        ("position", np.abs(np.diff(poses.position, axis=0)) > farthest_step, "jumps"),
    )
    for field, found, problem in wrong:
        if found.any():
            rows = found.any(axis=1)
            raise InputError(
                poses.source,
                f"field '{field}' {problem} in {rows.sum()} rows, first at "
                f"{time[int(np.argmax(rows))] - time[0]:.3f} s",
                "repair these rows or leave their reference empty",
            )
    return poses


# --- on one clock


def _shared_spans(streams: Streams, whole: bool) -> list[tuple[float, float]]:
    """(first, last) of the stretches in which no stream pauses for longer than a window."""
    gyro, accel, poses = streams.gyro, streams.accel, streams.poses
    clocks, outermost = [gyro.time, accel.time], (-np.inf, np.inf)
    _check_overlap(accel.time, accel.source, gyro.time)
    if streams.device is not None:
        _check_overlap(streams.device.time, streams.device.source, gyro.time)
    if poses is not None:
        both = gyro.time[(gyro.time >= accel.time[0]) & (gyro.time <= accel.time[-1])]
        _check_overlap(poses.time, poses.source, both)
        if poses.ends_pieces:
            clocks.append(poses.time)
        elif not whole:
            outermost = (float(poses.time[0]), float(poses.time[-1]))
    found = [outermost]
    for time in clocks:
        runs = [
            (time[run.start], time[run.stop - 1])
            for run in stretches(np.diff(time) > WINDOW_SECONDS)
        ]
        found = [(max(a, c), min(b, d)) for a, b in found for c, d in runs if min(b, d) > max(a, c)]
    # Each begins and ends at a sample of the gyro, which the clock then shares.
    inside = [gyro.time[(gyro.time >= a - 1e-9) & (gyro.time <= b + 1e-9)] for a, b in found]
    return [(float(time[0]), float(time[-1])) for time in inside if len(time) > 1]


def _check_overlap(time: np.ndarray, source: str, imu: np.ndarray) -> None:
    if min(time[-1], imu[-1]) <= max(time[0], imu[0]):
        raise InputError(
            source,
            f"field 'time' ({time[0] - imu[0]:.1f} to {time[-1] - imu[0]:.1f} s after the IMU's "
            f"first stamp) shares nothing with the IMU's (0.0 to {imu[-1] - imu[0]:.1f} s)",
            "check that the files are of one recording and one clock",
        )


def _on_clock(
    streams: Streams, rate: float, first: float, last: float, max_speed: float, max_drift: float
) -> Sequence:
    gyro, accel, poses = streams.gyro, streams.accel, streams.poses
    own = gyro.time[(gyro.time >= first) & (gyro.time <= last)]
    same = len(gyro.time) == len(accel.time) and bool((gyro.time == accel.time).all())
    if same and len(own) > 1 and is_uniform(own, rate):
        rows = slice(*np.searchsorted(gyro.time, [first, np.nextafter(last, np.inf)]))
        clock, measured = own, np.ones(len(own), dtype=bool)
        rates, forces = gyro.values[rows], accel.values[rows]
    else:
        clock = uniform_clock(first, last, rate)
        (rates, a), (forces, b) = (
            resampled(each.time, each.values, clock, rate) for each in (gyro, accel)
        )
        measured = a & b
    reference = _nothing(len(clock))
    if poses is not None:
        reference = reference_at(clock, rates, poses, max_speed, max_drift)
    known = reference.valid[:, None]
    device, waypoints = streams.device, streams.waypoints
    return Sequence(
        name=streams.name,
        time=clock - first,
        gyro=rates,
        accel=forces,
        orientation=np.where(known, reference.orientation, np.nan),
        position=np.where(known, reference.position, np.nan),
        velocity=np.where(known, reference.velocity, np.nan),
        valid=reference.valid & measured,
        device_orientation=device and slerped(device.time, device.values, clock),
        imu_valid=None if measured.all() else measured,
        waypoints=waypoints and _waypoints_within(waypoints, first, last),
        attributes=streams.attributes | {"start_time": streams.start + first},
    )


def _nothing(count: int) -> Reference:
    nothing = np.full((count, 3), np.nan)
    return Reference(np.full((count, 4), np.nan), nothing, nothing, np.zeros(count, dtype=bool))


def _waypoints_within(waypoints: Samples, first: float, last: float) -> Waypoints:
    inside = (waypoints.time >= first) & (waypoints.time <= last)
    return Waypoints(waypoints.time[inside] - first, waypoints.values[inside])


# --- pieces


def _kept(
    streams: Streams, pieces: list[Sequence], found: list[tuple[float, float]], whole: bool
) -> list[Sequence]:
    """The pieces that hold a window, numbered where there are several."""
    shortest = WINDOW_SECONDS - STAMP_ROUNDING
    holds = [_longest(streams, piece, whole) >= shortest for piece in pieces]
    gaps = [after[0] - before[1] for before, after in itertools.pairwise(found)]
    problem = f"no {WINDOW_SECONDS:g} s of it have an IMU and a reference that can be trusted"
    if streams.poses is not None and streams.poses.velocity is not None:
        problem += " (gaps, jumps, or a velocity that is not that of the position)"
    if gaps:
        problem = (
            f"field 'time' has gaps longer than {WINDOW_SECONDS:g} s ({len(gaps)}, "
            f"up to {max(gaps):.1f} s)"
        )
    if not any(holds):
        rest = ", and no piece between them holds a window with a reference" if gaps else ""
        raise Refusal(streams.source, problem + rest, "leave it out")
    kept, begin = list(itertools.compress(pieces, holds)), found[0][0]
    if len(kept) > 1:
        kept = [piece._replace(name=f"{piece.name}_piece{n}") for n, piece in enumerate(kept, 1)]
    if gaps:
        where = list(itertools.compress(found, holds))
        seconds, lost = _seconds(where), f"{sum(gaps):.1f} s in gaps"
        named = ", ".join(
            f"{piece.name} ({first - begin:.1f} to {last - begin:.1f} s)"
            for piece, (first, last) in zip(kept, where, strict=True)
        )
        if len(kept) < len(pieces):
            lost += f", {_seconds(found) - seconds:.1f} s in pieces without a whole window"
        warnings.warn(
            f"{streams.source}: {problem}; kept: {seconds:.1f} of {found[-1][1] - begin:.1f} s, "
            f"{named}; lost: {lost}",
            stacklevel=3,
        )
    return [validate(piece, streams.source) for piece in kept]


def _seconds(found: list[tuple[float, float]]) -> float:
    return sum(last - first for first, last in found)


def _longest(streams: Streams, piece: Sequence, whole: bool) -> float:
    """s of the longest stretch of use: with the reference, where the recording has one."""
    time, waypoints = piece.time, piece.waypoints
    if waypoints is not None and len(waypoints.time) < FEWEST_WAYPOINTS:
        return 0.0
    if streams.poses is None or (whole and piece.valid.any()):
        return float(time[-1])
    starts, stops = spans(piece.valid).T
    return float((time[stops - 1] - time[starts]).max(initial=0.0))
