"""The evaluations that a row of a comparison names: of one run, or of all seeds of a run."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import NamedTuple

from gnio_jax.comparison import figures
from gnio_jax.comparison.figures import Evaluated, Figures, Recordings
from gnio_jax.config import CompareConfig
from gnio_jax.errors import InputError
from gnio_jax.reporting import Reporter

_SEED = re.compile(r"_s(\d+)(?=(_calibrated)?$)")
"""In the name of a run."""


class Row(NamedTuple):
    """One configuration."""

    label: str
    """As it was named."""
    folders: list[Path]
    """Of its evaluations, a seed each."""
    seeds: list[Figures]
    """metrics.json of each."""
    runs: list[str]
    """Names of the runs."""


def find(word: str) -> list[Path]:
    """The runs, or folders of evaluations, that `word` names: itself, or the seeds of it.

    A name without a seed stands for all its seeds: `runs/gnio` for `runs/gnio_s0`, `runs/gnio_s1`
    and so on, `runs/gnio_calibrated` for `runs/gnio_s0_calibrated` and so on. Raises `InputError`
    where there is nothing.
    """
    if paths := of_all_seeds(Path(word)):
        return paths
    remedy = "name a run, the folder of an evaluation, or a run of several seeds without _s0"
    if "eval" in Path(word).parts:
        remedy = "make it with gnio evaluate, whose help names the options"
    raise InputError(word, "is not there", remedy)


def of_all_seeds(path: Path) -> list[Path]:
    """`path` where it is there; else the paths that differ from it in the seed alone, in the order
    of the seeds. Raises `InputError` where some seeds have such a path and others do not, and where
    two have the same number."""
    if path.exists():
        return [path]
    parent = next((folder for folder in path.parents if folder.exists()), None)
    if parent is None:
        return []
    name, *rest = path.relative_to(parent).parts
    seeds: dict[int, Path] = {}
    for entry in sorted(entry for entry in parent.iterdir() if is_run(entry)):
        seed = _SEED.search(entry.name)
        if seed and entry.name[: seed.start()] + entry.name[seed.end() :] == name:
            if other := seeds.get(int(seed[1])):
                raise InputError(str(path), f"has a seed twice: {other}, {entry}", "rename one")
            seeds[int(seed[1])] = entry
    paths = [seeds[seed].joinpath(*rest) for seed in sorted(seeds)]
    missing = [each for each in paths if not each.exists()]
    if missing and len(missing) < len(paths):
        problem = f"is there for {len(paths) - len(missing)} of {len(paths)} seeds"
        raise InputError(str(path), problem, f"missing: {', '.join(map(str, missing))}")
    return [] if missing else paths


def is_run(folder: Path) -> bool:
    """Whether a folder holds a run."""
    return (folder / "config.yaml").is_file()


def recordings(folder: Path, config: CompareConfig) -> Recordings:
    """What the evaluation of `folder` is of, or will be. Raises `InputError` where there is none
    and none can be made."""
    if is_run(folder):
        figures.missing(folder, config.split, config.estimator)
        return figures.usual_recordings(folder, config.split)
    return figures.recordings(figures.of_evaluation(folder).figures)


def read(
    word: str, folders: list[Path], config: CompareConfig, reporter: Reporter, workers: int
) -> Row:
    """The row that `word` names. Runs are evaluated where they are not yet."""
    found = [_evaluated(folder, config, reporter, workers) for folder in folders]
    return Row(
        label=str(Path(word)),
        folders=[each.folder for each in found],
        seeds=[each.figures for each in found],
        runs=[_run(folder).name for folder in folders],
    )


def _run(folder: Path) -> Path:
    """The run that a row names, or that has the evaluation which it names."""
    return folder if is_run(folder) else Path(os.path.abspath(folder)).parent.parent


def _evaluated(folder: Path, config: CompareConfig, reporter: Reporter, workers: int) -> Evaluated:
    """Of a run, its evaluation with all options as by default; any other folder is one."""
    if not is_run(folder):
        return figures.of_evaluation(folder)
    return figures.of_run(
        folder, config.split, config.estimator, reporter, config.data_root, workers
    )
