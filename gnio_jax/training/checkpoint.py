"""Checkpoints of a run: `checkpoints/latest` to resume from, `checkpoints/best` to evaluate.

Only this module imports Orbax. Orbax writes a checkpoint into a temporary folder and renames it, so
the previous one remains whole if the process is killed.
"""

from __future__ import annotations

import dataclasses
import errno
import logging
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal, NamedTuple

import chex
import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp
import yaml
from flax import linen as nn

from gnio_jax import config as configuration
from gnio_jax import models, parallel
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.training.optimizer import Plateau, filter_numbers, trained_settings
from gnio_jax.training.task import TrainState

Which = Literal["best", "latest"]
METADATA = 2**17
"""Largest number of bytes that a checkpoint takes besides its arrays."""

# Orbax logs every save there, and it logs every failure before it raises it.
logging.getLogger("absl").setLevel(logging.CRITICAL)
# Parts of a save that failed after the first failure. The first one is raised.
logging.getLogger("asyncio").addFilter(lambda record: "orbax" not in record.getMessage())


class RunPosition(NamedTuple):
    """The position of a run besides its `TrainState`, kept as JSON with the checkpoint."""

    epoch: int = 0
    """Epoch in progress, or finished if `step` is a multiple of the steps per epoch."""
    step: int = 0
    best: float | None = None
    """Smallest value of `optim.best_by` on the validation split since the last change of what is
    trained."""
    sums: dict[str, float] = {}
    """Figures summed over the steps of the epoch in progress (`task.DispatchSums`)."""
    seconds: float = 0.0
    """Time spent training so far."""
    plateau: Plateau = Plateau()


class Run(NamedTuple):
    """A trained network as evaluation needs it."""

    config: TrainConfig
    """Its section `filter` has the values that were trained."""
    model: nn.Module
    variables: Any
    epoch: int
    step: int


def exists(workdir: Path, which: Which = "latest") -> bool:
    """Whether `workdir` holds a finished checkpoint."""
    folder = workdir / "checkpoints" / which
    return folder.is_dir() and any(child.name.isdigit() for child in folder.iterdir())


def save(workdir: Path, which: Which, state: TrainState, position: RunPosition) -> None:
    """Write a checkpoint at `position.step`, `latest` with the optimizer's state. An existing
    checkpoint of this step is the same and is kept.

    Several processes must have the same state and see the same folder. All of them call this
    function, and Orbax writes in the first. Arrays are written from the host's memory, so a
    checkpoint does not depend on the devices. Raises `OSError` naming the folder if the disk is
    full; the previous checkpoint is kept.
    """
    folder, state = _folder(workdir, which), jax.device_get(state)
    shapes = _shapes(state.variables)
    meta = {"position": position._asdict(), "shapes": shapes}
    items: dict[str, Any] = {
        "variables": ocp.args.StandardSave(state.variables),
        "meta": ocp.args.JsonSave(meta),
    }
    if which == "latest":
        items["optimizer"] = ocp.args.StandardSave(state.opt_state)
    size = sum(leaf.nbytes for leaf in jax.tree.leaves(state))
    try:
        with _manager(folder, create=True) as manager:
            if position.step in manager.all_steps():
                return
            # Orbax also raises if the disk is full, but after the tracebacks of many threads.
            if shutil.disk_usage(folder).free < size + METADATA:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            manager.save(position.step, args=ocp.args.Composite(**items))
    except OSError as error:
        error.filename = error.filename or str(folder)
        raise


def write_best(workdir: Path, run: Run) -> None:
    """Write a checkpoint `best` with the variables of a run, and with the filter of its config if
    one was trained."""
    variables = {"batch_stats": {}, **run.variables}
    if numbers := filter_numbers(run.config):
        variables["filter"] = numbers
    state = TrainState(jnp.int32(run.step), variables, opt_state=())
    save(workdir, "best", state, RunPosition(run.epoch, run.step))


