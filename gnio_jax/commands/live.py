"""`gnio live`: the trajectory while samples arrive."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

from gnio_jax.commands import console, options
from gnio_jax.config.schema import UNNAMED, Bound, NewFile, NonNegative, Positive
from gnio_jax.errors import InputError
from gnio_jax.files import check_other_file, check_writable

Waiting = Annotated[
    float, Bound(lambda value: 0 <= value <= threading.TIMEOUT_MAX, "must be a time to wait, s")
]


@dataclass(frozen=True)
class LiveOptions:
    source: Annotated[str, UNNAMED] = "-"
    """- for standard input; udp:PORT for datagrams from this machine, udp:0.0.0.0:PORT from any
    machine; http:0.0.0.0:PORT for Sensor Logger on a phone, http:PORT for this machine alone;
    phyphox:ADDRESS for phyphox; or a recording."""
    network: str | None = None
    """Network: the folder of a run, a package or a name (see gnio weights); by default the one that
    comes with gnio-jax, else the newest run below runs/."""
    heading: Literal["device", "gait"] = "device"
    """What shows a network with model.equivariance device_heading the direction of a walk while a
    screen faces up: where the device looks, or the gait alone, for a phone that is held across and
    for a device that is no phone. Other networks, as the included one, go by the gait anyway."""
    out: NewFile | None = None
    """File for the trajectory in TUM format, which is written when the stream has ended."""
    page: str | None = None
    """Show a page of the path in the browser, at this port of this machine, or at 0.0.0.0:PORT for
    the network. A source http has its page at its own address."""
    rerun: str | None = None
    """File for the viewer Rerun, NAME.rrd, or the word viewer to open it now."""
    gyro_unit: Literal["rad/s", "deg/s"] | None = None
    """Unit of the gyro. By default it is rad/s for a stream, and the recording's own for a
    recording."""
    accel_unit: Literal["m/s2", "g", "mg"] | None = None
    """Unit of the accelerometer. By default it is m/s2 for a stream, and the recording's own for a
    recording."""
    accel_sign: Literal["android", "ios", "detect"] | None = None
    """At rest and level, the up axis reads +1 g (android) or −1 g (ios: all axes are negated).
    detect assumes that the screen points up more than down. By default it is android's, or the
    source's own."""
    imu_rate: Positive | None = None
    """Rate of the samples, Hz; by default it is measured."""
    rest_seconds: float = 1.0
    """Time for which the device lies still at the start, s."""
    speed: NonNegative = 1.0
    """For a recording: replay it this many times as fast as it was recorded; 0 means as fast as
    possible."""
    silence: Waiting | None = None
    """For udp, http and phyphox: end when, after the first message, none has come for this many
    seconds."""


def live(request: LiveOptions, _call: options.Call) -> None:
    """Follow an IMU live, and show where its carrier is now.

    From a phone in the same network: start http:0.0.0.0:8000, and let Sensor Logger push to the
    address that is printed (Accelerometer, Gravity and Gyroscope switched on); or allow remote
    access in an experiment of phyphox (Accelerometer and Gyroscope) and name its address. Any other
    program sends lines or datagrams: time,gyro x,y,z,accel x,y,z, or a JSON object with time, gyro
    and accel, in s, rad/s and m/s², +9.81 upwards at rest.

    The rate is measured. When the command prints ready, keep the device still for a second: tilt,
    velocity and the gyro's bias are taken from it. Until there is a pose, it says each second what
    it waits for; then it prints the pose each second. The page shows path, 3σ ellipse and speed in
    a browser. Ctrl-C, SIGTERM or a terminal that is closed ends it (status 130, 143, 129), and the
    trajectory is still written. If the units or columns of a recording must be named, import it
    first (gnio data import).

    examples:
      {prog} http:0.0.0.0:8000                       Sensor Logger on a phone, and the page
      {prog} phyphox:192.168.0.10:8080 --page 8000   phyphox on a phone, and the page
      {prog} udp:0.0.0.0:5555 --out now.txt          lines as datagrams
      phone_stream | {prog} --network runs/mine      lines on standard input
      {prog} walk.zip --speed 4                      a recording or bag, four times as fast
    """
    console.compile_quickly()
    import jax  # late, so that mistakes do not wait for it

    from gnio_jax import networks
    from gnio_jax.apps import heading, rerun
    from gnio_jax.apps.export import export
    from gnio_jax.apps.live import session, tracking

    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    if request.out:
        check_other_file(request.out, request.source)
        check_writable(request.out)  # otherwise the trajectory would be lost at the end
    if request.rerun:
        rerun.check(request.rerun)
    run, say = networks.load(request.network), console.say
    run = heading.without_heading(run) if request.heading == "gait" else run
    interruption: BaseException | None = None
    with contextlib.ExitStack() as running:
        source, show_state = _open(request, running)
        say(f"following {request.source} with {run.name}; Ctrl-C ends it")
        with console.terminal() as terminal:
            terminal.progress("compiling", 0.0)
            try:
                tracker = tracking.create_tracker(run, rest_seconds=request.rest_seconds)
            except ValueError as error:
                problem = str(error).removeprefix("rest_seconds: ")
                raise InputError("--rest-seconds", problem) from None
        result, nature = session.Followed(), source.nature
        show_state(result, run)
        arrivals = _prepare_source(source, tracker, result, run, request)
        viewer = running.enter_context(rerun.streaming(request.rerun)) if request.rerun else None
        last_shown = -math.inf

        def on_pose(result: Any) -> None:
            nonlocal last_shown
            if viewer is not None:
                viewer.add(result.pose)
            if result.pose.time >= last_shown + 1.0 - 1e-6:
                say(session.line(result))
                last_shown = result.pose.time

        try:  # Ctrl-C, SIGTERM and SIGHUP end the stream alone
            session.follow(tracker, arrivals, nature, result, on_pose, say)
        except (KeyboardInterrupt, SystemExit) as signal_exit:
            interruption = signal_exit
    if request.out and result.path:  # first, because the terminal may be gone
        export(request.out, result.trajectory, "tum")
    for warning in result.warnings():
        say(f"warning: {warning}")
    if result.pose is not None:
        say(session.line(result))
    if request.out and result.path:
        say(f"trajectory: {request.out}")
    if interruption is not None:
        raise interruption
    if not result.path:
        raise _no_path(result, nature.name, request.rest_seconds)


