"""Odometry while samples come: what `gnio live` does.

    lines, datagrams or a recording → samples with both sensors → rate and units → tracker → path

A stream does not describe itself. Its rate and the unit of its accelerometer are measured over its
first second, in which the device must be still in any case.
"""

from __future__ import annotations

import dataclasses
import heapq
import itertools
import json
import math
import queue
import socket
import threading
import time
from array import array
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.apps.importing import units
from gnio_jax.data import physics
from gnio_jax.data.resampling import longest_bridge
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Trajectory
from gnio_jax.evaluation.metrics import path_length
from gnio_jax.evaluation.prepare import ROUGH_START
from gnio_jax.filtering import Pose, Tracker, make_filter
from gnio_jax.filtering.start import level_state
from gnio_jax.models import Network
from gnio_jax.networks import TrainedNetwork
from gnio_jax.numerics import quaternion_from_matrix
from gnio_jax.types import FASTEST_TURN, STRONGEST_FORCE, Sequence

# --- samples

LONGEST_LINE = 4096
"""Largest number of characters of a sample."""
MISSING = (math.nan, math.nan, math.nan)
"""Values of a sensor that was not read."""


class Sample(NamedTuple):
    """A sample, raw, in the body frame. A missing value is NaN."""

    time: float
    """s."""
    gyro: tuple[float, float, float]
    """rad/s."""
    accel: tuple[float, float, float]
    """m/s², +9.81 upwards at rest."""

    @property
    def whole(self) -> bool:
        """Whether both sensors were read."""
        return _is_finite(self.gyro) and _is_finite(self.accel)


Units = tuple[str, str]
"""Units of gyro and accelerometer, by the names that an import knows."""
SI: Units = ("rad/s", "m/s2")


def parse_line(line: str, stated: Units = SI) -> Sample | None:
    """The sample of a line with the units `stated`, or None if it is no sample.

    There are two forms. One is seven numbers `time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z`,
    separated by commas, semicolons, tabs or blanks; an empty cell is a missing value. The other is
    a JSON object with `time`, `gyro` and `accel`, or with one sensor alone; null is a missing
    value. A line without a time, with too many numbers, or with rates or accelerations beyond the
    range of a phone is no sample.
    """
    line = line.strip()
    if not line or len(line) > LONGEST_LINE:
        return None
    try:
        if line.startswith("{"):
            found = json.loads(line)
            sensors = [found[name] for name in ("gyro", "accel") if name in found]
            cells = [found.get(name, [None] * 3) for name in ("gyro", "accel")]
            stamp, (gyro, accel) = _number(found["time"]), (list(map(_number, c)) for c in cells)
            if not sensors:
                return None
        else:
            separator = next((mark for mark in ",;\t" if mark in line), None)
            numbers = [float(cell) if cell.strip() else math.nan for cell in line.split(separator)]
            stamp, gyro, accel = numbers[0], numbers[1:4], numbers[4:]
        if not math.isfinite(stamp) or len(gyro) != 3 or len(accel) != 3:
            return None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError):
        return None
    gyro = [units.TO_RAD_PER_SECOND[stated[0]] * each for each in gyro]
    accel = [units.TO_METRES_PER_SECOND_SQUARED[stated[1]] * each for each in accel]
    if any(abs(each) > FASTEST_TURN for each in gyro):
        return None
    if any(abs(each) > STRONGEST_FORCE for each in accel):
        return None
    return Sample(stamp, (gyro[0], gyro[1], gyro[2]), (accel[0], accel[1], accel[2]))


def _number(value: Any) -> float:
    """The number, NaN for null. Raises `TypeError` for other values."""
    if value is None:
        return math.nan
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    return float(value)


def _is_finite(values: Iterable[float]) -> bool:
    return all(map(math.isfinite, values))


def _is_missing(values: Iterable[float]) -> bool:
    return all(map(math.isnan, values))


# --- sensors with rows of their own

LONGEST_WAIT = 0.1
"""Time that a row of one sensor alone waits for late rows, s (ours). Two readings of the
accelerometer are interpolated if they are no further apart."""
ROUNDING = 1e-6
"""Error of differences of stamps, s: Unix time in float64 has steps of 2e-7 s."""


