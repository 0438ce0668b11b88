"""`gnio live`: the trajectory while the samples come."""

from __future__ import annotations

import contextlib
import io
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import tyro

from gnio_jax.commands import console
from gnio_jax.commands.options import Command
from gnio_jax.commands.recording import RecordingOptions, Sign, read_any
from gnio_jax.errors import InputError
from gnio_jax.files import check_writable

DESCRIPTION = """Follow an IMU live: where its carrier is now.

  phone_stream | {prog} --weights runs/mine      (lines time,gyro x,y,z,accel x,y,z)
  {prog} udp:5555 --imu-rate 200                 (the same lines as datagrams on this machine)
  {prog} walk.zip --speed 4                      (a recording or bag, four times as fast)

Units are s, rad/s and m/s², +9.81 upwards at rest; a JSON object with time, gyro and accel does as
well. Keep the device still for the first second: tilt, velocity and the gyro's bias are taken from
it. In a terminal it draws the path, elsewhere it prints a line each second. Ctrl-C or SIGTERM ends
it (status 130, 143); the trajectory is written all the same. A log of one's own is read with the
options of gnio track after gnio data import."""

UDP = "udp:"
DRAWN_EVERY = 0.125
"""s. A drawing looks at the whole path: one for each pose would fall behind a long stream."""

VELOCITY = slice(3, 6)
"""Of a pose's covariance."""


@dataclass(frozen=True)
class LiveOptions:
    """What `gnio live` is asked for."""

    source: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="SOURCE")]] = "-"
    """- for standard input, udp:PORT on this machine, or a recording."""
    weights: str | None = None
    """Name, package or run folder; by default the network that comes with gnio-jax, else the newest
    run below runs/."""
    out: Path | None = None
    """File for the trajectory, in TUM format, when the stream has ended."""
    rerun: str | None = None
    """File for the viewer Rerun, NAME.rrd, or the word viewer to look at it now."""
    gyro_unit: Literal["rad/s", "deg/s"] | None = None
    """Unit of the gyro; rad/s of a stream, of a recording what it says."""
    accel_unit: Literal["m/s2", "g", "mg"] | None = None
    """Unit of the accelerometer; m/s2 of a stream, of a recording what it says."""
    accel_sign: Sign = None
    """Of a recording, as gnio track takes it."""
    imu_rate: float | None = None
    """Samples per second that will come, Hz; by default the network's, or the recording's."""
    rest_seconds: float = 1.0
    """How long the device lies still at the start, s."""
    speed: float = 1.0
    """Of a recording: how many times as fast as it was taken; 0 as fast as can be."""
    silence: float | None = None
    """Of datagrams: end after so many seconds without one."""


def live(options: LiveOptions, _prog: str) -> None:
    """Follow, show, and write the trajectory."""
    # After the options: --help and mistakes do not wait for these imports.
    import jax

    from gnio_jax import live as following
    from gnio_jax import tracking
    from gnio_jax.live import rerun_stream

    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    weights = tracking.choose_weights(options.weights)
    source, rate, notes = _source(options)
    if options.out:
        check_writable(options.out)  # or the trajectory would be lost at the end
    if options.rerun:
        rerun_stream.check(options.rerun)
    found = following.Follower(following.longest_untold(weights.run, rate))
    with console.terminal() as terminal:
        terminal.progress("compiling", 0.0)
        try:
            tracker = following.create_tracker(weights.run, rate, options.rest_seconds)
        except ValueError as error:
            raise InputError("--imu-rate or --rest-seconds", str(error)) from None
    output = console.stdout()
    output.print(f"following {source.name} with {weights.name}; Ctrl-C ends it", soft_wrap=True)
    for note in notes:
        output.print(f"  {note}", soft_wrap=True)
    with _rerun(options.rerun) as log, _shown(output) as show, _signals() as signalled:
        following.follow(tracker.push, source, found, lambda found: (log(found), show(found)))
    _tell(output, found)
    if found.poses:
        output.print(_line(found.poses), soft_wrap=True)
        if options.out:
            _write(options.out, found.poses)
            output.print(f"trajectory: {options.out}", soft_wrap=True)
    if signalled:
        print(signalled[0].said, file=sys.stderr)
        raise SystemExit(signalled[0].status)
    if not found.poses:
        problem = f"ended before the device was still for {options.rest_seconds:g} s"
        raise InputError(source.name, problem, "let it run longer, or lower --rest-seconds")


class Signal(NamedTuple):
    """What ended the stream from outside."""

    said: str
    status: int


@contextlib.contextmanager
def _signals() -> Iterator[list[Signal]]:
    """Ctrl-C and SIGTERM end the block alone; they are in the list then."""
    found: list[Signal] = []
    try:
        yield found
    except KeyboardInterrupt:
        found.append(Signal("interrupted", 128 + signal.SIGINT))
    except SystemExit as leaving:  # of the handler of `console.run`
        if leaving.code != 128 + signal.SIGTERM:
            raise
        found.append(Signal("terminated", 128 + signal.SIGTERM))


@contextlib.contextmanager
def _rerun(target: str | None) -> Iterator[Callable[[Any], None]]:
    """What is called after each clone step, to show the pose in Rerun."""
    if target is None:
        yield lambda found: None
        return
    from gnio_jax.live import rerun_stream

    with rerun_stream.streaming(target) as stream:
        yield lambda found: stream.add(found.poses[-1])


