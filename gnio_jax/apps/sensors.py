"""The other sensors of a phone in the track of its recording (ours).

A first run without them gives attitudes and a path, in a world whose yaw and origin are those of
the start. From these the rows of the measurements are made, and the filter runs again:

1. Magnetometer: the world's field, the phone's own, and the error of the gyro's bias are fitted to
   the first half minute (`filtering.magnetometer.fit_field`). The filter starts from the better
   bias, and from then on estimates it.
2. Barometer: heights above the start (`filtering.barometer`). A network that has seen few stairs is
   sure of level ground, so beside a barometer its vertical displacements count for less.
3. Receiver: the path of the runs so far is turned and shifted to the fixes of the first minute, or
   to all of them if a magnetometer holds the heading, by robust least squares. If the fixes do not
   show the heading, the time is doubled. This is the start in a world whose axes are east, north
   and up, with twice the uncertainty of this alignment, and then the fixes are measurements, with
   the standard deviations that the receiver gives.

A sensor whose readings are refused for the most part is left out, and the filter runs once more.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from gnio_jax import geometry
from gnio_jax.config import ConsideredStd, CorrelatedError
from gnio_jax.data.geodesy import Place, east_north_up, geodetic, near_longitude
from gnio_jax.data.sensors import BAROMETER, GNSS, MAGNETOMETER
from gnio_jax.errors import InputError
from gnio_jax.evaluation import PreparedRecording, SequenceEstimate
from gnio_jax.evaluation.prepare import Start
from gnio_jax.filtering import Filter
from gnio_jax.filtering.barometer import Barometer, barometer_on_intervals
from gnio_jax.filtering.fix import Fix, fixes_on_intervals
from gnio_jax.filtering.magnetometer import Magnetometer, fit_field
from gnio_jax.filtering.update import Measurement
from gnio_jax.numerics import interpolate, matrix_from_quaternion, rotation_z, yaw
from gnio_jax.types import Readings, Sequence

NAMES = {MAGNETOMETER: "magnetometer", BAROMETER: "barometer", GNSS: "fix"}
"""Sensor → the name of its measurement in the filter."""
RAW_BIAS = 0.1
"""Standard deviation of the bias of a raw gyro, rad/s, before the magnetometer shows it."""
LEAST_BIAS = 1e-3
"""Smallest standard deviation of the bias that the magnetometer has shown, rad/s: it walks."""
LARGEST_MISFIT = 20.0
"""Residuals of the fit of the field from which it is no field of the earth, µT rms."""
LEAST_ACCEPTED = 0.5
"""Share of the measurements of a sensor below which it is left out."""
ACCURACY = 10.0
"""Standard deviation of a fix for which the receiver states none, m."""
LEAST_ACCURACY = 2.0
"""Smallest standard deviation of a fix that is believed, m."""
FIX_SECONDS = 10.0
"""Time for which the error of a phone's fixes stays the same, s: fixes that are closer have larger
variances, so that those of this time count as one."""
FIRST_FIXES = 60.0
"""Time of the first fixes to which the path is aligned, s."""
LEAST_YAW, SURE_YAW, MOST_YAW = 0.1, 0.15, 0.5
"""Standard deviations of the aligned yaw, rad: the start has at least the first one, down to the
second one more fixes are used, beyond the third one the fixes do not show the heading."""
FEWEST_FIXES = 4
DISPLACEMENT_STD = 0.25
"""Smallest standard deviation of a displacement with fixes, m in a second: a filter that follows
the network alone may trust it, because nothing else is there, but a network makes every walk of a
person too long or too short by a few per cent, and turned by some degrees."""
DISPLACEMENT_ERROR = CorrelatedError(share=0.95, seconds=20.0)
"""How long these errors last: the filter learns them from the fixes."""

HEIGHT_STD = 0.5
"""Standard deviation of the surest vertical displacement with a barometer, m in a second: on stairs
a walker rises by about that. Those of all others are raised by the same factor."""


class SensorUse(NamedTuple):
    """What a sensor did in a track."""

    sensor: str
    rows: int
    """Number of its readings."""
    accepted: float | None
    """Share of its measurements that the filter used; None: there was none."""
    text: str
    """What it did, in words."""

    @property
    def line(self) -> str:
        """Its rows, its share, and what it did, in one line."""
        share = "" if self.accepted is None else f", {self.accepted:.0%} of its measurements used"
        return f"{self.rows} rows{share}: {self.text}"


class Fused(NamedTuple):
    """A track with its other sensors."""

    estimate: SequenceEstimate
    ready: PreparedRecording
    ekf: Filter
    uses: tuple[SensorUse, ...]
    origin: Place | None
    """The place of the origin, if the axes of the world are east, north and up."""


Run = Callable[[PreparedRecording, Filter], SequenceEstimate]
"""A function that estimates a prepared recording."""


def usable_readings(sequence: Sequence, without: tuple[str, ...]) -> dict[str, Readings]:
    """The readings of the sensors that are not left out. Raises `InputError` for a name of
    `without` that is none of a sensor."""
    for name in without:
        if name not in NAMES:
            raise InputError("--without", f"unknown sensor '{name}'", f"known: {', '.join(NAMES)}")
    return {s: r for s, r in sequence.readings.items() if s in NAMES and s not in without}


def fuse(
    first: SequenceEstimate,
    ready: PreparedRecording,
    ekf: Filter,
    readings: dict[str, Readings],
    run: Run,
    first_fixes: float = FIRST_FIXES,
) -> Fused:
    """The track with the readings of other sensors, from the run without them. `first_fixes` is the
    time of the fixes to which the path is aligned first, s.

    Sensors that cannot be used, and those of which the filter refuses most, are left out, and their
    text has the reason. If none remains, the first run is the result.

    Heights and field are fitted once, because neither depends on another sensor. The run without
    fixes, to whose path these are aligned, decides what it can: a sensor of which it refuses most
    has no part in the run with fixes, and it is the result if no fix can be used.
    """
    refused = dict[str, str]()
    bare = by_field = Fused(first, ready, ekf, (), None)
    fits: dict[str, Measurement] = {}
    if BAROMETER in readings:
        fits |= _try(refused, BAROMETER, lambda: _heights(readings[BAROMETER], ready, ekf))
    if MAGNETOMETER in readings:
        field = _try(
            refused,
            MAGNETOMETER,
            lambda: fit_magnetometer(readings[MAGNETOMETER], first, ready, ekf),
        ).get(MAGNETOMETER)
        if field is not None:
            fits[MAGNETOMETER] = field.rows
            start = ready._replace(start=field.start)
            by_field = bare._replace(ready=start, ekf=without_considered_bias(ekf))
    without_fixes, sensors = bare, tuple[str, ...]()
    while True:
        fits = {sensor: rows for sensor, rows in fits.items() if sensor not in refused}
        has_field, has_fixes = MAGNETOMETER in fits, GNSS in readings and GNSS not in refused
        base = by_field if has_field else bare
        if tuple(fits) != sensors and (has_field or not has_fixes):
            without_fixes, sensors = _estimate(base, readings, fits, run), tuple(fits)
            if _refuse_one(without_fixes, first, refused):
                continue
        fused = without_fixes
        if has_fixes:
            path = without_fixes.estimate if has_field else first
            longest = math.inf if has_field else first_fixes
            fused = _with_fixes(base, path, readings, fits, refused, run, longest)
            if fused is None or _refuse_one(fused, first, refused):
                continue
        reasons = (
            SensorUse(sensor, len(readings[sensor].time), None, f"left out: {reason}")
            for sensor, reason in refused.items()
        )
        return fused._replace(uses=(*fused.uses, *reasons))


def _refuse_one(fused: Fused, first: SequenceEstimate, refused: dict[str, str]) -> bool:
    """Whether a sensor must be left out. It is added to `refused` with the reason."""
    shares = {use.sensor: use.accepted for use in fused.uses if use.accepted is not None}
    if not shares:
        return False
    if not fused.estimate.trajectory.known.all() and first.trajectory.known.all():
        refused[list(shares)[-1]] = "with it the filter diverged"
        return True
    sensor = min(shares, key=lambda name: shares[name])
    if shares[sensor] >= LEAST_ACCEPTED:
        return False
    refused[sensor] = f"the filter refused {1 - shares[sensor]:.0%} of its measurements"
    return True


def _with_fixes(
    base: Fused,
    path: SequenceEstimate,
    readings: dict[str, Readings],
    fits: dict[str, Measurement],
    refused: dict[str, str],
    run: Run,
    longest: float,
) -> Fused | None:
    """The track with the receiver, too, which begins where the fixes place the path without them.
    None, with the reason in `refused`, if they do not show that."""
    placement: Placement | None = _try(
        refused, GNSS, lambda: place_on_map(readings[GNSS], path, longest)
    ).get(GNSS)
    if placement is None:
        return None
    ready, ekf = _start_on_map(base.ready, base.ekf, placement), _for_fixes(base.ekf)
    fits = dict(fits)
    for sensor, rows in fits.items():
        if isinstance(rows, Magnetometer):
            fits[sensor] = rows._replace(direction=rows.direction + placement.yaw)
    fits[GNSS] = placement.fixes(ready, ekf)
    return _estimate(base._replace(ready=ready, ekf=ekf), readings, fits, run, placement)


def _estimate(
    base: Fused,
    readings: dict[str, Readings],
    fits: dict[str, Measurement],
    run: Run,
    placement: Placement | None = None,
) -> Fused:
    """The track with the measurements of these sensors. `base` has the estimate without them, the
    start and the filter."""
    if not fits:
        return base
    ekf = _for_heights(base.ekf) if BAROMETER in fits else base.ekf
    estimate = run(base.ready._replace(measurements=tuple(fits.values())), ekf)
    if BAROMETER in fits:
        estimate = _with_offset(estimate, fits[BAROMETER])
    uses = []
    for sensor in fits:
        accepted = estimate.accepted[NAMES[sensor]]
        accepted = accepted[np.isfinite(accepted)]
        share = float(accepted.mean()) if len(accepted) else 0.0
        text = _describe(sensor, base.estimate, estimate, base.ready, placement)
        uses.append(SensorUse(sensor, len(readings[sensor].time), share, text))
    origin = placement and placement.origin
    return base._replace(estimate=estimate, ekf=ekf, uses=tuple(uses), origin=origin)


def _try(refused: dict[str, str], sensor: str, make: Callable[[], Any]) -> dict[str, Any]:
    """What `make` returns under the name of the sensor; nothing, and the reason in `refused`, if it
    raises `InputError`."""
    try:
        return {sensor: make()}
    except InputError as error:
        refused[sensor] = str(error)
        return {}


# --- barometer and magnetometer


def _for_heights(ekf: Filter) -> Filter:
    """The filter whose vertical displacements have at least the error of stairs. Velocities in the
    body have no vertical axis, so they remain."""
    if ekf.config.measures == "velocity":
        return ekf
    noise, config = ekf.noise, ekf.config
    least = math.exp(config.log_std_min) * math.sqrt(noise.measurement_scale)
    *level, vertical = noise.std_factor
    vertical = max(vertical, HEIGHT_STD * config.window * config.dt / least)
    return dataclasses.replace(ekf, noise=noise._replace(std_factor=(*level, vertical)))


def _heights(readings: Readings, ready: PreparedRecording, ekf: Filter) -> Measurement:
    pressure, start = readings.values[:, 0], ready.time[0]
    return barometer_on_intervals(readings.time, pressure, ready.strides, ekf.config, start)


def _with_offset(estimate: SequenceEstimate, heights: Measurement) -> SequenceEstimate:
    """The estimate whose variance of the height has that of the barometer's offset, which wanders
    with the weather and has no state in the filter. Where the pressures have ended it stays, since
    from there on the filter's own variance grows."""
    assert isinstance(heights, Barometer)
    if estimate.filtered is None:
        return estimate
    growth = np.square(heights.std) - np.square(heights.std[0])
    growth = np.maximum.accumulate(np.where(np.isfinite(heights.height), growth, 0.0))
    covariance = estimate.filtered.covariance.copy()
    covariance[1:, 2, 2] += growth
    return estimate._replace(filtered=estimate.filtered._replace(covariance=covariance))


