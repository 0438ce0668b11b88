"""`gnio weights`: the packages of trained networks that are found by name."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from gnio_jax.commands import console
from gnio_jax.commands.options import Command, sibling
from gnio_jax.errors import InputError

DESCRIPTION = """Packages of trained networks: name, size, trained on, key metric.

  {prog}                                     a list of what is found
  {prog} pedestrian                          its model card
  {prog} pedestrian --out runs/pedestrian    a run of it
  GNIO_WEIGHTS=~/packages {prog}

Looked for in the installed gnio-jax and in the folders of $GNIO_WEIGHTS. gnio publish makes them,
gnio track --weights NAME uses them. A run of a package is for gnio evaluate, gnio calibrate and
gnio export."""


@dataclass(frozen=True)
class WeightsOptions:
    """What `gnio weights` is asked for."""

    package: tyro.conf.Positional[Annotated[str | None, tyro.conf.arg(metavar="NAME")]] = None
    """Name, folder or zip of a package; by default all are listed."""
    out: Path | None = None
    """Folder for a run of the package; by default its model card is shown."""


def weights(options: WeightsOptions, prog: str) -> None:
    """List the packages, show the card of one, or make a run of it."""
    from gnio_jax import pretrained

    if options.package is None and options.out is not None:
        raise InputError(f"--out {options.out}", "is for one package", "name it before --out")
    if options.package is None:
        _list()
    elif options.out is None:
        print(pretrained.card_of(options.package).rstrip())
    else:
        pretrained.write_run(options.package, options.out)
        following = f"{sibling(prog, 'evaluate')} --workdir {options.out} --dataset ..."
        print(f"run: {options.out}; next: {following}")


def _list() -> None:
    """A line per package; one that is damaged has its fault in its line."""
    from rich import box
    from rich.table import Table

    from gnio_jax import pretrained

    found = pretrained.packages()
    output = console.stdout()
    if not found:
        output.print("no packages; gnio publish makes one of a run, $GNIO_WEIGHTS says where")
        return
    grid = Table(box=box.SIMPLE_HEAD)
    for heading in ("name", "size", "network", "trained on", "licence", "key metric"):
        grid.add_column(heading, overflow="fold")
    damaged = []
    for name, place in found.items():
        try:
            about = pretrained.about(place)
        except InputError as error:
            damaged.append(str(error))
            continue
        size = f"{about.bytes / 1e6:.2f} MB"
        grid.add_row(name, size, about.network, about.data, about.license, _metric(about.metric))
    output.print(grid)
    for line in damaged:
        output.print(line, soft_wrap=True)


def _metric(metric: Any) -> str:
    if metric is None:
        return "–"
    interval = "" if metric.low is None else f" ({metric.low:.2f}–{metric.high:.2f})"
    return f"ATE 2-D {metric.value:.2f} m{interval}, {metric.of}"


COMMAND = Command(WeightsOptions, weights, DESCRIPTION)
