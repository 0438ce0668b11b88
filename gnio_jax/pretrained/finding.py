"""Where packages lie: in the wheel, in the folders of $GNIO_WEIGHTS, or where a path says."""

from __future__ import annotations

import difflib
import os
from pathlib import Path

from gnio_jax import config as configuration
from gnio_jax.errors import InputError
from gnio_jax.pretrained.package import is_package

SHIPPED = Path(__file__).parents[1] / "weights"
"""The packages that the wheel brings."""
VARIABLE = "GNIO_WEIGHTS"
"""Folders of packages, separated as in $PATH."""


def packages() -> dict[str, Path]:
    """Packages by name (that of the folder, or of the zip without its suffix), the wheel's first.

    Raises `InputError` for a folder of $GNIO_WEIGHTS that is not there.
    """
    found: dict[str, Path] = {}
    for folder in (SHIPPED, *_own_folders()):
        for place in sorted(folder.iterdir()):
            if is_package(place):
                found.setdefault(place.name.removesuffix(".zip"), place)
    return found


def find(which: str | Path) -> Path:
    """The package or run that a path or a name means. Raises `InputError` for neither."""
    path = Path(which)
    if is_package(path) or (path / "config.yaml").is_file():
        return path
    known = packages()
    if str(which) in known:
        return known[str(which)]
    if path.exists():
        problem = "holds neither a package (manifest.json) nor a run (config.yaml)"
        raise InputError(path, problem, "gnio publish makes a package of a run")
    close = difflib.get_close_matches(str(which), known, n=1)
    names = f"known names: {', '.join(known)}" if known else "no package is installed"
    hint = f"did you mean '{close[0]}'?" if close else f"{names}; give a folder, a zip or a name"
    raise InputError(which, "no such weights", hint)


def default() -> Path:
    """The first package of the wheel, else the newest run below runs/. Raises `InputError` where
    there is neither."""
    shipped = [place for place in packages().values() if place.parent == SHIPPED]
    if shipped:
        return shipped[0]
    try:
        return configuration.newest_run()
    except InputError:
        remedy = "name a package or a run, or train one with gnio train"
        raise InputError("--weights", "there are no weights to start from", remedy) from None


def _own_folders() -> list[Path]:
    folders = [Path(each) for each in os.environ.get(VARIABLE, "").split(os.pathsep) if each]
    for folder in folders:
        if not folder.is_dir():
            raise InputError(f"${VARIABLE}", f"'{folder}' is no folder", "name folders of packages")
    return folders