def _open(request: LiveOptions, running: contextlib.ExitStack) -> tuple[Any, Callable]:
    """The source, and a function that shows a result on the page, if there is one."""
    from gnio_jax.apps.live import server as pages
    from gnio_jax.apps.live import sources, state
    from gnio_jax.filtering import make_filter

    stated = sources.Stated(
        request.gyro_unit,
        request.accel_unit,
        request.accel_sign,
        request.imu_rate,
        request.silence,
        request.speed,
    )
    source = sources.open_source(request.source, stated)
    running.callback(source.close)
    server = source.server
    if request.page is not None and server is not None:
        raise InputError(
            "--page", f"{request.source} has its page at its own address", "leave it out"
        )
    if request.page is not None:
        server = pages.listen(request.page, f"--page {request.page}")
        server.run()
        running.callback(server.close)
    if server is None:
        return source, lambda *_: None

    def show(result: Any, run: Any) -> None:
        measurements = make_filter(run.config.data, run.config.filter).measurements
        holds_rest = any(one.name == "zero_velocity" for one in measurements)
        server.state = partial(state.describe, result, source.nature, run.name, holds_rest)

    able = "can look at it" if server.inbox is None else "can send samples and look at it"
    note = "" if server.is_local else f" (everybody in this network {able})"
    console.say(f"page: {server.address}{note}")
    return source, show


def _prepare_source(source: Any, tracker: Any, result: Any, run: Any, request: LiveOptions) -> Any:
    """The arrivals of a source on one clock, in order and checked. Says what is known about it, and
    that it is ready."""
    from gnio_jax.apps.live import checks, tracking
    from gnio_jax.apps.live.clock import on_one_clock
    from gnio_jax.apps.live.pairing import in_order
    from gnio_jax.data.resampling import longest_bridge
    from gnio_jax.filtering import make_filter

    say, native = console.say, run.config.data.rate
    ekf = make_filter(run.config.data, run.config.filter)
    result.rest_seconds = ekf.config.rest_seconds
    for remark in source.remarks:
        say(f"  {remark}")
    if not any(one.name == "zero_velocity" for one in ekf.measurements):
        say("  the filter of this network does not hold the position while the device rests")

    def begin(imu_rate: float) -> None:
        tracker.set_rate(imu_rate, tracking.longest_interval(run, imu_rate))
        result.bridged = longest_bridge(imu_rate)

    def begin_measured(imu_rate: float) -> None:
        begin(imu_rate)
        lower = f"; the network was trained at {native:g} Hz, so higher frequencies are missing"
        say(f"  samples come at {imu_rate:.4g} Hz{lower if imu_rate < 0.99 * native else ''}")

    arrivals = in_order(on_one_clock(source.arrivals, source.nature.name, source.is_live))
    if source.imu_rate is not None:
        begin(source.imu_rate)
        return arrivals
    say(f"ready: hold still now, for {request.rest_seconds:g} s")
    if source.is_live:
        arrivals = tracking.since_ready(arrivals, time.monotonic(), ekf)
    return checks.with_measured_rate(arrivals, source.nature, begin_measured)


def _no_path(result: Any, name: str, rest_seconds: float) -> InputError:
    """The error if there is no healthy pose."""
    if result.pose is not None:
        problem = f"the filter diverged at once ({result.pose.failure})"
        remedy = "hold the device still at the start, and check units and axes"
        return InputError(name, problem, remedy)
    if result.samples == 0:
        problem = "ended without a single sample"
        return InputError(name, problem, "check that samples are sent to it")
    seconds, samples = result.last - result.first, result.samples
    problem = f"ended after {samples} samples in {seconds:.1f} s, before {rest_seconds:g} s of rest"
    remedy = "let it run longer, or lower --rest-seconds"
    if seconds > 2 * rest_seconds:
        needed = result.waiting.removeprefix("a rest").strip(" ()")
        problem = f"has no rest of {rest_seconds:g} s in {seconds:.1f} s"
        problem += f": {needed}" if needed else ""
        remedy = "send more of the samples, or lower --rest-seconds"
    return InputError(name, problem, remedy)
