"""`gnio data`: the datasets, whether they are sound, and how they come into one form."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence as Arguments
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from gnio_jax.commands import console, data_export, data_import
from gnio_jax.commands.options import Command, Group, execute, sibling
from gnio_jax.errors import InputError
from gnio_jax.files import write_text

OVERVIEW = """The datasets: what there is, whether it is sound, and how it comes into one form.

{prog} COMMAND --help explains each command with examples."""

LIST = """Every dataset that is read: splits, rate, licence, where it is had, what is found here.

  {prog}
  GNIO_DATA=~/recordings {prog}

Looked for in $GNIO_DATA/<name>, else in data/<name>. Only lists are read."""

CHECK = """Do IMU and reference of each recording describe the same motion? A table and the reasons.

  {prog} oxiod                                        (in $GNIO_DATA/oxiod, else data/oxiod)
  {prog} ~/tlio --dataset tlio --split test
  {prog} ~/my_recordings --dataset csv --plots pictures --json figures.json

The physical self-check: the mean of R·accel must be gravity, the gyro must turn as the reference
does, nobody walks faster than 3 m/s, and the positions must accelerate as the accelerometer says.
Every loader leaves out a recording that fails; here it is shown with its figures and the reason."""

CONVERT = """Any dataset as the package's HDF5, with its splits: one file a recording, at one rate.

  {prog} oxiod ~/oxiod ~/converted/oxiod
  {prog} tlio ~/tlio ~/converted/tlio_100 --rate 100 --workers 8
  gnio train --dataset csv --data-root ~/converted/oxiod

What fails the self-check is left out. Stop it when you like: the same command goes on where it was.
ROOT - stands for the usual place, $GNIO_DATA/<name>, else data/<name>."""


@dataclass(frozen=True)
class ListOptions:
    """What `gnio data list` is asked for."""


@dataclass(frozen=True)
class CheckOptions:
    """What `gnio data check` is asked for."""

    dataset_or_root: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="DATASET_OR_ROOT")]]
    """Name of a dataset, which is then looked for in the usual place; or its folder."""
    dataset: str | None = None
    """Dataset whose layout the folder has; by default the one that finds its recordings there."""
    split: str = "all"
    """A split, or all of them."""
    plots: Path | None = None
    """Folder for a picture of each recording: trajectory, speed, |accel|, gyro against reference,
    where it is not valid."""
    json: Path | None = None
    """File for the figures."""
    markdown: Path | None = None
    """File for the table as Markdown."""
    workers: int | None = None
    """Processes; by default as many as there are cores, and one for a few recordings."""


@dataclass(frozen=True)
class ConvertOptions:
    """What `gnio data convert` is asked for."""

    dataset: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="DATASET")]]
    """Name of the dataset."""
    root: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="ROOT")]]
    """Its folder; - for the usual place."""
    out: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUT")]]
    """Folder for the result."""
    split: str = "all"
    """A split, or all of them."""
    rate: float | None = None
    """Rate of the result, Hz; by default each recording's own."""
    workers: int | None = None
    """Processes; by default as many as there are cores, and one for a few recordings."""


def show_list(_options: ListOptions, _prog: str) -> None:
    """Two tables: what there is and what of it is here, and where it is had."""
    from gnio_jax.commands import data_tables

    output = console.stdout()
    for table in data_tables.datasets():
        output.print(table)
    bases = [os.environ["GNIO_DATA"]] if os.environ.get("GNIO_DATA") else []
    places = " and ".join([*bases, "data"])
    other = "another place is named by --data-root, or GNIO_DATA for all of them"
    output.print(f"looked in {places}; {other}")


