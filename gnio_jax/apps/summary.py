"""The figures of a track, and the warnings about what limits their value."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal, NamedTuple

import jax
import numpy as np

from gnio_jax.apps import drive, heading
from gnio_jax.apps.importing import GAPS, Imported
from gnio_jax.apps.publish import describe_data, describe_error
from gnio_jax.apps.sensors import SensorUse
from gnio_jax.config import TrainConfig
from gnio_jax.data.assembly import RECORDED_RATE
from gnio_jax.data.gait import Gait, detect_gait
from gnio_jax.data.geodesy import Place
from gnio_jax.data.sensors import BAROMETER, GNSS
from gnio_jax.evaluation import PreparedRecording, SequenceEstimate, metrics
from gnio_jax.evaluation.prepare import ROUGH_START
from gnio_jax.filtering import Filter
from gnio_jax.filtering.zero_velocity import ZeroVelocity, is_quiet
from gnio_jax.networks import TrainedNetwork
from gnio_jax.numerics import spans

LYING = 0.95
"""Share of rest from which a warning says that a recording lies still (ours)."""
RUNNING_SHARE = 0.7
"""Share of seconds that are shaken as in a run (`gait.RUNNING`) from which a warning says so
(ours)."""
NOT_WALKED = 0.2
"""Share of seconds neither of a walk nor quiet from which a warning names them (ours)."""
CLIMB = 3.0
"""Height between the lowest and the highest point of a path, m, from which it indicates stairs or
drift (ours)."""
REFUSED = 0.15
"""Share of refused displacements that gives a warning (ours). For people that a network has not
seen the filter refuses 0 to 5 %. For walks of a kind that it has not seen it refused 29 %, and the
error was 20 sigma."""
FASTEST = 3.0
"""Largest plausible mean speed of a walk, m/s, as in the self-check of recordings."""
COVERED = 50.0
"""Smallest share of rows in which the 95 % region of the filter must contain the reference, %
(ours)."""


class Summary(NamedTuple):
    """The figures and remarks about a track."""

    recording: str
    network: str
    trained_on: str
    """The training data of the network."""
    measured: str
    """The measured error of the network, in words; empty if there is none."""
    start_time: float
    """Time of the start by the recording's own clock, s."""
    seconds: float
    """Duration, s."""
    path_length: float
    """Horizontal length of the path, through points 1 s apart, m."""
    from_start: float
    """Horizontal distance of the end from the start, m."""
    expected_error: float
    """Expected horizontal error at the end, root mean square by the filter's covariance, m. NaN if
    there are no steps, the device does not look where its carrier walks, or the filter has
    diverged: no covariance shows how wrong the path is."""
    steps: float | None
    """Share of the seconds that are within a walk (`detect_gait`); None if it is too short."""
    at_rest: float
    """Share of the time in which the IMU is quieter than a hand."""
    running: float
    """Share of the seconds within a walk that is shaken as a run."""
    climb: float
    """Height between the lowest and the highest point, m."""
    accepted: float | None
    """Share of the displacements that the filter used; None if there was none."""
    errors: dict[str, float | None]
    """Metrics against the reference, start aligned; empty where there is none."""
    warnings: tuple[str, ...]
    """What limits the value of the figures, the most important first."""
    notes: tuple[str, ...]
    """Notes about what the import and the start detected, assumed or repaired."""
    sensors: tuple[SensorUse, ...] = ()
    """What the other sensors did."""
    carrier: Literal["person", "car"] = "person"
    """What carried the IMU."""
    origin: Place | None = None
    """The place of the start, if the axes of the world are east, north and up; None: they are those
    of the start."""


