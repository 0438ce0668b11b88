"""A recording as people have it, as a `Sequence`: a phone logger's export, a robot's bag, a folder
of EuRoC's layout, or any CSV.

The steps: the format by the content (`recognition`), the samples of each sensor and the reference
as the reader of the format gives them (a `source.Source`), both sensors in order and on one clock
(`streams`), units and signs (`units`), one uniform clock, and the reference on it (`reference`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd

from gnio_jax.config import ImportOptions
from gnio_jax.data.importing.asl import read_asl
from gnio_jax.data.importing.bags import KINDS
from gnio_jax.data.importing.kept import Imported
from gnio_jax.data.importing.phyphox import read_phyphox
from gnio_jax.data.importing.recognition import recognise
from gnio_jax.data.importing.reference import with_reference
from gnio_jax.data.importing.ros import Topics, read_bag
from gnio_jax.data.importing.sensor_logger import read_sensor_logger
from gnio_jax.data.importing.source import Source, Track, Units
from gnio_jax.data.importing.streams import (
    Joined,
    SensorFile,
    Stream,
    join,
    read_stream,
    read_table,
)
from gnio_jax.data.parsing import units
from gnio_jax.data.parsing.stamps import PER_SECOND, RATES, rounded_rate, seconds
from gnio_jax.data.parsing.stamps import time_unit as detect_time_unit
from gnio_jax.data.parsing.tables import Table
from gnio_jax.data.readers.csv_files import ACCEL, GYRO, check_columns, reference
from gnio_jax.data.reference import SHORTEST_RUN
from gnio_jax.data.resampling import resample
from gnio_jax.data.self_check import self_check
from gnio_jax.data.validation import WINDOW_SECONDS, validate
from gnio_jax.errors import InputError
from gnio_jax.types import Sequence

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

    Two sensors with stamps of their own are put on the faster one's over the time that both cover,
    by cubic splines. Raises `InputError` naming file, field and remedy.
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


def _read_other(path: Path, kind: str, topics: Topics) -> Source:
    match kind:
        case "sensor_logger":
            return read_sensor_logger(path)
        case "phyphox":
            return read_phyphox(path)
        case "euroc":
            return read_asl(path)
        case _:
            return read_bag(path, kind, topics)


def _imported(source: Source, stated: Units, rate: float | None, name: str) -> Imported:
    """What any format comes to: `stated` wins over what the format says of its units."""
    notes, warnings = list(source.notes), []
    imu = _joined(source, stated, notes, warnings)
    sequence = _without_reference(imu, name, source.gyro.path)
    own = rounded_rate(imu.time)
    target = rate or own
    notes.append(f"put on a uniform clock of {target:g} Hz")
    if own < SLOW:
        notes.append(
            f"it was recorded at {own:g} Hz, which is slow: steps need {SLOW:g} Hz, and the "
            "networks were trained on 100 Hz and more"
        )
    sequence = resample(sequence, target)
    if source.track is not None:
        sequence = _with_track(sequence, imu.start, source.track, notes)
    return Imported(sequence, tuple(notes), tuple(warnings))


def _with_track(sequence: Sequence, start: float, track: Track, notes: list[str]) -> Sequence:
    """With the reference, where it can be one and describes the motion of the IMU."""
    try:
        result = with_reference(sequence, start, track)
        _check_motion_is_one(result, track)
    except InputError as error:
        if track.named:
            raise
        notes.append(f"no reference is taken: {error}")
        return sequence
    notes.append(f"reference from {track.name}, {result.valid.mean():.0%} of the time")
    return result


def _check_motion_is_one(sequence: Sequence, track: Track) -> None:
    """Raise `InputError` where the self-check would leave the sequence out."""
    if failures := self_check(sequence, pedestrian=False).failures:
        raise InputError(
            track.path,
            f"the reference {track.name} does not fit the IMU ({'; '.join(failures)})",
            "its frame must be the IMU's, its world z-up, its clock the same",
        )


def _joined(source: Source, stated: Units, notes: list[str], warnings: list[str]) -> Joined:
    """Both sensors on one clock, in SI units and with Android's sign."""
    gyro_file, accel_file, known = source.gyro, source.accel, source.units
    time_unit = stated.time or known.time
    gyro = read_stream(gyro_file, time_unit, notes)
    accel = read_stream(accel_file, time_unit, notes)
    _check_length(gyro, accel, source.path)
    scale = units.accel_scale(accel.values, stated.accel or known.accel, accel_file.path, notes)
    imu = join(gyro, _scaled(accel, scale), gyro_file.path, accel_file.path, notes)
    scale = units.gyro_scale(_imu(imu), stated.gyro or known.gyro, gyro_file.path, notes)
    imu = imu._replace(gyro=imu.gyro * scale)
    if stated.gyro is None and known.gyro is not None:
        units.check_rad_per_second(_imu(imu), gyro_file.path)
    sign = stated.sign or known.sign
    if sign is None:
        raise InputError(
            accel_file.path,
            "the sign of field 'accel' depends on the phone's system, which is not known here",
            "state it: android, ios or detect",
        )
    force = units.signed(imu.accel, sign, accel_file.path, notes)
    imu = imu._replace(accel=force)
    upward = units.note_gravity(_imu(imu), accel_file.path, notes)
    if upward == "-z" and stated.sign is None and known.sign_is_assumed:
        warnings.append(
            f"sign: gravity reads on -z in {accel_file.path.name}: the screen points down, or this "
            "is iOS's sign and the track is wrong: compare with --accel-sign ios"
        )
    return imu


