"""Checkpoints of a run: `checkpoints/latest` to resume from, `checkpoints/best` to evaluate.

The only importer of Orbax.

Orbax writes a checkpoint into a temporary folder and renames it, so a killed process leaves the
previous one whole.
"""

from __future__ import annotations

import dataclasses
import errno
import json
import logging
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import orbax.checkpoint as ocp
from flax import linen as nn
from orbax.checkpoint.options import MultiprocessingOptions

from gnio_jax import config as configuration
from gnio_jax import models
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.scaling import devices
from gnio_jax.scaling.processes import all_or_none, from_first, is_first, several, text_from_first
from gnio_jax.training import learnt as learning
from gnio_jax.training.optimizer import Plateau
from gnio_jax.training.step import TrainState, evaluated

Which = Literal["best", "latest"]
ARRAYS = ("variables", "optimizer", "training")
"""The items of a checkpoint that are trees of arrays."""
METADATA = 2**17
"""Bytes that a checkpoint takes besides its arrays, at most."""

# Orbax logs every save there, and each of its failures before it raises them.
logging.getLogger("absl").setLevel(logging.CRITICAL)
# Parts of a save that failed after the first failure, which is raised.
logging.getLogger("asyncio").addFilter(lambda record: "orbax" not in record.getMessage())


class Position(NamedTuple):
    """Where a run stands besides its `TrainState`: kept as JSON with the checkpoint."""

    epoch: int
    """Epoch in progress, or finished if `step` is a multiple of the steps per epoch."""
    step: int
    best_loss: float | None
    """Smallest value on the validation split, since the last switch of what is trained, of what
    `optim.best_by` names."""
    loss_sums: tuple[float, ...]
    """Training losses summed over the steps of the epoch in progress; none before the first."""
    seconds: float
    """Time spent training so far."""
    plateau: Plateau = Plateau()
    gradient_norms: dict[str, float] = {}
    """Norms of the gradient by part of the network, summed over the steps of the epoch in progress.
    """


class Run(NamedTuple):
    """A trained network as evaluation needs it."""

    config: TrainConfig
    """Its section `filter` has the values that have learnt."""
    model: nn.Module
    variables: Any
    epoch: int
    step: int
    filter: dict[str, Any] = {}
    """Options of the filter as they learn (`learnt.filter_numbers`), if they do."""


def create_model(config: TrainConfig) -> nn.Module:
    """The network that `config.model` describes; what that leaves open is the network's own."""
    options = {
        key: value
        for key, value in vars(config.model).items()
        if key != "name" and value is not None
    }
    return models.create(config.model.name, **options)


def exists(workdir: Path, which: Which = "latest") -> bool:
    """Whether `workdir` holds a finished checkpoint."""
    folder = workdir / "checkpoints" / which
    return folder.is_dir() and any(child.name.isdigit() for child in folder.iterdir())


class Checkpoints:
    """The two series of a run; a context manager, because Orbax keeps threads that want closing.

    Of several processes, all of which have the same state, the first one alone writes and reads;
    `save` and `restore` are for all of them to call.
    """

    def __init__(self, workdir: Path):
        self._workdir = workdir
        self._managers: dict[Which, ocp.CheckpointManager] = {}
        with all_or_none():
            for which in ("latest", "best") if is_first() else ():
                self._managers[which] = _manager(workdir / "checkpoints" / which, create=True)

    def __enter__(self) -> Checkpoints:
        return self

    def __exit__(self, *_: object) -> None:
        for manager in self._managers.values():
            manager.close()

    def save(self, which: Which, state: TrainState, position: Position) -> None:
        """Write a checkpoint at `position.step`; one that is already there for this step is the
        same and stays.

        Its variables are those that are evaluated. Where they are averages, `latest` also holds the
        parameters that training goes on with. Arrays are written from the host's memory: a
        checkpoint does not know on which devices they lay, and fits any. Raises `OSError` naming
        the folder where it cannot be written; the checkpoint before stays.
        """
        with all_or_none():
            if is_first():
                self._save(self._managers[which], which, jax.device_get(state), position)

    def _save(
        self, manager: ocp.CheckpointManager, which: Which, state: TrainState, position: Position
    ) -> None:
        if position.step in manager.all_steps():
            return
        items = _evaluated_items(state, position)
        if which == "latest":
            items["optimizer"] = ocp.args.StandardSave(state.opt_state)
            if state.average is not None:
                items["training"] = ocp.args.StandardSave(state.params)
        folder = self._workdir / "checkpoints" / which
        with _disk_errors_named(folder):
            _require_room(folder, sum(leaf.nbytes for leaf in jax.tree.leaves(state)))
            manager.save(position.step, args=ocp.args.Composite(**items))

    def restore(self, template: TrainState) -> tuple[TrainState, Position]:
        """The latest state, in the structure of `template`, as `devices.everywhere` places it.

        Raises `InputError` if it does not fit.
        """
        template, meta = jax.device_get(template), "{}"
        with all_or_none():
            if is_first():
                template, meta = self._restored(template)
        # The others have the template's shapes, and now the first one's values.
        state = devices.everywhere(from_first(template))
        return state, _position(json.loads(text_from_first(meta)))

    def _restored(self, template: TrainState) -> tuple[TrainState, str]:
        """The latest state, and its position as JSON."""
        manager = self._managers["latest"]
        step = manager.latest_step()
        where = self._workdir / "checkpoints" / "latest"
        if step is None:
            raise InputError(where, "holds no checkpoint", "start the run without --resume")
        wanted = {"variables": evaluated(template).variables, "optimizer": template.opt_state}
        if template.average is not None:
            wanted["training"] = template.params
        meta = _checked_meta(manager, step, wanted["variables"], where)
        restored = _read_arrays(manager, step, wanted, where)
        state = TrainState.of(jnp.int32(step), restored["variables"], restored["optimizer"])
        if template.average is not None:
            state = state._replace(params=restored["training"], average=state.params)
        return state, json.dumps(meta["position"])


