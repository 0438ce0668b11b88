"""The data of a calibration: recordings, and the displacements that a network predicts for them.
The network was not trained on them."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from gnio_jax import config as configuration
from gnio_jax import data, models, networks
from gnio_jax.config import CalibrateConfig, FilterSettings, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import PreparedRecording, SequenceEstimate, estimate, prepare
from gnio_jax.filtering import make_filter
from gnio_jax.models import Network
from gnio_jax.networks import TrainedNetwork, load_corrector

OnStage = Callable[[str, float], None]
"""Called with the stage and the share of it that is done."""


class Predictions(NamedTuple):
    """Recordings and their estimates with a network in the filter, in the same order."""

    recordings: list[PreparedRecording]
    estimates: list[SequenceEstimate]


class FoldNetwork(NamedTuple):
    """A network and the part of the split for which it predicts displacements."""

    run: TrainedNetwork
    fold: data.Fold | None
    """None: all of the split."""


def load_network(network: str | Path, config: CalibrateConfig) -> TrainedNetwork:
    """The network that is to be calibrated. Raises `InputError` as `networks.load` and
    `average_over_headings` do, and for a network without displacements."""
    trained = networks.load(network)
    if not models.predicts_displacement(trained.model):
        problem = f"'{trained.config.model.name}' predicts no displacement that could be calibrated"
        raise InputError(str(network), problem, "train the filter's numbers: through_filter.learn")
    if not config.average_headings:
        return trained
    return average_over_headings(trained, f"--average-headings with {network}")


def average_over_headings(network: TrainedNetwork, source: str) -> TrainedNetwork:
    """Average a network over four headings (`models.equivariance.FourHeadings`), which has the same
    weights. Raises `InputError` naming `source` for a network that was not trained on every
    heading, or is equivariant in another way."""
    frame = network.config.model.equivariance
    if frame not in ("none", "four_headings"):
        averages = getattr(network.model, "averages_headings", False)
        reason = "which averages over four headings" if averages else "a frame of its own"
        problem = f"its network has model.equivariance: {frame}, {reason}"
        raise InputError(source, problem, "leave --average-headings out")
    averaged = dataclasses.replace(network.config.model, equivariance="four_headings")
    config = dataclasses.replace(network.config, model=averaged)
    configuration.validate(config, source)
    return network._replace(config=config, model=models.from_config(averaged))


def choose_networks(run: TrainedNetwork, config: CalibrateConfig) -> tuple[str, list[FoldNetwork]]:
    """Choose the split and the networks that predict its displacements: the run's own network, or
    one for each fold.

    Raises `InputError` for a split that is neither the run's validation nor its training split, and
    for runs that are not the folds of one experiment.
    """
    train, val = run.config.data.train_split, run.config.data.val_split
    if not config.out_of_fold:
        if config.split not in (None, val, train):
            problem = "is neither the validation nor the training split of the run"
            remedy = f"give {val} or {train}: the filter must not be fitted to test walks"
            raise InputError(f"--split {config.split}", problem, remedy)
        return config.split or val, [FoldNetwork(run, None)]
    if config.split:
        problem = "has no effect with --out-of-fold, which takes the training split"
        raise InputError(f"--split {config.split}", problem)
    runs = [load_network(folder, config) for folder in config.out_of_fold]
    for folder, fold_run in zip(config.out_of_fold, runs, strict=True):
        _check_alike(folder, fold_run.config, run.config)
    splits, count = [fold_run.config.data.train_split for fold_run in runs], len(runs)
    folds = {
        f"{train}-{k}of{count}": data.Fold(train, k, count, left_out=False) for k in range(count)
    }
    if count < 2 or sorted(splits) != sorted(folds):
        remedy = f"train one run for each of --data.train-split {train}-0ofK, {train}-1ofK, ..."
        raise InputError("--out-of-fold", f"were trained on the splits {', '.join(splits)}", remedy)
    return train, [
        FoldNetwork(fold_run, folds[name]) for fold_run, name in zip(runs, splits, strict=True)
    ]


def _check_alike(folder: str, fold_run: TrainConfig, run: TrainConfig) -> None:
    """Check that a fold has the experiment of the run, except for its share of the recordings."""
    windows = dataclasses.replace(fold_run.data, train_split=run.data.train_split)
    for name, section, expected in (
        ("dataset", fold_run.dataset, run.dataset),
        ("data", windows, run.data),
        ("model", fold_run.model, run.model),
    ):
        if section != expected:
            raise InputError(folder, f"differs from the calibrated run in '{name}'")


def predict(
    split: str,
    networks: list[FoldNetwork],
    config: CalibrateConfig,
    settings: FilterSettings,
    progress: OnStage,
    workers: int,
) -> Predictions:
    """Predict the displacements of the split, each network for its recordings. Raises `InputError`
    for missing data.

    The network runs in the loop of the filter with `settings`, and the filter's attitude rotates
    the windows.
    """
    trained = networks[0].run.config
    names = ", ".join(trained.datasets)
    roots = config.data_root or (trained.data_root,) * len(trained.datasets)
    if len(roots) != len(trained.datasets):
        problem = f"names {len(roots)} folders, and the run has learnt from {names}"
        raise InputError("--data-root", problem, "name one for each dataset")
    datasets = [
        data.load(name, root, split, workers, lambda share: progress("reading", share))
        for name, root in zip(trained.datasets, roots, strict=True)
    ]
    predictions = Predictions([], [])
    for number, fold_network in enumerate(networks):
        windows, subset = fold_network.run.config.data, f"dataset {names}, split '{split}'"
        sequences = [sequence for dataset in datasets for sequence in dataset]
        if fold_network.fold is not None:
            subset = f"{subset}, fold {fold_network.fold.number}"
            sequences = [
                sequence for dataset in datasets for sequence in fold_network.fold.select(dataset)
            ]
        with_reference = [sequence for sequence in sequences if sequence.valid.any()]
        corrector = load_corrector(settings, windows.rate, fold_network.run)
        ekf = make_filter(windows, settings)
        prepared, _ = prepare(with_reference, windows, ekf, corrector=corrector)
        if not prepared:
            problem = "has no recording with a reference that is long enough to be fitted"
            raise InputError(subset, problem)
        network = Network.of(fold_network.run.model, fold_network.run.variables)
        estimates = estimate(
            prepared,
            network,
            trained.data,
            make_filter(trained.data, settings),
            progress=lambda share, n=number: progress("estimating", (n + share) / len(networks)),
        )
        predictions.recordings.extend(prepared)
        predictions.estimates.extend(estimates)
    return predictions
