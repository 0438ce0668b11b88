"""The trajectory of samples that are arrays in memory (`gnio_jax.track`).

arrays → check → one clock, as of every recording → the start and the filter of `gnio track`
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from gnio_jax import networks
from gnio_jax.apps.heading import without_heading
from gnio_jax.apps.importing import units
from gnio_jax.apps.importing.clocks import Sensor
from gnio_jax.apps.importing.readings import RawReadings
from gnio_jax.apps.importing.recording import RawRecording, as_sequence
from gnio_jax.apps.summary import summarise
from gnio_jax.apps.track import estimate_recording
from gnio_jax.config import ImportOptions
from gnio_jax.data import physics
from gnio_jax.data.geodesy import Place
from gnio_jax.data.parsing.stamps import check_seconds, first_stamp
from gnio_jax.data.sensors import GNSS, SENSOR_KINDS, check_readings
from gnio_jax.data.validation import check_accel
from gnio_jax.errors import InputError
from gnio_jax.types import Readings

SOURCE = "samples"
"""Name of the arrays in messages and notes."""


class Odometry(NamedTuple):
    """Poses of an IMU, its velocity, and the uncertainty of its position, at k moments.

    The world is z-up. It begins where the IMU begins, with yaw zero; with fixes of a receiver its
    axes are east and north. Rows from a divergence of the filter on are NaN, and a note says why.
    """

    time: Float[np.ndarray, "k"]
    """Stamps on the clock of the samples, s: the first sample, and the end of each stride."""
    position: Float[np.ndarray, "k 3"]
    """m."""
    orientation: Float[np.ndarray, "k 4"]
    """Body→world, unit quaternions wxyz."""
    velocity: Float[np.ndarray, "k 3"]
    """m/s."""
    covariance: Float[np.ndarray, "k 3 3"]
    """Covariance of the error of `position`, m²."""
    notes: tuple[str, ...]
    """Warnings, what was found out about the samples and the start, and what the other sensors did,
    one sentence each."""
    origin: Place | None = None
    """The place of the start on the earth, if fixes show it."""


def track(
    time: Any,
    gyro: Any,
    accel: Any,
    network: str | Path = "pedestrian",
    heading: str = "device",
    sensors: Mapping[str, Any] = MappingProxyType({}),
) -> Odometry:
    """The trajectory of a phone that somebody carries, from arrays of its IMU's samples.

    Start, filter and result are those of `gnio track` for a file with these samples. Stand still
    for a second at the beginning: the first second gives the tilt, and a rest gives the gyro's
    bias. Rows may be out of order, holes of up to a second are bridged, and the rate is that of the
    samples, 10 to 2000 Hz. The filter runs in float64, whatever JAX is set to.

    Args:
        time: (n,) stamps, s, from any origin.
        gyro: (n, 3) angular rate, body frame, rad/s.
        accel: (n, 3) specific force, body frame, m/s², with gravity in it: the axis that points up
            reads +9.81 at rest, as on Android.
        network: Name of a trained network, or its folder or zip.
        heading: What shows a network with `model.equivariance: device_heading` the direction of a
            walk while a screen faces up: "device", where the device looks, or "gait" alone, for a
            phone that is held across and for a device that is no phone. Other networks, as the
            included one, go by the gait anyway and refuse "gait".
        sensors: Readings of the phone's other sensors, with the stamps of the sensor, f of them in
            any order, on the clock of `time`:

            - `"magnetometer": (time, field)`, (f, 3) µT in the axes of the IMU;
            - `"barometer": (time, pressure)`, (f,) or (f, 1) Pa;
            - `"gnss": (time, places)` or `(time, places, std)`, (f, 3) latitude and longitude in
              degrees and altitude in m, and their standard deviations east, north and up in m. NaN:
              the altitude, or a standard deviation, is not known.

            A sensor of which the filter refuses most is left out, and a note says so.

    Raises:
        InputError: An array has the wrong shape, a value that is not finite, or another unit; the
            samples last less than two seconds or so; there is no such network or sensor; or the
            network sees no heading that could be left out. It is a `ValueError`.
    """
    time, gyro, accel = _checked_samples(time, gyro, accel)
    if not isinstance(sensors, Mapping):
        remedy = "give a dict such as {'barometer': (time, pressure)}, or leave it out"
        raise InputError("sensors", f"is a {type(sensors).__name__}", remedy)
    others = tuple(_checked_readings(name, parts, time) for name, parts in sensors.items())
    recording = RawRecording(
        Path(SOURCE),
        Sensor("gyro", Path(SOURCE), time, gyro, second="s", unit="rad/s"),
        Sensor("accel", Path(SOURCE), time, accel, second="s", unit="m/s2"),
        notes=[],
        warnings=[],
        sign="android",
        others=others,
    )
    chosen = networks.load(network)
    if heading not in ("device", "gait"):
        raise InputError("heading", f"must be 'device' or 'gait', found {heading!r}")
    chosen = without_heading(chosen) if heading == "gait" else chosen
    with jax.enable_x64(True):  # for the filter; the network states its float32
        imported = as_sequence(recording, ImportOptions(), None, SOURCE)
        sequence = imported.sequence
        fused = estimate_recording(sequence, sequence.readings, chosen)
        estimate, ready, ekf, uses, origin = fused
        summary = summarise(estimate, {}, ready, imported, chosen, ekf, uses, origin)
    used = (f"{use.sensor}: {use.line}" for use in uses if use.accepted is not None)
    path, filtered, states = estimate.trajectory, estimate.filtered, estimate.states
    assert filtered is not None and states is not None
    return Odometry(
        path.time + summary.start_time,
        path.position,
        path.orientation,
        np.where(path.known[:, None], states.velocity, np.nan),
        np.where(path.known[:, None, None], filtered.covariance, np.nan),
        (*summary.warnings, *summary.notes, *used),
        origin,
    )


def _checked_samples(time: Any, gyro: Any, accel: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The samples as float64 arrays in SI units. Raises `InputError` naming the argument, what it
    is and what is expected."""
    stamps = _checked_array("time", time, None)
    rate = _checked_array("gyro", gyro, len(stamps))
    force = _checked_array("accel", accel, len(stamps))
    check_seconds(stamps, SOURCE)
    check_accel(force, SOURCE)
    first = first_stamp(stamps, "s", SOURCE)
    rows = np.unique(stamps, return_index=True)[1]
    imu = physics.ImuSamples(stamps[rows] - first, rate[rows], force[rows])
    peak = float(np.percentile(np.linalg.norm(rate, axis=1), 99.9))
    reason = f"it reaches {peak:.3g}, and no phone measures more than {units.PHONE_RANGE:g} rad/s"
    reason = reason if peak > units.PHONE_RANGE else ""
    stated, *others = (
        physics.agreement(imu, scale) for scale in (1.0, physics.DEGREE, 1 / physics.DEGREE)
    )
    if not physics.is_supported(*stated):
        by_gravity = "by the turning of gravity"
        in_degrees, in_radians_twice = (physics.is_supported(*other) for other in others)
        if in_radians_twice:
            problem = f"is too small to be in rad/s ({by_gravity})"
            raise InputError("gyro", problem, "give rad/s, and convert from deg/s only once")
        reason = by_gravity if in_degrees else reason
    if reason:
        problem = f"looks like deg/s ({reason}), expected rad/s"
        raise InputError("gyro", problem, "convert it: numpy.radians(gyro)")
    return stamps, rate, force