def paired(samples: Iterable[Sample | None]) -> Iterator[Sample | None]:
    """Samples at the stamps of the gyro, with the accelerometer interpolated linearly where a row
    has none, because many phones send each sensor in its own rows.

    Rows pass unchanged until a row has one sensor alone. From then on they are held for
    `LONGEST_WAIT` by their stamps and are passed on in order, so either sensor may be late by this
    time. A row of the gyro gets the accelerometer from the readings around it. A row without the
    gyro makes no sample, except if there is no gyro for longer than `LONGEST_WAIT`: then it is
    passed on, so that time advances. None stands for a row that is no sample, and for a row that is
    not later than the last one of the same sensors.
    """
    held: list[tuple[float, int, Sample]] = []
    newest: dict[tuple[bool, bool], float] = {}
    """Last stamps, by the sensors that a row has."""
    reading: Sample | None = None
    """The last row with the accelerometer that was passed on."""
    turned = math.nan
    """The last stamp of the gyro that was passed on, or the start of the stream."""
    apart = False

    def leaving(now: float) -> Iterator[Sample]:
        nonlocal reading, turned
        while held and not abs(now - held[0][0]) <= LONGEST_WAIT + ROUNDING:
            row = heapq.heappop(held)[2]
            if not _is_missing(row.gyro):
                turned = row.time
                yield _with_accelerometer(row, reading, held)
            elif not 0 <= row.time - turned <= LONGEST_WAIT and row.time < now:
                yield row
            reading = row if _is_finite(row.accel) else reading

    for number, row in enumerate(samples):
        if row is None:
            yield None
            continue
        turned = row.time if math.isnan(turned) else turned
        sensors = not _is_missing(row.gyro), not _is_missing(row.accel)
        apart = apart or sensors in ((True, False), (False, True))
        if not apart:
            reading, turned = (row, row.time) if all(sensors) else (reading, turned)
            yield row
        elif 0 <= newest.get(sensors, -math.inf) - row.time <= LONGEST_WAIT:
            yield None
        else:
            newest[sensors] = row.time
            heapq.heappush(held, (row.time, number, row))
            yield from leaving(row.time)
    yield from leaving(math.nan)


def _with_accelerometer(
    row: Sample, before: Sample | None, held: list[tuple[float, int, Sample]]
) -> Sample:
    """A row of the gyro with the accelerometer interpolated between the reading before and the next
    one that is held. The row is unchanged if it has the accelerometer, or if the readings do not
    enclose it."""
    after = min((each for each in held if _is_finite(each[2].accel)), default=None)
    if not _is_missing(row.accel) or after is None:
        return row
    stamp, _, reading = after
    if stamp == row.time:
        return row._replace(accel=reading.accel)
    if before is None or stamp - before.time > LONGEST_WAIT + ROUNDING:
        return row
    share = (row.time - before.time) / (stamp - before.time)
    x, y, z = (a + share * (b - a) for a, b in zip(before.accel, reading.accel, strict=True))
    return row._replace(accel=(x, y, z))


# --- where samples come from

LONGEST_QUEUE = 100_000
"""Largest number of datagrams that wait for the filter; later ones are lost."""
QUIET_SECONDS = 5.0
"""Time without a datagram after which a message says so, s."""


class Source(NamedTuple):
    """Samples as they come."""

    samples: Iterator[Sample | None]
    """The samples; None for a line that is no sample."""
    name: str


def lines_of(stream: Iterable[str], name: str = "standard input", stated: Units = SI) -> Source:
    """The lines of a stream with the units `stated`, until it ends."""
    return Source(paired(parse_line(line, stated) for line in stream), name)


def from_recording(sequence: Sequence, speed: float) -> Source:
    """The samples of a recording, `speed` times as fast as they were recorded; 0: as fast as
    possible. Samples that are interpolated across a gap are missing."""

    def played() -> Iterator[Sample]:
        begin, first, there = time.monotonic(), float(sequence.time[0]), sequence.imu_valid
        missing = np.zeros((len(sequence.time), 1), bool) if there is None else ~there[:, None]
        signals = (np.where(missing, np.nan, each) for each in (sequence.gyro, sequence.accel))
        for stamp, gyro, accel in zip(sequence.time, *signals, strict=True):
            if speed > 0:
                time.sleep(max(0.0, begin + (stamp - first) / speed - time.monotonic()))
            yield Sample(float(stamp), tuple(gyro.tolist()), tuple(accel.tolist()))

    return Source(played(), sequence.name)


