"""One calibration, from its options to the calibrated run."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gnio_jax import config as configuration
from gnio_jax.calibration.comparison import Effect, compare_filters
from gnio_jax.calibration.fit import (
    DIGITS,
    GROUPS,
    ConsiderFit,
    InnovationFit,
    compare_positions,
    fit_considered,
    fit_innovations,
    fit_std_factors,
    start_of_fit,
    true_displacements,
)
from gnio_jax.calibration.predictions import OnStage, choose_networks, load_network, predict
from gnio_jax.config import CalibrateConfig, ConsideredStd, FilterSettings
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Displacements
from gnio_jax.evaluation.estimate import filter_inputs
from gnio_jax.files import replacing_folder, write_text
from gnio_jax.filtering.settings import filter_config
from gnio_jax.networks import (
    TrainedNetwork,
    find_network,
    newest_run,
    with_corrector,
    write_network,
)
from gnio_jax.networks.folder import SPLITS, has_card, name_of
from gnio_jax.numerics import filled_up

MOST_STEPS = 60
"""Largest number of steps of the search for the settings (L-BFGS)."""
RECORD = "calibration.json"
"""File that records the fit and its data, by which a calibrated run is recognised."""
LEAST_RECORDINGS = 5
"""Number of recordings below which a fit to them is doubtful (ours)."""


class Calibration(NamedTuple):
    """The result of `calibrate` and its folder."""

    before: FilterSettings
    innovation_fit: InnovationFit
    consider_fit: ConsiderFit
    """The last fit, with the settings of the calibrated run."""
    effect: Effect
    """The errors of the trajectories with both filters."""
    recordings: int
    raw_gyros: int
    """Number of recordings with a raw gyro."""
    folder: Path

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons not to trust the calibration, each in one sentence."""
        others = self.recordings - self.raw_gyros
        groups = {"with a raw gyro": self.raw_gyros, "without a raw gyro": others}
        few = (
            f"only {count} recording{'s' * (count > 1)} {group}: fewer than {LEAST_RECORDINGS} "
            "hardly determine the settings that are fitted to them"
            for group, count in groups.items()
            if 0 < count < LEAST_RECORDINGS
        )
        return (*self.innovation_fit.warnings, *self.effect.warnings, *few)