def _tell(output: Any, found: Any) -> None:
    """What was refused, and how it began."""
    from gnio_jax.evaluation.preparation import ROUGH_START

    if found.poses and found.poses[0].covariance[VELOCITY, VELOCITY].max() > ROUGH_START**2:
        lines = "start: it moved while it should lie still, so velocity and tilt are rough"
        output.print(f"warning: {lines}", soft_wrap=True)
    if found.gaps:
        lines = f"{len(found.gaps)}, the longest of {max(found.gaps):.2g} s: samples are missing"
        guessed = "what happened there is guessed, and the filter is surer than it should be"
        output.print(f"warning: gaps: {lines}, {guessed}", soft_wrap=True)
    if found.refused:
        lines = f"warning: {found.refused} lines refused, the first: {found.reason}"
        output.print(lines, soft_wrap=True)
    if found.lost:
        lines = f"{found.in_a_row} lines in a row refused, the newest: {found.newest_reason}"
        output.print(f"warning: stopped, {lines}", soft_wrap=True)


def _source(options: LiveOptions) -> tuple[Any, float | None, tuple[str, ...]]:
    """Where samples come from, their rate where it is known, and what was assumed of them."""
    from gnio_jax import live as following

    scale = following.scale_of(options.gyro_unit, options.accel_unit)
    if options.accel_sign is not None and _is_stream(options.source):
        raise InputError("--accel-sign", "is of a recording", "a stream reads +9.81 upwards")
    if options.source == "-":
        if isinstance(sys.stdin, io.TextIOWrapper):
            sys.stdin.reconfigure(errors="replace")  # noise on a line is no text
        lines = following.lines_of(sys.stdin, scale=scale)
        return following.checked_units(lines), options.imu_rate, ()
    if options.source.startswith(UDP):
        port = options.source.removeprefix(UDP)
        if not (port.isdecimal() and int(port[:6]) > 0):
            raise InputError(options.source, "names no port", "write udp:5555")
        if options.silence is not None and not 0 <= options.silence <= threading.TIMEOUT_MAX:
            raise InputError("--silence", f"{options.silence:g} s is no time to wait")
        messages = following.datagrams(int(port), options.silence, scale)
        return following.checked_units(messages), options.imu_rate, ()
    if options.speed < 0:
        raise InputError("--speed", f"must not be negative, found {options.speed:g}")
    given = RecordingOptions(
        Path(options.source),
        gyro_unit=options.gyro_unit,
        accel_unit=options.accel_unit,
        accel_sign=options.accel_sign,
    )
    sequence, notes = read_any(given)
    rate = 1 / float(np.median(np.diff(sequence.time)))
    return following.from_recording(sequence, options.speed), options.imu_rate or rate, notes


def _is_stream(source: str) -> bool:
    return source == "-" or source.startswith(UDP)


@contextlib.contextmanager
def _shown(output: Any) -> Iterator[Callable[[Any], None]]:
    """What is called after each clone step: it draws in a terminal, and prints a line each second
    elsewhere."""
    if not output.is_terminal:
        yield lambda found: _print_each_second(output, found.poses)
        return
    from rich.live import Live
    from rich.text import Text

    from gnio_jax.live import drawing

    with Live(console=output, refresh_per_second=8, transient=True) as screen:
        drawn = -math.inf

        def draw(found: Any) -> None:
            nonlocal drawn
            if time.monotonic() - drawn < DRAWN_EVERY:
                return
            columns, rows = max(10, output.width - 2), max(5, output.height - 4)
            positions = np.array([pose.position for pose in found.poses])
            screen.update(Text(f"{drawing(positions, columns, rows)}\n{_line(found.poses)}"))
            drawn = time.monotonic()

        yield draw


def _print_each_second(output: Any, poses: list[Any]) -> None:
    newest, start = poses[-1].time, poses[0].time
    before = poses[-2].time if len(poses) > 1 else start - 1
    if int(newest - start) > int(before - start):
        output.print(_line(poses), soft_wrap=True)


def _line(poses: list[Any]) -> str:
    """The newest pose in words."""
    pose = poses[-1]
    x, y, z = pose.position
    sigma = float(np.sqrt(np.maximum(np.trace(pose.covariance[6:8, 6:8]), 0.0)))
    path = np.array([each.position for each in poses[::10]])
    walked = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    health = "" if pose.healthy else "  THE FILTER DIVERGED"
    return (
        f"{pose.time - poses[0].time:7.1f} s  x {x:+8.2f}  y {y:+8.2f}  z {z:+7.2f} m  "
        f"± {sigma:.2f} m  walked {walked:.1f} m{health}"
    )


def _write(path: Path, poses: list[Any]) -> None:
    from scipy.spatial.transform import Rotation

    from gnio_jax.evaluation import Trajectory
    from gnio_jax.evaluation.tum import write_tum
    from gnio_jax.files import replacing

    sound = [pose for pose in poses if pose.healthy]
    if not sound:
        raise InputError(path, "there is no sound pose to write", "the filter diverged at once")
    orientation = Rotation.from_matrix(np.array([pose.rotation for pose in sound]))
    trajectory = Trajectory(
        np.array([pose.time for pose in sound]),
        np.array([pose.position for pose in sound]),
        orientation.as_quat(scalar_first=True),
    )
    with replacing(path) as temporary:
        write_tum(temporary, trajectory)


COMMAND = Command(LiveOptions, live, DESCRIPTION)