class Datagrams:
    """The datagrams of a UDP socket, with one or several lines each. A thread reads them from the
    socket from the beginning, so that nothing is lost while the filter is compiled."""

    def __init__(self, inbox: socket.socket, name: str):
        self.name, self._socket = name, inbox
        self._waiting: queue.Queue[bytes] = queue.Queue(LONGEST_QUEUE)
        threading.Thread(target=self._receive, daemon=True).start()

    def _receive(self) -> None:
        while True:
            try:
                message = self._socket.recv(65536)
            except OSError:
                return  # the socket is closed
            if not self._waiting.full():
                self._waiting.put(message)

    def source(
        self,
        stated: Units = SI,
        silence: float | None = None,
        say: Callable[[str], None] = print,
        at_rest: Callable[[list[Sample]], bool] = bool,
    ) -> Source:
        """The samples, in the units `stated`, until nothing comes for `silence` s after the first
        one (None: without end).

        `say` prints a message if nothing comes. Samples that came before this call are used if
        `at_rest` says that they begin at rest. Otherwise the device was in motion before the
        message to hold it still, and they are left out.
        """
        come = [self._waiting.get_nowait() for _ in range(self._waiting.qsize())]
        messages = self._messages(silence, say, begun=bool(come))
        early = lines_of(_lines(come), self.name, stated).samples
        if come and not at_rest([each for each in early if each is not None and each.whole]):
            say(f"{len(come)} datagrams came before the device was still and are left out")
            come = []
        return lines_of(_lines(itertools.chain(come, messages)), self.name, stated)

    def _messages(
        self, silence: float | None, say: Callable[[str], None], begun: bool
    ) -> Iterator[bytes]:
        said = False
        wait = QUIET_SECONDS if silence is None else min(silence, QUIET_SECONDS)
        since = time.monotonic()
        try:
            while True:
                try:
                    message = self._waiting.get(timeout=wait)
                except queue.Empty:
                    quiet = time.monotonic() - since
                    if begun and silence is not None and quiet >= silence:
                        return
                    if quiet >= QUIET_SECONDS and not said:
                        say(f"nothing has come on {self.name} for {quiet:.0f} s")
                        said = True
                    continue
                begun, said, since = True, False, time.monotonic()
                yield message
        finally:
            self._socket.close()


def _lines(messages: Iterable[bytes]) -> Iterator[str]:
    for message in messages:
        for line in message.decode("utf-8", "replace").splitlines() or [""]:
            yield line[: LONGEST_LINE + 1]


# --- the tracker, at the rate and in the units of the stream

FIRST_SECONDS = 1.0
"""Time of a stream over which its rate is measured, s …"""
FIRST_SAMPLES = 21
"""… and smallest number of samples for it, from which the units of accelerometer and stamps are
recognised (ours)."""
LONGEST_INTERVAL = 0.5
"""Largest time between samples by their stamps, s: a slower stream has stamps in ms (ours)."""
RATE_SHARE = 0.75
"""Smallest ratio of a stated rate to the measured one, and of the measured one to it (ours)."""
TURNING_SECONDS = 10.0
"""Time after which the rotation of gravity is compared with the gyro, s (ours)."""


def create_tracker(
    run: TrainedNetwork, imu_rate: float | None = None, rest_seconds: float = 1.0
) -> Tracker:
    """The compiled tracker of a run, with the filter and the start of `gnio track`.

    From the same samples it makes the same trajectory as `gnio track`, to rounding, if the
    recording rests for `rest_seconds` and less than a second longer. From a longer rest a track
    uses all samples for the gyro's bias, but a live tracker does not know the later ones. Live
    samples are interpolated linearly if the rates differ.

    `imu_rate` is the rate of the samples that will come, Hz; None: the network's, until
    `Tracker.expect` changes it. If samples are further apart than 1.5 of its intervals, some are
    missing between them. Raises `ValueError` for a rest that is shorter than two samples.
    """
    network = Network.of(run.model, run.variables)
    return Tracker(
        network.predict(),
        make_filter(run.config.data, run.config.filter),
        rest_seconds=rest_seconds,
        hole=longest_interval(run, imu_rate),
        imu_rate=imu_rate or run.config.data.rate,
    )


