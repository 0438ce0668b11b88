"""A recording from the reader of its format, and its conversion to a `Sequence`: rows in order,
units and signs, the uniform clock of all recordings (`data.assembly`), the reference."""

from __future__ import annotations

import re
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from gnio_jax.apps.importing import units
from gnio_jax.apps.importing.clocks import Clocked, Sensor, read_clock
from gnio_jax.apps.importing.readings import RawReadings, readings_on_clock
from gnio_jax.config import ImportOptions
from gnio_jax.data import physics
from gnio_jax.data.assembly import Poses, Samples, Streams, assemble
from gnio_jax.data.parsing.stamps import RATES, is_rate, rounded_rate
from gnio_jax.data.resampling import longest_bridge
from gnio_jax.data.self_check import self_check
from gnio_jax.data.validation import WINDOW_SECONDS
from gnio_jax.errors import InputError
from gnio_jax.numerics import interpolate
from gnio_jax.types import Sequence

GAPS = "lacks samples"
"""Words in a note about holes in a recording."""
WORTH_TELLING = 0.05
"""Time at both ends for which only one sensor has samples, beyond which a note has it, s (ours)."""
SLOW = 50.0
"""Rate below which the impacts of steps are lost, Hz (ours)."""

IN_TURN = 2.0
"""Ratio of the steps between neighbouring samples and between every second one, of gyro and accel,
beyond which two devices take turns (ours). Walks have 0.5 to 0.8 and the drones of EuRoC up to 1.6;
two walks in turn have 2.7 and more."""
LEAST_APART = 0.01
"""Distance of the mean specific forces of two devices, of their mean: their biases and the way in
which they are held differ."""


class Track(NamedTuple):
    """A reference trajectory on the clock of the IMU's stamps."""

    name: str
    """The file or topic, as in the sequence's attribute `truth`."""
    poses: Poses
    """Poses of the IMU in a z-up world, in s after `start`."""
    start: Fraction
    """s."""
    named: bool = False
    """Whether the user asked for it. A problem is then an error, and otherwise a note."""


class RawRecording(NamedTuple):
    """A recording from a reader, before the conversion of units, clocks and rates."""

    path: Path
    """Path, as the user named it."""
    gyro: Sensor
    accel: Sensor
    notes: list[str]
    """Notes about what was recognised, chosen or left out, one sentence each."""
    warnings: list[str]
    """Warnings about problems that may make all results wrong, one sentence each."""
    sign: str | None = None
    """Sign of the accelerometer: android, ios or detect (see `units.with_sign`), if it is known."""
    sign_is_assumed: bool = False
    track: Track | None = None
    raw_gyro: bool = False
    """Whether it is known that the phone subtracts no bias from the gyro."""
    others: tuple[RawReadings, ...] = ()
    """The sensors beside the IMU."""
    by_columns: bool = True
    """Whether it is a table, whose columns and rate options can state."""


class Imported(NamedTuple):
    """A recording on a uniform clock, with a reference if it has one, and its notes and warnings
    for the user."""

    sequence: Sequence
    notes: tuple[str, ...]
    warnings: tuple[str, ...] = ()


def as_sequence(
    raw: RawRecording, options: ImportOptions, rate: float | None, name: str
) -> Imported:
    """The sequence of a recording in any format; units in `options` override those of the format.
    Raises `InputError`."""
    notes, sensors = raw.notes, (raw.gyro, raw.accel)
    gyro, accel = (read_clock(one, options.time_unit, notes, raw.warnings) for one in sensors)
    _check_one_device(gyro, accel, raw.warnings)
    delay = float(accel.start - gyro.start)
    accel = accel._replace(time=accel.time + delay, row_time=accel.row_time + delay)
    gyro, accel = _in_si(raw, options, gyro, accel)
    if not np.array_equal(gyro.time, accel.time):
        lost = sum(abs(gyro.time[row] - accel.time[row]) for row in (0, -1))
        note = "gyro and accel have different stamps: both are interpolated to one clock"
        cut = f", and {lost:.2f} s that only one of them covers are cut off"
        notes.append(note + cut if lost >= WORTH_TELLING else note)
    recorded = max(rounded_rate(gyro.time), rounded_rate(accel.time))
    notes.append(f"put on a uniform clock of {rate or recorded:g} Hz")
    if recorded < SLOW:
        notes.append(f"it was recorded at {recorded:g} Hz, which is slow: steps need {SLOW:g} Hz")
    attributes = {"dataset": "csv", "group": name, "truth": "none"}
    attributes |= {"imu_compensated": "no"} if raw.raw_gyro else {}
    samples = [Samples(one.time, one.values, str(one.file)) for one in (gyro, accel)]
    streams = Streams(name, str(raw.path), samples[0], samples[1], attributes, float(gyro.start))
    by_stamps = options.sample_rate is None
    readings = readings_on_clock(raw.others, gyro, accel, by_stamps, notes, raw.warnings)
    streams = streams._replace(readings=readings)
    sequence = raw.track and _with_track(streams, rate, raw.track, gyro.start, notes)
    if sequence is None:
        (sequence,) = assemble(streams, rate, whole=True)
    return Imported(sequence, tuple(notes), tuple(dict.fromkeys(raw.warnings)))


