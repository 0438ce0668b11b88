"""`gnio data`: list, check and convert datasets."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from gnio_jax.commands import console, options
from gnio_jax.commands.names import check_names
from gnio_jax.config.schema import UNNAMED, Folder, NewFile, Rate
from gnio_jax.errors import InputError
from gnio_jax.files import write_text


@dataclass(frozen=True)
class ListOptions:
    """`gnio data list` has no options."""


@dataclass(frozen=True, kw_only=True)
class _Dataset:
    name: Annotated[str, UNNAMED]
    """Name of the dataset, csv for recordings of your own."""
    data_root: str | None = None
    """Folder of the dataset; by default $GNIO_DATA/NAME, then data/NAME."""
    split: str = "all"
    """A split, or all of them."""


@dataclass(frozen=True, kw_only=True)
class CheckOptions(_Dataset):
    plots: Folder | None = None
    """Folder for a picture of each recording: trajectory, speed, |accel|, gyro against reference,
    and the times at which it is not valid."""
    json: NewFile | None = None
    """File for the figures."""


@dataclass(frozen=True, kw_only=True)
class ConvertOptions(_Dataset):
    out: Annotated[Path, UNNAMED]
    """Folder for the result."""
    rate: Rate | None = None
    """Rate of the result, Hz; by default each recording's own."""


def show_list(request: ListOptions, _call: options.Call) -> None:
    """List every known dataset: rate, splits, licence, source, and what is found here.

    A dataset is looked for in $GNIO_DATA/NAME, then in data/NAME. Its recordings are not read.

    examples:
      {prog}
      GNIO_DATA=~/recordings {prog}
    """
    from gnio_jax import data  # late: mistakes do not wait for JAX

    rows = []
    for dataset in map(data.get, data.names()):
        splits = ", ".join(dataset.splits)
        rows += [
            (dataset.name, f"{dataset.rate:g} Hz; splits {splits}; {dataset.licence}"),
            ("  here", _describe_root(dataset)),
            ("  source", dataset.source),
            *([("  layout", dataset.layout)] if dataset.needs_root else []),
        ]
    console.say(console.pairs(rows))
    bases = [os.environ["GNIO_DATA"]] if os.environ.get("GNIO_DATA") else []
    other = "--data-root names another folder, and GNIO_DATA the parent of all folders"
    console.say(f"looked in {' and '.join([*bases, 'data'])}; {other}")


def _describe_root(dataset: Any) -> str:
    """The folder of a `Dataset`, and the recordings of each split."""
    from gnio_jax.data.conversion import find_recordings

    try:
        _, root = _find(dataset.name, None)
    except InputError:
        return "not found"
    prefix = f"{root}: " if dataset.needs_root else "computed: "
    try:
        recordings, splits, _ = find_recordings(dataset, root, "all")
    except InputError as error:
        return f"{prefix}no recording ({error})"
    counts = ", ".join(f"{split} {len(names)}" for split, names in splits.items())
    return f"{prefix}{len(recordings)} recordings ({counts})"


def check(request: CheckOptions, _call: options.Call) -> None:
    """Check whether IMU and reference of each recording describe the same motion.

    The mean of R·accel must be gravity, and the gyro must turn as the reference does. A walker's
    median speed must be at most 3 m/s, and the accelerations of the positions must agree with the
    accelerometer's. Every loader leaves out a recording that fails; here it is shown with its
    figures and the reason.

    examples:
      {prog} oxiod                                        in $GNIO_DATA/oxiod, else data/oxiod
      {prog} tlio --data-root ~/tlio --split test
      {prog} csv --data-root ~/walks --plots pictures --json figures.json
    """
    dataset, root = _find(request.name, request.data_root)
    from gnio_jax.data import conversion  # late: mistakes do not wait for JAX

    with console.terminal() as terminal:
        progress = partial(terminal.progress, "checking")
        rows, notes = conversion.check(dataset, root, request.split, request.plots, None, progress)
    location = f" at {root}" if dataset.needs_root else ""
    title = f"{dataset.name}{location}, split {request.split}"
    table = console.columns("sequence", "split", title=title, title_justify="left")
    for column in (*_FIGURES, ""):
        table.add_column(column, justify="right", no_wrap=True)
    for row in rows:
        cells = (figure(row.check) if row.check else "–" for figure in _FIGURES.values())
        state, style = ("left out", "red") if row.reason else ("used", None)
        table.add_row(row.name, ", ".join(row.splits), *cells, state, style=style)
    console.say(table)
    _print_reasons({row.name: row.reason for row in rows if row.reason}, notes)
    used, count = [row for row in rows if not row.reason], len(rows)
    hours = sum(row.check.duration for row in used if row.check) / 3600
    console.say(f"{len(used)} of {count} sequences are used, {hours:.2f} h")
    if request.json:
        content = {
            "dataset": dataset.name,
            "root": str(root) if dataset.needs_root else None,
            "split": request.split,
            "sequences": {row.name: _json(row) for row in rows},
            "notes": notes,
        }
        write_text(request.json, json.dumps(content, indent=2, ensure_ascii=False) + "\n")
    if request.plots:
        console.say(f"pictures: {request.plots}")
    if not used:
        raise InputError(root, f"none of {count} sequences can be used", "see the reasons above")


