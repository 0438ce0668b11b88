"""Existing evaluations of networks, which are used again if they are the requested ones."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from gnio_jax import data
from gnio_jax.config import EvaluateConfig, to_plain
from gnio_jax.errors import InputError
from gnio_jax.evaluation.evaluate import OF_SAMPLES, evaluate, folder_of, resolve
from gnio_jax.evaluation.folder import read
from gnio_jax.evaluation.report import Report
from gnio_jax.networks import find_network, newest_run
from gnio_jax.networks.folder import name_of, read_settings
from gnio_jax.reporting import Reporter

IDENTITY = ("dataset", "data_root", "split", "alignment")
"""Settings that two evaluations must share to have the same recordings and errors."""


class RequestedEvaluation(NamedTuple):
    """A requested evaluation of a network, with its figures if they exist."""

    config: EvaluateConfig
    """The request, as `evaluate.resolve` completes it."""
    folder: Path
    report: Report | None
    """The figures, if they exist."""
    problem: str
    """The reason why the network has to be evaluated; empty if the figures exist."""


def find_existing(config: EvaluateConfig) -> RequestedEvaluation:
    """Find the figures of a network that match `config`, with the network's own filter.

    Raises `InputError` if the network cannot be evaluated.
    """
    path = find_network(config.network or newest_run())
    if config.checkpoint == "latest":
        from gnio_jax.training.checkpoint import load_latest  # Orbax takes half a second to import

        trained = load_latest(path).config
    else:
        trained = read_settings(path).config
    config = resolve(config, trained)
    folder = folder_of(path, config, trained)
    report, problem = None, "it is not evaluated yet"
    if (folder / "metrics.json").exists():
        try:
            report = read(folder)
            problem = (
                _find_difference(report, config)
                or find_change(report, path)
                or find_other_recordings(report)
            )
        except InputError as error:
            problem = f"its figures cannot be used: {error}"
    return RequestedEvaluation(config, folder, None if problem else report, problem)


def load_or_evaluate(request: RequestedEvaluation, reporter: Reporter, workers: int = 1) -> Report:
    """The existing figures, or those of a new evaluation."""
    if request.report is not None:
        return request.report
    config = request.config
    name = name_of(find_network(config.network or newest_run()))
    reporter.line(f"evaluating {name} on {config.split} ({config.estimator}): {request.problem}")
    evaluate(config, reporter, workers)
    return read(request.folder)


def find_change(report: Report, path: Path) -> str:
    """The reason why the figures are not of the weights of the network in `path`, and of the
    corrector of its filter; empty if they are."""
    if report.settings.get("checkpoint") == "latest":
        step = str(report.settings.get("step"))
        current = (path / "checkpoints" / "latest" / step).is_dir()
    else:
        current = report.settings.get("weights") == read_settings(path).digest
    if not current:
        return "its figures are of weights that the network has no more"
    name = report.settings.get("filter", {}).get("corrector")
    digest = report.settings.get("corrector_weights", "")  # None: it comes with the network
    if name is None or digest is None:
        return ""
    try:
        current = digest == read_settings(find_network(name)).digest
    except InputError:  # it is not there any more, so it was not trained again
        return ""
    return "" if current else f"its figures are of weights that the corrector {name} has no more"


def find_other_recordings(report: Report) -> str:
    """The reason why the figures are not of the recordings that are there now; empty if they
    are."""
    settings = report.settings
    data_root = settings.get("data_root")
    change = data.find_change(
        settings["dataset"], data_root, settings["split"], settings.get("contents", {})
    )
    return f"its figures are of other recordings: {change}" if change else ""


def _find_difference(report: Report, config: EvaluateConfig) -> str:
    """The reason why the figures are not the requested ones; empty if they are."""
    for name in IDENTITY:
        if (value := report.settings.get(name)) != (request := getattr(config, name)):
            return f"its figures are of {name.replace('_', ' ')} {value}, not {request}"
    ours, theirs = report.settings.get("filter", {}), to_plain(config.filter)
    if config.estimator == "integrate":
        ours, theirs = ([settings.get(name) for name in OF_SAMPLES] for settings in (ours, theirs))
    if ours != theirs:
        return "its figures are of another filter than the network's"
    return ""