def _check_one_device(gyro: Clocked, accel: Clocked, warnings: list[str]) -> None:
    """Raise `InputError` if the samples of two devices take turns in both sensors; a warning, if
    this may be a vibration."""

    def step(values: Float[np.ndarray, "n 3"], count: int) -> float:
        return float(np.median(np.linalg.norm(values[count:] - values[:-count], axis=1)))

    if len(accel.values) <= 2:
        return
    if all(step(one.values, 1) > IN_TURN * step(one.values, 2) for one in (gyro, accel)):
        problem = "in gyro and accel, samples differ far more from the next one than from the"
        problem += " second next"
        # A part that vibrates at half of the rate turns back and forth about one mean.
        distance = np.linalg.norm(accel.values[::2].mean(axis=0) - accel.values[1::2].mean(axis=0))
        if distance < LEAST_APART * np.linalg.norm(accel.values.mean(axis=0)):
            text = f"{gyro.file.name}: {problem}: it vibrates at about half of its rate, or two"
            warnings.append(f"{text} devices take turns, whose track is wrong")
            return
        problem = f"holds two sensors in turn: {problem}"
        remedy = "keep the samples of one sensor, in a table whose column names it by --where"
        raise InputError(gyro.file, problem, remedy)


def _in_si(
    raw: RawRecording, options: ImportOptions, gyro: Clocked, accel: Clocked
) -> tuple[Clocked, Clocked]:
    """Gyro in rad/s and accel in m/s² with Android's sign, each on its own stamps, without repeated
    rows. Raises `InputError` if a sensor is dead, or if both contradict each other."""
    notes, warnings = raw.notes, raw.warnings
    warnings += physics.check_alive(gyro.values, "gyro", gyro.file)
    warnings += physics.check_alive(accel.values, "accel", accel.file)
    unit = options.accel_unit or raw.accel.unit
    scale, doubts = units.accel_scale(accel.values, unit, accel.file, notes)
    accel = accel._replace(values=accel.values * scale)
    rows, is_slower = physics.repeats(gyro.time, gyro.values)
    force = interpolate(gyro.time, accel.time, accel.values)
    # Some gyros read 0 at rest: these rows are measured.
    rows &= ~physics.find_rest(physics.ImuSamples(gyro.time, gyro.values, force), rows)
    gyro = _without_repeats(gyro, rows, is_slower, raw)
    accel = _without_repeats(accel, *physics.repeats(accel.time, accel.values), raw)
    first, last = max(gyro.time[0], accel.time[0]), min(gyro.time[-1], accel.time[-1])
    if last - first < WINDOW_SECONDS:
        problem = f"both sensors were recorded for {max(last - first, 0.0):.2f} s, less than the"
        problem += f" network's window of {WINDOW_SECONDS:g} s"
        raise InputError(raw.path, problem, "record for longer, both by one clock")
    inside = (gyro.time >= first) & (gyro.time <= last)
    force = interpolate(gyro.time[inside], accel.time, accel.values)
    imu = physics.ImuSamples(gyro.time[inside], gyro.values[inside], force)
    unit = options.gyro_unit or raw.gyro.unit
    scale, slowness = units.gyro_scale(imu, unit, gyro.file, notes)
    imu = imu._replace(gyro=imu.gyro * scale)
    adapt = str if raw.by_columns else _without_columns
    read_as = next((name for name in physics.SCALES if units.UNITS["gyro"][name] == scale), None)
    warnings += doubts + slowness + physics.check_turning(imu, gyro.file, adapt, read_as)
    if (gyro.is_doubtful or accel.is_doubtful) and not physics.is_clock_supported(imu):
        problem = f"field 'time' makes it run at {rounded_rate(imu.time):g} Hz, which may be wrong"
        remedy = "if that is right, state its unit by --time-unit, or give --sample-rate (Hz)"
        raise InputError(gyro.file, problem, remedy)
    sign = options.accel_sign or raw.sign
    if sign is None:
        problem = "the sign of field 'accel' depends on the phone's system, which is not known here"
        raise InputError(accel.file, problem, "state it: android, ios or detect")
    force = units.with_sign(accel.values, sign, accel.file, notes)
    upward = units.note_gravity(accel.time, force, accel.file, notes)
    if upward == "-z" and options.accel_sign is None and raw.sign_is_assumed:
        problem = f"gravity reads on -z in {accel.file.name}: the screen points down, or this is"
        remedy = "compare with --accel-sign ios"
        warnings.append(f"sign: {problem} iOS's sign and the track is wrong: {remedy}")
    return gyro._replace(values=gyro.values * scale), accel._replace(values=force)


