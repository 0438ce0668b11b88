"""A recording as people have it, as a `Sequence`: a phone logger's export, a robot's bag, a folder
of EuRoC's layout, or any CSV.

The steps: the format by the content (`recognition`), the samples of each sensor and the reference
as the reader of the format gives them (a `recording.Recording`), order, units and signs, and the
one path of all recordings to a sequence (`data.assembly`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.apps.importing.asl import read_asl
from gnio_jax.apps.importing.bags import KINDS
from gnio_jax.apps.importing.kept import Imported
from gnio_jax.apps.importing.phyphox import read_phyphox
from gnio_jax.apps.importing.recognition import recognise
from gnio_jax.apps.importing.recording import (
    Recording,
    Sensor,
    Track,
    Units,
    read_table,
    sensor_of,
)
from gnio_jax.apps.importing.ros import Topics, read_bag
from gnio_jax.apps.importing.sensor_logger import read_sensor_logger
from gnio_jax.config import ImportOptions
from gnio_jax.data.assembly import Samples, Streams, assemble
from gnio_jax.data.parsing import units
from gnio_jax.data.parsing.stamps import (
    PER_SECOND,
    RATES,
    first_stamp,
    in_order,
    rounded_rate,
    seconds,
    time_unit,
)
from gnio_jax.data.parsing.tables import Table
from gnio_jax.data.readers.csv_files import ACCEL, GYRO, check_columns, reference
from gnio_jax.data.reference import SHORTEST_RUN
from gnio_jax.data.resampling import longest_bridge
from gnio_jax.data.self_check import self_check
from gnio_jax.data.validation import WINDOW_SECONDS, check_finite
from gnio_jax.errors import InputError
from gnio_jax.numerics import interpolate
from gnio_jax.types import Sequence

GAPS = "lacks samples"
"""What a note of holes in a recording says."""

SLOW = 50.0
"""Hz below which the impacts of steps are lost; networks are trained on 100 and more (ours)."""

NOTHING_STATED = ImportOptions()
_COLUMNS = ("time", "accel_time", *GYRO, *ACCEL)


def import_recording(
    path: str | os.PathLike[str],
    options: ImportOptions = NOTHING_STATED,
    *,
    rate: float | None = None,
    name: str | None = None,
) -> Imported:
    """A recording as a `Sequence` on a uniform clock.

    `path`
        A zip, folder or workbook of Sensor Logger or phyphox, a bag or MCAP, a folder of EuRoC's
        layout, or a CSV: the gyro's file, and the accelerometer's unless `options.accel_path` is
        given; lines that begin with # are comments.
    `options`
        What the recording does not say of itself. What `options.columns` leaves out is looked up by
        our name. Rows out of order are sorted, of rows with one stamp the first counts, and a CSV's
        separator is the most frequent of comma, semicolon and tab, or blanks.
    `rate`
        Hz of the result; None keeps the faster sensor's own.
    `name`
        Of the sequence; None takes that of the file.

    Two sensors with stamps of their own are put on one clock over the time that both cover, by
    cubic splines. Raises `InputError` naming file, field and remedy.
    """
    _check_choice("time_unit", options.time_unit, PER_SECOND)
    _check_choice("gyro_unit", options.gyro_unit, units.TO_RAD_PER_SECOND)
    _check_choice("accel_unit", options.accel_unit, units.TO_METRES_PER_SECOND_SQUARED)
    _check_choice("accel_sign", options.accel_sign, units.SIGNS)
    if rate is not None and not 1.0 <= rate <= RATES[1]:
        raise InputError(
            "rate", f"{rate:g} Hz is no rate to resample to", f"give 1 to {RATES[1]:g} Hz"
        )
    columns = _columns_of(options.columns)
    path = Path(path)
    for file in (path, options.accel_path):
        if file is not None and file.exists() and not (file.is_file() or file.is_dir()):
            raise InputError(
                file, "can be read only once, as a pipe can", "save the recording as a file"
            )
    kind = "csv" if columns or options.accel_path is not None else recognise(path)
    topics = Topics(options.imu_topic, options.accel_topic, options.reference_topic)
    if any(topics) and kind not in KINDS:
        raise InputError(path, "has no topics", "a topic is one of a ROS bag or an MCAP")
    if kind == "csv":
        source = _read_csv(path, options.accel_path, columns, options.time_unit)
    else:
        source = _read_other(path, kind, topics)
    stated = Units(options.time_unit, options.gyro_unit, options.accel_unit, options.accel_sign)
    return _imported(source, stated, rate, name or path.stem)


def _columns_of(given: tuple[str, ...]) -> dict[str, str]:
    """From our names to the file's, of words such as "gyro_x=wx"."""
    columns = {}
    for word in given:
        ours, equals, theirs = word.partition("=")
        if not (equals and theirs):
            raise InputError("columns", f"'{word}' names no column", "write gyro_x=NAME")
        if ours not in _COLUMNS:
            known = f"known names: {', '.join(_COLUMNS)}"
            raise InputError("columns", f"unknown name '{ours}'", known)
        columns[ours] = theirs
    return columns