def _checked_readings(sensor: str, parts: Any, clock: Float[np.ndarray, "n"]) -> RawReadings:
    """An entry of `sensors` of `track`. `clock` has the stamps of the IMU. Raises `InputError`
    naming it, what it is and what is expected."""
    kind = SENSOR_KINDS.get(sensor)
    if kind is None:
        names = ", ".join(SENSOR_KINDS)
        raise InputError("sensors", f"unknown sensor '{sensor}'", f"known: {names}")
    field, width = f"sensors['{sensor}']", len(kind.columns)
    if not isinstance(parts, tuple | list) or len(parts) not in (2, 3)[: 1 + (sensor == GNSS)]:
        remedy = "give (time, values)" + (", or (time, values, std)" if sensor == GNSS else "")
        raise InputError(field, "is no tuple of arrays, or has too many or too few", remedy)
    try:
        time, *columns = (np.asarray(part, dtype=np.float64) for part in parts)
    except (TypeError, ValueError) as error:
        raise InputError(field, f"has something that is no array of numbers ({error})") from None
    if width == 1:
        columns = [part[:, None] if part.ndim == 1 else part for part in columns]
    if time.ndim != 1 or any(part.shape != (len(time), width) for part in columns):
        shapes = ", ".join(str(part.shape) for part in (time, *columns))
        problem = f"has arrays of the shapes {shapes}, expected (f,) and (f, {width})"
        raise InputError(field, problem, "give each stamp one row")
    values, std = columns if len(columns) == 2 else (*columns, np.full((len(time), width), np.nan))
    rows = np.unique(time, return_index=True)[1]
    readings = Readings(time[rows] - clock.min(), values[rows], std[rows])
    check_readings(sensor, readings, np.sort(clock) - clock.min(), field)
    return RawReadings(sensor, Path(SOURCE), time, values, std, second="s", has_unit=True)


def _checked_array(name: str, values: Any, count: int | None) -> np.ndarray:
    """One argument as a finite float64 array, (n,) if `count` is None and else (`count`, 3)."""
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(name, f"is not an array of numbers ({error})") from None
    if count is None and (array.ndim != 1 or len(array) < 2):
        problem = f"has shape {array.shape}, expected (n,): a stamp in s for each sample"
        raise InputError(name, problem)
    if count is not None and array.shape != (count, 3):
        problem = f"has shape {array.shape}, expected {(count, 3)}: x, y, z for each of the stamps"
        transposed = array.ndim == 2 and array.T.shape == (count, 3)
        raise InputError(name, problem, f"give {name}.T" if transposed else "")
    if not (finite := np.isfinite(array)).all():
        rows = ~finite.reshape(len(array), -1).all(axis=1)
        problem = f"is NaN or infinite in {rows.sum()} of {len(array)} rows, the first is row "
        problem += f"{rows.argmax()} (counted from 0)"
        remedy = "leave these rows out of time, gyro and accel: holes of up to a second are bridged"
        raise InputError(name, problem, remedy)
    return array