def longest_interval(run: TrainedNetwork, imu_rate: float | None = None) -> float:
    """Largest time between samples without missing ones, s; `imu_rate` as in `create_tracker`."""
    own = 1 / run.config.data.rate
    return 1.5 * max(own, 1 / imu_rate if imu_rate else own)


def expect(tracker: Tracker, found: Followed, run: TrainedNetwork, imu_rate: float) -> None:
    """Set the rate of the samples, Hz, in the tracker of a run and in `found`."""
    tracker.expect(imu_rate, longest_interval(run, imu_rate))
    found.bridged = longest_bridge(imu_rate)


def begins_at_rest(run: TrainedNetwork) -> Callable[[list[Sample]], bool]:
    """A function that tells whether the first second of some samples is quiet enough for the start
    of the filter."""
    ekf = make_filter(run.config.data, run.config.filter)

    def at_rest(samples: list[Sample]) -> bool:
        first = [each for each in samples if each.time - samples[0].time < FIRST_SECONDS]
        if len(first) < FIRST_SAMPLES or samples[-1].time - samples[0].time < FIRST_SECONDS:
            return True  # too few samples: the rest may continue
        rows = np.array([(each.time, *each.gyro, *each.accel) for each in first])
        config = dataclasses.replace(ekf.config, dt=float(np.median(np.diff(rows[:, 0]))))
        sampled = dataclasses.replace(ekf, config=config)
        state = level_state(sampled, rows[:, 1:4], rows[:, 4:])
        return float(state.core_covariance[VELOCITY.start, VELOCITY.start]) <= ROUGH_START**2

    return at_rest


def measured(
    source: Source, begin: Callable[[float], None], imu_rate: float | None = None
) -> Source:
    """The same samples; the first second is held until its rate, Hz, is given to `begin`.

    Raises `InputError` while it runs, if the stamps are not in seconds, if the stated `imu_rate` is
    wrong, if the accelerometer of a device at rest does not read gravity, or if after ten seconds
    gravity does not turn as the gyro does.
    """

    def samples() -> Iterator[Sample | None]:
        held: list[Sample | None] = []
        stamps: list[float] = []
        for sample in source.samples:
            held.append(sample)
            if sample is not None and (not stamps or sample.time > stamps[-1]):
                stamps.append(sample.time)
            enough = len(stamps) >= FIRST_SAMPLES and stamps[-1] - stamps[0] >= FIRST_SECONDS
            if enough or len(held) - len(stamps) >= LINES_BEFORE_A_SAMPLE:
                break
        kept = [each for each in held if each is not None and each.whole]
        if len(stamps) >= FIRST_SAMPLES:
            begin(_rate_of(stamps, imu_rate, source.name))
        if len(kept) >= FIRST_SAMPLES:
            _check_gravity(kept, source.name)
        yield from held
        for sample in source.samples:
            yield sample
            if sample is None or not sample.whole:
                continue
            kept.append(sample)
            if sample.time - kept[0].time >= TURNING_SECONDS:
                _check_turning(kept, source.name)
                break
        yield from source.samples

    return Source(samples(), source.name)


def _rate_of(stamps: list[float], imu_rate: float | None, where: str) -> float:
    interval = float(np.median(np.diff(stamps)))
    if interval > LONGEST_INTERVAL:
        problem = f"its samples come {interval:g} s apart by their stamps"
        raise InputError(where, problem, "stamps must be in seconds, not in ms")
    if imu_rate and not RATE_SHARE < imu_rate * interval < 1 / RATE_SHARE:
        problem = f"its samples come at {1 / interval:.4g} Hz by their stamps"
        raise InputError(where, problem, f"leave out --imu-rate {imu_rate:g}: it is measured")
    return imu_rate or 1 / interval