def _read_other(path: Path, kind: str, topics: Topics) -> Recording:
    match kind:
        case "sensor_logger":
            return read_sensor_logger(path)
        case "phyphox":
            return read_phyphox(path)
        case "euroc":
            return read_asl(path)
        case _:
            return read_bag(path, kind, topics)


# --- one sensor


class _Clocked(NamedTuple):
    """One sensor's samples in order."""

    time: Float[np.ndarray, " n"]
    """s since `first`."""
    values: Float[np.ndarray, "n 3"]
    first: Fraction
    """s: the first stamp, exactly, since unix time in a float is good to a quarter of a
    microsecond."""
    unit: str


def _clocked(sensor: Sensor, unit: str | None, notes: list[str]) -> _Clocked:
    """`unit` is that of the stamps, None detects it. What was detected or repaired is added to
    `notes`. Raises `InputError`."""
    name, file = sensor.name, sensor.file
    stamps, values = sensor.stamps, sensor.values
    empty = np.isnan(values).all(axis=1)
    if empty.any() and not empty.all():
        # Loggers that write every sensor into one table leave the others' columns empty.
        notes.append(
            f"{file.name}: {empty.sum()} of {len(empty)} rows have no {name} and are not its "
            "samples"
        )
        stamps, values = stamps[~empty], values[~empty]
    if len(stamps) < 2:
        problem = f"holds {len(stamps)} samples of field '{name}'"
        raise InputError(file, problem, "record for longer")
    check_finite(stamps.astype(np.float64), "time", file)
    check_finite(values, name, file)
    detected, rate = time_unit(stamps - stamps.min())
    if unit is None and detected is None:
        raise InputError(
            file,
            f"the unit of field 'time' is ambiguous (in seconds {name} would run at {rate:.3g} Hz)",
            "state it: s, ms, us or ns",
        )
    if unit is None:
        notes.append(
            f"{file.name}: time of {name} taken as {detected}, "
            f"by which it runs at {rate * PER_SECOND[detected]:.4g} Hz"
        )
    unit = unit or detected
    rate *= PER_SECOND[unit]
    if not RATES[0] * 0.99 <= rate <= RATES[1] * 1.01:
        raise InputError(
            file,
            f"field 'time' makes {name} run at {rate:.3g} Hz with the unit {unit}",
            f"an IMU runs at {RATES[0]:g} to {RATES[1]:g} Hz",
        )
    first = first_stamp(stamps, unit, file)
    time = seconds(stamps, first, unit)
    rows, repairs = in_order(time, values, f"{file}: {name}")
    time, values = time[rows], values[rows]
    if backward := repairs.get("rows_sorted"):
        notes.append(
            f"{file.name}: {name} had {backward:.0f} steps back in time; its rows were sorted"
        )
    if repeated := repairs.get("rows_repeated"):
        notes.append(f"{file.name}: {repeated:.0f} rows of {name} repeat a stamp and were dropped")
    if len(time) < 2:
        raise InputError(file, f"holds 1 sample of field '{name}'", "record for longer")
    holes = np.diff(time)[np.diff(time) > longest_bridge(rate)]
    if holes.size:
        notes.append(
            f"{file.name}: {name} {GAPS} {holes.size} times, "
            f"for up to {holes.max():.2f} s; bridged linearly"
        )
    return _Clocked(time, values, Fraction(first) / int(PER_SECOND[unit]), unit)


# --- both sensors and the reference