def calibrate(
    config: CalibrateConfig, progress: OnStage = lambda stage, share: None, workers: int = 1
) -> Calibration:
    """Fit the filter's settings of a run to recordings that its network was not trained on, and
    write a run that differs only in them, and in the average over headings if the options ask for
    it.

    There are three steps (ours). First each axis gets the factor that makes the network's standard
    deviations those of its errors, which are compared with the reference window by window. Then the
    settings of `config.fit` are chosen so that the innovations of the filter are most likely; here
    the reference gives only the start. Last, the consider covariance is chosen so that the errors
    of the filter's positions are most likely; it changes no trajectory. Likely innovations are not
    always good trajectories, so the errors of these are compared with those of the run's filter.

    The recordings are those of the validation split, or those of the training split, each with the
    displacements of a network that was not trained on it. Raises `InputError` for another split,
    for an output folder that exists already, and for missing data.
    """
    if not config.fit:
        raise InputError("--fit", "names nothing", f"name some of {', '.join(GROUPS)}")
    paths = [path for group in dict.fromkeys(config.fit) for path in GROUPS[group]]
    path = find_network(config.network or newest_run())
    run = with_corrector(load_network(path, config))
    folder = _choose_folder(config, path)
    split, networks = choose_networks(run, config)
    windows = run.config.data
    noise = run.config.filter.noise._replace(measurement_scale=1.0, std_factor=(1.0, 1.0, 1.0))
    # Consider covariance changes no estimate, and is fitted last.
    uncalibrated = dataclasses.replace(run.config.filter, noise=noise, considered=ConsideredStd())
    start_of_fit(uncalibrated, paths)  # finds mistakes before reading data
    recordings, estimates = predict(split, networks, config, uncalibrated, progress, workers)
    try:
        truths = [
            recording.velocity
            if uncalibrated.measures == "velocity"
            else true_displacements(estimate, windows)
            for recording, estimate in zip(recordings, estimates, strict=True)
        ]
        factors = fit_std_factors(estimates, truths)
    except ValueError as error:
        raise InputError(f"split '{split}'", str(error)) from None
    x, y, z = (float(f"{factor:.{DIGITS}g}") for factor in factors)  # as written to the settings
    noise = noise._replace(std_factor=(x, y, z))
    settings = start_of_fit(dataclasses.replace(uncalibrated, noise=noise), paths)
    strides = max(recording.strides for recording in recordings)
    # The first row of an estimate is its start.
    rows = [estimate.displacements for estimate in estimates if estimate.displacements is not None]
    displacements = [Displacements(value[1:], covariance[1:]) for value, covariance, _ in rows]
    walks = filter_inputs(recordings, displacements, strides, filter_config(windows, settings))
    innovation_fit = fit_innovations(
        walks,
        windows,
        settings,
        paths,
        lambda calls: progress("fitting", min(1.0, calls / (1.3 * MOST_STEPS))),
        MOST_STEPS,
    )
    progress("considering", 0.0)
    references = (recording.reference.position[1:] for recording in recordings)
    truth = np.stack([filled_up(reference, strides, np.nan) for reference in references])
    positions = compare_positions(walks, truth, windows, innovation_fit.settings)
    consider_fit = fit_considered(positions, innovation_fit.settings)
    progress("comparing", 0.0)
    before = run.config.filter
    effect = compare_filters(recordings, displacements, windows, before, consider_fit.settings)
    progress("comparing", 1.0)
    counts = len(recordings), sum(bool(recording.start.raw_gyro) for recording in recordings)
    calibration = Calibration(before, innovation_fit, consider_fit, effect, *counts, folder)
    _write(calibration, path, run, config, split)
    return calibration


def _choose_folder(config: CalibrateConfig, path: Path) -> Path:
    if (path / RECORD).exists():
        remedy = "calibrate the run that it was made from"
        raise InputError(path, "is a calibrated run", remedy)
    parent = Path("runs") if path.is_file() or has_card(path) else path.resolve().parent
    folder = Path(config.out) if config.out else parent / f"{name_of(path.resolve())}_calibrated"
    if folder.exists():
        raise InputError(folder, "exists already", "remove it, or give another --out")
    return folder


def _write(
    calibration: Calibration,
    path: Path,
    trained: TrainedNetwork,
    config: CalibrateConfig,
    split: str,
) -> None:
    """Write the network with its new settings, and the record of the fit."""
    fit, effect = calibration.innovation_fit, calibration.effect
    settings = calibration.consider_fit.settings
    record: dict[str, Any] = {
        "run": str(path),
        "split": split,
        "out_of_fold": list(config.out_of_fold),
        "average_headings": config.average_headings,
        "recordings": calibration.recordings,
        "recordings_with_raw_gyro": calibration.raw_gyros,
        "fitted": list(config.fit),
        "negative_log_likelihood_per_innovation": {"before": fit.before, "after": fit.after},
        "steps": fit.steps,
        "warnings": list(calibration.warnings),
        "position_nees_per_axis": {
            "before": calibration.consider_fit.before,
            "after": calibration.consider_fit.after,
        },
        "trajectories": {
            **{metric: change._asdict() for metric, change in effect.errors.items()},
            "diverged": effect.diverged._asdict(),
        },
        "filter": configuration.to_plain(settings),
    }
    with replacing_folder(calibration.folder) as new:
        experiment = dataclasses.replace(
            trained.config, workdir=str(calibration.folder), filter=settings
        )
        configuration.validate(experiment, "the calibrated run")
        write_network(new, trained._replace(config=experiment))
        write_text(new / RECORD, json.dumps(record, indent=2) + "\n")
        for name in (SPLITS, "metrics.jsonl"):
            if (path / name).exists():
                shutil.copy2(path / name, new / name)
