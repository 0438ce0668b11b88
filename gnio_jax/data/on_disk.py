"""Windows of recordings that are larger than memory: arrays that lie on the disk."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import IO, Any

import numpy as np

from gnio_jax.data.windows import WindowSource


def source_on_disk(parts: Iterable[WindowSource], folder: Path) -> WindowSource:
    """The windows of `parts`, one part for each recording, as `data.windows.joined` gives them, but
    with arrays that are mapped from files. One part is in memory at a time.

    The files have no name in `folder`: the system removes them when this process ends, however it
    ends. Raises `OSError` where the disk is full.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = [tempfile.TemporaryFile(dir=folder) for _ in WindowSource._fields]
    rows = windows = 0
    arrays: list[np.ndarray] = []
    try:
        for part in parts:
            part = part.moved(rows, windows)
            arrays = [np.ascontiguousarray(field) for field in part]
            for file, array in zip(files, arrays, strict=True):
                file.write(array.data)
            rows += len(part.imu)
            windows += len(part.start)
        return WindowSource(*(_mapped(f, a) for f, a in zip(files, arrays, strict=True)))
    except OSError as error:
        error.filename = error.filename or str(folder)
        raise
    finally:
        for file in files:
            file.close()  # what is mapped stays


def _mapped(file: IO[bytes], like: np.ndarray) -> Any:
    """The file as rows like those of `like`, read when they are looked at."""
    file.flush()
    size = like[:1].nbytes
    return np.memmap(file, like.dtype, "r", shape=(file.tell() // size, *like.shape[1:]))


def bytes_of(source: WindowSource) -> int:
    """What the arrays of a source take."""
    return sum(field.nbytes for field in source)