class FieldStart(NamedTuple):
    """The rows of a magnetometer, and the start with the bias of the gyro that it shows."""

    rows: Magnetometer
    start: Start


def fit_magnetometer(
    readings: Readings, first: SequenceEstimate, ready: PreparedRecording, ekf: Filter
) -> FieldStart:
    """The field along the path of the run without it, and the start with the bias of the gyro that
    it shows. Raises `InputError` if the readings are not those of the earth's field."""
    last = _last_row(first)
    rotation = matrix_from_quaternion(first.trajectory.orientation[1:])
    rotation[last:] = rotation[last - 1]
    bias_std = RAW_BIAS if ready.start.raw_gyro else _bias_std(ready, ekf)
    time, values, _ = readings
    fit = fit_field(time, values, rotation, ekf.config, ready.time[0], bias_std=bias_std)
    if fit.misfit > LARGEST_MISFIT:
        problem = f"the field does not turn as the phone does (it is off by {fit.misfit:.0f} µT)"
        raise InputError("magnetometer", problem, "keep magnets and cases with clasps away")
    start = ready.start
    std = start.std._replace(gyro_bias=max(fit.gyro_bias_std, LEAST_BIAS))
    start = start._replace(gyro_bias=start.gyro_bias + fit.gyro_bias, std=std, raw_gyro=False)
    return FieldStart(fit.rows, start)


