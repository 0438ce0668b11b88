"""A tracker that follows a stream: what is refused is counted, and said once."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax.data.resampling import longest_bridge
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Trajectory
from gnio_jax.evaluation.prepare import ROUGH_START
from gnio_jax.evaluation.trajectory import write_tum
from gnio_jax.files import replacing
from gnio_jax.filtering import Pose, Tracker
from gnio_jax.live.samples import Sample
from gnio_jax.live.sources import Source
from gnio_jax.models import Network
from gnio_jax.tracking.filter import tracking_filter
from gnio_jax.training.checkpoint import Run

Push = Callable[[Any, Any, Any], Pose | None]
"""`Tracker.push`: (time, gyro, accel) -> the pose of a clone step; raises `ValueError`."""
LINES_BEFORE_A_SAMPLE = 100
"""So many lines without a single sample are no stream of an IMU."""
SECONDS_WITHOUT_A_SENSOR = 10.0
"""So many s from the start without a sample that has both sensors: one of them is not sent, or goes
by another name (ours)."""
REFUSED_IN_A_ROW = 1000
"""So many refused samples in a row end the stream: its clock or its format is another one now, and
no later sample would be taken (ours)."""
LONGEST_INTERVAL = 0.5
"""s between samples, by their stamps: what is slower is no IMU, but stamps in ms (ours)."""
FIRST_STAMPS = 21
"""Samples by which that is told."""
VELOCITY = slice(3, 6)
"""Of a pose's covariance."""


def create_tracker(run: Run, imu_rate: float | None = None, rest_seconds: float = 1.0) -> Tracker:
    """The compiled tracker of a run, with the filter and the start of `tracking.track`.

    Of the same samples it makes the same trajectory, to rounding, where the recording rests for
    `rest_seconds` and less than a second longer: of a longer rest a track takes the whole for the
    gyro's bias, but what has not come yet is not known. Live, samples are interpolated by lines
    where the rates differ. The covariance has the errors that a calibrated filter considers.

    `imu_rate` is that of the samples that will come, Hz (None: the network's). Samples that are
    further apart than 1.5 of its intervals miss some between them. Raises `ValueError` for a rest
    that is shorter than two samples.
    """
    setup = tracking_filter(run)
    network = Network.of(run.model, run.variables)

    def predict(windows: Any) -> Any:
        return network.apply(network.variables, windows)

    return Tracker(
        predict,
        setup.config,
        setup.noise,
        rest_seconds=rest_seconds,
        std=setup.initial_std,
        hole=longest_interval(run, imu_rate),
        imu_rate=imu_rate or run.config.data.rate,
        considered=setup.considered,
    )


def longest_interval(run: Run, imu_rate: float | None = None) -> float:
    """s between samples that miss none between them; `imu_rate` as in `create_tracker`."""
    own = 1 / run.config.data.rate
    return 1.5 * max(own, 1 / imu_rate if imu_rate else own)


def longest_untold(run: Run, imu_rate: float | None = None) -> float:
    """s between samples of which nobody needs to be told; `imu_rate` as in `create_tracker`."""
    return longest_bridge(imu_rate or run.config.data.rate)


@dataclass
class Follower:
    """What has been found so far."""

    longest_interval: float = math.inf
    """s between two whole samples; a longer one is a gap."""
    poses: list[Pose] = field(default_factory=list)
    """One for each clone step."""
    samples: int = 0
    refused: int = 0
    """Lines that were no samples, and samples that the tracker could not take."""
    reason: str = ""
    """Why the first one was refused."""
    in_a_row: int = 0
    """Refused since the newest sample."""
    newest_reason: str = ""
    """Why the newest one was refused."""
    stamps: list[float] = field(default_factory=list)
    """Of the first samples, s."""
    last: float = math.nan
    """Stamp of the last sample, s."""
    newest: float = math.inf
    """Stamp of the newest whole sample, s."""
    gaps: list[float] = field(default_factory=list)
    """Lengths of the gaps since the first pose, s."""
    gap_ends: list[float] = field(default_factory=list)
    """Stamps at which they ended, s."""

    @property
    def lost(self) -> bool:
        """Whether the stream was given up."""
        return self.in_a_row >= REFUSED_IN_A_ROW

    def warnings(self) -> list[str]:
        """How it began, what is missing and what was refused, as far as somebody must know."""
        lines = []
        if self.poses and self.poses[0].covariance[VELOCITY, VELOCITY].max() > ROUGH_START**2:
            lines.append(
                "start: it moved while it should lie still, so velocity and tilt are rough"
            )
        if self.gaps:
            longest = (
                f"{len(self.gaps)}, the longest of {max(self.gaps):.2g} s: samples are missing"
            )
            guessed = "what happened there is guessed, and the filter is surer than it should be"
            lines.append(f"gaps: {longest}, {guessed}")
        if self.refused:
            lines.append(f"{self.refused} lines refused, the first: {self.reason}")
        if self.lost:
            newest = f"{self.in_a_row} lines in a row refused, the newest: {self.newest_reason}"
            lines.append(f"stopped, {newest}")
        return lines


