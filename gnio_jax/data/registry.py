"""The datasets by name, and their folders.

A new dataset is one module in `readers` that ends with `DATASET = Dataset(...)`, and two lines in
`readers/__init__.py`. A plugin (`gnio_jax.plugins`) calls `register` with its `Dataset` instead.
"""

from __future__ import annotations

import os
from pathlib import Path

from gnio_jax import plugins
from gnio_jax.data.dataset import Dataset
from gnio_jax.data.readers import DATASETS
from gnio_jax.errors import InputError, did_you_mean

_PUBLISHED = frozenset(DATASETS)
"""Names of the datasets of this package; a registered one must have another name."""


def register(dataset: Dataset) -> None:
    """Add a dataset of your own: `load`, `get` and the commands then know it by its name.

    Raises `InputError` for the name of a dataset of this package.
    """
    if dataset.name in _PUBLISHED:
        problem = "is a dataset of gnio-jax"
        raise InputError(f"dataset '{dataset.name}'", problem, "choose another name")
    DATASETS[dataset.name] = dataset


def names() -> list[str]:
    """Names of the known datasets, with those of plugins."""
    plugins.load()
    return sorted(DATASETS)


def get(name: str) -> Dataset:
    """The dataset of that name; raises `InputError` that lists the known ones."""
    if name not in DATASETS:
        plugins.load()
    if name not in DATASETS:
        remedy = f"known datasets: {', '.join(names())}"
        raise InputError(
            "dataset", f"unknown name '{name}'", f"{did_you_mean(name, names())}{remedy}"
        )
    return DATASETS[name]


def find_root(name: str, root: str | os.PathLike[str] | None = None) -> Path:
    """The folder of dataset `name`: `root` if given, else $GNIO_DATA/<name>, else data/<name>.

    Raises `InputError` if it is missing, with the ways to name it, the place of the public set, and
    the expected layout.
    """
    dataset = get(name)
    bases = [base for base in (os.environ.get("GNIO_DATA"), "data") if base]
    candidates = [Path(base) / folder for base in bases for folder in dataset.folders or (name,)]
    if root is not None:
        candidates = [Path(root)]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    looked = ", ".join(dict.fromkeys(str(candidate) for candidate in candidates))
    remedy = f"give --data-root, or set GNIO_DATA to its parent; source: {dataset.source}"
    layout = f"expected layout: {dataset.layout}"
    raise InputError(looked, f"no folder of dataset '{name}'", f"{remedy}; {layout}")