def _bias_std(ready: PreparedRecording, ekf: Filter) -> float:
    """Standard deviation of the gyro's first bias, rad/s, with its considered part, which a filter
    must estimate if a sensor shows the heading."""
    considered = ekf.considered or ConsideredStd()
    of_raw = float(considered.raw_gyro_bias) * ready.start.raw_gyro
    return math.hypot(float(ready.start.std.gyro_bias), float(considered.gyro_bias), of_raw)


def without_considered_bias(ekf: Filter, **zeros: float) -> Filter:
    """The filter without the considered error of the gyro's bias, which it estimates."""
    if ekf.considered is None:
        return ekf
    considered = ekf.considered._replace(gyro_bias=0.0, raw_gyro_bias=0.0, **zeros)
    return dataclasses.replace(ekf, considered=considered if any(considered) else None)


# --- fixes of a receiver


class Placement(NamedTuple):
    """A path on the map."""

    yaw: float
    """Angle by which the world of the first run is turned to have the axes east and north, rad."""
    yaw_std: float
    """rad."""
    std: float
    """Standard deviation of the place of the start, m."""
    origin: Place
    """Place of the start."""
    time: Float[np.ndarray, "f"]
    """Stamps of the fixes, s."""
    position: Float[np.ndarray, "f 2"]
    """East and north of the origin, m."""
    fix_std: Float[np.ndarray, "f"]
    """m, of an axis."""
    crowd: Float[np.ndarray, "f"]
    """Number of fixes within `FIX_SECONDS`, whose errors are the same."""
    distance: float
    """Median distance of the path from the fixes of the alignment, m."""

    def fixes(self, ready: PreparedRecording, ekf: Filter) -> Fix:
        """The fixes as measurements."""
        inside = (self.time > ready.time[0]) & (self.time < ready.time[-1])
        variance = (self.fix_std**2 * self.crowd)[inside]
        covariance = variance[:, None, None] * np.eye(2)
        rows = self.time[inside], self.position[inside], covariance
        return fixes_on_intervals(*rows, ready.strides, ekf.config, ready.time[0])