def check(options: CheckOptions, _prog: str) -> None:
    """The table, the reasons and notes, and on request pictures, JSON and Markdown."""
    from gnio_jax.commands import data_tables
    from gnio_jax.data import checking

    _refuse_check_options(options)
    dataset, root = checking.resolve(options.dataset_or_root, options.dataset)
    with console.terminal() as terminal:
        checked = checking.check(
            dataset,
            root,
            options.split,
            options.plots,
            options.workers,
            lambda share: terminal.progress("checking", share),
        )
    place = f" at {root}" if dataset.needs_root else ""
    title = f"{dataset.name}{place}, split {options.split}"
    output = console.stdout()
    output.print(data_tables.check_table(checked.sequences, title))
    _print_reasons({row.name: row.reason for row in checked.sequences if row.reason}, checked.notes)
    used, count = checked.used(), len(checked.sequences)
    hours = sum(row.check.duration for row in used if row.check) / 3600
    output.print(f"{len(used)} of {count} sequences are used, {hours:.2f} h")
    if options.json:
        found = {
            "dataset": dataset.name,
            "root": str(root) if dataset.needs_root else None,
            "split": options.split,
            "sequences": checking.figures(checked),
            "notes": checked.notes,
        }
        write_text(options.json, json.dumps(found, indent=2, ensure_ascii=False) + "\n")
    if options.markdown:
        write_text(options.markdown, data_tables.check_markdown(checked.sequences))
    if options.plots:
        output.print(f"pictures: {options.plots}", soft_wrap=True)
    if not used:
        raise InputError(root, f"none of {count} sequences can be used", "see the reasons above")


def _refuse_check_options(options: CheckOptions) -> None:
    _refuse_workers(options.workers)
    for option, path in (("--json", options.json), ("--markdown", options.markdown)):
        if path is not None and path.is_dir():
            raise InputError(option, f"{path} is a folder", "name a file")
    if options.plots is not None and options.plots.exists() and not options.plots.is_dir():
        raise InputError("--plots", f"{options.plots} is a file", "name a folder")


def _refuse_workers(workers: int | None) -> None:
    if workers is not None and workers < 1:
        raise InputError("--workers", f"must be at least 1, found {workers}")


def _print_reasons(left_out: dict[str, str], notes: list[str]) -> None:
    output = console.stdout()
    for name, reason in left_out.items():
        output.print(f"left out: {name}: {reason}", soft_wrap=True)
    for note in dict.fromkeys(notes):
        output.print(f"note: {note}", soft_wrap=True)


def convert(options: ConvertOptions, prog: str) -> None:
    """Write what is not there yet, then the lists."""
    from gnio_jax.data import conversion, registry

    _refuse_workers(options.workers)
    if options.rate is not None and not 1.0 <= options.rate <= 10000.0:
        problem = f"{options.rate:g} Hz is no rate to resample to"
        raise InputError("--rate", problem, "give 1 to 10000 Hz")
    dataset, root = registry.get(options.dataset), Path(".")
    if dataset.needs_root:
        root = registry.find_root(dataset.name, None if options.root == "-" else options.root)
    with console.terminal() as terminal:
        result = conversion.convert(
            dataset,
            root,
            options.out,
            options.split,
            options.rate,
            options.workers,
            lambda share: terminal.progress("converting", share),
        )
    done = result.recordings.values()
    left_out = {name: reason for one in done for name, reason in one.left_out.items()}
    _print_reasons(left_out, [*result.notes, *(note for one in done for note in one.notes)])
    kept = sum(len(one.kept) for one in done)
    if not kept:
        problem = f"none of {len(done)} recordings can be used"
        raise InputError(root, problem, "see the reasons above")
    hours = sum(one.seconds for one in done) / 3600
    counts = ", ".join(f"{split} {len(result.sequences(split))}" for split in result.splits)
    again = sum(len(one.kept) for one in done if one.there_already)
    there = f"; {again} of them were there already" if again else ""
    output = console.stdout()
    summary = f"{options.out}: {kept} sequences, {hours:.2f} h ({counts}){there}"
    output.print(summary, soft_wrap=True)
    following = f"{prog.rpartition(' ')[0]} check {options.out} --dataset csv"
    if {"train", "val"} <= result.splits.keys():
        following = f"{sibling(prog, 'train')} --dataset csv --data-root {options.out}"
    output.print(f"next: {following}", soft_wrap=True)


COMMANDS = Group(
    {
        "list": Command(ListOptions, show_list, LIST),
        "check": Command(CheckOptions, check, CHECK),
        "convert": Command(ConvertOptions, convert, CONVERT),
        "import": data_import.COMMAND,
        "export": data_export.COMMAND,
    },
    OVERVIEW,
)


def main(argv: Arguments[str] | None = None, prog: str = "python -m gnio_jax.data") -> None:
    """Run one of the commands."""
    execute(COMMANDS, argv, prog)
