"""The log of a run: a row of figures for each epoch in metrics.jsonl and TensorBoard."""

from __future__ import annotations

import json
import time
from pathlib import Path

from tensorboardX.event_file_writer import EventsWriter
from tensorboardX.proto import event_pb2
from tensorboardX.summary import scalar

from gnio_jax.files import write_text
from gnio_jax.scaling.processes import is_first

Row = dict[str, int | float]

# Made when the module is imported, so type checkers do not know them.
_Event, _SessionLog = (getattr(event_pb2, name) for name in ("Event", "SessionLog"))


class Log:
    """Rows of the finished epochs. A resumed run drops those after its checkpoint and writes them
    again. Of several processes the first one writes them."""

    def __init__(self, workdir: Path, epoch: int, step: int):
        self._path = workdir / "metrics.jsonl"
        self._rows, self._board = [], None
        if is_first():
            self._rows = _rows_before(self._path, epoch)
            self._board = _Board(workdir / "tensorboard", step)

    def __enter__(self) -> Log:
        return self

    def __exit__(self, *_: object) -> None:
        if self._board is not None:
            self._board.close()

    def add(self, row: Row) -> None:
        """Write the row of an epoch."""
        if self._board is None:
            return
        self._rows.append(row)
        write_text(self._path, "".join(json.dumps(row) + "\n" for row in self._rows))
        self._board.add(row)


class _Board:
    """A TensorBoard event file, written row by row.

    tensorboardX's own SummaryWriter writes in a thread, which dies where the disk is full; then
    the run would wait for it for ever.
    """

    def __init__(self, folder: Path, step: int):
        """Rows from `step` on that other files of the folder hold are void."""
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._file = EventsWriter(str(folder / "events"))
        start = _SessionLog(status=_SessionLog.START)
        self._file.write_event(_Event(wall_time=time.time(), step=step, session_log=start))

    def add(self, row: Row) -> None:
        try:
            for name, value in row.items():
                event = _Event(wall_time=time.time(), step=row["step"], summary=scalar(name, value))
                self._file.write_event(event)
            self._file.flush()
        except OSError as error:
            error.filename = str(self._folder)
            raise

    def close(self) -> None:
        try:
            self._file.close()
        except OSError:
            pass  # `add` has said it, or something worse has


def _rows_before(path: Path, epoch: int) -> list[Row]:
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [row for row in map(json.loads, lines) if row["epoch"] < epoch]