def place_on_map(readings: Readings, path: SequenceEstimate, longest: float) -> Placement:
    """The path turned and shifted to the fixes of its first `longest` s, or of twice that time and
    so on until these show the heading to `SURE_YAW`. Raises `InputError` if all fixes do not show
    it to `MOST_YAW`."""
    last = _last_row(path)
    stamps, walked = path.trajectory.time[: last + 1], path.trajectory.position[: last + 1, :2]
    inside = (readings.time > stamps[0]) & (readings.time < stamps[-1])
    time, values = readings.time[inside], readings.values[inside]
    if len(time) < FEWEST_FIXES:
        problem = f"{len(time)} fixes are within the recording, and {FEWEST_FIXES} are needed"
        raise InputError("gnss", problem, "wait for the first fix, and record for a minute")
    std = readings.std[inside, :2].max(axis=1)
    std = np.maximum(np.where(np.isfinite(std), std, ACCURACY), LEAST_ACCURACY)
    altitude = values[:, 2][np.isfinite(values[:, 2])]
    level = float(np.median(altitude[:10])) if len(altitude) else 0.0
    longitude = near_longitude(values[:, 1], values[0, 1])
    places = np.column_stack([values[:, 0], longitude, np.full(len(time), level)])
    reference = Place(*np.median(places, axis=0).tolist())
    position = east_north_up(places, reference)[:, :2]
    crowd = (np.abs(time[:, None] - time[None]) < FIX_SECONDS / 2).sum(axis=1).astype(float)
    walked = interpolate(time, stamps, walked)
    end = max(longest, time[1] - time[0])
    while True:
        rows = time <= time[0] + end
        if rows.sum() >= FEWEST_FIXES:
            turn, shift, yaw_std, distance = _align(
                walked[rows], position[rows], std[rows], crowd[rows]
            )
            if yaw_std < SURE_YAW or rows.all():
                break
        end *= 2
    if not yaw_std < MOST_YAW:
        spread = float(np.linalg.norm(np.ptp(walked, axis=0)))
        problem = f"the fixes show the heading to {np.degrees(min(yaw_std, 3.0)):.0f}° only: the"
        problem += f" path spans {spread:.0f} m, and the fixes are good to {np.median(std):.0f} m"
        raise InputError("gnss", problem, "go farther, under the open sky")
    origin = Place(*geodetic(np.array([[*shift, 0.0]]), reference)[0].tolist())
    position = east_north_up(places, origin)[:, :2]
    yaw, first_std = float(np.arctan2(turn[1, 0], turn[0, 0])), float(np.median(std))
    return Placement(yaw, yaw_std, first_std, origin, time, position, std, crowd, distance)


