"""The track of a car's drive (ours). No network predicts the path of a car, so the filter measures
other things in its place (`docs/vehicles.md`):

1. Stops: seconds in which neither the mean rate nor the mean force of a tenth of a second changes.
   They give the gyro's bias, and in the filter a velocity of zero.
2. The mounting, from the whole drive (`filtering.mounting`), and with it the constraint that a car
   moves neither sideways nor up.
3. Heights of a barometer and fixes of a receiver, as for a walk (`apps.sensors`). A car that moves
   at its start has the speed of its first fixes.

The field in a car is that of its steel and its currents, so a magnetometer is left out.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from gnio_jax import config as configuration
from gnio_jax.apps import sensors
from gnio_jax.config import TrainConfig
from gnio_jax.data.gait import detect_gait
from gnio_jax.data.geodesy import Place, east_north_up
from gnio_jax.data.resampling import resample
from gnio_jax.data.sensors import GNSS, MAGNETOMETER
from gnio_jax.data.validation import check_bridged
from gnio_jax.errors import InputError
from gnio_jax.evaluation import (
    PreparedRecording,
    SequenceEstimate,
    estimate,
    no_displacements,
    prepare,
)
from gnio_jax.filtering import Filter, find_mounting, make_filter
from gnio_jax.filtering.mounting import Mounting
from gnio_jax.filtering.nonholonomic import NonHolonomic, car_axes
from gnio_jax.geometry import level
from gnio_jax.numerics import rotation_z, yaw
from gnio_jax.reporting import Progress, silent
from gnio_jax.types import GRAVITY, Readings, Sequence

MEASURED = (
    "on the two drives with a reference on which this was measured, from rest and without fixes, "
    "the path errs by 3.3 and 1.5 % of the way (t_rel, onavdata)"
)
"""What is known about the error (`docs/vehicles.md`)."""
DRIVEN, APART = 4.0, 5.0
"""Upper quartile of the speeds between fixes that are at least this time, s, apart, from which a
recording without steps is a drive, m/s (ours). It is a quartile because a fix may be kilometres
off, and fixes that follow each other closely show their errors."""
MEAN_SECONDS = 0.1
"""Length of the means that show a stop, s."""
STOP_BIAS, STOP_SPEED = 5e-4, 0.05
"""Standard deviations of the gyro's bias after a stop, rad/s, which walks, and of the velocity at
one, m/s (ours)."""
FIRST_FIXES = 15.0
"""Time of the first fixes to which the path is aligned, s: a car that moves needs no more."""
ROAD_STD = 0.05
"""Standard deviation of the tilt of a road, rad (ours)."""
UNKNOWN_SPEED = 15.0
"""Standard deviation of the first velocity of a car that moves, m/s (ours)."""
FIRST_SECONDS = 5.0
"""Time of the first fixes that give the speed, s."""
FASTEST = 70.0
"""Speed that no car reaches, m/s: a fix that needs it is off (ours)."""
SPEED_ERROR, LEAST_SPEED_STD = 0.3, 1.5
"""Standard deviation of that speed, as a share of it, and the smallest one, m/s (ours)."""


class Stops(NamedTuple):
    """The seconds in which a car stands."""

    still: Bool[np.ndarray, "k"]
    """Which whole seconds of the recording; none of which a sample is missing."""
    gyro_bias: Float[np.ndarray, "3"]
    """Median of the gyro in them, rad/s; zero if there is none."""


def is_drive(sequence: Sequence, readings: dict[str, Readings]) -> bool:
    """Whether the fixes of a recording without steps show a drive."""
    fixes = readings.get(GNSS)
    if fixes is None:
        return False
    rate = 1.0 / float(np.median(np.diff(sequence.time)))
    if detect_gait(sequence.gyro, sequence.accel, rate).has_steps:
        return False
    later = np.searchsorted(fixes.time, fixes.time + APART)
    earlier = np.flatnonzero(later < len(fixes.time))
    if not len(earlier):
        return False
    time, position = fixes.time, _on_map(fixes)
    distance = np.linalg.norm(position[later[earlier]] - position[earlier], axis=1)
    return bool(np.quantile(distance / (time[later[earlier]] - time[earlier]), 0.75) > DRIVEN)


def load_filter(carrier: str) -> TrainConfig:
    """The configuration of a car's filter: "car" is configs/drive.yaml, others are files or names
    of experiments. Raises `InputError` if it cannot be read, or is none of a car."""
    is_name = carrier in configuration.experiment_names()
    if carrier != "car" and not is_name and not Path(carrier).exists():
        problem = f"'{carrier}' is neither person nor car, and no such file"
        raise InputError("--carrier", problem, "give person, car, or a file as configs/drive.yaml")
    config = configuration.load("drive" if carrier == "car" else carrier)
    config = configuration.validate(config, carrier)
    if NonHolonomic.name not in config.filter.measurements:
        problem = "has no filter.measurements.nonholonomic, so it is no filter of a car"
        raise InputError(carrier, problem, "write it as configs/drive.yaml, or give --carrier car")
    return config


def estimate_drive(
    sequence: Sequence,
    readings: dict[str, Readings],
    config: TrainConfig,
    progress: Progress = silent,
) -> sensors.Fused:
    """The estimate of a drive, as `track.estimate_recording` gives that of a walk.

    Args:
        sequence: The recording.
        readings: The readings of its other sensors.
        config: The rate and the filter, as configs/drive.yaml has them.
        progress: A function that gets the finished share.

    Raises:
        InputError: The drive does not show the mounting, the settings do not state it, and there
            are no fixes; or the recording is too short or has a hole that is too long.
    """
    check_bridged(sequence)
    ekf, rate = make_filter(config.data, config.filter), config.data.rate
    sequence = resample(sequence, rate)
    stops = find_stops(sequence, rate, ekf)
    notes = [f"car: it stands for {stops.still.sum()} s, which give the gyro's bias"]
    if not stops.still.any():
        notes = ["car: it never stands still, so the gyro's bias starts from zero"]
    mounting = _stated_mounting(config)
    source = "of the settings"
    if mounting is None:
        try:
            gyro = sequence.gyro - stops.gyro_bias
            mounting = find_mounting(gyro, sequence.accel, rate, sequence.name)
            source = f"±{np.degrees(mounting.std):.1f}°"
        except InputError as error:
            problem = error.parts[1]
            if GNSS not in readings:
                remedy = "drive on, through bends; or give --carrier FILE, as configs/drive.yaml, "
                remedy += "with yaw, pitch and roll (rad) of nonholonomic"
                raise InputError(sequence.name, problem, remedy) from error
            notes.append(f"car: no constraint, because the mounting is unknown: {problem}")
    if mounting is not None:
        angles = np.degrees([mounting.yaw, mounting.pitch, mounting.roll])
        words = "mounting: yaw {:.0f}°, pitch {:.0f}°, roll {:.0f}°".format(*angles)
        notes.append(f"{words} ({source})")
    ekf = dataclasses.replace(ekf, measurements=tuple(_measurements(ekf, mounting)))
    prepared, left_out = prepare([sequence], config.data, ekf, init="static", from_first=True)
    if not prepared:
        raise InputError(sequence.name, left_out[sequence.name], "record for longer")
    ready = _start(prepared[0], stops, mounting, readings.get(GNSS))
    ready = ready._replace(notes=(*ready.notes, *notes))

    none = [no_displacements(ready)]
    (first,) = estimate([ready], none, config.data, ekf, 1, progress)

    def run(ready: PreparedRecording, ekf: Filter) -> SequenceEstimate:
        return estimate([ready], none, config.data, ekf, 1)[0]

    others = {sensor: rows for sensor, rows in readings.items() if sensor != MAGNETOMETER}
    fused = sensors.fuse(first, ready, ekf, others, run, FIRST_FIXES)
    if MAGNETOMETER in readings:
        reason = "left out: the field in a car is that of its steel and its currents"
        use = sensors.SensorUse(MAGNETOMETER, len(readings[MAGNETOMETER].time), None, reason)
        fused = fused._replace(uses=(*fused.uses, use))
    return fused


def find_stops(sequence: Sequence, rate: float, ekf: Filter) -> Stops:
    """The seconds in which the means of gyro and accelerometer over `MEAN_SECONDS` differ from the
    second's mean by less than the filter's bounds of rest, and the mean rate from the median of
    these seconds."""
    config = ekf.config
    parts = max(int(min(1.0 / MEAN_SECONDS, rate) + 1e-6), 1)  # each has at least one sample
    seconds = int(len(sequence.time) / rate + 1e-6)
    edges = np.round(np.arange(seconds * parts + 1) * rate / parts).astype(int)
    sums = (
        np.add.reduceat(signal[: edges[-1]], edges[:-1])
        for signal in (sequence.gyro, sequence.accel)
    )
    gyro, accel = ((part / np.diff(edges)[:, None]).reshape(seconds, parts, 3) for part in sums)
    still = np.linalg.norm(gyro - gyro.mean(1, keepdims=True), axis=2).max(1) < config.rest_gyro
    still &= np.linalg.norm(accel - accel.mean(1, keepdims=True), axis=2).max(1) < config.rest_accel
    if sequence.imu_valid is not None:  # samples on a line across a hole look like rest
        measured = sequence.imu_valid[: edges[-1]]
        still &= np.logical_and.reduceat(measured, edges[:-1:parts])
    if not still.any():
        return Stops(still, np.zeros(3))
    bias = np.median(gyro[still].mean(1), axis=0)
    still &= np.linalg.norm(gyro.mean(1) - bias, axis=1) < config.rest_gyro
    return Stops(still, bias)


def _stated_mounting(config: TrainConfig) -> Mounting | None:
    """The mounting of the settings; None if they have none of its angles."""
    numbers = config.filter.measurements.get(NonHolonomic.name) or {}
    angles = {name: float(numbers[name]) for name in ("yaw", "pitch", "roll") if name in numbers}
    if not angles:
        return None
    return Mounting(**{"yaw": 0.0, "pitch": 0.0, "roll": 0.0, **angles}, std=0.0)


def _measurements(ekf: Filter, mounting: Mounting | None) -> list:
    """The measurements of the filter with this mounting; without one there is no constraint."""
    measurements = []
    for measurement in ekf.measurements:
        if not isinstance(measurement, NonHolonomic):
            measurements.append(measurement)
        elif mounting is not None:
            yaw, pitch, roll, _ = mounting
            measurements.append(measurement._replace(yaw=yaw, pitch=pitch, roll=roll))
    return measurements


def _start(
    ready: PreparedRecording,
    stops: Stops,
    mounting: Mounting | None,
    fixes: Readings | None,
) -> PreparedRecording:
    """The start with the gyro's bias of the stops.

    A car that stands has the tilt that the mean force of its first second shows. One that does not
    has the tilt of its mounting on a level road, because the mean force has the acceleration in it,
    and the speed of its first fixes, ahead. Without them the speed is unknown.
    """
    start = ready.start
    notes = [note for note in ready.notes if not note.startswith("start: ")]
    rotation, velocity, std = start.rotation, start.velocity, start.std
    if stops.still.any():
        std = std._replace(gyro_bias=STOP_BIAS)
    elif start.raw_gyro:
        std = std._replace(gyro_bias=sensors.RAW_BIAS)
    if stops.still[:1].any():
        # An engine shakes the samples, so a walker's start would turn them by a gyro with its bias.
        second = round(len(ready.accel) / (ready.time[-1] - ready.time[0]))
        rotation = np.asarray(level(jnp.asarray(ready.accel[:second].mean(axis=0))))
        std = std._replace(velocity=STOP_SPEED, tilt=float(std.accel_bias) / GRAVITY)
    else:
        speed = None if fixes is None else first_speed(fixes, ready.time[0])
        std, note = std._replace(velocity=UNKNOWN_SPEED), "nothing shows its speed"
        if mounting is not None:
            rotation = np.asarray(car_axes(mounting.yaw, mounting.pitch, mounting.roll))
            rotation = rotation_z(-yaw(rotation)) @ rotation
            std = std._replace(tilt=ROAD_STD)
        if speed is not None and mounting is not None:
            velocity = speed * (rotation @ car_axes(*mounting[:3])[0])
            std = std._replace(velocity=max(SPEED_ERROR * speed, LEAST_SPEED_STD))
            note = f"its first fixes show {speed:.0f} m/s"
        notes.append(f"start: the car moves, and {note}")
    start = start._replace(
        rotation=rotation,
        velocity=np.asarray(velocity),
        gyro_bias=stops.gyro_bias,
        std=std,
        level_gyro_bias=std.gyro_bias,
        raw_gyro=start.raw_gyro and not stops.still.any(),
    )
    return ready._replace(start=start, notes=tuple(notes))


def first_speed(fixes: Readings, start: float) -> float | None:
    """The speed at the start by the fixes of the first `FIRST_SECONDS`, m/s: that of a parabola,
    because a car speeds up, or of a line through two or three. Fixes that no car reaches from the
    others are left out. None with fewer than two, less than two seconds between them, or a speed
    of no car."""
    rows = (fixes.time >= start - 1.0) & (fixes.time <= start + FIRST_SECONDS)
    time, position = fixes.time[rows] - start, _on_map(fixes)[rows]
    if len(time) > 2:
        distance = np.linalg.norm(position - np.median(position, axis=0), axis=1)
        reached = distance < FASTEST * np.ptp(time)
        time, position = time[reached], position[reached]
    if len(time) < 2 or np.ptp(time) < 2.0:
        return None
    speed = float(np.linalg.norm(np.polyfit(time, position, 2 if len(time) > 3 else 1)[-2]))
    return speed if speed < FASTEST else None


def _on_map(fixes: Readings) -> Float[np.ndarray, "f 2"]:
    """East and north of the first fix, m."""
    places = np.column_stack([fixes.values[:, :2], np.zeros(len(fixes.time))])
    return east_north_up(places, Place(*places[0].tolist()))[:, :2]