def _two_digits(*values: float) -> str:
    if any(map(math.isnan, values)):
        return "–"
    return " ".join(f"{round(value, 2) + 0.0:.2f}" for value in values)  # no −0.00


_FIGURES: dict[str, Callable[[Any], str]] = {
    "s": lambda figures: f"{figures.duration:.1f}",
    "Hz": lambda figures: f"{figures.rate:.1f}",
    "mean of R·accel\nm/s²": lambda figures: _two_digits(*figures.gravity_mean),
    "gyro\n°/10 s": lambda figures: _two_digits(figures.gyro_consistency_degrees),
    "speed\nm/s": lambda figures: _two_digits(figures.median_speed),
    "accel\ncorr.": lambda figures: _two_digits(figures.accel_correlation_horizontal),
    "valid": lambda figures: (
        "–" if math.isnan(figures.share_valid) else f"{figures.share_valid:.1%}"
    ),
}
"""Columns of a `SelfCheck`."""


def _json(row: Any) -> dict[str, Any]:
    """A `conversion.CheckResult` for a JSON file, which has no arrays and no NaN."""

    def plain(value: Any) -> Any:
        if isinstance(value, Iterable) and not isinstance(value, str):
            return [plain(entry) for entry in value]
        return None if isinstance(value, float) and math.isnan(value) else value

    figures = row.check._asdict() if row.check else {}
    state = {"split": ", ".join(row.splits), "used": not row.reason, "reason": row.reason}
    return state | {name: plain(value) for name, value in figures.items()}


def convert(request: ConvertOptions, _call: options.Call) -> None:
    """Convert a dataset to the package's HDF5: a file per recording, a list per split.

    Recordings that fail the self-check are left out. The folder is written whole or not at all: a
    conversion that was stopped leaves nothing, and the same command starts again.

    examples:
      {prog} oxiod ~/converted/oxiod
      {prog} tlio ~/converted/tlio_100 --data-root ~/tlio --rate 100
      gnio train --dataset csv --data-root ~/converted/oxiod
    """
    dataset, root = _find(request.name, request.data_root)
    from gnio_jax.data import conversion  # late: mistakes do not wait for JAX

    with console.terminal() as terminal:
        progress = partial(terminal.progress, "converting")
        result = conversion.convert(
            dataset, root, request.out, request.split, request.rate, None, progress
        )
    _print_reasons(result.left_out, result.notes)
    counts = ", ".join(f"{split} {len(stems)}" for split, stems in result.sequences.items())
    console.say(f"{request.out}: {result.files} sequences, {result.hours:.2f} h ({counts})")
    learnable = {"train", "val"} <= result.sequences.keys()
    following = "gnio train --dataset csv" if learnable else "gnio data check csv"
    console.say(f"next: {following} --data-root {request.out}")


def _find(name: str, data_root: str | None) -> tuple[Any, Path]:
    """A dataset and its folder."""
    check_names(datasets=[name])
    from gnio_jax import data

    dataset = data.get(name)
    return dataset, data.find_root(name, data_root) if dataset.needs_root else Path(".")


def _print_reasons(left_out: dict[str, str], notes: list[str]) -> None:
    for name, reason in left_out.items():
        console.say(f"left out: {name}: {reason}")
    for note in dict.fromkeys(notes):
        console.say(f"note: {note}")
