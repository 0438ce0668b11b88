"""Conditions that every sequence must satisfy before it is used."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

from gnio_jax.data.resampling import longest_bridge
from gnio_jax.data.sensors import check_readings
from gnio_jax.errors import InputError
from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE, Sequence

FASTEST = 300.0
"""Largest speed, m/s, above that of every carrier of such an IMU."""
FASTEST_WALKER = 6.0
"""Largest speed of a person, m/s; faster steps come from a visual odometry that relocalises."""
LARGEST_STEP = 10.0
"""Largest jump of positions that were held for some time, or corrected, m."""
FARTHEST = 1e8
"""Largest distance from the world's origin at which a float64 has enough digits, m."""
WINDOW_SECONDS = 1.0
"""The network's window, s. At a longer hole in the IMU readers divide the recording
(`assembly.assemble`), or refuse it."""
FEWEST_WAYPOINTS = 3
"""Smallest number of waypoints to which a track can be aligned: a rotation and a shift need two."""
UNIT_NORM_TOLERANCE = 1e-3
"""Tolerance of the norm of a quaternion, which exceeds the rounding of text files."""


def validate(sequence: Sequence, source: object) -> Sequence:
    """Return `sequence` if every consumer can rely on it.

    Quaternions whose norm differs from 1 by at most `UNIT_NORM_TOLERANCE` are normalized. Raises
    `InputError` naming `source`, the field and the remedy.
    """
    _check_shapes(sequence, source)
    for field in ("time", "gyro", "accel"):
        check_finite(getattr(sequence, field), field, source)
    check_increasing(sequence.time, source)
    check_accel(sequence.accel, source)
    check_gyro(sequence.gyro, source)
    for field in ("orientation", "position", "velocity"):
        finite = np.isfinite(getattr(sequence, field))
        if not finite.all():
            bad = sequence.valid & ~finite.all(axis=1)
            _refuse(bad, field, "is NaN or Inf", source, "mark these rows invalid")
    _check_motion(sequence, source)
    _check_waypoints(sequence, source)
    for sensor, readings in sequence.readings.items():
        check_readings(sensor, readings, sequence.time, source)
    orientation = check_unit_norm(sequence.orientation, sequence.valid, "orientation", source)
    device = sequence.device_orientation
    if device is not None:
        present = np.asarray(np.isfinite(device).all(axis=1))
        device = check_unit_norm(device, present, "device_orientation", source)
    return sequence._replace(orientation=orientation, device_orientation=device)


def from_one(index: int) -> int:
    """The row of an entry, counted from 1, if no row comes before the first entry."""
    return index + 1


def _refuse(
    bad: Bool[np.ndarray, " n"],
    field: str,
    problem: str,
    source: object,
    remedy: str,
    row: Callable[[int], int] = from_one,
) -> None:
    """Raise `InputError` if an entry is bad; `row` gives its row in the file."""
    if bad.any():
        rows = f"in {bad.sum()} rows, first in row {row(int(np.argmax(bad)))}"
        raise InputError(source, f"field '{field}' {problem} {rows}", remedy)


def _check_shapes(sequence: Sequence, source: object) -> None:
    """Check the shapes, which come from files, so that a wrong one is a user's error."""
    time = sequence.time
    count = time.shape[0] if time.ndim == 1 else -1
    if count < 2:
        problem = f"field 'time' must hold at least two stamps, found shape {time.shape}"
        raise InputError(source, problem)
    widths = {"gyro": 3, "accel": 3, "orientation": 4, "position": 3, "velocity": 3}
    for field, width in (widths | {"device_orientation": 4}).items():
        values = getattr(sequence, field)
        if values is not None and values.shape != (count, width):
            problem = f"field '{field}' has shape {values.shape}, expected {(count, width)}"
            raise InputError(source, f"{problem} as field 'time' has {count} stamps")
    for field in ("valid", "imu_valid"):
        mask = getattr(sequence, field)
        if mask is not None and (mask.shape != (count,) or mask.dtype != np.bool_):
            actual = f"{mask.dtype} of shape {mask.shape}"
            raise InputError(source, f"field '{field}' must be {count} booleans, found {actual}")


def _check_motion(sequence: Sequence, source: object) -> None:
    """Raise `InputError` if the motion of the valid reference is impossible."""
    valid, position = sequence.valid, sequence.position
    if not valid.any():
        return
    farthest_step = np.maximum(FASTEST * np.diff(sequence.time), LARGEST_STEP)[:, None]
    jumps = (np.abs(np.diff(position, axis=0)) > farthest_step).any(axis=1)
    jumps = np.concatenate([[False], valid[:-1] & jumps])
    for field, problem, bad in (
        ("velocity", f"is beyond {FASTEST:g} m/s", np.abs(sequence.velocity).max(axis=1) > FASTEST),
        ("position", f"is beyond {FARTHEST:g} m", np.abs(position).max(axis=1) > FARTHEST),
        ("position", "jumps", jumps),
    ):
        if (bad := bad & valid).any():
            # A sequence on a clock of its own no longer has the rows of its file.
            first = sequence.time[np.argmax(bad)] - sequence.time[0]
            problem = f"field '{field}' {problem} in {bad.sum()} rows"
            problem += f", first {first:.3f} s after the start"
            raise InputError(source, problem, "repair these rows or mark them invalid")


