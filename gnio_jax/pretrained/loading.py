"""A package, or the folder of a run, as a `Run`."""

from __future__ import annotations

from pathlib import Path

from gnio_jax import config as configuration
from gnio_jax import models
from gnio_jax.errors import InputError
from gnio_jax.pretrained import arrays, package
from gnio_jax.pretrained.finding import find
from gnio_jax.training.checkpoint import Run, load_run
from gnio_jax.training.filter_task import filter_numbers
from gnio_jax.training.window_task import create_model


def load_pretrained(which: str | Path) -> Run:
    """The network of `which` with its variables and configuration.

    `which` is the folder or zip of a package, the folder of a run, or the name of a package that
    the wheel or a folder of $GNIO_WEIGHTS holds. Every file is checked against the manifest.
    `Run.model.apply(run.variables, windows)` gives a `Prediction` of windows (b, N, 6), float32,
    [accel m/s², gyro rad/s] in the gravity frame at `run.config.data.rate`; `run.config.filter` are
    the filter's options as they were calibrated or learnt. Raises `InputError`.
    """
    place = find(which)
    return _load_package(place) if package.is_package(place) else load_run(place)


def card_of(which: str | Path) -> str:
    """The model card of a package, Markdown. Raises `InputError`, also for a run, which has
    none."""
    place = find(which)
    if not package.is_package(place):
        raise InputError(place, "is a run and has no model card", "gnio publish makes a package")
    return package.read(place).files[package.CARD].decode(errors="replace")


def _load_package(place: Path) -> Run:
    found = package.read(place)
    source = str(place / package.CONFIG)
    try:
        text = found.files[package.CONFIG].decode()
    except UnicodeDecodeError as error:
        raise InputError(source, f"is no text ({error})") from None
    config = configuration.validate(configuration.parse(text, source), source)
    model = create_model(config)
    shapes = models.variable_shapes(model, config.data.seen)
    template = {"params": shapes["params"], "batch_stats": shapes.get("batch_stats", {})}
    content = found.files[package.WEIGHTS]
    variables = arrays.from_bytes(content, template, place / package.WEIGHTS)
    learns = bool(config.through_filter.learn)
    numbers = filter_numbers(config.filter) if learns else {}
    return Run(config, model, variables, found.about.epoch, found.about.step, numbers)
