"""The data of a calibration: recordings, and the displacements that a network predicts for them
which was not trained on them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from gnio_jax import data
from gnio_jax.config import CalibrateConfig, FilterSettings, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Estimate, Recording, estimate, prepare
from gnio_jax.filtering import filter_setup
from gnio_jax.models import Network
from gnio_jax.training import checkpoint
from gnio_jax.training.checkpoint import Run

OnStage = Callable[[str, float], None]
"""Called with the stage and the share of it that is done."""


class Evidence(NamedTuple):
    """Recordings and the estimates of a network for each, in the same order."""

    recordings: list[Recording]
    estimates: list[Estimate]


class Source(NamedTuple):
    """A network and the recordings for which it predicts displacements."""

    run: Run
    fold: data.Fold | None
    """The part of the split; None for all of it."""


def load_run(workdir: Path, config: CalibrateConfig) -> Run:
    """A run with the network that is to be calibrated. Raises `InputError` as `checkpoint.load_run`
    and `checkpoint.averaged_over_headings` do."""
    run = checkpoint.load_run(workdir)
    if not config.average_headings:
        return run
    return checkpoint.averaged_over_headings(run, f"--average-headings with {workdir}")


def sources(run: Run, config: CalibrateConfig) -> tuple[str, list[Source]]:
    """The split, and the networks that predict its displacements: the run's own, or one for each
    fold.

    Raises `InputError` for a split that is neither the run's validation nor its training split, and
    for runs that are not the folds of one experiment.
    """
    split, own = run.config.data.train_split, run.config.data.val_split
    if not config.out_of_fold:
        if config.split not in (None, own, split):
            problem = "is neither the validation nor the training split of the run"
            remedy = f"give {own} or {split}: the filter must not be fitted to test walks"
            raise InputError(f"--split {config.split}", problem, remedy)
        return config.split or own, [Source(run, None)]
    if config.split:
        problem = "is of no use with --out-of-fold, which takes the training split"
        raise InputError(f"--split {config.split}", problem)
    runs = [load_run(Path(folder), config) for folder in config.out_of_fold]
    for folder, fold_run in zip(config.out_of_fold, runs, strict=True):
        _check_alike(folder, fold_run.config, run.config)
    found, count = [each.config.data.train_split for each in runs], len(runs)
    unseen = {
        f"{split}-{k}of{count}": data.Fold(split, k, count, left_out=False) for k in range(count)
    }
    if count < 2 or sorted(found) != sorted(unseen):
        remedy = f"train one run for each of --data.train-split {split}-0ofK, {split}-1ofK, ..."
        raise InputError("--out-of-fold", f"were trained on the splits {', '.join(found)}", remedy)
    return split, [Source(each, unseen[name]) for each, name in zip(runs, found, strict=True)]


def _check_alike(folder: str, fold_run: TrainConfig, run: TrainConfig) -> None:
    """Check that a fold has the experiment of the run, except for its share of the recordings."""
    own = dataclasses.replace(fold_run.data, train_split=run.data.train_split)
    for name, found, expected in (
        ("dataset", fold_run.dataset, run.dataset),
        ("data", own, run.data),
        ("model", fold_run.model, run.model),
    ):
        if found != expected:
            raise InputError(folder, f"differs from the calibrated run in '{name}'")


def gather(
    split: str,
    asked: list[Source],
    config: CalibrateConfig,
    settings: FilterSettings,
    progress: OnStage,
    workers: int,
) -> Evidence:
    """The predictions of each network for its recordings of the split. Raises `InputError` for
    missing data.

    The network runs in the loop of the filter with `settings`, and the filter's attitude rotates
    the windows.
    """
    own = asked[0].run.config
    names = ", ".join(own.datasets)
    roots = config.data_root or (own.data_root,) * len(own.datasets)
    if len(roots) != len(own.datasets):
        problem = f"names {len(roots)} folders, and the run has learnt from {names}"
        raise InputError("--data-root", problem, "name one for each dataset")
    loaded = [
        data.load(name, root, split, workers, lambda share: progress("reading", share))
        for name, root in zip(own.datasets, roots, strict=True)
    ]
    found = Evidence([], [])
    for number, source in enumerate(asked):
        trained, where = source.run.config.data, f"dataset {names}, split '{split}'"
        recordings = [each for sequences in loaded for each in sequences]
        if source.fold is not None:
            where = f"{where}, fold {source.fold.number}"
            recordings = [each for some in loaded for each in source.fold.select(some)]
        with_reference = [each for each in recordings if each.valid.any()]
        prepared, _ = prepare(
            with_reference, trained, settings.start, raw_gyro_bias=settings.raw_gyro_bias
        )
        if not prepared:
            problem = "has no recording with a reference that is long enough to be fitted"
            raise InputError(where, problem)
        network = Network.of(source.run.model, source.run.variables)
        estimates = estimate(
            prepared,
            network,
            own.data,
            filter_setup(own.data, settings),
            progress=lambda share, n=number: progress("estimating", (n + share) / len(asked)),
        )
        found.recordings.extend(prepared)
        found.estimates.extend(estimates)
    return found
