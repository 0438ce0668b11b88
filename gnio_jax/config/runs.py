"""Where runs lie."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

from gnio_jax.config.schema import TrainConfig
from gnio_jax.errors import InputError


def default_workdir(config: TrainConfig) -> Path:
    """Where a run goes: its `workdir`, else runs/<dataset>_<model>."""
    return Path(config.workdir or f"runs/{config.dataset}_{config.model.name}")


def with_seeds(config: TrainConfig, seeds: Sequence[int]) -> list[TrainConfig]:
    """The experiment with each of these seeds: ordinary runs, in the work folders WORKDIR_s0,
    WORKDIR_s1, ... Raises `InputError` for no seed, and for one that is named twice."""
    if not seeds:
        raise InputError("--seeds", "names no seed", "give some, e.g. 0 1 2")
    twice = [seed for seed in seeds if seeds.count(seed) > 1]
    if twice:
        raise InputError("--seeds", f"names {twice[0]} twice", "each seed is one run")
    folder = default_workdir(config)
    return [dataclasses.replace(config, seed=seed, workdir=f"{folder}_s{seed}") for seed in seeds]


def newest_run(folder: str | Path = "runs") -> Path:
    """The run below `folder` that was trained last; calibrated copies of a run do not count. Raises
    `InputError` when there is none."""
    found = [path.parent for path in Path(folder).glob("*/config.yaml")]
    runs = [run for run in found if not (run / "calibration.json").exists()]
    if not runs:
        remedy = "train one with gnio train, or name its folder with --workdir"
        raise InputError(folder, "holds no run", remedy)
    return max(runs, key=_last_trained)


def _last_trained(run: Path) -> float:
    files = (run / "config.yaml", run / "metrics.jsonl")
    return max(path.stat().st_mtime for path in files if path.exists())
