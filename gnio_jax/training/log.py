"""The log of a run: a row of figures for each epoch in metrics.jsonl and TensorBoard."""

from __future__ import annotations

import json
from pathlib import Path

from tensorboardX import SummaryWriter

from gnio_jax.files import write_text
from gnio_jax.scaling.processes import is_first

Row = dict[str, int | float]


class Log:
    """Rows of the finished epochs. A resumed run drops those after its checkpoint and writes them
    again. Of several processes the first one writes them."""

    def __init__(self, workdir: Path, epoch: int, step: int):
        self._path = workdir / "metrics.jsonl"
        self._rows, self._board = [], None
        if is_first():
            self._rows = _rows_before(self._path, epoch)
            self._board = SummaryWriter(str(workdir / "tensorboard"), purge_step=step)

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
        for name, value in row.items():
            self._board.add_scalar(name, value, row["step"])


def _rows_before(path: Path, epoch: int) -> list[Row]:
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    return [row for row in map(json.loads, lines) if row["epoch"] < epoch]
