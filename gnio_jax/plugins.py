"""Networks, datasets and measurements of other packages and files.

A plugin is a Python module that calls `models.register`, `data.register` or `filtering.register`
when it is imported. An installed package names its module as an entry point of the group
`gnio_jax.plugins`:

    [project.entry-points."gnio_jax.plugins"]
    barometer = "my_package.barometer"

A single file is named by the environment variable GNIO_PLUGINS, which may hold several paths, as
PATH does. Plugins are loaded when a registry is first asked for a name that it does not know, or
for all names, also in worker processes. A configuration file cannot name one: it holds values, and
no code.
"""

from __future__ import annotations

import importlib.util
import os
import sys
from importlib.metadata import entry_points
from pathlib import Path

from gnio_jax.errors import InputError

GROUP, VARIABLE = "gnio_jax.plugins", "GNIO_PLUGINS"

_loaded: set[str] = set()
"""Names and paths of the plugins that have been imported, or are just being imported."""


def load() -> None:
    """Import every plugin that has not been imported yet. Raises `InputError` naming one that
    cannot be imported."""
    for point in entry_points(group=GROUP):
        if point.value not in _loaded:
            _loaded.add(point.value)
            try:
                point.load()
            except Exception as error:
                remedy = "mend or uninstall its package"
                raise InputError(f"plugin {point.name}", _reason(error), remedy) from error
    for path in filter(None, os.environ.get(VARIABLE, "").split(os.pathsep)):
        if path not in _loaded:
            _loaded.add(path)
            _import_file(Path(path))


def _import_file(path: Path) -> None:
    if not path.is_file():
        raise InputError(
            VARIABLE, f"names {path}, which is not a file", "give the path of a .py file"
        )
    name = f"gnio_jax_plugin_{path.stem}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InputError(VARIABLE, f"names {path}, which is not a Python file")
    # The types of a class are read from its module.
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        remedy = f"mend it, or leave it out of {VARIABLE}"
        raise InputError(f"plugin {path}", _reason(error), remedy) from error


def _reason(error: Exception) -> str:
    return str(error) if isinstance(error, InputError) else f"{type(error).__name__}: {error}"
