"""The folder of a run: its settings, the recordings it is trained on, and its log."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import jax
import numpy as np
import yaml
from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto import event_pb2
from tensorboardX.summary import scalar

from gnio_jax import config as configuration
from gnio_jax import models, parallel
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.files import write_text
from gnio_jax.networks.folder import CONFIG, SPLITS, has_card, recordings_by_name
from gnio_jax.training.recordings import TrainingData
from gnio_jax.training.task import Row

# Made when the module is imported, so type checkers do not know them.
_Event, _SessionLog = (getattr(event_pb2, name) for name in ("Event", "SessionLog"))

LOG = "metrics.jsonl"
"""File of a run with a row of figures for each finished epoch."""


# Settings and recordings
# ------------------------------------------------------------------------------------------------


def refuse_other_run(config: TrainConfig, resume: bool) -> Path:
    """The work folder of a run that `config` may start or continue; nothing is written.

    Raises `InputError` for a folder that already holds a run, and with `resume` for one that holds
    none, or one with other settings. Of several processes only the first one checks this.
    """
    workdir = configuration.default_workdir(config)
    file = workdir / CONFIG
    if not parallel.is_first():
        return workdir
    if has_card(workdir):
        raise InputError(workdir, "holds a published network", "choose another --workdir")
    if not resume:
        if workdir.is_file():
            raise InputError(workdir, "is a file", "name a folder with --workdir")
        if file.exists():
            remedy = "continue it with --resume, or choose another --workdir"
            raise InputError(workdir, "already holds a run", remedy)
        return workdir
    if not file.exists():
        problem = "holds no run to resume (config.yaml is missing)"
        raise InputError(workdir, problem, "start it without --resume")
    # The path of the data may change, but not that of the weights to begin with: others would make
    # another run of one that has no checkpoint yet, and would have no effect on the others.
    ours, theirs = (
        configuration.flatten(configuration.without_paths(run))
        | {"init_from": run.init_from and _spelled_out(run.init_from)}
        for run in (config, configuration.load(file))
    )
    network = models.from_config(config.model)
    fitted = {f"model.options.{option}" for option in models.fitted_options(network)}
    for name in ours | theirs:
        if ours.get(name) != theirs.get(name) and not (name in fitted and ours.get(name) is None):
            problem = f"'{name}' was {theirs.get(name)} and is now {ours.get(name)}"
            raise InputError(file, problem, "resume with the same settings")
    return workdir


def _spelled_out(network: str) -> str:
    """The whole path of a folder; a name as it is."""
    return str(Path(network).resolve()) if Path(network).exists() else network


@contextmanager
def open_run(
    config: TrainConfig, data: TrainingData, variables: Any, resume: bool
) -> Iterator[Path]:
    """The work folder, with the config.yaml and splits.yaml of a new run. It is for one training at
    a time: the folder is locked until the context or the process ends.

    Raises `InputError` if another process trains in it, for a resumed run that was begun with other
    recordings, and as `compare_processes` does for the variables at step 0. Of several processes
    the first one writes.
    """
    compare_processes(config, data, variables)
    workdir = configuration.default_workdir(config)
    if not parallel.is_first():
        yield workdir
        return
    workdir.mkdir(parents=True, exist_ok=True)
    folder = os.open(workdir, os.O_RDONLY)
    try:
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            problem = "another process is training in it"
            raise InputError(workdir, problem, "choose another --workdir") from None
        refuse_other_run(config, resume)  # another run may have begun while the data were read
        if not resume:
            configuration.save(workdir / CONFIG, config)
        path = workdir / SPLITS
        if path.exists():
            _refuse_other_recordings(path, data.splits)
        else:
            write_splits(workdir, data.splits)
        yield workdir
    finally:
        os.close(folder)


def write_splits(workdir: Path, splits: dict[str, dict[str, int] | list[str]]) -> None:
    """Write the names of the recordings of a run (`TrainingData.splits`)."""
    text = yaml.safe_dump(splits, sort_keys=False, allow_unicode=True)
    write_text(workdir / SPLITS, text)


def _refuse_other_recordings(path: Path, splits: dict[str, dict[str, int] | list[str]]) -> None:
    """Refuse recordings other than those with which the run was begun. Hold-outs are drawn from the
    recordings of a copy of the data, which may differ between copies, and so may recordings with
    the same name."""
    try:
        before = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        problem = f"cannot be read ({' '.join(str(error).split())})"
        remedy = "remove it, and it is written again from the recordings"
        raise InputError(path, problem, remedy) from None
    before = before if isinstance(before, dict) else {}
    for split in splits | before:
        ours, theirs = (
            recordings_by_name(recordings.get(split)) for recordings in (splits, before)
        )
        if list(ours.items()) != list(theirs.items()):
            changed = sorted(
                name for name in ours | theirs if ours.get(name, -1) != theirs.get(name, -1)
            )
            what = f", e.g. {changed[0]}" if changed else ", their order does"
            problem = (
                f"the run was begun with other recordings in split '{split}' "
                f"({len(changed)} differ{what})"
            )
            raise InputError(path, problem, "resume with the same data")


def compare_processes(config: TrainConfig, data: TrainingData, variables: Any) -> None:
    """Raise `InputError` in every process unless all have the same settings, recordings and weights
    to begin with. Otherwise they would compute different results, or wait for each other without
    end.

    Trees of arrays are compared by their shapes and a sample of their rows.
    """
    if jax.process_count() == 1:
        return

    def sample_tree(tree: Any) -> list[Any]:
        leaves = [np.atleast_1d(leaf) for leaf in jax.tree.leaves(parallel.on_host(tree))]
        return [(leaf.shape, leaf[:: len(leaf) // 999 + 1].tobytes()) for leaf in leaves]

    settings = configuration.flatten(configuration.without_paths(config))
    for what, value, remedy in (
        ("settings", settings, "start all with the same options, also --config"),
        (
            "recordings",
            (data.splits, sample_tree(data[:2])),
            "give all of them the same data",
        ),
        ("weights to begin with", sample_tree(variables), "start all with the same --init-from"),
    ):
        digest = hashlib.sha256(repr(value).encode()).digest()
        number = int.from_bytes(digest[:4], "big") >> 1
        greatest, least = parallel.largest(number, -number)
        if greatest != -least:
            raise InputError("--distributed", f"the processes have different {what}", remedy)


# The log
# ------------------------------------------------------------------------------------------------


def read_rows(workdir: Path) -> list[Row]:
    """The rows of the log of a run, one for each finished epoch. A last line that was cut off is
    left out. Raises `InputError` for a log that cannot be read, and for another line that is no
    row."""
    path = workdir / LOG
    try:
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(path, f"cannot be read ({error})", "remove it") from None
    rows = []
    for number, line in enumerate(lines, 1):
        try:
            row = json.loads(line)
        except ValueError:
            if number == len(lines):
                break
            row = None
        if not (isinstance(row, dict) and type(row.get("epoch")) is int):
            raise InputError(path, f"line {number} is no row of figures", "remove this line")
        rows.append(row)
    return rows


def count_epochs(rows: Sequence[Row]) -> int:
    """The number of epochs until that of the last row."""
    return int(rows[-1]["epoch"]) + 1 if rows else 0


class Log:
    """A row of figures for each finished epoch, in metrics.jsonl and TensorBoard. A resumed run
    removes the rows after its checkpoint and writes them again. Of several processes the first one
    writes.

    tensorboardX's own SummaryWriter writes in a thread, which ends when the disk is full, and then
    the run would wait for it without end. So the events are written here, one by one.
    """

    def __init__(self, workdir: Path, epoch: int, step: int):
        self._path, self._board = workdir / LOG, workdir / "tensorboard"
        self._rows, self._events = [], None
        if parallel.is_first():
            self._rows = [row for row in read_rows(workdir) if row["epoch"] < epoch]
            self._board.mkdir(parents=True, exist_ok=True)
            self._events = EventsWriter(str(self._board / "events"))
            # Events of other files from this step on are invalid: those after the checkpoint.
            start = _SessionLog(status=_SessionLog.START)
            event = _Event(wall_time=time.time(), step=step + 1, session_log=start)
            self._events.write_event(event)

    @property
    def epochs(self) -> int:
        """The number of epochs until the last one of the log."""
        return count_epochs(self._rows)

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *_: object) -> None:
        if self._events is not None:
            with suppress(OSError):  # `add` has raised it, or a worse error is under way
                self._events.close()

    def add(self, row: Row) -> None:
        """Write the row of an epoch."""
        if self._events is None:
            return
        self._rows.append(row)
        write_text(self._path, "".join(json.dumps(row) + "\n" for row in self._rows))
        try:
            for name, value in row.items():
                event = _Event(wall_time=time.time(), step=row["step"], summary=scalar(name, value))
                self._events.write_event(event)
            self._events.flush()
        except OSError as error:
            error.filename = str(self._board)
            raise