def write_best(workdir: Path, run: Run) -> None:
    """A checkpoint `best` with the variables of a run, and the filter of its config where one has
    learnt."""
    learns = bool(run.config.through_filter.learn)
    numbers = learning.filter_numbers(run.config.filter) if learns else {}
    network = (run.variables[name] for name in ("params", "batch_stats"))
    state = TrainState(jnp.int32(run.step), *network, opt_state={}, filter=numbers)
    position = Position(run.epoch, run.step, best_loss=None, loss_sums=(), seconds=0.0)
    with _manager(workdir / "checkpoints" / "best", create=True) as manager:
        manager.save(run.step, args=ocp.args.Composite(**_evaluated_items(state, position)))


def load_run(workdir: Path | str, which: Which = "best") -> Run:
    """The network of a run with its trained variables.

    Raises `InputError` for a folder without a run or checkpoint, or one whose arrays do not fit the
    run's config.yaml.
    """
    workdir = Path(workdir)
    if not (workdir / "config.yaml").is_file():
        raise InputError(
            workdir,
            "holds no run (config.yaml is missing)",
            "train one with gnio train --workdir ...",
        )
    config = configuration.validate(
        configuration.load(workdir / "config.yaml"), str(workdir / "config.yaml")
    )
    where = workdir / "checkpoints" / which
    if not exists(workdir, which):
        raise InputError(
            where,
            "holds no checkpoint",
            "let gnio train finish its first epoch, or name another run",
        )
    model = create_model(config)
    template = models.variable_shapes(model, config.data.seen)
    template = {"params": template["params"], "batch_stats": template.get("batch_stats", {})}
    if config.through_filter.learn:
        template["filter"] = learning.filter_numbers(config.filter)
    with _manager(where, create=False) as manager:
        step = manager.latest_step()
        meta = _checked_meta(manager, step, template, where)
        variables = _read_arrays(manager, step, {"variables": template}, where)["variables"]
    variables = uncommitted(variables)
    numbers = variables.pop("filter", {})
    options = learning.learnt_options(config.filter, numbers)
    config = dataclasses.replace(config, filter=options)
    return Run(config, model, variables, meta["position"]["epoch"], step, numbers)


def averaged_over_headings(run: Run, source: str) -> Run:
    """The run with its network averaged over four headings (`models.equivariance.FourHeadings`),
    which has the same weights. Raises `InputError` naming `source` for a network that did not learn
    from every heading, or is equivariant in another way."""
    if run.config.model.equivariance == "canonical_frame":
        raise InputError(source, "its network has a canonical frame: there is nothing to average")
    averaged = dataclasses.replace(run.config.model, equivariance="four_headings")
    config = dataclasses.replace(run.config, model=averaged)
    configuration.validate(config, source)
    return run._replace(config=config, model=create_model(config))


def _evaluated_items(state: TrainState, position: Position) -> dict[str, Any]:
    """What every checkpoint holds."""
    variables = evaluated(state).variables
    meta = {"position": position._asdict(), "shapes": _shapes(variables)}
    return {"variables": ocp.args.StandardSave(variables), "meta": ocp.args.JsonSave(meta)}


