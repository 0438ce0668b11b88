"""Evaluations that a network has already, and whether they may replace new ones."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from gnio_jax.config import EvaluateConfig, to_plain
from gnio_jax.errors import InputError
from gnio_jax.evaluation.evaluate import evaluate, folder_of, resolve
from gnio_jax.evaluation.report import Report, read
from gnio_jax.networks import find_network, newest_run
from gnio_jax.networks.folder import name_of, read_settings
from gnio_jax.reporting import Reporter

IDENTITY = ("dataset", "data_root", "split", "alignment")
"""Settings that two evaluations must share to have the same recordings and errors."""


class Kept(NamedTuple):
    """A requested evaluation of a network, and whether it has to be made."""

    config: EvaluateConfig
    """The request, as `evaluate.resolve` completes it."""
    folder: Path
    report: Report | None
    """The existing report, if it is the requested one."""
    problem: str
    """The reason why it has to be made; empty if it exists."""


def look(config: EvaluateConfig) -> Kept:
    """The evaluation of a network that `config` asks for, with the network's own filter.

    Raises `InputError` for one that does not exist and cannot be made.
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
            problem = _differs(report, config) or out_of_date(report, path)
        except InputError as error:
            problem = f"its figures cannot be used: {error}"
    return Kept(config, folder, None if problem else report, problem)


def made(kept: Kept, reporter: Reporter, workers: int = 1) -> Report:
    """The evaluation, which is made if necessary."""
    if kept.report is not None:
        return kept.report
    config = kept.config
    name = name_of(find_network(config.network or newest_run()))
    reporter.line(f"evaluating {name} on {config.split} ({config.estimator}): {kept.problem}")
    evaluate(config, reporter, workers)
    return read(kept.folder)


def out_of_date(report: Report, path: Path) -> str:
    """The reason why the figures are not those of the network in `path`; empty if they are."""
    if report.settings.get("checkpoint") == "latest":
        step = str(report.settings.get("step"))
        current = (path / "checkpoints" / "latest" / step).is_dir()
    else:
        current = report.settings.get("weights") == read_settings(path).digest
    return "" if current else "its figures are of weights that the network has no more"


def _differs(report: Report, config: EvaluateConfig) -> str:
    """The reason why the figures are not the requested ones; empty if they are."""
    for name in IDENTITY:
        if (own := report.settings.get(name)) != (wanted := getattr(config, name)):
            return f"its figures are of {name.replace('_', ' ')} {own}, not {wanted}"
    if config.estimator != "integrate" and report.settings["filter"] != to_plain(config.filter):
        return "its figures are of another filter than the network's"
    return ""