def _imported(source: Recording, stated: Units, rate: float | None, name: str) -> Imported:
    """What any format comes to: `stated` wins over what the format says of its units."""
    notes, warnings = list(source.notes), []
    gyro, accel = (
        _clocked(sensor, stated.time or source.units.time, notes)
        for sensor in (source.gyro, source.accel)
    )
    accel = accel._replace(time=accel.time + float(accel.first - gyro.first))
    _check_overlap(source, gyro, accel, notes)
    rates, forces = _in_si(source, stated, gyro, accel, notes, warnings)
    own = max(rounded_rate(gyro.time), rounded_rate(accel.time))
    notes.append(f"put on a uniform clock of {rate or own:g} Hz")
    if own < SLOW:
        notes.append(
            f"it was recorded at {own:g} Hz, which is slow: steps need {SLOW:g} Hz, and the "
            "networks were trained on 100 Hz and more"
        )
    streams = Streams(
        name,
        str(source.path),
        Samples(gyro.time, rates, str(source.gyro.file)),
        Samples(accel.time, forces, str(source.accel.file)),
        {"dataset": "csv", "group": name, "truth": "none"},
        float(gyro.first),
    )
    (sequence,) = assemble(streams, rate, whole=True)
    if source.track is not None:
        sequence = _with_track(sequence, streams, source.track, gyro, notes)
    return Imported(sequence, tuple(notes), tuple(warnings))


def _check_overlap(source: Recording, gyro: _Clocked, accel: _Clocked, notes: list[str]) -> None:
    """Raise `InputError` where both sensors share less than the network's window."""
    first, last = max(gyro.time[0], accel.time[0]), min(gyro.time[-1], accel.time[-1])
    shortest = min(float(each.time[-1] - each.time[0]) for each in (gyro, accel))
    if shortest < WINDOW_SECONDS:
        raise InputError(
            source.path,
            f"lasts {shortest:.2f} s, less than the network's window of {WINDOW_SECONDS:g} s",
            "record for longer",
        )
    if last - first < WINDOW_SECONDS:
        raise InputError(
            source.accel.file,
            f"field 'time' overlaps by {max(last - first, 0.0):.3g} s "
            f"with that of gyro in {source.gyro.file.name}",
            "the files must be of one recording and one clock",
        )
    if not np.array_equal(gyro.time, accel.time):
        both = max(gyro.time[-1], accel.time[-1]) - min(gyro.time[0], accel.time[0])
        notes.append(
            "gyro and accel have stamps of their own: both are interpolated, "
            f"{both - (last - first):.2f} s cut that only one of them covers"
        )


def _in_si(
    source: Recording,
    stated: Units,
    gyro: _Clocked,
    accel: _Clocked,
    notes: list[str],
    warnings: list[str],
) -> tuple[np.ndarray, np.ndarray]:
    """(gyro rad/s, accel m/s² with Android's sign), each on its own stamps."""
    known, gyro_file, accel_file = source.units, source.gyro.file, source.accel.file
    unit = stated.accel or known.accel
    force = accel.values * units.accel_scale(accel.values, unit, accel_file, notes)
    inside = (gyro.time >= accel.time[0]) & (gyro.time <= accel.time[-1])
    time = gyro.time[inside]
    motion = units.Motion(time, gyro.values[inside], interpolate(time, accel.time, force))
    unit = stated.gyro or known.gyro
    scale = units.gyro_scale(motion, unit, gyro_file, notes)
    if stated.gyro is None and known.gyro is not None:
        units.check_rad_per_second(motion._replace(gyro=motion.gyro * scale), gyro_file)
    sign = stated.sign or known.sign
    if sign is None:
        raise InputError(
            accel_file,
            "the sign of field 'accel' depends on the phone's system, which is not known here",
            "state it: android, ios or detect",
        )
    force = units.signed(force, sign, accel_file, notes)
    upward = units.note_gravity(accel.time, force, accel_file, notes)
    if upward == "-z" and stated.sign is None and known.sign_is_assumed:
        warnings.append(
            f"sign: gravity reads on -z in {accel_file.name}: the screen points down, or this "
            "is iOS's sign and the track is wrong: compare with --accel-sign ios"
        )
    return gyro.values * scale, force


def _with_track(
    sequence: Sequence, streams: Streams, track: Track, gyro: _Clocked, notes: list[str]
) -> Sequence:
    """With the reference, where it can be one and describes the motion of the IMU."""
    later = float(Fraction(track.first) / int(PER_SECOND[gyro.unit]) - gyro.first)
    poses = track.poses._replace(time=track.poses.time + later)
    about = streams.attributes | {"truth": track.name}
    try:
        rate = rounded_rate(sequence.time)
        (result,) = assemble(streams._replace(poses=poses, attributes=about), rate, whole=True)
        # What the self-check would leave out is no reference.
        if failures := self_check(result, pedestrian=False).failures:
            raise InputError(
                poses.source,
                f"the reference {track.name} does not fit the IMU ({'; '.join(failures)})",
                "its frame must be the IMU's, its world z-up, its clock the same",
            )
    except InputError as error:
        if track.named:
            raise
        notes.append(f"no reference is taken: {error}")
        return sequence
    notes.append(f"reference from {track.name}, {result.valid.mean():.0%} of the time")
    return result