def _check_length(gyro: Stream, accel: Stream, path: Path) -> None:
    seconds = float(min(gyro.time[-1], accel.time[-1]))
    if seconds < WINDOW_SECONDS:
        raise InputError(
            path,
            f"lasts {seconds:.2f} s, less than the network's window of {WINDOW_SECONDS:g} s",
            "record for longer",
        )


def _check_choice(option: str, value: str | None, choices: Mapping[str, float] | tuple) -> None:
    if value is not None and value not in choices:
        raise InputError(option, f"unknown value '{value}'", f"known: {', '.join(choices)}")


def _read_csv(
    gyro_path: Path,
    accel_path: str | os.PathLike[str] | None,
    columns: dict[str, str],
    time_unit: str | None,
) -> Source:
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
    gyro = SensorFile("gyro", gyro_path, table, time, gyro_axes)
    accel = SensorFile("accel", gyro_path, table, columns.get("accel_time", time), accel_axes)
    if accel_path is not None:
        own = Path(accel_path)
        accel_table = read_table(own, (accel.time, *accel_axes))
        accel = accel._replace(path=own, table=accel_table)
    known = Units(
        gyro=units.common_unit(gyro.axes, units.TO_RAD_PER_SECOND),
        accel=units.common_unit(accel.axes, units.TO_METRES_PER_SECOND_SQUARED),
        sign="android",
        sign_is_assumed=True,
    )
    pairs = ((gyro, known.gyro), (accel, known.accel))
    notes = [
        f"{one.path.name}: {one.sensor} in {unit}, by its header" for one, unit in pairs if unit
    ]
    track = None
    try:
        track = _csv_reference(gyro_path, table, time, time_unit)
    except InputError as error:
        notes.append(f"no reference is taken: {error}")
    return Source(gyro_path, gyro, accel, known, track, tuple(notes))


def _csv_reference(path: Path, frame: pd.DataFrame, time: str, unit: str | None) -> Track | None:
    """The reference in the package's own columns, on the gyro's stamps."""
    table = Table(path, frame)
    stamps = table.stamps(time)
    first = stamps.min().item()
    unit = unit or detect_time_unit(stamps - first).unit
    if unit is None:  # the gyro's own stamps are refused for this
        return None
    poses = reference(table, seconds(stamps, first, unit))
    if poses is None:
        return None
    rows = np.unique(poses.time, return_index=True)[1]
    if len(rows) < SHORTEST_RUN:
        raise InputError(path, f"holds {len(rows)} poses", f"{SHORTEST_RUN} are the fewest")
    velocity = None if poses.velocity is None else poses.velocity[rows]
    poses = poses._replace(
        time=poses.time[rows],
        attitude=poses.attitude[rows],
        position=poses.position[rows],
        velocity=velocity,
    )
    return Track(path, "given", float(first) / PER_SECOND[unit], poses)


def _scaled(stream: Stream, scale: float) -> Stream:
    return stream._replace(values=stream.values * scale)


def _imu(joined: Joined) -> units.Imu:
    return units.Imu(joined.time, joined.gyro, joined.accel)


def _without_reference(imu: Joined, name: str, source: Path) -> Sequence:
    count = len(imu.time)
    nothing = np.full((count, 3), np.nan)
    sequence = Sequence(
        name=name,
        time=imu.time,
        gyro=imu.gyro,
        accel=imu.accel,
        orientation=np.full((count, 4), np.nan),
        position=nothing,
        velocity=nothing,
        valid=np.zeros(count, dtype=bool),
        imu_valid=imu.valid,
        attributes={"dataset": "csv", "group": name, "truth": "none", "start_time": imu.start},
    )
    return validate(sequence, source)


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
