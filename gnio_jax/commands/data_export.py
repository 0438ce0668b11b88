"""`gnio data export`: a trajectory in the format of another program."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from gnio_jax.commands import console
from gnio_jax.commands.options import Command
from gnio_jax.errors import InputError

DESCRIPTION = """A trajectory that `evaluate` left, in the format of another program.

  {prog} trajectories/walk.txt walk.mcap        (Foxglove, ROS 2)
  {prog} walk.txt walk.csv                      (or .kitti, .tum)
  {prog} walk.txt walk.gpx --first-fix 48.1375 11.5755 --heading 90

walk.geojson goes like walk.gpx. --first-fix is where the first pose is, LAT LON [ALT], deg and m.
--heading is the direction of the trajectory's x axis, deg clockwise from true north: turn it until
the path lies on the map."""


@dataclass(frozen=True)
class ExportOptions:
    """What `gnio data export` is asked for."""

    trajectory: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="TRAJECTORY")]]
    """File in TUM format."""
    out: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUT")]]
    """File to write; its suffix tells the format."""
    format: Literal["tum", "kitti", "csv", "geojson", "gpx", "mcap"] | None = None
    """Format, where the suffix does not tell it."""
    first_fix: tuple[float, ...] | None = None
    """LAT LON [ALT] of the first pose, deg and m above the ellipsoid."""
    heading: float | None = None
    """Direction of the trajectory's x axis, deg clockwise from true north."""


def export_file(options: ExportOptions, _prog: str) -> None:
    """Write the file, and say what is in it."""
    from gnio_jax.evaluation import exporting
    from gnio_jax.evaluation.exporting.geographic import first_fix

    if options.out.is_dir():
        raise InputError("OUT", f"'{options.out}' is a folder", "name a file in it")
    fix = None
    if options.first_fix is not None:
        fix = first_fix(options.first_fix, options.heading)
    trajectory = exporting.read_trajectory(options.trajectory)
    count = exporting.export(options.out, trajectory, options.format, fix)
    seconds = trajectory.time[-1] - trajectory.time[0]
    console.stdout().print(f"{options.out}: {count} poses, {seconds:.1f} s", soft_wrap=True)


COMMAND = Command(ExportOptions, export_file, DESCRIPTION)
