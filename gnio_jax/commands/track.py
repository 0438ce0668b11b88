"""`gnio track`: the trajectory of one's own recording."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gnio_jax.commands import console
from gnio_jax.commands.options import Command, called
from gnio_jax.commands.recording import RecordingOptions, read_any
from gnio_jax.files import file_stem

DESCRIPTION = """The trajectory of a recording: where its carrier walked, and how far to trust it.

  {prog} walk.zip                              (Sensor Logger, phyphox; weights found by themselves)
  {prog} walk.bag --imu-topic /imu --weights runs/mine --out tracks/walk
  {prog} walk.csv --accel-sign ios --format csv mcap
  {prog} walk.zip --format gpx --first-fix 48.1375 11.5755 --heading 90

It reads what gnio data import reads, and its HDF5. Stand still for a second at the beginning. In
the folder OUT it leaves trajectory.txt (TUM format), track.png, report.html and summary.json. gnio
weights lists the networks that are found by name."""


@dataclass(frozen=True)
class TrackOptions(RecordingOptions):
    """What `gnio track` is asked for."""

    weights: str | None = None
    """Name, package or run folder; by default the network that comes with gnio-jax, else the newest
    run below runs/."""
    out: Path | None = None
    """Folder for the results; by default tracks/ and the recording's name."""
    format: tuple[Literal["kitti", "csv", "geojson", "gpx", "mcap"], ...] = ()
    """Further formats of the trajectory."""
    first_fix: tuple[float, ...] | None = None
    """LAT LON [ALT] of the start, deg and m, for geojson and gpx."""
    heading: float | None = None
    """Direction of the track's x axis, deg clockwise from true north."""
    rerun: Path | None = None
    """File to write for the viewer Rerun, NAME.rrd: paths, covariances, IMU, gate."""


def track(options: TrackOptions, prog: str) -> None:
    """Track, and show the figures and the limits."""
    # After the options: --help and mistakes do not wait for these imports.
    import jax

    from gnio_jax import tracking
    from gnio_jax.evaluation.exporting.geographic import first_fix

    jax.config.update("jax_enable_x64", True)  # for the filter; the network states its float32
    fix = None if options.first_fix is None else first_fix(options.first_fix, options.heading)
    recording = read_any(options)
    weights = tracking.choose_weights(options.weights)
    out = options.out or Path("tracks") / _folder_name(recording.sequence.name)
    with console.terminal() as terminal:
        terminal.progress("compiling and tracking", 0.0)
        call = (recording, weights, out, options.format, fix)
        found = tracking.track(*call, command=called(prog), rerun=options.rerun)
    output = console.stdout()
    for note in found.summary.notes:
        output.print(f"  {note}", soft_wrap=True)
    output.print(_table(found.summary))
    for warning in found.summary.warnings:
        output.print(f"warning: {warning}", soft_wrap=True)
    output.print(found.summary.limits, soft_wrap=True)
    output.print(f"results: {found.folder} (look at track.png, report.html)", soft_wrap=True)


def _folder_name(name: str) -> str:
    """The recording's name, or what can be one of a folder: a file may say anything of itself."""
    plain = name == Path(name).name and name.isprintable() and name not in ("", "..")
    return name if plain else file_stem(name)


def _table(summary: Any) -> Any:
    """Two columns: figure and value."""
    from rich import box
    from rich.table import Table

    from gnio_jax.evaluation.table import COLUMNS
    from gnio_jax.tracking.summary import ERRORS

    grid = Table(box=box.SIMPLE_HEAD, title_style="bold", title_justify="left")
    grid.add_column(f"{summary.recording}, by {summary.weights}", overflow="fold")
    grid.add_column("", justify="right")
    grid.add_row("time", f"{summary.seconds:.1f} s")
    grid.add_row("path", f"{summary.path_length:.1f} m")
    grid.add_row("end from start", f"{summary.from_start:.1f} m")
    grid.add_row("expected error at the end", f"{summary.expected_error:.1f} m")
    grid.add_row("at rest", f"{summary.rest:.0%}")
    if summary.accepted is not None:
        grid.add_row("displacements used", f"{summary.accepted:.0%}")
    for name in ERRORS if summary.errors else ():
        column, value = COLUMNS[name], summary.errors.get(name)
        text = "–" if value is None or not math.isfinite(value) else f"{value:.{column.digits}f}"
        grid.add_row(f"{column.heading} (against the reference)", f"{text} {column.unit}".strip())
    return grid


COMMON = (
    "FILE",
    "--weights",
    "--out",
    "--format",
    "--first-fix",
    "--heading",
    "--rerun",
    "--accel-path",
    "--gyro-unit",
    "--accel-unit",
    "--accel-sign",
    "--imu-topic",
    "--reference-topic",
)

COMMAND = Command(TrackOptions, track, DESCRIPTION, common=COMMON)
