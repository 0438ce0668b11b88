"""`gnio weights`: the packages of trained networks that are found by name."""

from __future__ import annotations

from dataclasses import dataclass

from gnio_jax.commands import console
from gnio_jax.commands.options import Command

DESCRIPTION = """Packages of trained networks: name, size, trained on, key metric.

  {prog}
  GNIO_WEIGHTS=~/packages {prog}

Looked for in the installed gnio-jax and in the folders of $GNIO_WEIGHTS. gnio publish makes them,
gnio track --weights NAME uses them."""


@dataclass(frozen=True)
class WeightsOptions:
    """What `gnio weights` is asked for."""


def weights(_options: WeightsOptions, _prog: str) -> None:
    """A line per package; one that is damaged has its fault in its line."""
    from rich import box
    from rich.table import Table

    from gnio_jax import pretrained
    from gnio_jax.errors import InputError

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


def _metric(metric) -> str:
    if metric is None:
        return "–"
    interval = "" if metric.low is None else f" ({metric.low:.2f}–{metric.high:.2f})"
    return f"ATE 2-D {metric.value:.2f} m{interval}, {metric.of}"


COMMAND = Command(WeightsOptions, weights, DESCRIPTION)
