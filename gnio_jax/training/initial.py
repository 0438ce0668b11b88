"""The trained network from which a training starts."""

from __future__ import annotations

import dataclasses
from typing import Any

from gnio_jax import models, networks
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.networks import TrainedNetwork


def load_initial_network(config: TrainConfig) -> TrainedNetwork | None:
    """The network that `config.init_from` names, if any.

    Raises `InputError` for a folder without a network, and for one whose network is not that of
    `config`; also if training through the filter has none to start from and the network predicts
    displacements. A plain head and one with a calibrated uncertainty may replace each other, and so
    may a network with and without an average over headings, since their parameters are the same.
    """
    learns_displacement = models.predicts_displacement(models.from_config(config.model))
    if config.init_from is None and config.through_filter.learn and learns_displacement:
        problem = "needs the weights of a network that has been trained on windows"
        remedy = "name it with --init-from"
        raise InputError("config", f"field 'through_filter.learn' {problem}", remedy)
    if config.init_from is None:
        return None
    network = networks.load(config.init_from)
    theirs, ours = map(_describe_network, (network.config, config))
    head_to_calibrated = ("head", "calibrated")
    if (theirs.get("model.uncertainty"), ours.get("model.uncertainty")) == head_to_calibrated:
        ours["model.uncertainty"] = "head"
    for name in theirs | ours:
        if theirs.get(name) != ours.get(name):
            problem = f"its {name} is {theirs.get(name)}, and here it is {ours.get(name)}"
            raise InputError(config.init_from, problem, "describe the same network")
    return network


def _describe_network(config: TrainConfig) -> dict[str, Any]:
    """What two experiments share if they have the same network: its name and options, and its
    windows."""
    whole = models.from_config(config.model)
    model: Any = models.innermost(whole)
    fields = (field.name for field in dataclasses.fields(model))
    options = {name: getattr(model, name) for name in fields if name not in ("parent", "name")}
    # Any network can be averaged over headings, which adds no parameters.
    frame = config.model.equivariance
    frame = "none" if frame == "four_headings" else frame
    parts = {"name": config.model.name, "equivariance": frame, "corrector": config.model.corrector}
    of_frame = {name: getattr(whole, name, None) for name in models.frame_options(frame)}
    options = {**parts, **options, **of_frame}
    of_windows = ("rate", "window_seconds", "context_seconds", "window_rotation")
    windows = {f"data.{name}": getattr(config.data, name) for name in of_windows}
    return {f"model.{name}": value for name, value in options.items()} | windows
