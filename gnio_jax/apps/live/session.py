"""Following a stream: the samples go to a tracker, and what its poses say is kept and shown."""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from gnio_jax.apps.live.checks import SECONDS_WITHOUT_A_SENSOR, Nature
from gnio_jax.apps.live.samples import Arrival, Sample
from gnio_jax.apps.live.tracking import VELOCITY
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Trajectory
from gnio_jax.evaluation.prepare import ROUGH_START
from gnio_jax.filtering import Pose
from gnio_jax.numerics import quaternion_from_matrix

LINES_BEFORE_A_SAMPLE = 100
"""Number of lines without a sample after which the input counts as no stream of an IMU."""
REFUSED_IN_A_ROW = 1000
"""Number of successive refused samples that ends the stream: its clock or its format has changed,
and all later samples would be refused (ours)."""
STRETCH = 1.0
"""Time between the points by which a walk is measured, s, as in `metrics.path_length`."""
STEP = 0.2
"""Distance between points of the path that are drawn, m (ours)."""
MOST_NOTICES = 20
"""Newest messages that are kept for the page."""
QUIET_SECONDS = 5.0
"""Time without a sample after which a message says so, s."""
OFTEN = 10
"""Number of seconds for which it is said every second what the stream waits for; then it is said
every so many seconds."""


@dataclass
class Followed:
    """The results of a stream so far. Only the path of the poses is kept: 64 bytes each, 23 MB in
    ten hours at 10 Hz. A pose costs the same at the end of a walk as at its beginning."""

    bridged: float = math.inf
    """Largest time between two whole samples, s; a longer time is a gap
    (`data.resampling.longest_bridge`)."""
    rest_seconds: float = math.inf
    """Time for which the IMU must be quiet to be at rest, s (`FilterConfig.rest_seconds`)."""
    pose: Pose | None = None
    """The newest pose."""
    rough: bool = False
    """Whether the device moved while it should be still."""
    path: array = field(default_factory=lambda: array("d"))
    """Time, position and attitude (wxyz) of each healthy pose, one pose after another."""
    points: list[tuple[float, float]] = field(default_factory=list)
    """The path that is drawn: places `STEP` apart, m."""
    walked: float = 0.0
    """Length of the path up to `corner`, m."""
    corner: tuple[float, float, float] = (math.nan, math.nan, math.nan)
    """Time (s), x and y (m) of the last point by which the walk is measured."""
    quiet_since: float = math.nan
    """Time since which all poses are quiet, s; NaN if the newest is not."""
    waiting: str = ""
    """What is needed before there can be a pose, or why nothing comes."""
    notices: list[str] = field(default_factory=list)
    """The newest messages."""
    samples: int = 0
    first: float = math.nan
    """Stamp of the first sample, s."""
    last: float = math.nan
    """Stamp of the last sample, s."""
    whole: float = math.nan
    """Stamp of the newest sample with both sensors, s."""
    gaps: int = 0
    """Number of gaps since the first pose."""
    longest_gap: float = 0.0
    """s."""
    refused: int = 0
    """Number of lines that were no samples, and of samples that were refused."""
    in_a_row: int = 0
    """Number of lines refused since the newest sample."""
    reasons: tuple[str, str] = ("", "")
    """Reasons why the first and the newest line were refused."""

    @property
    def trajectory(self) -> Trajectory:
        """The path, of healthy poses."""
        rows = np.array(self.path).reshape(-1, 8)
        return Trajectory(rows[:, 0], rows[:, 1:4], rows[:, 4:])

    @property
    def lost(self) -> bool:
        """Whether the stream was ended because of refused lines."""
        return self.in_a_row >= REFUSED_IN_A_ROW

    @property
    def distance(self) -> float:
        """Horizontal length of the path up to the newest pose, through points 1 s apart, m."""
        if not self.path:
            return 0.0
        return self.walked + math.dist(self.path[-7:-5], self.corner[1:])

    @property
    def at_rest(self) -> bool:
        """Whether the IMU has been quiet for as long as the filter asks of a rest."""
        return self.pose is not None and self.pose.time - self.quiet_since >= self.rest_seconds

    def warnings(self) -> list[str]:
        """Warnings for the user about the start, missing samples and refused lines."""
        warnings = []
        if self.rough:
            problem = "it moved while it should lie still, so velocity and tilt are inaccurate"
            warnings.append(f"start: {problem}")
        if self.gaps:
            longest = f"the longest of {self.longest_gap:.2g} s"
            problem = "the motion there is not known, and the reported covariance is too small"
            warnings.append(f"gaps: {self.gaps}, {longest}: samples are missing, {problem}")
        if self.refused:
            warnings.append(f"{self.refused} lines refused, the first: {self.reasons[0]}")
        if self.lost:
            newest = f"{self.in_a_row} lines in a row refused, the newest: {self.reasons[1]}"
            warnings.append(f"stopped, {newest}")
        return warnings

    def refuse(self, reason: str) -> None:
        """Count a line, or a sample, that was refused."""
        self.refused, self.in_a_row = self.refused + 1, self.in_a_row + 1
        self.reasons = self.reasons[0] or reason, reason

    def count(self, sample: Sample, nature: Nature) -> None:
        """Count a sample that the tracker has taken. Raises `InputError` if one sensor is
        missing."""
        self.first = sample.time if self.samples == 0 else self.first
        self.last, self.samples, self.in_a_row = sample.time, self.samples + 1, 0
        if sample.whole:
            self.note_gap()
            self.whole = sample.time
        elif math.isnan(self.whole) and self.last - self.first > SECONDS_WITHOUT_A_SENSOR:
            problem = f"has no sample with both sensors in its first {SECONDS_WITHOUT_A_SENSOR:g} s"
            raise InputError(nature.name, problem, nature.needs)

    def note_gap(self) -> None:
        """Record the time from the newest whole sample to the last one as a gap, if samples are
        missing there. Samples before the start are not in the path."""
        length = self.last - self.whole
        if self.pose is not None and length > self.bridged:
            self.gaps, self.longest_gap = self.gaps + 1, max(self.longest_gap, length)

    def add(self, pose: Pose) -> None:
        """Add a pose. Nothing of a pose that is not healthy is added to the path."""
        if self.pose is None:
            self.rough = bool(pose.covariance[VELOCITY, VELOCITY].max() > ROUGH_START**2)
        self.pose = pose
        if not pose.quiet:
            self.quiet_since = math.nan
        elif math.isnan(self.quiet_since):
            self.quiet_since = pose.time
        if not pose.healthy:
            return
        attitude = quaternion_from_matrix(pose.rotation[None])[0]
        self.path.extend((pose.time, *pose.position, *attitude))
        x, y = map(float, pose.position[:2])
        if math.isnan(self.corner[0]):
            self.corner = pose.time, x, y
        elif pose.time >= self.corner[0] + STRETCH - 1e-6:
            self.walked += math.dist((x, y), self.corner[1:])
            self.corner = pose.time, x, y
        if not self.points or math.dist((x, y), self.points[-1]) >= STEP:
            self.points.append((x, y))


