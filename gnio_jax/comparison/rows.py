"""The evaluations that a row of a comparison names: of one run, or of all seeds of a run."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import NamedTuple

from gnio_jax.comparison.pairs import Figures
from gnio_jax.errors import InputError
from gnio_jax.evaluation import report

_SEED = re.compile(r"_s(\d+)(?=_|$)")


class Row(NamedTuple):
    """One configuration."""

    label: str
    """As it was named."""
    folders: list[Path]
    """Of its evaluations, a seed each."""
    seeds: list[Figures]
    """metrics.json of each."""


def read_row(word: str, split: str, estimator: str) -> Row:
    """The row that `word` names: a run, or the folder of one of its evaluations.

    A name without a seed stands for all its seeds: `runs/gnio` for `runs/gnio_s0`, `runs/gnio_s1`
    and so on, `runs/gnio_calibrated` for `runs/gnio_s0_calibrated` and so on. Raises `InputError`
    where there is nothing, or no such evaluation.
    """
    found = of_all_seeds(Path(word))
    if not found:
        remedy = "name a run, the folder of an evaluation, or a run of several seeds without _s0"
        raise InputError(word, "is not there", remedy)
    folders = [_evaluation(folder, split, estimator) for folder in found]
    return Row(str(Path(word)), folders, [_read(folder) for folder in folders])


def of_all_seeds(path: Path) -> list[Path]:
    """`path` where it is there; else the paths that differ from it in the seed alone, in the order
    of the seeds."""
    if path.exists():
        return [path]
    for parent in path.parents:
        if parent.exists():
            name, *rest = path.relative_to(parent).parts
            seeds = {
                int(seed[1]): entry
                for entry in parent.iterdir()
                if (seed := _SEED.search(entry.name)) and _SEED.sub("", entry.name, 1) == name
            }
            paths = [seeds[seed].joinpath(*rest) for seed in sorted(seeds)]
            return [seed for seed in paths if seed.exists()]
    return []


def _evaluation(folder: Path, split: str, estimator: str) -> Path:
    """Of a run, the evaluation of this split with this estimator, all else as by default; any other
    folder is an evaluation's."""
    if not (folder / "config.yaml").exists():
        return folder
    found = sorted((folder / "eval").glob(f"*_{split}_{estimator}"))
    if len(found) == 1:
        return found[0]
    if found:
        remedy = f"name one of {', '.join(map(str, found))}"
        raise InputError(str(folder), f"has evaluations of '{split}' on several datasets", remedy)
    remedy = f"run gnio evaluate --workdir {folder} --split {split}"
    if estimator != "ekf":
        remedy += f" --estimator {estimator}"
    raise InputError(str(folder), f"has no evaluation of '{split}' with {estimator}", remedy)


def _read(folder: Path) -> Figures:
    """metrics.json of an evaluation. Raises `InputError` where it is not there, or its figures
    cannot stand beside those of today."""
    path = folder / "metrics.json"
    try:
        figures = json.loads(path.read_text(encoding="utf-8"))
        definitions = report.definitions(figures)
    except FileNotFoundError:
        remedy = "name a run, or a folder below its eval/"
        raise InputError(str(folder), "is neither a run nor an evaluation", remedy) from None
    except (ValueError, KeyError, TypeError, AttributeError):
        remedy = "run gnio evaluate again"
        raise InputError(str(path), "is not a metrics.json of an evaluation", remedy) from None
    if definitions != report.DEFINITIONS:
        problem = "was written by another version, whose figures mean something else"
        raise InputError(str(path), problem, "run gnio evaluate again")
    return figures