def summarise(
    estimate: SequenceEstimate,
    errors: dict[str, float | None],
    ready: PreparedRecording,
    recording: Imported,
    source: TrainedNetwork | TrainConfig,
    ekf: Filter,
    sensors: tuple[SensorUse, ...] = (),
    origin: Place | None = None,
) -> Summary:
    """The figures of a finished track, up to a divergence if there was one.

    Args:
        estimate: The estimate, with the filter's covariances.
        errors: Metrics against the reference by their names; empty without a reference.
        ready: The recording as the filter took it.
        recording: The recording as it was imported, with its notes and warnings.
        source: The network, for its name, its training data and its measured error; or the
            configuration of a car's filter.
        ekf: The filter.
        sensors: What the other sensors did.
        origin: The place of the start, if a receiver shows it.
    """
    filtered, sequence = estimate.filtered, recording.sequence
    assert filtered is not None
    rows = int(np.flatnonzero(estimate.trajectory.known)[-1]) + 1
    has_diverged = rows < len(estimate.trajectory.time)
    time, position = estimate.trajectory.time[:rows], estimate.trajectory.position[:rows]
    used = filtered.accepted[:rows]
    used = used[np.isfinite(used)]
    error = float(np.sqrt(np.trace(filtered.covariance[rows - 1, :2, :2])))
    gait = detect_gait(ready.gyro, ready.accel, 1.0 / ekf.config.dt, ready.imu_valid)
    summary = Summary(
        recording=sequence.name,
        **describe_source(source),
        start_time=float(sequence.attributes.get("start_time", 0.0)),
        seconds=float(time[-1] - time[0]),
        path_length=0.0
        if rows < 2
        else metrics.path_length(position[:, :2], float(time[1] - time[0])),
        from_start=float(np.linalg.norm((position[-1] - position[0])[:2])),
        expected_error=np.nan,
        steps=float(gait.walking.mean()) if len(gait.walking) else None,
        at_rest=_share_at_rest(ready, ekf),
        running=float(gait.running.mean()) if len(gait.running) else 0.0,
        climb=float(np.ptp(position[:, 2])),
        accepted=float(used.mean()) if len(used) else None,
        errors=errors,
        warnings=(),
        notes=(*recording.notes, *ready.notes),
        sensors=sensors,
        origin=origin,
    )
    rate = 1.0 / float(np.median(np.diff(sequence.time)))
    recorded_rate = min(rate, float(sequence.attributes.get(RECORDED_RATE, rate)) or rate)
    if summary.carrier == "car":
        shown = any(use.sensor == GNSS and use.accepted is not None for use in sensors)
        first, of_walk = _warnings_of_drive(summary, shown), []
        of_start = _warnings_of_car_start(ready, shown)
    else:
        assert isinstance(source, TrainedNetwork)
        of_heading = _warnings_of_heading(ready, source) if gait.has_steps else []
        shown = gait.has_steps and not of_heading
        first = [*of_heading, *_warnings_of_gait(gait, summary.steps)]
        of_walk = _warnings_of_walk(summary, recorded_rate, ekf)
        of_start = _warnings_of_start(ready, ekf)
    warnings = (
        *(note for note in estimate.notes if note not in ready.notes),  # of a divergence
        *first,
        *recording.warnings,
        *(f"{use.sensor}: {use.text}" for use in sensors if use.accepted is None),
        *of_walk,
        *_warnings_of_errors(summary),
        *_warnings_of_gaps(ready, recording, ekf),
        *of_start,
    )
    expected_error = error if shown and not has_diverged else np.nan
    return summary._replace(expected_error=expected_error, warnings=warnings)


def describe_source(source: TrainedNetwork | TrainConfig) -> dict[str, Any]:
    """The fields of a `Summary` that say what estimated the path."""
    if isinstance(source, TrainConfig):
        return {
            "network": "no network",
            "trained_on": "",
            "measured": drive.MEASURED,
            "carrier": "car",
        }
    return {
        "network": source.name,
        "trained_on": describe_data(source),
        "measured": describe_error(source),
    }


def _warnings_of_drive(summary: Summary, has_fixes: bool) -> list[str]:
    """The warning about a drive without fixes, whose error grows with the way."""
    if has_fixes:
        return []
    return [f"car: no fixes are used, so no error can be stated: {summary.measured}"]


def _warnings_of_gait(gait: Gait, steps: float | None) -> list[str]:
    """Warnings about a recording that is no walk, or one for a part of the time alone."""
    if not gait.has_steps:
        share = f"no steps in {1.0 - steps:.0%} of the time" if steps else "no steps"
        return [
            f"no walk: there are {share}. The network reads the path from steps: in a vehicle, on "
            "a trolley or in a hand that only moves, the path is wrong, and no error can be "
            "stated. For a car, give --carrier car"
        ]
    others = ~gait.walking & ~gait.quiet
    if not len(others) or others.mean() <= NOT_WALKED:
        return []
    start, stop = max(spans(others).tolist(), key=lambda span: span[1] - span[0])
    return [
        f"no walk in {others.mean():.0%} of the time, the longest from {start} s to {stop} s: it "
        "moves without steps. If it was in a vehicle or on a trolley, the path there is wrong, and "
        "the error is larger than expected"
    ]


def _warnings_of_heading(ready: PreparedRecording, source: TrainedNetwork) -> list[str]:
    """A warning if the device does not look where the gait goes."""
    angle = heading.misalignment(ready, source) if heading.uses_heading(source) else np.nan
    if not abs(angle) > heading.MISALIGNED:
        return []
    side = "left" if angle > 0 else "right"
    return [
        f"heading: by the gait, the carrier walks {abs(angle):.0f}° to the {side} of where the "
        "device looks, so the path may be turned, and no error can be stated. If the device is "
        "held across, or is no phone, give --heading gait"
    ]