def restore(workdir: Path, template: TrainState) -> tuple[TrainState, RunPosition]:
    """The latest state, in the structure of `template`, placed by `parallel.everywhere`.

    Raises `InputError` if it does not fit.
    """
    template = jax.device_get(template)
    templates = {"variables": template.variables, "optimizer": template.opt_state}
    position, items = _read_items(workdir, "latest", templates)
    state = TrainState(jnp.int32(position.step), items["variables"], items["optimizer"])
    chex.assert_trees_all_equal_shapes_and_dtypes(state, template)
    return parallel.everywhere(state), position


def load_run(workdir: Path | str, which: Which = "best") -> Run:
    """The network of a run with its trained variables.

    Raises `InputError` for a folder without a run or checkpoint, one whose arrays do not fit the
    run's config.yaml, and one with arrays that are not finite.
    """
    workdir, file = Path(workdir), Path(workdir) / "config.yaml"
    if not file.is_file():
        problem = "holds no run (config.yaml is missing)"
        raise InputError(workdir, problem, "train one with gnio train --workdir ...")
    config = configuration.validate(configuration.load(file), str(file))
    model = models.from_config(config.model)
    template = {"batch_stats": {}, **models.variable_shapes(model, config.data.seen)}
    if numbers := filter_numbers(config):
        template["filter"] = numbers
    position, items = _read_items(workdir, which, {"variables": template})
    variables = items["variables"]
    chex.assert_trees_all_equal_shapes_and_dtypes(variables, template)
    try:
        chex.assert_tree_all_finite(variables)
    except AssertionError:
        remedy = "evaluate another run, or train it again with a lower optim.learning_rate"
        where = _folder(workdir, which)
        raise InputError(where, "holds parameters that are not finite", remedy) from None
    variables = jax.tree.map(parallel.fresh_copy, variables)
    settings = trained_settings(config.filter, variables.pop("filter", {}))
    config = dataclasses.replace(config, filter=settings)
    return Run(config, model, variables, position.epoch, position.step)


def load_initial_network(config: TrainConfig, load: Callable[[str], Run]) -> Run | None:
    """The run that `config.init_from` names, if any, as `load` reads it.

    Raises `InputError` for a folder without a run, and for one whose network is not that of
    `config`; also if training through the filter has none to start from. A plain head and one with
    a calibrated uncertainty may replace each other, and so may a network with and without an
    average over headings, since their parameters are the same.
    """
    if config.init_from is None and config.through_filter.learn:
        problem = "needs the weights of a network that has been trained on windows"
        remedy = "name its run with --init-from"
        raise InputError("config", f"field 'through_filter.learn' {problem}", remedy)
    if config.init_from is None:
        return None
    run = load(config.init_from)
    theirs, ours = map(_describe_network, (run.config, config))
    head_to_calibrated = ("head", "calibrated")
    if (theirs.get("model.uncertainty"), ours.get("model.uncertainty")) == head_to_calibrated:
        ours["model.uncertainty"] = "head"
    for name in theirs | ours:
        if theirs.get(name) != ours.get(name):
            problem = f"its {name} is {theirs.get(name)}, and here it is {ours.get(name)}"
            raise InputError(config.init_from, problem, "describe the same network")
    return run


def _describe_network(config: TrainConfig) -> dict[str, Any]:
    """What two runs must share to have the same network: its name and options, and its windows."""
    model: Any = models.from_config(config.model)
    model = getattr(model, "network", model)  # the network inside an equivariant construction
    fields = (field.name for field in dataclasses.fields(model))
    options = {name: getattr(model, name) for name in fields if name not in ("parent", "name")}
    # Any network can be averaged over headings, which adds no parameters.
    framed = config.model.equivariance == "canonical_frame"
    options = {"name": config.model.name, "canonical_frame": framed, **options}
    of_windows = ("rate", "window_seconds", "context_seconds", "window_rotation")
    windows = {f"data.{name}": getattr(config.data, name) for name in of_windows}
    return {f"model.{name}": value for name, value in options.items()} | windows