def _check_gravity(samples: list[Sample], where: str) -> None:
    size = float(np.median(np.linalg.norm([sample.accel for sample in samples], axis=1)))
    ranges = units.GRAVITY_RANGES.items()
    looks = [unit for unit, (least, most) in ranges if least <= size <= most]
    if looks == ["m/s2"]:
        return
    problem = f"its accelerometer reads {size:.3g} m/s² at the start, and gravity is 9.81"
    known = ", ".join(units.TO_METRES_PER_SECOND_SQUARED)
    remedy = f"give --accel-unit {looks[0]}" if looks else f"give its --accel-unit: {known}"
    raise InputError(where, problem, f"{remedy}; gravity must be in it")


def _check_turning(samples: list[Sample], where: str) -> None:
    rows = np.array([[sample.time, *sample.gyro, *sample.accel] for sample in samples])
    rows = rows[np.unique(rows[:, 0], return_index=True)[1]]  # in order
    imu = physics.ImuSamples(rows[:, 0] - rows[0, 0], rows[:, 1:4], rows[:, 4:7])
    physics.check_turning(imu, where)


# --- following

LINES_BEFORE_A_SAMPLE = 100
"""Number of lines without a sample after which the input counts as no stream of an IMU."""
SECONDS_WITHOUT_A_SENSOR = 10.0
"""Time from the start without a sample of both sensors after which one of them counts as not sent,
or as sent by another name, s (ours)."""
REFUSED_IN_A_ROW = 1000
"""Number of successive refused samples that ends the stream: its clock or its format has changed,
and all later samples would be refused (ours)."""
VELOCITY = slice(3, 6)
"""Rows of the position in a pose's covariance."""


@dataclass
class Followed:
    """The results of a stream so far. Only the path of the poses is kept: 64 bytes each, 23 MB in
    ten hours at 10 Hz."""

    bridged: float = math.inf
    """Largest time between two whole samples, s; a longer time is a gap
    (`data.resampling.longest_bridge`)."""
    pose: Pose | None = None
    """The newest pose."""
    rough: bool = False
    """Whether the device moved while it should be still."""
    path: array = field(default_factory=lambda: array("d"))
    """Time, position and attitude (wxyz) of each healthy pose, one pose after another."""
    samples: int = 0
    first: float = math.nan
    """Stamp of the first sample, s."""
    last: float = math.nan
    """Stamp of the last sample, s."""
    whole: float = math.nan
    """Stamp of the newest sample with both sensors, s."""
    gaps: list[tuple[float, float]] = field(default_factory=list)
    """Gaps since the first pose: stamp of the end and length, s."""
    refused: int = 0
    """Number of lines that were no samples, and of samples that the tracker refused."""
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

    def warnings(self) -> list[str]:
        """Warnings for the user about the start, missing samples and refused lines."""
        found = []
        if self.rough:
            problem = "it moved while it should lie still, so velocity and tilt are inaccurate"
            found.append(f"start: {problem}")
        if self.gaps:
            longest = f"the longest of {max(length for _, length in self.gaps):.2g} s"
            guessed = "the motion there is not known, and the reported covariance is too small"
            found.append(f"gaps: {len(self.gaps)}, {longest}: samples are missing, {guessed}")
        if self.refused:
            found.append(f"{self.refused} lines refused, the first: {self.reasons[0]}")
        if self.lost:
            newest = f"{self.in_a_row} lines in a row refused, the newest: {self.reasons[1]}"
            found.append(f"stopped, {newest}")
        return found


def follow(
    push: Callable[[Any, Any, Any], Pose | None],
    source: Source,
    found: Followed,
    on_pose: Callable[[Followed], None],
) -> None:
    """Feed the samples to a tracker, by its `push`, until the source ends or its samples are no
    longer accepted (`Followed.lost`).

    `found` is updated with each sample, and `on_pose` is called after each clone step. Raises
    `InputError` if no line is a sample, or if no sample has both sensors.
    """
    for sample in source.samples:
        try:
            if sample is None:
                raise ValueError("is no sample: time,gyro x,y,z,accel x,y,z or JSON is wanted")
            pose = push(sample.time, sample.gyro, sample.accel)
        except ValueError as error:
            found.refused, found.in_a_row = found.refused + 1, found.in_a_row + 1
            found.reasons = found.reasons[0] or str(error), str(error)
            if found.samples == 0 and found.refused >= LINES_BEFORE_A_SAMPLE:
                problem = f"has no sample in its first {LINES_BEFORE_A_SAMPLE} lines"
                raise InputError(source.name, problem, f"the last of them {error}") from None
            if found.lost:
                break
            continue
        _count(found, sample, source.name)
        if pose is not None:
            _add(found, pose)
            on_pose(found)
    _note_gap(found)