def _check_waypoints(sequence: Sequence, source: object) -> None:
    """Check that there are three or more waypoints, finite, increasing, and on the sequence's clock
    to a sample."""
    if sequence.waypoints is None:
        return
    step = float(sequence.time[1] - sequence.time[0])
    if problem := sequence.waypoints.problem(sequence.time, step, FEWEST_WAYPOINTS):
        raise InputError(source, f"field 'waypoints' {problem}", "repair or leave out these")


def check_finite(
    values: Float[np.ndarray, "n ..."],
    field: str,
    source: object,
    row: Callable[[int], int] = from_one,
) -> None:
    """Raise `InputError` if a column that must be complete has NaN or Inf. `row` gives the row of
    an entry in the file."""
    finite = np.isfinite(values)
    if not finite.all():
        bad = ~finite.reshape(len(values), -1).all(axis=1)
        _refuse(bad, field, "is NaN or Inf", source, "repair or cut the recording there", row)


def check_increasing(
    time: Float[np.ndarray, "n"], source: object, row: Callable[[int], int] = from_one
) -> None:
    """Raise `InputError` if the stamps (s) do not increase. `row` gives the row of an entry in the
    file."""
    backward = np.concatenate([[False], np.diff(time) <= 0])
    remedy = "sort the rows and drop repeated ones"
    _refuse(backward, "time", "does not increase", source, remedy, row)


def check_gyro(
    gyro: Float[np.ndarray, "n 3"], source: object, time: Float[np.ndarray, " n"] | None = None
) -> None:
    """Raise `InputError` if the magnitudes show that a gyro is not in rad/s. Messages name samples
    by their stamps `time` (s), or else by their rows."""
    turn = float(np.median(np.linalg.norm(gyro, axis=1)))
    if turn > 20.0:
        problem = f"field 'gyro' looks like deg/s (median magnitude {turn:.3g})"
        raise InputError(source, problem, "convert it to rad/s (× π/180)")
    _check_range("gyro", gyro, FASTEST_TURN, "rad/s", source, time)


def check_accel(
    accel: Float[np.ndarray, "n 3"], source: object, time: Float[np.ndarray, " n"] | None = None
) -> None:
    """Raise `InputError` if the magnitudes show that an accelerometer is not in m/s², or that they
    lack gravity. Messages name samples as those of `check_gyro` do."""
    force = float(np.median(np.linalg.norm(accel, axis=1)))
    problem, remedy = "", "give the specific force in m/s², gravity included"
    if 0.5 < force < 2.0:
        problem, remedy = "looks like G", "convert it to m/s² (× 9.80665)"
    elif force < 5.0:  # a walker's linear acceleration is 1–4 m/s²
        problem = "has no gravity in it"
    elif force > 50.0:
        problem = "is not in m/s²"
    if problem:
        raise InputError(source, f"field 'accel' {problem} (median magnitude {force:.3g})", remedy)
    _check_range("accel", accel, STRONGEST_FORCE, "m/s²", source, time)


def _check_range(
    field: str, values: np.ndarray, most: float, unit: str, source: object, time: np.ndarray | None
) -> None:
    size = np.abs(values)
    if size.max() > most:
        beyond = (size > most).any(axis=1)
        row = int(np.argmax(beyond))
        first = f"in row {row + 1}"
        if time is not None:
            first = f"{time[row] - time[0]:.3f} s after the start"
        problem = f"field '{field}' is beyond {most:g} {unit} in {beyond.sum()} rows, first {first}"
        remedy = "no such sensor measures that: repair or cut the recording there"
        raise InputError(source, problem, remedy)


def check_unit_norm(
    wxyz: Float[np.ndarray, "n 4"], where: Bool[np.ndarray, "n"] | bool, field: str, source: object
) -> Float[np.ndarray, "n 4"]:
    """Quaternions, normalized where `where` holds.

    Raises `InputError` if the norm of one of these differs from 1 by more than
    `UNIT_NORM_TOLERANCE`.
    """
    norm = np.linalg.norm(wxyz, axis=1)
    error = np.where(where, np.abs(norm - 1.0), 0.0)
    remedy = "check the column order and normalize, or mark the rows invalid"
    _refuse(error > UNIT_NORM_TOLERANCE, field, "is not a unit quaternion", source, remedy)
    # Quaternions that are exact to rounding are not changed at all, so that writing and reading
    # again changes nothing.
    rounded = error > 1e-12
    if not rounded.any():
        return wxyz
    normalized = wxyz / np.where(norm > 0, norm, 1.0)[:, None]
    return np.where(rounded[:, None], normalized, wxyz)


def check_gaps(
    time: Float[np.ndarray, "n"], source: object, longest: float = WINDOW_SECONDS
) -> None:
    """Raise `InputError` if two successive stamps are further apart than `longest` (s)."""
    gaps = np.diff(time)
    if gaps.size and gaps.max() > longest:
        row = int(np.argmax(gaps))
        problem = f"field 'time' has a gap of {gaps[row]:.3f} s after row {row + 1}"
        raise InputError(source, f"{problem}, longer than {longest:g} s", "cut the recording there")


def check_bridged(sequence: Sequence) -> None:
    """Raise `InputError` for a hole that is too long to be bridged, because no sample shows the
    motion in it."""
    # An earlier resampling interpolated the holes, and each clock has widened a hole by up to a
    # sample at each end.
    measured = np.union1d(sequence.time[sequence.measured_rows], sequence.time[[0, -1]])
    bridged = longest_bridge(1.0 / float(np.median(np.diff(sequence.time))))
    check_gaps(sequence.time, sequence.name)
    check_gaps(measured, sequence.name, WINDOW_SECONDS + bridged)