# --- a CSV


def _read_csv(
    gyro_path: Path,
    accel_path: str | os.PathLike[str] | None,
    columns: dict[str, str],
    time_unit_of_file: str | None,
) -> Recording:
    """One file, or one of each sensor, with the columns that the user names."""
    time = columns.get("time", "time")
    gyro_axes, accel_axes = (
        tuple(columns.get(axis, axis) for axis in axes) for axes in (GYRO, ACCEL)
    )
    table = read_table(gyro_path, (time, *gyro_axes))
    wanted = {"time": time, **dict(zip(GYRO, gyro_axes, strict=True))}
    of_accel = {"accel_time": columns.get("accel_time", time)}
    of_accel |= dict(zip(ACCEL, accel_axes, strict=True))
    # "a+b" is the sum of two columns.
    wanted |= {} if accel_path is not None else of_accel
    check_columns(gyro_path, table.columns, {n: c for n, c in wanted.items() if "+" not in c})
    gyro = sensor_of("gyro", table, time, gyro_axes)
    of_accel_file = table if accel_path is None else None
    if of_accel_file is None:
        columns_of_accel = (columns.get("accel_time", time), *accel_axes)
        of_accel_file = read_table(Path(accel_path), columns_of_accel)
    accel = sensor_of("accel", of_accel_file, columns.get("accel_time", time), accel_axes)
    known = Units(
        gyro=units.common_unit(gyro_axes, units.TO_RAD_PER_SECOND),
        accel=units.common_unit(accel_axes, units.TO_METRES_PER_SECOND_SQUARED),
        sign="android",
        sign_is_assumed=True,
    )
    pairs = ((gyro, known.gyro), (accel, known.accel))
    notes = [f"{one.file.name}: {one.name} in {unit}, by its header" for one, unit in pairs if unit]
    track = None
    try:
        track = _csv_reference(table, gyro, time_unit_of_file)
    except InputError as error:
        notes.append(f"no reference is taken: {error}")
    return Recording(gyro_path, gyro, accel, known, track, tuple(notes))


def _csv_reference(table: Table, gyro: Sensor, unit: str | None) -> Track | None:
    """The reference in the package's own columns, on the gyro's stamps."""
    if not np.isfinite(gyro.stamps).all() or len(gyro.stamps) < 2:
        return None  # the gyro is refused for this
    first = gyro.stamps.min().item()
    unit = unit or time_unit(gyro.stamps - first).unit
    poses = reference(table, seconds(gyro.stamps, first, unit)) if unit else None
    if poses is None:
        return None
    if len(poses.time) < SHORTEST_RUN:
        problem = f"holds {len(poses.time)} poses"
        raise InputError(table.path, problem, f"{SHORTEST_RUN} are the fewest")
    return Track("given", poses, first)


def _check_choice(option: str, value: str | None, choices: Mapping[str, float] | tuple) -> None:
    if value is not None and value not in choices:
        raise InputError(option, f"unknown value '{value}'", f"known: {', '.join(choices)}")


def impressions(sequence: Sequence) -> list[str]:
    """What a person can compare with what was recorded: length, strength, rest."""
    time = sequence.time
    step = float(np.median(np.diff(time)))
    accel, gyro = (np.linalg.norm(field, axis=1) for field in (sequence.accel, sequence.gyro))
    pull = f"{np.median(accel):.2f} m/s² in the median, {accel.min():.2f} to {accel.max():.2f}"
    lines = [
        f"{time[-1] - time[0]:.1f} s at {1.0 / step:.4g} Hz",
        f"|accel| {pull}",
        f"|gyro| {np.median(gyro):.2f} rad/s in the median, up to {gyro.max():.2f}",
    ]
    span = max(round(0.5 / step), 1)
    count = len(accel) // span
    if count:
        accel, gyro = (norm[: count * span].reshape(count, span) for norm in (accel, gyro))
        still = (accel.std(axis=1) < 0.2) & (gyro.mean(axis=1) < 0.1)
        lines.append(f"it rests {still.mean():.0%} of the time")
    return lines