def _align(
    path: Float[np.ndarray, "f 2"],
    fixes: Float[np.ndarray, "f 2"],
    std: Float[np.ndarray, "f"],
    crowd: Float[np.ndarray, "f"],
) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Rotation and shift of a path to the fixes, the standard deviation of the angle, and the
    median distance. The weights are Cauchy's, at the scale of the fix or of the median distance."""
    align = jax.jit(geometry.planar_alignment)
    information = 1 / (std**2 * crowd)
    weight = information
    for _ in range(20):
        turn, shift = jax.device_get(align(path, fixes, weight))
        distance = np.linalg.norm(path @ turn.T + shift - fixes, axis=1)
        scale = np.maximum(std, np.median(distance))
        weight = information / (1 + (distance / scale) ** 2)
    misfit = float((weight * distance**2).sum() / (weight * std**2).sum())
    centred = path - (weight[:, None] * path).sum(axis=0) / weight.sum()
    shown = float((weight * (centred**2).sum(axis=1)).sum())
    yaw_std = math.sqrt(max(misfit, 1.0) / shown) if shown > 0 else math.inf
    return turn, shift, yaw_std, float(np.median(distance))


def _start_on_map(ready: PreparedRecording, ekf: Filter, placement: Placement) -> PreparedRecording:
    """The start in a world of east, north and up. The fixes are measured afterwards, so the aligned
    start must not count as another measurement: its standard deviations are doubled."""
    start = ready.start
    std = start.std._replace(
        yaw=min(max(2 * placement.yaw_std, LEAST_YAW), MOST_YAW),
        position=2 * placement.std,
        gyro_bias=_bias_std(ready, ekf),
    )
    rotation = rotation_z(placement.yaw) @ start.rotation
    return ready._replace(start=start._replace(rotation=rotation, std=std, raw_gyro=False))


def _for_fixes(ekf: Filter) -> Filter:
    """The filter whose displacements have the errors of a walk in its covariance."""
    noise = ekf.noise._replace(
        std_factor=(1.0, 1.0, 1.0), measurement_scale=1.0, correlation=DISPLACEMENT_ERROR
    )
    seconds = ekf.config.window * ekf.config.dt
    least = max(ekf.config.log_std_min, math.log(DISPLACEMENT_STD * seconds))
    config = dataclasses.replace(ekf.config, log_std_min=least)
    ekf = dataclasses.replace(ekf, config=config, noise=noise)
    return without_considered_bias(ekf, scale=0.0, heading=0.0)


def _last_row(estimate: SequenceEstimate) -> int:
    """Number of intervals until the filter diverged, or all."""
    return int(np.flatnonzero(estimate.trajectory.known)[-1])


# --- words


def _describe(
    sensor: str,
    first: SequenceEstimate,
    estimate: SequenceEstimate,
    ready: PreparedRecording,
    placement: Placement | None,
) -> str:
    """What a sensor did, against the run without any."""
    row = min(_last_row(first), _last_row(estimate))
    before, after = first.trajectory, estimate.trajectory
    if sensor == BAROMETER:
        heights = (path.position[row, 2] - path.position[0, 2] for path in (after, before))
        return "the end is {:+.1f} m above the start, {:+.1f} m without".format(*heights)
    if sensor == MAGNETOMETER:
        yaws = [yaw(matrix_from_quaternion(p.orientation[[0, row]])) for p in (after, before)]
        turns = [ends[1] - ends[0] for ends in yaws]
        change = math.degrees(math.remainder(turns[0] - turns[1], 2 * math.pi))
        bias = np.degrees(np.linalg.norm(ready.start.gyro_bias))
        return f"turned the heading at the end by {change:+.0f}°, the gyro's bias is {bias:.2g} °/s"
    assert placement is not None
    path = interpolate(placement.time, after.time[: row + 1], after.position[: row + 1, :2])
    distance = float(np.median(np.linalg.norm(path - placement.position, axis=1)))
    where = f"{placement.origin.latitude:.5f}, {placement.origin.longitude:.5f}"
    text = f"the path begins at {where} and passes the fixes at {distance:.1f} m"
    return f"{text} in the median, {placement.distance:.1f} m without"
