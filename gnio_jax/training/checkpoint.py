"""The checkpoint of a run, `checkpoints/latest`, from which it is resumed. Its best weights are
those of the network in its folder (`networks.folder`).

Only this module imports Orbax. Orbax writes a checkpoint into a temporary folder and renames it, so
the previous one remains whole if the process is killed.
"""

from __future__ import annotations

import dataclasses
import errno
import logging
import os
import shutil
from pathlib import Path
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp

from gnio_jax import config as configuration
from gnio_jax import models, parallel
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.networks import TrainedNetwork
from gnio_jax.networks.folder import write_weights
from gnio_jax.training.optimizer import Plateau, filter_numbers, trained_settings
from gnio_jax.training.task import Row, TrainState

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
    """Value of `optim.best_by` on the validation split at the best epoch since the last change of
    what is trained."""
    sums: dict[str, float] = {}
    """Figures summed over the steps of the epoch in progress (`task.DispatchSums`)."""
    seconds: float = 0.0
    """Time spent training so far."""
    plateau: Plateau = Plateau()
    row: Row | None = None
    """The log's row of the epoch that has just finished; None within an epoch."""
    improved: bool = False
    """Whether that epoch is the best one so far."""


def exists(workdir: Path) -> bool:
    """Whether `workdir` holds a finished checkpoint."""
    folder = _folder(workdir)
    return folder.is_dir() and any(
        child.name.isdigit() and child.is_dir() for child in folder.iterdir()
    )


def save(workdir: Path, state: TrainState, position: RunPosition) -> None:
    """Write a checkpoint at `position.step`. An existing checkpoint of this step is the same and is
    kept.

    Several processes must have the same state and see the same folder. All of them call this
    function, and Orbax writes in the first. Arrays are written from the host's memory, so a
    checkpoint does not depend on the devices. Raises `OSError` naming the folder if the disk is
    full; the previous checkpoint is kept.
    """
    folder, state = _folder(workdir), jax.device_get(state)
    meta = {"position": position._asdict(), "shapes": _shapes(state.variables)}
    items: dict[str, Any] = {
        "variables": ocp.args.StandardSave(state.variables),
        "meta": ocp.args.JsonSave(meta),
        "optimizer": ocp.args.StandardSave(state.opt_state),
    }
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


def save_best(workdir: Path, config: TrainConfig, state: TrainState, position: RunPosition) -> None:
    """Write the weights of the network in `workdir`, with the filter's settings if they are
    trained. Of several processes the first one writes. Raises `OSError` naming the file if the disk
    is full; the previous weights are kept."""
    if not parallel.is_first():
        return
    variables = jax.device_get(state.variables)
    numbers = variables.pop("filter", {})
    settings = trained_settings(config.filter, numbers) if numbers else None
    write_weights(workdir, variables, position.epoch, position.step, settings)


def restore(workdir: Path, template: TrainState) -> tuple[TrainState, RunPosition]:
    """The latest state, in the structure of `template`, placed by `parallel.copy_to_devices`.

    Raises `InputError` if it does not fit.
    """
    template = jax.device_get(template)
    templates = {"variables": template.variables, "optimizer": template.opt_state}
    position, items = _read_items(workdir, templates)
    state = TrainState(jnp.int32(position.step), items["variables"], items["optimizer"])
    chex.assert_trees_all_equal_shapes_and_dtypes(state, template)
    return parallel.copy_to_devices(state), position


def load_latest(workdir: Path) -> TrainedNetwork:
    """The network of the latest checkpoint of a run.

    Raises `InputError` for a folder without a checkpoint, one whose arrays do not fit the run's
    config.yaml, and one with arrays that are not finite.
    """
    _refuse_missing(workdir)
    file = workdir / "config.yaml"
    config = configuration.validate(configuration.load(file), str(file))
    model = models.from_experiment(config, str(file))
    template = {"batch_stats": {}, **models.variable_shapes(model, config.data.input_samples)}
    if numbers := filter_numbers(config):
        template["filter"] = numbers
    position, items = _read_items(workdir, {"variables": template})
    variables = items["variables"]
    chex.assert_trees_all_equal_shapes_and_dtypes(variables, template)
    try:
        chex.assert_tree_all_finite(variables)
    except AssertionError:
        remedy = "evaluate another run, or train it again with a lower optim.learning_rate"
        problem = "holds parameters that are not finite"
        raise InputError(_folder(workdir), problem, remedy) from None
    variables = jax.tree.map(parallel.fresh_copy, variables)
    settings = trained_settings(config.filter, variables.pop("filter", {}))
    config = dataclasses.replace(config, filter=settings)
    return TrainedNetwork(config, model, variables, position.epoch, position.step, workdir)


def _folder(workdir: Path) -> Path:
    return workdir / "checkpoints" / "latest"


def _refuse_missing(workdir: Path) -> None:
    if not exists(workdir):
        remedy = "let gnio train finish its first epoch, or name another run"
        raise InputError(_folder(workdir), "holds no checkpoint", remedy)


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


def _read_items(workdir: Path, templates: dict[str, Any]) -> tuple[RunPosition, dict[str, Any]]:
    """The position of a checkpoint, and the items that these templates name.

    Raises `InputError` if there is no checkpoint, if it is damaged, or if its variables have other
    shapes.
    """
    _refuse_missing(workdir)
    where = _folder(workdir)
    damaged = f"the checkpoint is damaged: begin another run, with --init-from {workdir} from its"
    damaged += " best weights"
    with _manager(where, create=False) as manager:
        step = manager.latest_step()

        def restore_items(items: dict[str, Any]) -> Any:
            try:
                return manager.restore(step, args=ocp.args.Composite(**items))
            except (OSError, ValueError, KeyError, TypeError) as error:
                problem = f"cannot be read ({str(error)[:120]})"
                raise InputError(where / str(step), problem, damaged) from None

        meta = restore_items({"meta": ocp.args.JsonRestore()})["meta"]
        try:
            position, saved_shapes = RunPosition(**meta["position"]), dict(meta["shapes"])
            position = position._replace(plateau=Plateau(*position.plateau))
        except (KeyError, TypeError, ValueError):
            problem = "does not have the position of a run"
            raise InputError(where / str(step), problem, damaged) from None
        shapes = _shapes(templates["variables"])
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
    return position, trees


def _shapes(variables: Any) -> dict[str, list[int]]:
    leaves = jax.tree_util.tree_leaves_with_path(variables)
    names = {path: jax.tree_util.keystr(path, simple=True, separator="/") for path, _ in leaves}
    return {names[path]: list(leaf.shape) for path, leaf in leaves}