def _manager(folder: Path, create: bool) -> ocp.CheckpointManager:
    options = ocp.CheckpointManagerOptions(
        max_to_keep=1,
        enable_async_checkpointing=False,
        create=create,
        cleanup_tmp_directories=create,  # what a killed process has left
    )
    if not several():
        return ocp.CheckpointManager(folder.absolute(), options=options)
    if create:
        folder.mkdir(parents=True, exist_ok=True)
    own = jax.process_index()
    alone = MultiprocessingOptions(own, {own}, barrier_sync_key_prefix=f"process{own}")
    options = dataclasses.replace(options, create=False, multiprocessing_options=alone)
    return ocp.CheckpointManager(
        folder.absolute(), options=options, handler_registry=_handlers(alone)
    )


def _read_arrays(
    manager: ocp.CheckpointManager, step: int, templates: dict[str, Any], where: Path
) -> Any:
    """The items of a checkpoint that these templates name. Raises `InputError` for damaged ones."""
    items = {name: ocp.args.StandardRestore(tree) for name, tree in templates.items()}
    try:
        return manager.restore(step, args=ocp.args.Composite(**items))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _damaged(where / str(step), error) from None


def _damaged(checkpoint: Path, error: Exception) -> InputError:
    problem = f"cannot be read ({str(error)[:120]})"
    return InputError(checkpoint, problem, "the checkpoint is damaged")


def _require_room(folder: Path, size: int) -> None:
    """Raise `OSError` where the disk has no room for arrays of `size` bytes.

    Orbax raises it, too, but only after the tracebacks of many threads.
    """
    if shutil.disk_usage(folder).free < size + METADATA:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@contextmanager
def _disk_errors_named(folder: Path) -> Iterator[None]:
    """What the disk refuses is an `OSError` with the folder's name, also where Orbax raises
    `ValueError` for it."""
    try:
        yield
    except OSError as error:
        error.filename = error.filename or str(folder)
        raise
    except ValueError as error:
        code = re.search(r"os_error_code='(\d+)'", str(error))
        if code is None:
            raise
        number = int(code[1])
        raise OSError(number, os.strerror(number), str(folder)) from None


def _handlers(alone: MultiprocessingOptions) -> Any:
    """What writes and reads the items of a checkpoint in one process of several."""
    handlers = ocp.handlers.DefaultCheckpointHandlerRegistry()
    for name in ARRAYS:
        arrays = _WrittenByOne(multiprocessing_options=alone, use_ocdbt=False)
        for arguments in (ocp.args.StandardSave, ocp.args.StandardRestore):
            handlers.add(name, arguments, arrays)
    meta = ocp.JsonCheckpointHandler(multiprocessing_options=alone)
    for arguments in (ocp.args.JsonSave, ocp.args.JsonRestore):
        handlers.add("meta", arguments, meta)
    return handlers


class _WrittenByOne(ocp.StandardCheckpointHandler):
    """Arrays that one process of several writes or reads, without waiting for the others in Orbax:
    one that fails must not keep them."""

    def finalize(self, directory: Any) -> None:
        """Nothing: there is no share of another process to merge, nor to compare with."""


def uncommitted(tree: Any) -> Any:
    """Plain copies of arrays that are committed to a device, or to several: one compiled step for
    both."""
    return jax.tree.map(devices.fresh_copy, tree)


def _position(found: dict[str, Any]) -> Position:
    """A position as JSON keeps it; older checkpoints have no plateau."""
    tuples = {
        "loss_sums": tuple(found["loss_sums"]),
        "plateau": Plateau(*found.get("plateau", ())),
    }
    return Position(**(found | tuples))


def _shapes(variables: Any) -> dict[str, list[int]]:
    leaves = jax.tree_util.tree_leaves_with_path(variables)
    names = {path: jax.tree_util.keystr(path, simple=True, separator="/") for path, _ in leaves}
    return {names[path]: list(leaf.shape) for path, leaf in leaves}


def _checked_meta(
    manager: ocp.CheckpointManager, step: int, variables: Any, where: Path
) -> dict[str, Any]:
    try:
        meta = manager.restore(step, args=ocp.args.Composite(meta=ocp.args.JsonRestore()))["meta"]
        found = meta["shapes"]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise _damaged(where / str(step), error) from None
    wanted = _shapes(variables)
    for name in sorted(wanted.keys() | found.keys()):
        if wanted.get(name) != found.get(name):
            problem = (
                f"'{name}' has shape {found.get(name)} in the checkpoint "
                f"and {wanted.get(name)} in the configured model"
            )
            remedy = "model.width and the other model fields must be those of the run"
            raise InputError(where, problem, remedy)
    return meta
