"""`gnio doctor`: what is installed here, and what is found."""

from __future__ import annotations

import json as json_format
from dataclasses import dataclass
from typing import Any

import tyro

from gnio_jax.commands import console
from gnio_jax.commands.options import Command

DESCRIPTION = """What is installed here and what is found: packages, devices, datasets, weights.

  {prog}
  {prog} --data-root ~/recordings
  {prog} --json

Missing things are remarks, not errors: it leaves with status 0. The last lines say what you may
want to change. Show its output where you ask for help."""
MOST = 6
"""Names in a line; of more, their number is told."""


@dataclass(frozen=True)
class DoctorOptions:
    """What `gnio doctor` is asked for."""

    data_root: str | None = None
    """Folder whose folders are datasets; by default $GNIO_DATA, then data."""
    json: tyro.conf.FlagCreatePairsOff[bool] = False
    """Print all of it as JSON."""


def doctor(options: DoctorOptions, _prog: str) -> None:
    """Look, and say what is there."""
    from gnio_jax.commands import installation

    found = installation.find(options.data_root)
    if options.json:
        print(json_format.dumps(found._asdict(), indent=2, ensure_ascii=False))
        return
    output = console.stdout()
    output.print(f"gnio-jax {found.version}, Python {found.python}", soft_wrap=True)
    output.print(_grid(found))
    for remark in found.remarks:
        output.print(f"remark: {remark}", soft_wrap=True)


def _grid(found: Any) -> Any:
    """Two columns: what, and how it is."""
    from rich.table import Table

    grid = Table.grid(padding=(0, 2))
    grid.add_column(no_wrap=True)
    grid.add_column(overflow="fold")
    for name, text in _lines(found):
        grid.add_row(name, text)
    return grid


def _lines(found: Any) -> list[tuple[str, str]]:
    versions = [f"{name} {version or 'missing'}" for name, version in found.packages.items()]
    kinds = dict.fromkeys(found.devices["kinds"])
    counts = [f"{found.devices['kinds'].count(kind)} × {kind}" for kind in kinds]
    works = "float64 works" if found.devices["float64"] else "float64 does not work"
    weights = found.weights["packages"]
    return [
        ("packages", ", ".join(versions)),
        *((f"extra {name}", _extra(name, lacks)) for name, lacks in found.extras.items()),
        ("devices", f"{', '.join(counts)}; {works}" if counts else "none"),
        *((f"dataset {name}", place) for name, place in found.datasets.items()),
        ("looked in", f"{', '.join(found.looked_in)} (gnio data list shows every dataset)"),
        ("weights", _names(list(weights)) if weights else "no packages"),
        ("newest run", found.weights["newest_run"] or "none below runs/"),
        *((f"cache of {name}", place) for name, place in found.caches.items()),
    ]


def _extra(name: str, lacks: list[str]) -> str:
    missing = f"lacks {', '.join(lacks)}: pip install 'gnio-jax[{name}]'"
    return missing if lacks else "complete"


def _names(names: list[str]) -> str:
    more = f" and {len(names) - MOST} more (gnio weights)" if len(names) > MOST else ""
    return ", ".join(names[:MOST]) + more


COMMAND = Command(DoctorOptions, doctor, DESCRIPTION)
