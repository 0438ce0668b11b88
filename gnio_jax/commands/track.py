"""`gnio track`: the trajectory of your own recording."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from rich import box
from rich.table import Table

from gnio_jax.commands import console, options
from gnio_jax.config import ImportOptions
from gnio_jax.config.schema import UNNAMED, Words
from gnio_jax.errors import InputError
from gnio_jax.files import file_stem

ERRORS = ("ate", "ate_2d", "rte_60s", "rpe_1s", "yaw_rmse", "path_length_ratio")
ERRORS += ("leg_ratio", "leg_error", "waypoint_rms")
"""Metrics against a reference that are shown if they exist; summary.json has all."""


@dataclass(frozen=True)
class TrackOptions:
    file: Annotated[Path, UNNAMED]
    """The recording, a file or a folder. If each sensor has its own CSV, give the gyro's."""
    network: str | None = None
    """Network: the folder of a run, a package or a name (see gnio weights); by default the one that
    comes with gnio-jax, else the newest run below runs/."""
    out: Path | None = None
    """Folder for the results; by default tracks/ and the recording's name."""
    format: tuple[Literal["csv", "mcap", "geojson", "gpx"], ...] = ()
    """Further formats of the trajectory. geojson and gpx need fixes of a receiver in the
    recording."""
    without: Annotated[
        tuple[Literal["magnetometer", "barometer", "gnss"], ...], Words(repeated=True)
    ] = ()
    """A sensor beside the IMU that is not used; may be repeated."""
    heading: Literal["device", "gait"] = "device"
    """What shows a network with model.equivariance device_heading the direction of a walk while a
    screen faces up: where the device looks, or the gait alone, for a phone that is held across and
    for a device that is no phone. Other networks, as the included one, go by the gait anyway."""
    carrier: str | None = None
    """What carries the IMU: person, car, or a file with the filter of a car (as configs/drive.yaml,
    that of car). By default person, and car if a recording without steps has the fixes of a
    drive and no --network is named."""
    rerun: Path | None = None
    """File to write for the viewer Rerun, NAME.rrd: paths, covariances, IMU, gate."""
    recording: Annotated[ImportOptions, UNNAMED] = ImportOptions()  # noqa: RUF009 - it is frozen


def track(request: TrackOptions, call: options.Call) -> None:
    """Compute the trajectory of a recording and its expected accuracy.

    FILE is anything that gnio data import reads, or an HDF5 file that it has written. Stand still
    for a second at the beginning. A magnetometer, a barometer and the fixes of a receiver in FILE
    are used: for the heading, the height and the place on the map. The folder OUT gets
    trajectory.txt (TUM format), track.png, report.html and summary.json. gnio weights lists the
    networks that are found by name.

    examples:
      {prog} walk.zip                              of Sensor Logger or phyphox
      {prog} walk.bag --imu-topic /imu --network runs/mine --out tracks/walk
      {prog} walk.csv --accel-sign ios --format csv mcap
      {prog} walk.zip --without magnetometer --format gpx
      {prog} drive.zip --carrier car --format geojson
      {prog} imu.csv --network mine --heading gait   an IMU that is no phone
      {prog} robot.csv --columns time=stamp gyro_x=wx gyro_y=wy gyro_z=wz accel_x=ax accel_y=ay \\
          accel_z=az
    """
    if not request.file.exists():
        raise InputError(request.file, "no such file or folder")
    if request.network and request.carrier not in (None, "person"):
        problem = f"{request.network} is a network, and a car has none"
        raise InputError("--network", problem, f"leave it out with --carrier {request.carrier}")
    if request.heading == "gait" and request.carrier not in (None, "person"):
        remedy = f"leave it out with --carrier {request.carrier}"
        raise InputError("--heading gait", "is for people, and a car has no gait", remedy)
    console.compile_quickly()
    import jax  # late, so that mistakes do not wait for it

    from gnio_jax import networks
    from gnio_jax.apps import drive, heading, sensors
    from gnio_jax.apps import track as tracking
    from gnio_jax.apps.importing import read_imported

    on_foot = request.network or request.heading == "gait"
    carrier = "person" if on_foot else request.carrier
    source: Any = None if carrier in (None, "person") else drive.load_filter(carrier)
    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    recording = read_imported(request.file, request.recording)
    readings = sensors.usable_readings(recording.sequence, request.without)
    if carrier is None and drive.is_drive(recording.sequence, readings):
        console.say("no steps, and fixes as fast as a car: tracked as a car (--carrier)")
        source = drive.load_filter("car")
    if source is None:
        source = networks.load(request.network)
        source = heading.without_heading(source) if request.heading == "gait" else source
    out = request.out or Path("tracks") / _folder_name(recording.sequence.name)
    with console.terminal() as terminal:
        terminal.progress("compiling and tracking", 0.0)
        details: dict[str, Any] = {"command": str(call), "rerun_file": request.rerun}
        details["without"] = request.without
        result = tracking.track(recording, source, out, request.format, **details)
    summary = result.summary
    first = summary.warnings[:1] if math.isnan(summary.expected_error) else ()
    for warning in first:  # it says why there is no expected error, before every figure
        console.say(f"warning: {warning}")
    for note in summary.notes:
        console.say(f"  {note}")
    console.say(_table(summary))
    for use in summary.sensors:
        if use.accepted is not None:
            console.say(f"{use.sensor}: {use.text}")
    for warning in summary.warnings[len(first) :]:
        console.say(f"warning: {warning}")
    if not first and summary.carrier == "person":  # what was measured are whole walks
        on_others = f" on recordings with a reference: {summary.measured}"
        measured = on_others if summary.measured else ": its error was not measured (gnio evaluate)"
        console.say(f"network {summary.network}{measured}")
    console.say(f"results: {result.folder} (open report.html, or look at track.png)")


def _folder_name(name: str) -> str:
    """The recording's name, made fit for a folder, because the name inside a file may be
    arbitrary."""
    plain = name == Path(name).name and name.isprintable() and name not in ("", "..")
    return name if plain else file_stem(name)


def _table(summary: Any) -> Table:
    """Two columns: figure and value."""
    from gnio_jax.evaluation import tabulate

    grid = Table(box=box.SIMPLE_HEAD, title_style="bold", title_justify="left")
    grid.add_column(f"{summary.recording}, by {summary.network}", overflow="fold")
    grid.add_column("", justify="right")
    grid.add_row("time", f"{summary.seconds:.1f} s")
    grid.add_row("path", f"{summary.path_length:.1f} m")
    grid.add_row("end from start", f"{summary.from_start:.1f} m")
    if not math.isnan(summary.expected_error):
        grid.add_row("expected error at the end", f"{summary.expected_error:.1f} m")
    if summary.steps is not None:
        grid.add_row("time with steps", f"{summary.steps:.0%}")
    grid.add_row("time at rest (quieter than a hand)", f"{summary.at_rest:.0%}")
    if summary.accepted is not None:
        grid.add_row("displacements accepted", f"{summary.accepted:.0%}")
    for use in summary.sensors:
        share = "left out" if use.accepted is None else f"{use.accepted:.0%} used"
        grid.add_row(f"{use.sensor}, {use.rows} rows", share)
    for name in [metric for metric in ERRORS if metric in summary.errors]:
        column = tabulate.column(name)
        text = tabulate.number(summary.errors.get(name), column.digits)
        grid.add_row(f"{column.heading} (against the reference)", f"{text} {column.unit}".strip())
    return grid