def average_over_headings(run: Run, source: str) -> Run:
    """The run with its network averaged over four headings (`models.equivariance.FourHeadings`),
    which has the same weights. Raises `InputError` naming `source` for a network that was not
    trained on every heading, or is equivariant in another way."""
    if run.config.model.equivariance == "canonical_frame":
        raise InputError(source, "its network has a canonical frame: there is nothing to average")
    averaged = dataclasses.replace(run.config.model, equivariance="four_headings")
    config = dataclasses.replace(run.config, model=averaged)
    configuration.validate(config, source)
    return run._replace(config=config, model=models.from_config(averaged))


def _folder(workdir: Path, which: Which) -> Path:
    return workdir / "checkpoints" / which


def _manager(folder: Path, create: bool) -> ocp.CheckpointManager:
    """Orbax's view of a series of checkpoints. It is a context manager, because its threads must be
    closed."""
    options = ocp.CheckpointManagerOptions(
        max_to_keep=1,
        enable_async_checkpointing=False,
        create=create,
        cleanup_tmp_directories=create,  # left by a killed process
    )
    return ocp.CheckpointManager(folder.absolute(), options=options)


def _read_items(
    workdir: Path, which: Which, templates: dict[str, Any]
) -> tuple[RunPosition, dict[str, Any]]:
    """The position of a checkpoint, and the items that these templates name.

    Raises `InputError` if there is no checkpoint, if it is damaged, or if its variables have other
    shapes.
    """
    where = _folder(workdir, which)
    if not exists(workdir, which):
        wait = "let gnio train finish its first epoch, or name another run"
        raise InputError(where, "holds no checkpoint", wait)
    with _manager(where, create=False) as manager:
        step = manager.latest_step()

        def restore_items(items: dict[str, Any]) -> Any:
            try:
                return manager.restore(step, args=ocp.args.Composite(**items))
            except (OSError, ValueError, KeyError, TypeError) as error:
                problem = f"cannot be read ({str(error)[:120]})"
                damaged = InputError(where / str(step), problem, "the checkpoint is damaged")
                raise damaged from None

        meta = restore_items({"meta": ocp.args.JsonRestore()})["meta"]
        shapes, saved_shapes = _shapes(templates["variables"]), meta["shapes"]
        for name in sorted(shapes.keys() | saved_shapes.keys()):
            if shapes.get(name) != saved_shapes.get(name):
                problem = (
                    f"'{name}' has shape {saved_shapes.get(name)} in the checkpoint "
                    f"and {shapes.get(name)} in the configured model"
                )
                same = "model.width and the other model fields must be those of the run"
                raise InputError(where, problem, same)
        trees = restore_items({n: ocp.args.StandardRestore(tree) for n, tree in templates.items()})
        trees = {name: trees[name] for name in templates}
    position = meta["position"]
    return RunPosition(**position | {"plateau": Plateau(*position["plateau"])}), trees


def _shapes(variables: Any) -> dict[str, list[int]]:
    leaves = jax.tree_util.tree_leaves_with_path(variables)
    names = {path: jax.tree_util.keystr(path, simple=True, separator="/") for path, _ in leaves}
    return {names[path]: list(leaf.shape) for path, leaf in leaves}


# The recordings of a run
# ------------------------------------------------------------------------------------------------


def training_recordings(workdir: Path, config: TrainConfig, dataset: str) -> set[str]:
    """Names of the recordings of a dataset that the network of a run was trained on; none if the
    folder does not list them."""
    path = workdir / "splits.yaml"
    try:
        splits = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError):
        return set()
    names = recordings_by_name(
        splits.get(config.data.train_split) if isinstance(splits, dict) else None
    )
    if config.datasets == (dataset,):
        return set(names)
    prefix = f"{dataset}/"
    return {name.removeprefix(prefix) for name in names if name.startswith(prefix)}


def recordings_by_name(recordings: Any) -> dict[str, int | None]:
    """Recordings and their lengths in samples; None if only the names are known."""
    if isinstance(recordings, dict):
        return {str(name): length for name, length in recordings.items()}
    return dict.fromkeys(map(str, recordings)) if isinstance(recordings, list) else {}