def _without_columns(remedy: str) -> str:
    """A remedy for a recording that is no table, in the place of one by columns or by a rate."""
    remedy = re.sub(r",? (or|as by) --columns.*", " in their driver, or in the bag", remedy)
    return remedy.replace(" or --sample-rate (Hz)", "")


def _without_repeats(
    samples: Clocked, rows: Bool[np.ndarray, " n"], is_slower: bool, raw: RawRecording
) -> Clocked:
    """The samples without `rows` that repeat the one before: the sensor is slower than its rows, or
    it hung. Holes are noted. Raises `InputError` if it hung for longer than a window."""
    name, file = samples.name, samples.file
    samples = samples._replace(time=samples.time[~rows], values=samples.values[~rows])
    rate, gaps = rounded_rate(samples.time), np.diff(samples.time)
    problem = f"{file.name}: {name} repeats the same values in {rows.sum()} of {len(rows)} rows"
    if is_slower and is_rate(rate):
        raw.notes.append(f"{problem}: they are not samples, and it runs at {rate:g} Hz")
    elif is_slower:
        remedy = f"an IMU runs at {RATES[0]:g} to {RATES[1]:g} Hz"
        raise InputError(file, f"{name} runs at {rate:.3g} Hz without repeated values", remedy)
    elif rows.any() and gaps.max() > WINDOW_SECONDS:
        problem = f"{name} repeats the same values for {gaps.max():.2f} s after"
        problem += f" {samples.time[np.argmax(gaps)]:.2f} s: it was stuck"
        raise InputError(file, problem, "cut the recording there")
    elif rows.any():
        raw.warnings.append(f"sensors: {problem}: it was stuck, and they are left out")
    gaps = gaps[gaps > longest_bridge(rate)]
    if gaps.size:
        problem = f"{name} {GAPS} {gaps.size} times, for up to {gaps.max():.2f} s"
        raw.notes.append(f"{file.name}: {problem}; bridged linearly")
    return samples


def _with_track(
    streams: Streams, rate: float | None, track: Track, start: Fraction, notes: list[str]
) -> Sequence | None:
    """The recording with the reference; None if that is no valid reference, or does not describe
    the motion of the IMU."""
    poses = track.poses._replace(time=track.poses.time + float(track.start - start))
    attributes = streams.attributes | {"truth": track.name}
    streams = streams._replace(poses=poses, attributes=attributes)
    try:
        (sequence,) = assemble(streams, rate, whole=True)
        # A reference that fails the self-check is not used.
        if failures := self_check(sequence, pedestrian=False).failures:
            problem = f"the reference {track.name} does not fit the IMU ({'; '.join(failures)})"
            remedy = "its frame must be the IMU's, its world z-up, its clock the same"
            raise InputError(poses.source, problem, remedy)
    except InputError as error:
        if track.named:
            raise
        notes.append(f"no reference is taken: {error}")
        return None
    notes.append(f"reference from {track.name}, {sequence.valid.mean():.0%} of the time")
    return sequence