def _warnings_of_gaps(ready: PreparedRecording, recording: Imported, ekf: Filter) -> list[str]:
    """A warning about missing samples."""
    has_holes = ready.imu_valid is not None
    if not has_holes and not any(GAPS in note for note in recording.notes):
        return []
    where = "" if has_holes else " (see above)"
    hidden = ekf.config.gap_gyro_std > 0 and ekf.config.gap_accel_std > 0
    counted = "" if hidden else ", and more so than the filter says, which counts no motion in it"
    return [
        f"gaps: samples are missing{where}, and nothing shows the turn in a gap: trust the shape "
        "of the path before and after it, but not the angle between both parts. The heading and "
        f"the place after it are uncertain{counted}"
    ]


def _warnings_of_start(ready: PreparedRecording, ekf: Filter) -> list[str]:
    """Warnings about the start of a walk, and about a filter that was not calibrated."""
    conditions = {
        "gyro: raw, and without a rest that shows its bias: the heading may be lost within a "
        "minute; hold the phone still for some seconds first": ready.start.raw_gyro,
        "start: it moves in its first second, so velocity and tilt are inaccurate": (
            ready.start.std.velocity > ROUGH_START
        ),
        "calibration: the filter's covariances were not calibrated (gnio calibrate), so the real "
        "error is probably larger than the expected one": ekf.considered is None,
    }
    return [text for text, applies in conditions.items() if applies]


def _warnings_of_car_start(ready: PreparedRecording, has_fixes: bool) -> list[str]:
    """Warnings about the start of a drive. The fixes of a receiver show the speed."""
    conditions = {
        "start: the car moves, and nothing shows its speed, so the path is wrong; begin at rest": (
            ready.start.std.velocity >= drive.UNKNOWN_SPEED and not has_fixes
        ),
        "gyro: no stop of the car shows its bias, so mounting and path may be farther off than the "
        "filter says; stand still for two seconds": (
            float(ready.start.std.gyro_bias) > drive.STOP_BIAS
        ),
    }
    return [text for text, applies in conditions.items() if applies]


def _warnings_of_walk(summary: Summary, recorded_rate: float, ekf: Filter) -> list[str]:
    """Warnings that limit the value of the figures of a walk."""
    accepted = 1.0 if summary.accepted is None else summary.accepted
    speed = summary.path_length / max(summary.seconds, 1e-9)
    rate = 1.0 / ekf.config.dt
    has_height = any(use.sensor == BAROMETER and use.accepted for use in summary.sensors)
    at_rest = "the filter holds the position"
    if not any(isinstance(measurement, ZeroVelocity) for measurement in ekf.measurements):
        at_rest = "the filter does not measure this (filter.measurements.zero_velocity), so the "
        at_rest += "position drifts with the displacements of the network"
    conditions = {
        f"rate: recorded at {recorded_rate:.4g} Hz, the network was trained at {rate:g} Hz: the "
        f"content above {recorded_rate / 2.0:.3g} Hz is unknown": recorded_rate < 0.99 * rate,
        f"rest: it lies still {summary.at_rest:.0%} of the time, and {at_rest}": (
            summary.at_rest >= LYING
        ),
        f"running: in {summary.running:.0%} of the seconds it is shaken as in a run, where "
        "networks trained on walks make the path too short": summary.running > RUNNING_SHARE,
        f"height: it changes by {summary.climb:.1f} m: that is drift unless the way goes up or "
        "down, which few networks have learnt": summary.climb > CLIMB and not has_height,
        f"gate: the filter refused {1.0 - accepted:.0%} of the network's displacements: the motion "
        "is unlike that in the network's training data, and the error may be many times the "
        "expected one": accepted < 1.0 - REFUSED,
        f"speed: {speed:.1f} m/s in the mean is faster than people walk: the track is wrong": (
            speed > FASTEST
        ),
    }
    return [text for text, applies in conditions.items() if applies]


def _warnings_of_errors(summary: Summary) -> list[str]:
    """A warning if the errors are larger than the filter's covariance says."""
    covered = {
        "place": summary.errors.get("nees_coverage_2d"),
        "place and height": summary.errors.get("nees_coverage"),
    }
    shares = {of: share for of, share in covered.items() if share is not None}
    worst = min(shares, key=shares.__getitem__, default="")
    if shares.get(worst, 100.0) >= COVERED:
        return []
    return [
        f"errors: larger than the filter says: its 95 % region of {worst} holds the reference in "
        f"{shares[worst]:.0f} % of the rows"
    ]


def _share_at_rest(ready: PreparedRecording, ekf: Filter) -> float:
    """Share of the strides in which the IMU is as quiet as the filter's rest; strides across a gap
    do not count as rest."""
    samples = ekf.config.samples_per_clone
    strides = (ready.gyro - ready.start.gyro_bias, ready.accel)
    rate, force = (part.reshape(-1, samples, 3) for part in strides)
    quiet = np.asarray(jax.jit(jax.vmap(partial(is_quiet, config=ekf.config)))(rate, force))
    if ready.imu_valid is not None:
        quiet = quiet & ready.imu_valid.reshape(-1, samples).all(axis=1)
    return float(quiet.mean())
