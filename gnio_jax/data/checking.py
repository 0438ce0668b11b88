"""The self-check of a whole dataset: figures of each recording, the reasons, pictures."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from gnio_jax.data.dataset import Dataset, Recording
from gnio_jax.data.plausibility import SelfCheck
from gnio_jax.data.processes import map_in_processes, suggested_workers
from gnio_jax.data.reading import check_recording, find_recordings
from gnio_jax.files import file_stem
from gnio_jax.types import Sequence


class CheckedSequence(NamedTuple):
    """The self-check of one sequence."""

    name: str
    split: str
    """The splits that it is in, separated by commas."""
    check: SelfCheck | None
    """None where it could not be read."""
    reason: str
    """Why it is left out; empty where it is used."""


class Checked(NamedTuple):
    """The self-check of a dataset."""

    sequences: list[CheckedSequence]
    notes: list[str]
    """Warnings of the readers, and what could not be found."""

    def used(self) -> list[CheckedSequence]:
        """The sequences that pass."""
        return [sequence for sequence in self.sequences if not sequence.reason]


def check(
    dataset: Dataset,
    root: Path,
    split: str = "all",
    pictures: Path | None = None,
    workers: int | None = 1,
    progress: Callable[[float], None] = lambda share: None,
) -> Checked:
    """Read every recording of a split (or of all) and check it.

    `pictures` is a folder for a picture of each. `workers` processes share the work (None: as
    many as are worth starting), and `progress` is told the share that is done.
    """
    found, splits, notes = find_recordings(dataset, root, split)
    items = [(recording, dataset, pictures) for recording in found.values()]
    count = workers or suggested_workers(len(items))
    results = list(map_in_processes(_figures_of, items, count, progress))
    rows = []
    for name, (checks, problem, warned) in zip(found, results, strict=True):
        own = _splits_of(name, splits)
        rows += [
            CheckedSequence(sequence, own, figures, "; ".join(figures.failures))
            for sequence, figures in checks
        ]
        if problem:
            rows.append(CheckedSequence(name, own, None, problem))
        notes += [note for note in warned if note not in notes]
    return Checked(rows, notes)


def _figures_of(
    recording: Recording, dataset: Dataset, pictures: Path | None
) -> tuple[list[tuple[str, SelfCheck]], str, tuple[str, ...]]:
    """The figures of one recording, why there are none, and the notes; without the sequences, which
    are large."""
    found = check_recording(recording, dataset)
    if pictures is not None and found.sequences:
        from gnio_jax.data import pictures as draw  # Matplotlib takes a second to import

        for sequence, figures in found.sequences:
            path = pictures / f"{file_stem(sequence.name)}.png"
            draw.save(path, draw.overview(sequence, figures))
    figures = [(sequence.name, figures) for sequence, figures in found.sequences]
    return figures, found.problem, found.notes


def _splits_of(name: str, splits: dict[str, tuple[str, ...]]) -> str:
    """The splits a recording is in; the split "all" is named where there is no other."""
    own = [split for split, names in splits.items() if name in names]
    return ", ".join(split for split in own if split != "all" or len(own) == 1)


def figures(checked: Checked) -> dict[str, Any]:
    """The figures by sequence, for a JSON file."""
    return {
        row.name: {
            "split": row.split,
            "used": not row.reason,
            "reason": row.reason,
            **{
                key: _plain(value)
                for key, value in (row.check._asdict() if row.check else {}).items()
            },
        }
        for row in checked.sequences
    }


def _plain(value: Any) -> Any:
    """A value of JSON, which knows no array and no NaN."""
    if isinstance(value, np.ndarray | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float) and math.isnan(value):
        return None
    return value.item() if isinstance(value, np.generic) else value


def impressions(sequence: Sequence) -> list[str]:
    """What a person can compare with what was recorded: length, strength, rest."""
    time = sequence.time
    step = float(np.median(np.diff(time)))
    accel, gyro = (np.linalg.norm(field, axis=1) for field in (sequence.accel, sequence.gyro))
    pull = f"{np.median(accel):.2f} m/s² in the median, {accel.min():.2f} to {accel.max():.2f}"
    lines = [
        f"{time[-1] - time[0]:.1f} s at {1.0 / step:.4g} Hz",
        f"|accel| {pull}",
        f"|gyro| {np.median(gyro):.2f} rad/s in the median, up to {gyro.max():.2f}",
    ]
    span = max(round(0.5 / step), 1)
    count = len(accel) // span
    if count:
        accel, gyro = (norm[: count * span].reshape(count, span) for norm in (accel, gyro))
        still = (accel.std(axis=1) < 0.2) & (gyro.mean(axis=1) < 0.1)
        lines.append(f"it rests {still.mean():.0%} of the time")
    return lines
