"""From a dataset's name to its sequences. A new dataset is one module with a `DATASET`, imported
and listed here.

A module that reads several sets of one layout has `DATASETS`, a tuple, besides.
"""

from __future__ import annotations

import difflib
import os
from pathlib import Path

from gnio_jax.data.readers import blackbird, euroc, idol, kitti, oxiod, ridi, ronin, synthetic, tlio
from gnio_jax.data.readers import csv_files as csv
from gnio_jax.data.sequence import Dataset
from gnio_jax.types import InputError, Sequence

_MODULES = (blackbird, csv, euroc, idol, kitti, oxiod, ridi, ronin, synthetic, tlio)
_DATASETS: dict[str, Dataset] = {
    dataset.name: dataset
    for module in _MODULES
    for dataset in getattr(module, "DATASETS", (module.DATASET,))
}

# Rewritten recordings lie in a folder of another name than the public set's, so that nobody takes
# the one for the other.
_FOLDERS = {"tlio": ("tlio", "tlio_layout")}


def names() -> list[str]:
    """Names of the known datasets."""
    return sorted(_DATASETS)


def get(name: str) -> Dataset:
    """The dataset of that name; raises `InputError` that lists the known ones."""
    if name not in _DATASETS:
        close = difflib.get_close_matches(name, names(), n=1)
        hint = f"did you mean '{close[0]}'? " if close else ""
        raise InputError(
            "dataset", f"unknown name '{name}'", f"{hint}known datasets: {', '.join(names())}"
        )
    return _DATASETS[name]


def find_root(
    name: str, root: str | os.PathLike[str] | None = None, hint: str = "give --data-root"
) -> Path:
    """The folder of dataset `name`: `root` if given, else $GNIO_DATA/<name>, else data/<name>.

    Raises `InputError` when it is missing, saying how to name it (`hint`), where the public set is
    had and which layout is expected.
    """
    dataset = get(name)
    if root is not None:
        candidates = [Path(root)]
    else:
        bases = [Path(os.environ["GNIO_DATA"])] if os.environ.get("GNIO_DATA") else []
        candidates = [
            base / folder
            for base in [*bases, Path("data")]
            for folder in _FOLDERS.get(name, (name,))
        ]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    looked = ", ".join(dict.fromkeys(str(candidate) for candidate in candidates))
    raise InputError(
        looked,
        f"no folder of dataset '{name}'",
        f"{hint}, or set GNIO_DATA to its parent; get it from {dataset.source}; expected layout: {dataset.layout}",
    )


def load(
    name: str, root: str | os.PathLike[str] | None = None, split: str = "test"
) -> list[Sequence]:
    """The sequences of a split of a dataset, validated, at its native rate (`resample` changes
    that).

    Raises `InputError` on an unknown name or split, a missing folder, or a split without a
    sequence.
    """
    dataset = get(name)
    if split not in dataset.splits and dataset.list_splits is None:
        close = difflib.get_close_matches(split, dataset.splits, n=1)
        hint = f"did you mean '{close[0]}'? " if close else ""
        raise InputError(
            f"dataset {name}",
            f"unknown split '{split}'",
            f"{hint}known splits: {', '.join(dataset.splits)}",
        )
    folder = find_root(name, root) if dataset.needs_root else Path(root or ".")
    sequences = dataset.read(folder, split)
    if not sequences:
        raise InputError(
            folder,
            f"split '{split}' of dataset '{name}' holds no sequence",
            f"expected layout: {dataset.layout}",
        )
    return sequences