def follow(
    tracker: Any,
    arrivals: Iterator[Arrival],
    nature: Nature,
    result: Followed,
    on_pose: Callable[[Followed], None],
    say: Callable[[str], None],
) -> None:
    """Feed the samples to a tracker, until the source ends or its samples are no longer accepted
    (`Followed.lost`).

    Args:
        tracker: A `filtering.Tracker`.
        arrivals: What comes from the source, on one clock, in order and checked.
        nature: What is known about the source.
        result: The results, which are updated with each sample.
        on_pose: A function that is called after each clone step.
        say: A function that gets messages, and, before there is a pose, each second what is needed
            for it.

    Raises:
        InputError: No line is a sample, or no sample has both sensors.
    """
    begin = time.monotonic()
    latest, spoken, is_silent = begin, 0, False
    for arrival in arrivals:
        if arrival.notice:
            result.notices.append(arrival.notice)
            del result.notices[:-MOST_NOTICES]
            say(arrival.notice)
        if arrival.refusal:
            result.refuse(arrival.refusal)
        result.waiting = arrival.waiting or result.waiting
        pose = None
        if arrival.sample is not None:
            latest, is_silent = time.monotonic(), False
            pose = _push(tracker, arrival.sample, nature, result)
            waits = result.pose is None and pose is None
            result.waiting = _describe_rest(tracker) if waits else ""
        if result.samples == 0 and result.refused >= LINES_BEFORE_A_SAMPLE:
            problem = f"has no sample in its first {LINES_BEFORE_A_SAMPLE} lines"
            raise InputError(nature.name, problem, f"the last of them {result.reasons[1]}")
        if result.lost:
            break
        if pose is not None:
            is_first = result.pose is None
            result.add(pose)
            if is_first and result.rough:
                say(f"warning: {result.warnings()[0]}")
            on_pose(result)
        now = time.monotonic()
        if result.pose is None:
            seconds = int(now - begin)
            if seconds > spoken and (seconds <= OFTEN or seconds % OFTEN == 0):
                spoken = seconds
                say(f"waiting for {_describe(result)}")
        elif now - latest >= QUIET_SECONDS and not is_silent:
            is_silent = True
            say(f"nothing has come on {nature.name} for {now - latest:.0f} s")
    result.note_gap()


def _push(tracker: Any, sample: Sample, nature: Nature, result: Followed) -> Pose | None:
    try:
        pose = tracker.push(sample.time, sample.gyro, sample.accel)
    except ValueError as error:
        result.refuse(str(error))
        return None
    result.count(sample, nature)
    return pose


def _describe_rest(tracker: Any) -> str:
    """What a tracker without a pose needs."""
    hindrance = tracker.hindrance
    return f"a rest{f' ({hindrance})' if hindrance else ''}"


def _describe(result: Followed) -> str:
    """What is needed, and how many lines were refused."""
    needed = result.waiting or "the first sample"
    if not result.refused:
        return needed
    return f"{needed}; {result.refused} lines are refused, the newest {result.reasons[1]}"


def line(result: Followed) -> str:
    """The newest pose as text."""
    pose = result.pose
    assert pose is not None
    x, y, z = np.round(pose.position, 2) + 0.0  # no -0.00
    sigma = math.sqrt(max(float(np.trace(pose.covariance[6:8, 6:8])), 0.0))
    begin = result.path[0] if result.path else pose.time
    health = "" if pose.healthy else f"  THE FILTER DIVERGED ({pose.failure})"
    return (
        f"{pose.time - begin:7.1f} s  x {x:+8.2f}  y {y:+8.2f}  z {z:+7.2f} m  "
        f"± {sigma:.2f} m  walked {result.distance:.1f} m{health}"
    )
