"""Training from the weights of another run."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.training.checkpoint import Run, create_model, load_run
from gnio_jax.training.step import TrainState


def initial_run(config: TrainConfig, load: Callable[[str], Run] = load_run) -> Run | None:
    """The run that `config.init_from` names, if any, as `load` reads it.

    Raises `InputError` for a folder without a run, and for one whose network is not that of
    `config`; also if training through the filter has none to start from. A calibrated uncertainty
    may follow a plain head, since its parameters are the same.
    """
    if config.init_from is None and config.through_filter.learn:
        problem = "needs the weights of a network that has been trained on windows"
        remedy = "name its run with --init-from"
        raise InputError("config", f"field 'through_filter.learn' {problem}", remedy)
    if config.init_from is None:
        return None
    run = load(config.init_from)
    theirs, ours = (_description(each) for each in (run.config, config))
    head_to_calibrated = ("head", "calibrated")
    if (theirs.get("model.uncertainty"), ours.get("model.uncertainty")) == head_to_calibrated:
        ours["model.uncertainty"] = "head"
    for name in theirs | ours:
        if theirs.get(name) != ours.get(name):
            problem = f"its {name} is {theirs.get(name)}, and here it is {ours.get(name)}"
            raise InputError(config.init_from, problem, "describe the same network")
    return run


def _description(config: TrainConfig) -> dict[str, Any]:
    """What makes a network the same: its kind and options, and the windows that it reads."""
    model = create_model(config)
    model = getattr(model, "network", model)  # what an equivariant construction is made around
    options = {
        f"model.{field.name}": getattr(model, field.name)
        for field in dataclasses.fields(model)
        if field.name not in ("parent", "name")
    }
    windows = {
        f"data.{name}": getattr(config.data, name)
        for name in ("rate", "window_seconds", "context_seconds", "window_rotation")
    }
    kind = {f"model.{name}": getattr(config.model, name) for name in ("name", "equivariance")}
    return {**kind, **options, **windows}


def with_weights(state: TrainState, run: Run) -> TrainState:
    """A fresh state with the network of a run; what that does not have stays as it is. The state of
    the optimizer does not change, nor the filter, which is that of the configuration."""
    found = _overlaid(state.variables, run.variables)
    return TrainState.of(state.step, found, state.opt_state)


def _overlaid(tree: dict[str, Any], other: dict[str, Any]) -> dict[str, Any]:
    """`tree` with the leaves that `other` has in the same places."""
    return {
        name: _overlaid(leaf, other.get(name, {}))
        if isinstance(leaf, dict)
        else other.get(name, leaf)
        for name, leaf in tree.items()
    }
