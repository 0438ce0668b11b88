"""The evaluations that a row of a comparison names: of one run, or of all seeds of a run."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from gnio_jax.comparison.figures import Evaluated, Figures, of_evaluation, of_run
from gnio_jax.config import CompareConfig
from gnio_jax.errors import InputError
from gnio_jax.reporting import Reporter

_SEED = re.compile(r"_s\d+(?=_|$)")


class Row(NamedTuple):
    """One configuration."""

    label: str
    """As it was named."""
    folders: list[Path]
    """Of its evaluations, a seed each."""
    seeds: list[Figures]
    """metrics.json of each."""


def read_row(word: str, config: CompareConfig, reporter: Reporter, workers: int) -> Row:
    """The row that `word` names: a run, or the folder of one of its evaluations.

    A name without a seed stands for all its seeds: `runs/gnio` for `runs/gnio_s0`, `runs/gnio_s1`
    and so on, `runs/gnio_calibrated` for `runs/gnio_s0_calibrated` and so on. Runs are evaluated
    where they are not yet. Raises `InputError` where there is nothing.
    """
    paths = of_all_seeds(Path(word))
    if not paths:
        remedy = "name a run, the folder of an evaluation, or a run of several seeds without _s0"
        raise InputError(word, "is not there", remedy)
    found = [_evaluated(path, config, reporter, workers) for path in paths]
    return Row(str(Path(word)), [each.folder for each in found], [each.figures for each in found])


def of_all_seeds(path: Path) -> list[Path]:
    """`path` where it is there; else the paths that differ from it in the seed alone, in the order
    of the seeds. Raises `InputError` where some seeds have such a path and others do not."""
    if path.exists():
        return [path]
    parent = next((folder for folder in path.parents if folder.exists()), None)
    if parent is None:
        return []
    name, *rest = path.relative_to(parent).parts
    seeds = {
        int(seed[0][2:]): entry.joinpath(*rest)
        for entry in parent.iterdir()
        for seed in _SEED.finditer(entry.name)
        if entry.name[: seed.start()] + entry.name[seed.end() :] == name
    }
    paths = [seeds[seed] for seed in sorted(seeds)]
    missing = [each for each in paths if not each.exists()]
    if missing and len(missing) < len(paths):
        problem = f"is there for {len(paths) - len(missing)} of {len(paths)} seeds"
        raise InputError(str(path), problem, f"missing: {', '.join(map(str, missing))}")
    return [] if missing else paths


def _evaluated(folder: Path, config: CompareConfig, reporter: Reporter, workers: int) -> Evaluated:
    """Of a run, its evaluation with all options as by default; any other folder is one."""
    if not (folder / "config.yaml").exists():
        return of_evaluation(folder)
    return of_run(folder, config.split, config.estimator, reporter, config.data_root, workers)