def _count(found: Followed, sample: Sample, where: str) -> None:
    """Count a sample that the tracker has taken."""
    while found.gaps and found.gaps[-1][0] > sample.time:
        found.gaps.pop()  # the tracker rejected a stamp that jumped
    found.first = sample.time if found.samples == 0 else found.first
    found.last, found.samples, found.in_a_row = sample.time, found.samples + 1, 0
    if sample.whole:
        _note_gap(found)
        found.whole = sample.time
    elif math.isnan(found.whole) and found.last - found.first > SECONDS_WITHOUT_A_SENSOR:
        problem = f"has no sample with both sensors in its first {SECONDS_WITHOUT_A_SENSOR:g} s"
        raise InputError(where, problem, "send the gyro (gyro) and the accelerometer (accel)")


def _note_gap(found: Followed) -> None:
    """Record the time from the newest whole sample to the last one as a gap, if samples are missing
    there. Samples before the start are not in the path."""
    if found.pose is not None and found.last - found.whole > found.bridged:
        found.gaps.append((found.last, found.last - found.whole))


def _add(found: Followed, pose: Pose) -> None:
    if found.pose is None:
        found.rough = bool(pose.covariance[VELOCITY, VELOCITY].max() > ROUGH_START**2)
    found.pose = pose
    if pose.healthy:
        attitude = quaternion_from_matrix(pose.rotation[None])[0]
        found.path.extend((pose.time, *pose.position, *attitude))


# --- the terminal

LEAST_EXTENT = 4.0
"""Smallest extent of the drawing, m."""
_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
"""Bits of the Unicode braille patterns by row and column of the dot."""


def line(found: Followed) -> str:
    """The newest pose as text. The distance walked is horizontal, through points 1 s apart, as in
    `gnio track`."""
    assert found.pose is not None
    x, y, z = np.round(found.pose.position, 2) + 0.0  # no -0.00
    path, time = found.trajectory, found.trajectory.time
    sigma = float(np.sqrt(np.maximum(np.trace(found.pose.covariance[6:8, 6:8]), 0.0)))
    walked = 0.0
    if len(time) > 1:
        walked = path_length(path.position[:, :2], float(np.median(np.diff(time))))
    health = "" if found.pose.healthy else f"  THE FILTER DIVERGED ({found.pose.failure})"
    return (
        f"{found.pose.time - time[0]:7.1f} s  x {x:+8.2f}  y {y:+8.2f}  z {z:+7.2f} m  "
        f"± {sigma:.2f} m  walked {walked:.1f} m{health}"
    )


def drawing(positions: Float[np.ndarray, "n d"], columns: int, rows: int) -> str:
    """A map of the path in braille characters, two dots by four in each, x to the right and y up,
    at one scale; the last position is `●`."""
    finite = positions[np.isfinite(positions[:, :2]).all(1), :2]
    if not len(finite):
        return "\n".join(" " * columns for _ in range(rows))
    low, high = finite.min(axis=0), finite.max(axis=0)
    width, height = 2 * columns - 1, 4 * rows - 1
    extent = np.maximum(high - low, 1e-9)
    metres = max(extent[0] / width, extent[1] / height, LEAST_EXTENT / min(width, height))
    middle = (low + high) / 2
    across = np.rint((finite[:, 0] - middle[0]) / metres + width / 2).astype(int)
    down = np.rint(height / 2 - (finite[:, 1] - middle[1]) / metres).astype(int)
    across, down = np.clip(across, 0, width), np.clip(down, 0, height)
    cells = np.zeros((rows, columns), np.int64)
    np.bitwise_or.at(cells, (down // 4, across // 2), _DOTS[down % 4, across % 2])
    text = [[chr(0x2800 + bits) for bits in row] for row in cells.tolist()]
    text[down[-1] // 4][across[-1] // 2] = "●"
    return "\n".join("".join(row) for row in text)
