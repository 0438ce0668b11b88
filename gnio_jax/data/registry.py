"""From a dataset's name to its sequences. A new dataset is one module in `readers` with a
`DATASET`, imported and listed here.

A module that reads several sets of one layout has `DATASETS`, a tuple, besides.
"""

from __future__ import annotations

import difflib
import os
from collections.abc import Callable, Iterator
from pathlib import Path

from gnio_jax.data.dataset import Dataset
from gnio_jax.data.folds import parse_fold
from gnio_jax.data.readers import (
    blackbird,
    csv_files,
    euroc,
    idol,
    kitti,
    oxiod,
    randomised,
    ridi,
    ronin,
    synthetic,
    tlio,
)
from gnio_jax.data.reading import read_each
from gnio_jax.errors import InputError
from gnio_jax.types import Sequence

_MODULES = (
    blackbird,
    csv_files,
    euroc,
    idol,
    kitti,
    oxiod,
    randomised,
    ridi,
    ronin,
    synthetic,
    tlio,
)
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
        raise InputError(
            "dataset",
            f"unknown name '{name}'",
            f"{_did_you_mean(name, names())}known datasets: {', '.join(names())}",
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
        candidates = [place for base in [*bases, Path("data")] for place in _folders_in(name, base)]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    looked = ", ".join(dict.fromkeys(str(candidate) for candidate in candidates))
    raise InputError(
        looked,
        f"no folder of dataset '{name}'",
        f"{hint}, or set GNIO_DATA to its parent; get it from {dataset.source}; "
        f"expected layout: {dataset.layout}",
    )


def folder_in(name: str, base: Path) -> Path | None:
    """The folder of dataset `name` in a folder of datasets; None where it has none."""
    return next((place for place in _folders_in(name, base) if place.is_dir()), None)


def _folders_in(name: str, base: Path) -> list[Path]:
    return [base / folder for folder in _FOLDERS.get(name, (name,))]


def load(
    name: str,
    root: str | os.PathLike[str] | None = None,
    split: str = "test",
    workers: int = 1,
    progress: Callable[[float], None] = lambda share: None,
) -> list[Sequence]:
    """The sequences of a split of a dataset, validated and self-checked, at its native rate
    (`resample` changes that). A split may be a fold, or all but a fold (see `folds`).

    Recordings that cannot be used are left out with a warning. With `workers` > 1 that many
    processes read the recordings that are slow to read and not in the cache yet; a script that asks
    for them needs its `if __name__ == "__main__"`. `progress` is told the share of these recordings
    that is read. Raises `InputError` on an unknown name or split, a missing folder, a damaged file,
    or a split without a sequence.
    """
    return list(load_each(name, root, split, workers, progress))


def load_each(
    name: str,
    root: str | os.PathLike[str] | None = None,
    split: str = "test",
    workers: int = 1,
    progress: Callable[[float], None] = lambda share: None,
) -> Iterator[Sequence]:
    """The sequences of `load` one after another, for those that do not fit the memory together."""
    fold = parse_fold(split)
    if fold is not None:
        return iter(fold.select(load_each(name, root, fold.split, workers, progress)))
    dataset = get(name)
    # Where lists at the root name the splits, the reader knows them.
    if split not in dataset.splits and dataset.list_splits is None:
        raise InputError(
            f"dataset {name}",
            f"unknown split '{split}'",
            f"{_did_you_mean(split, dataset.splits)}known splits: {', '.join(dataset.splits)}",
        )
    folder = find_root(name, root) if dataset.needs_root else Path(root or ".")
    return read_each(dataset, folder, split, workers, progress)


def _did_you_mean(word: str, known: list[str] | tuple[str, ...]) -> str:
    close = difflib.get_close_matches(word, known, n=1)
    return f"did you mean '{close[0]}'? " if close else ""
