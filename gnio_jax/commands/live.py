"""`gnio live`: the trajectory while samples arrive."""

from __future__ import annotations

import contextlib
import io
import math
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from gnio_jax.commands import console, options
from gnio_jax.config import ImportOptions
from gnio_jax.config.schema import UNNAMED, Bound, NewFile, NonNegative, Positive
from gnio_jax.errors import InputError
from gnio_jax.files import check_writable

UDP = "udp:"
Waiting = Annotated[
    float, Bound(lambda value: 0 <= value <= threading.TIMEOUT_MAX, "must be a time to wait, s")
]
DRAWN_EVERY = 0.125
"""Time between drawings, s. Each drawing processes the whole path, so one for each pose would be
too slow for a long stream."""


@dataclass(frozen=True)
class LiveOptions:
    source: Annotated[str, UNNAMED] = "-"
    """- for standard input; udp:PORT from this machine, udp:0.0.0.0:PORT from any machine; or a
    recording."""
    network: str | None = None
    """Network: the folder of a run, a package or a name (see gnio weights); by default the one that
    comes with gnio-jax, else the newest run below runs/."""
    out: NewFile | None = None
    """File for the trajectory in TUM format, which is written when the stream has ended."""
    rerun: str | None = None
    """File for the viewer Rerun, NAME.rrd, or the word viewer to open it now."""
    gyro_unit: Literal["rad/s", "deg/s"] | None = None
    """Unit of the gyro. By default it is rad/s for a stream, and the recording's own for a
    recording."""
    accel_unit: Literal["m/s2", "g", "mg"] | None = None
    """Unit of the accelerometer. By default it is m/s2 for a stream, and the recording's own for a
    recording."""
    imu_rate: Positive | None = None
    """Rate of the samples, Hz; by default it is measured."""
    rest_seconds: float = 1.0
    """Time for which the device lies still at the start, s."""
    speed: NonNegative = 1.0
    """For a recording: replay it this many times as fast as it was recorded; 0 means as fast as
    possible."""
    silence: Waiting | None = None
    """For datagrams: end when, after the first one, none has come for this many seconds."""


def live(request: LiveOptions, _call: options.Call) -> None:
    """Follow an IMU live, and show where its carrier is now.

    A stream has a line for each sample, time,gyro x,y,z,accel x,y,z, or a JSON object with time,
    gyro and accel, in s, rad/s and m/s², +9.81 upwards at rest. Its rate is measured. When the
    command prints ready, keep the device still for a second: tilt, velocity and the gyro's bias are
    taken from it. In a terminal the path is drawn; elsewhere a line is printed each second. Ctrl-C
    or SIGTERM ends it (status 130, 143), and the trajectory is still written. If the units or
    columns of a recording must be named, import it first (gnio data import).

    examples:
      phone_stream | {prog} --network runs/mine      lines on standard input
      {prog} udp:0.0.0.0:5555                        the same lines as datagrams, from a phone
      {prog} walk.zip --speed 4                      a recording or bag, four times as fast
    """
    inbox = _listen(request) if request.source.startswith(UDP) else None  # before slow imports
    console.compile_quickly()
    import jax  # late, so that mistakes do not wait for it
    import numpy as np

    from gnio_jax import networks
    from gnio_jax.apps import live as following
    from gnio_jax.apps import rerun
    from gnio_jax.apps.export import export
    from gnio_jax.apps.importing import read_imported

    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    datagrams = following.Datagrams(inbox, request.source) if inbox else None
    if request.out:
        check_writable(request.out)  # otherwise the trajectory would be lost at the end
    if request.rerun:
        rerun.check(request.rerun)
    run, say = networks.load(request.network), console.say
    say(f"following {request.source} with {run.name}; Ctrl-C ends it")
    stream, rate = None, 0.0
    if datagrams is None and request.source != "-":
        units = ImportOptions(gyro_unit=request.gyro_unit, accel_unit=request.accel_unit)
        sequence, notes, warnings = read_imported(Path(request.source), units)
        for note in (*warnings, *notes):
            say(f"  {note}")
        stream = following.from_recording(sequence, request.speed)
        rate = request.imu_rate or 1 / float(np.median(np.diff(sequence.time)))
    with console.terminal() as terminal:
        terminal.progress("compiling", 0.0)
        try:
            tracker = following.create_tracker(run, rest_seconds=request.rest_seconds)
        except ValueError as error:
            problem = str(error).removeprefix("rest_seconds: ")
            raise InputError("--rest-seconds", problem) from None
    result = following.Followed()

    def begin(imu_rate: float) -> None:
        following.expect(tracker, result, run, imu_rate)
        native = run.config.data.rate
        lower = f"; the network was trained at {native:g} Hz, so higher frequencies are missing"
        say(f"  samples come at {imu_rate:.4g} Hz{lower if imu_rate < 0.99 * native else ''}")

    if stream is None:
        units = request.gyro_unit or "rad/s", request.accel_unit or "m/s2"
        say(f"ready: hold still now, for {request.rest_seconds:g} s")
        if datagrams is None:
            if isinstance(sys.stdin, io.TextIOWrapper):
                sys.stdin.reconfigure(errors="replace")  # noise on a line is no text
            stream = following.lines_of(sys.stdin, stated=units)
        else:
            at_rest = following.begins_at_rest(run)
            stream = datagrams.source(units, request.silence, say, at_rest)
        stream = following.measured(stream, begin, request.imu_rate)
    else:
        following.expect(tracker, result, run, rate)
    interruption: BaseException | None = None
    with contextlib.ExitStack() as running:
        viewer = running.enter_context(rerun.streaming(request.rerun)) if request.rerun else None
        show = running.enter_context(_shown())

        def on_pose(result: Any) -> None:
            if viewer is not None:
                viewer.add(result.pose)
            show(result)

        try:  # Ctrl-C and SIGTERM end the stream alone
            following.follow(tracker.push, stream, result, on_pose)
        except (KeyboardInterrupt, SystemExit) as signal_exit:
            interruption = signal_exit
    for warning in result.warnings():
        say(f"warning: {warning}")
    if result.pose is not None:
        say(following.line(result))
        if request.out:
            export(request.out, result.trajectory, "tum")
            say(f"trajectory: {request.out}")
    if interruption is not None:
        raise interruption
    if result.pose is None:
        raise _no_start(result, stream.name, request.rest_seconds)


