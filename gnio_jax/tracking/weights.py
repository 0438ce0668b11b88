"""The network that tracks, with what a reader should know of it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

from gnio_jax import pretrained
from gnio_jax.errors import InputError
from gnio_jax.pretrained import figures
from gnio_jax.pretrained.package import Metric, is_package
from gnio_jax.training.checkpoint import Run


class Weights(NamedTuple):
    """A network ready to track."""

    name: str
    run: Run
    trained_on: str
    measured: str
    """The error that an evaluation found, in words; empty where there is none."""


def choose_weights(which: str | None) -> Weights:
    """The weights of a name, package or run; None takes the default. Raises `InputError`."""
    place = pretrained.default() if which is None else pretrained.find(which)
    run = pretrained.load_pretrained(place)
    if is_package(place):
        about = pretrained.about(place)
        return Weights(about.name, run, about.data, _in_words(about.metric))
    config = run.config
    trained_on = f"dataset {config.dataset}, split {config.data.train_split}"
    return Weights(place.name, run, trained_on, _in_words(_own_metric(place, config.dataset)))


def _own_metric(workdir: Path, dataset: str) -> Metric | None:
    """Of the run's evaluations; a damaged one keeps nobody from tracking."""
    try:
        return figures.key_metric(figures.read(workdir), dataset)
    except InputError:
        return None


def _in_words(metric: Metric | None) -> str:
    """Of `figures.KEY`."""
    return "" if metric is None else f"whose ATE 2-D is {metric.value:.1f} m on {metric.of}"
