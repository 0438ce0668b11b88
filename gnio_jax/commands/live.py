"""`gnio live`: the trajectory while the samples come."""

from __future__ import annotations

import contextlib
import io
import signal
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro

from gnio_jax.commands import console, options
from gnio_jax.config import ImportOptions
from gnio_jax.errors import InputError
from gnio_jax.files import check_writable

UDP = "udp:"


@dataclass(frozen=True)
class LiveOptions:
    """What `gnio live` is asked for."""

    source: tyro.conf.Positional[str] = "-"
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
    imu_rate: float | None = None
    """Samples per second that will come, Hz; by default the network's, or the recording's."""
    rest_seconds: float = 1.0
    """How long the device lies still at the start, s."""
    speed: float = 1.0
    """Of a recording: how many times as fast as it was taken; 0 as fast as can be."""
    silence: float | None = None
    """Of datagrams: end after so many seconds without one."""


def live(asked: LiveOptions, _call: options.Call) -> None:
    """Follow an IMU live: where its carrier is now.

    A stream has a line for each sample, time,gyro x,y,z,accel x,y,z, or a JSON object with time,
    gyro and accel, in s, rad/s and m/s², +9.81 upwards at rest. Keep the device still for the first
    second: tilt, velocity and the gyro's bias are taken from it. In a terminal the path is drawn,
    elsewhere a line is printed each second. Ctrl-C or SIGTERM ends it (status 130, 143); the
    trajectory is written all the same. A recording whose units or columns must be named goes
    through gnio data import first.

    examples:
      phone_stream | {prog} --weights runs/mine      lines on standard input
      {prog} udp:5555 --imu-rate 200                 the same lines as datagrams on this machine
      {prog} walk.zip --speed 4                      a recording or bag, four times as fast
    """
    import jax  # late: mistakes do not wait for it

    from gnio_jax import live as following
    from gnio_jax.apps import packages
    from gnio_jax.live import rerun_stream

    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    weights = packages.choose(asked.weights)
    source, rate, notes = _source(asked)
    if asked.out:
        check_writable(asked.out)  # or the trajectory would be lost at the end
    if asked.rerun:
        rerun_stream.check(asked.rerun)
    found = following.Follower(following.longest_untold(weights.run, rate))
    with console.terminal() as terminal:
        terminal.progress("compiling", 0.0)
        try:
            tracker = following.create_tracker(weights.run, rate, asked.rest_seconds)
        except ValueError as error:
            raise InputError("--imu-rate or --rest-seconds", str(error)) from None
    output = console.stdout()
    output.print(f"following {source.name} with {weights.name}; Ctrl-C ends it", soft_wrap=True)
    for note in notes:
        output.print(f"  {note}", soft_wrap=True)
    stopped: list[tuple[str, int]] = []
    with contextlib.ExitStack() as running:
        stream = running.enter_context(rerun_stream.streaming(asked.rerun)) if asked.rerun else None
        show = running.enter_context(following.shown(output))
        running.enter_context(_signals(stopped))

        def on_pose(found: Any) -> None:
            if stream is not None:
                stream.add(found.poses[-1])
            show(found)

        following.follow(tracker.push, source, found, on_pose)
    for warning in found.warnings():
        output.print(f"warning: {warning}", soft_wrap=True)
    if found.poses:
        output.print(following.line(found.poses), soft_wrap=True)
        if asked.out:
            following.write_trajectory(asked.out, found.poses)
            output.print(f"trajectory: {asked.out}", soft_wrap=True)
    for word, status in stopped:
        print(word, file=sys.stderr)
        raise SystemExit(status)
    if not found.poses:
        problem = f"ended before the device was still for {asked.rest_seconds:g} s"
        raise InputError(source.name, problem, "let it run longer, or lower --rest-seconds")


@contextlib.contextmanager
def _signals(stopped: list[tuple[str, int]]) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the block alone; `stopped` has then what to say and the status."""
    try:
        yield
    except KeyboardInterrupt:
        stopped.append(("interrupted", 128 + signal.SIGINT))
    except SystemExit as leaving:  # of the handler of `console.run`
        if leaving.code != 128 + signal.SIGTERM:
            raise
        stopped.append(("terminated", 128 + signal.SIGTERM))


def _source(asked: LiveOptions) -> tuple[Any, float | None, tuple[str, ...]]:
    """Where samples come from, their rate where it is known, and what was assumed of them."""
    from gnio_jax import live as following

    scale = following.scale_of(asked.gyro_unit, asked.accel_unit)
    if asked.source == "-":
        if isinstance(sys.stdin, io.TextIOWrapper):
            sys.stdin.reconfigure(errors="replace")  # noise on a line is no text
        lines = following.lines_of(sys.stdin, scale=scale)
        return following.checked_units(lines), asked.imu_rate, ()
    if asked.source.startswith(UDP):
        port = asked.source.removeprefix(UDP)
        if not (port.isdecimal() and int(port[:6]) > 0):
            raise InputError(asked.source, "names no port", "write udp:5555")
        if asked.silence is not None and not 0 <= asked.silence <= threading.TIMEOUT_MAX:
            raise InputError("--silence", f"{asked.silence:g} s is no time to wait")
        messages = following.datagrams(int(port), asked.silence, scale)
        return following.checked_units(messages), asked.imu_rate, ()
    if asked.speed < 0:
        raise InputError("--speed", f"must not be negative, found {asked.speed:g}")
    from gnio_jax.apps.importing import read_imported

    stated = ImportOptions(gyro_unit=asked.gyro_unit, accel_unit=asked.accel_unit)
    sequence, notes, warned = read_imported(Path(asked.source), stated)
    rate = 1 / float(np.median(np.diff(sequence.time)))
    played = following.from_recording(sequence, asked.speed)
    return played, asked.imu_rate or rate, (*warned, *notes)