def _listen(request: LiveOptions) -> socket.socket:
    """The socket of udp:PORT, which only this machine reaches, or of udp:ADDRESS:PORT."""
    host, _, port = request.source.removeprefix(UDP).rpartition(":")
    if not (port.isascii() and port.isdecimal() and 0 < int(port[:6]) < 2**16):
        raise InputError(request.source, "names no port", "write udp:5555 or udp:0.0.0.0:5555")
    inbox = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        inbox.bind((host or "127.0.0.1", int(port)))
    except OSError as error:
        inbox.close()
        problem = f"cannot listen there ({error})"
        raise InputError(request.source, problem, "choose another port or address") from None
    return inbox


def _no_start(result: Any, name: str, rest_seconds: float) -> InputError:
    """The error if there is no pose."""
    if result.samples == 0:
        return InputError(
            name, "ended without a single sample", "check that samples are sent to it"
        )
    seconds, samples = result.last - result.first, result.samples
    problem = f"ended after {samples} samples in {seconds:.1f} s, before {rest_seconds:g} s of rest"
    remedy = "let it run longer, or lower --rest-seconds"
    if seconds > 2 * rest_seconds:
        problem = f"has no {rest_seconds:g} s without a missing sample in {seconds:.1f} s"
        remedy = "send every sample, or lower --rest-seconds"
    return InputError(name, problem, remedy)


@contextlib.contextmanager
def _shown() -> Iterator[Callable[[Any], None]]:
    """A function that is called after each clone step: in a terminal it draws the path, elsewhere
    it prints a line each second."""
    from gnio_jax.apps import live as following

    output, last_shown = console.stdout(), -math.inf

    def print_each_second(result: Any) -> None:
        nonlocal last_shown
        if result.pose.time >= last_shown + 1.0 - 1e-6:
            output.print(following.line(result), soft_wrap=True)
            last_shown = result.pose.time

    if not output.is_terminal:
        yield print_each_second
        return
    from rich.live import Live
    from rich.text import Text

    with Live(console=output, refresh_per_second=8, transient=True) as screen:

        def draw(result: Any) -> None:
            nonlocal last_shown
            if time.monotonic() - last_shown < DRAWN_EVERY:
                return
            columns, rows = max(10, output.width - 2), max(5, output.height - 4)
            picture = following.drawing(result.trajectory.position, columns, rows)
            screen.update(Text(f"{picture}\n{following.line(result)}"))
            last_shown = time.monotonic()

        yield draw