def follow(
    push: Push, source: Source, found: Follower, on_pose: Callable[[Follower], None]
) -> None:
    """Feed the samples to a tracker until the source ends, or nothing of it is taken any more
    (`Follower.lost`); `found` grows on the way, and `on_pose` is called after each clone step.

    Raises `InputError` where nothing that comes is a sample or none has both sensors, or its stamps
    are not in seconds.
    """
    for sample in source.samples:
        pose = _pushed(push, sample, found)
        if pose is not None:
            found.poses.append(pose)
            on_pose(found)
        if found.samples == 0 and found.refused >= LINES_BEFORE_A_SAMPLE:
            problem = f"has no sample in its first {LINES_BEFORE_A_SAMPLE} lines"
            raise InputError(source.name, problem, f"the first one {found.reason}")
        if found.samples == FIRST_STAMPS:
            _check_interval(found.stamps, source.name)
        if found.samples > LINES_BEFORE_A_SAMPLE:
            _check_sensors(found, source.name)
        if found.lost:
            break
    _note_gap(found)


def _pushed(push: Push, sample: Sample | None, found: Follower) -> Pose | None:
    """The pose that a sample makes, if it makes one."""
    if sample is None:
        _refuse(found, "is no sample: time,gyro x,y,z,accel x,y,z or JSON is wanted")
        return None
    try:
        pose = push(sample.time, sample.gyro, sample.accel)
    except ValueError as error:
        _refuse(found, str(error))
        return None
    while found.gap_ends and found.gap_ends[-1] > sample.time:
        # The stamp leapt, and the tracker did not believe it: there was no gap before it.
        found.gaps.pop()
        found.gap_ends.pop()
    found.last = sample.time
    if np.isfinite([sample.gyro, sample.accel]).all():
        _note_gap(found)
        found.newest = sample.time
    found.samples += 1
    found.in_a_row = 0
    if found.samples <= FIRST_STAMPS:
        found.stamps.append(sample.time)
    return pose


def _note_gap(found: Follower) -> None:
    """Keep the time from the newest whole sample to the last one, if samples are missing there.
    What came before the start is not in the path."""
    if found.poses and found.last - found.newest > found.longest_interval:
        found.gaps.append(found.last - found.newest)
        found.gap_ends.append(found.last)


def _check_sensors(found: Follower, where: str) -> None:
    """Raise `InputError` where one of the sensors has not come for `SECONDS_WITHOUT_A_SENSOR`."""
    if math.isinf(found.newest) and found.last - found.stamps[0] > SECONDS_WITHOUT_A_SENSOR:
        problem = f"has no sample with both sensors in its first {SECONDS_WITHOUT_A_SENSOR:g} s"
        raise InputError(where, problem, "send the gyro (gyro) and the accelerometer (accel)")


def _check_interval(stamps: list[float], where: str) -> None:
    """Raise `InputError` where the stamps are no IMU's if they are seconds."""
    interval = float(np.median(np.diff(stamps)))
    if interval > LONGEST_INTERVAL:
        problem = f"its samples come {interval:g} s apart by their stamps"
        raise InputError(where, problem, "stamps must be in seconds, not in ms")


def _refuse(found: Follower, reason: str) -> None:
    found.refused += 1
    found.in_a_row += 1
    found.reason = found.reason or reason
    found.newest_reason = reason


def write_trajectory(path: Path, poses: list[Pose]) -> None:
    """Write the healthy poses in TUM format. Raises `InputError` where there is none."""
    healthy = [pose for pose in poses if pose.healthy]
    if not healthy:
        raise InputError(path, "there is no sound pose to write", "the filter diverged at once")
    orientation = Rotation.from_matrix(np.array([pose.rotation for pose in healthy]))
    trajectory = Trajectory(
        np.array([pose.time for pose in healthy]),
        np.array([pose.position for pose in healthy]),
        orientation.as_quat(scalar_first=True),
    )
    with replacing(path) as temporary:
        write_tum(temporary, trajectory)
