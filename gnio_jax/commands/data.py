"""The command line of the data sets; see `python -m gnio_jax.data --help`."""

from __future__ import annotations

import dataclasses
import difflib
import json
import math
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterable
from collections.abc import Sequence as Arguments
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import tyro
from rich.console import Console
from rich.table import Table

from gnio_jax.commands import console as cli
from gnio_jax.data import importing, registry
from gnio_jax.data.dataset import Dataset, Recording
from gnio_jax.data.hdf5 import read_hdf5, write_hdf5
from gnio_jax.data.plausibility import SelfCheck
from gnio_jax.data.processes import map_in_processes, suggested_workers
from gnio_jax.data.readers import csv_files as csv
from gnio_jax.data.reading import check_recording, find_recordings
from gnio_jax.data.resampling import resample
from gnio_jax.files import replacing
from gnio_jax.types import InputError

PROGRAM = "python -m gnio_jax.data"

OVERVIEW = f"""usage: {PROGRAM} COMMAND ...

  list      every dataset the package reads: splits, rate, licence, where it is had, its layout, and what of it is found here
  check     do IMU and reference of each recording describe the same motion? A table, the reasons, pictures
  convert   any dataset into the package's HDF5, with its splits: read at once, at one rate, by --dataset csv
  import    the files of a phone's logger into one HDF5

{PROGRAM} COMMAND --help explains each with examples."""

LIST = f"""Every dataset that --dataset knows, and what of it is found here: in $GNIO_DATA/<name>, else in data/<name>. Only lists are read.

  {PROGRAM} list
  GNIO_DATA=~/recordings {PROGRAM} list"""

CHECK = f"""The physical self-check of every recording: the mean of R·accel must be gravity, the gyro must turn as the reference does,
nobody walks faster than 3 m/s, and the positions must accelerate as the accelerometer says. A recording that fails is left out by
every loader; here it is shown with its figures and the reason.

  {PROGRAM} check oxiod                                        (in $GNIO_DATA/oxiod, else data/oxiod)
  {PROGRAM} check ~/tlio --dataset tlio --split test
  {PROGRAM} check ~/my_recordings --dataset csv --plots pictures --json figures.json"""

CONVERT = f"""Any dataset as the package's HDF5: one file a recording, and a list for each split. What fails the self-check is left out.

  {PROGRAM} convert oxiod ~/oxiod ~/converted/oxiod
  {PROGRAM} convert tlio ~/tlio ~/converted/tlio_100 --rate 100 --workers 8
  python train.py --dataset csv --data-root ~/converted/oxiod

Stop it when you like: the same command goes on where it was. ROOT - stands for the usual place, $GNIO_DATA/<name>, else data/<name>."""

IMPORT = f"""A phone logger's CSV (one file, or one a sensor) as the package's HDF5. Units and the unit of time are detected where the
data tell them; what was assumed is said. A recording without a reference is of use with evaluate.py --init static.

  {PROGRAM} import walk.csv --out recordings/walk.h5
  {PROGRAM} import Gyroscope.csv --accel-path Accelerometer.csv --columns.time "Time (s)" \\
      --columns.gyro-x "X (rad/s)" --columns.gyro-y "Y (rad/s)" --columns.gyro-z "Z (rad/s)" \\
      --columns.accel-x "X (m/s^2)" --columns.accel-y "Y (m/s^2)" --columns.accel-z "Z (m/s^2)" --out recordings/walk.h5
  {PROGRAM} import ios.csv --accel-sign ios --gyro-unit deg/s --rate 100 --out recordings/ios.h5"""


@dataclass(frozen=True)
class ListOptions:
    """What `list` is asked for."""


@dataclass(frozen=True)
class CheckOptions:
    """What `check` is asked for."""

    dataset_or_root: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="DATASET_OR_ROOT")]]
    """Name of a dataset, which is looked for in the usual place, or the folder of one."""
    dataset: str | None = None
    """Dataset whose layout the folder has; without it the one that finds its recordings there."""
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
    """Processes; without it as many as there are cores, and one for a few recordings."""


@dataclass(frozen=True)
class ConvertOptions:
    """What `convert` is asked for."""

    dataset: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="DATASET")]]
    """Name of the dataset."""
    root: tyro.conf.Positional[Annotated[str, tyro.conf.arg(metavar="ROOT")]]
    """Its folder; - for the usual place."""
    out: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="OUT")]]
    """Folder for the result."""
    split: str = "all"
    """A split, or all of them."""
    rate: float | None = None
    """Rate of the result, Hz; without it each recording's own."""
    workers: int | None = None
    """Processes; without it as many as there are cores, and one for a few recordings."""


@dataclass(frozen=True)
class Columns:
    """Names of the file's columns (or their places from 0, where it has no header); "a+b" is a sum."""

    time: str | None = None
    """Stamps."""
    accel_time: str | None = None
    """Stamps of the accelerometer, where they are another column."""
    gyro_x: str | None = None
    """Angular rate."""
    gyro_y: str | None = None
    """Angular rate."""
    gyro_z: str | None = None
    """Angular rate."""
    accel_x: str | None = None
    """Acceleration, gravity included."""
    accel_y: str | None = None
    """Acceleration, gravity included."""
    accel_z: str | None = None
    """Acceleration, gravity included."""


@dataclass(frozen=True)
class ImportOptions:
    """What `import` is asked for."""

    file: tyro.conf.Positional[Annotated[Path, tyro.conf.arg(metavar="FILE")]]
    """The logger's file, or the gyro's where the accelerometer has one of its own."""
    out: Path
    """HDF5 file to write, NAME.h5."""
    accel_path: Path | None = None
    """The accelerometer's file."""
    columns: Columns = field(default_factory=Columns)
    """What the columns are called; those not given are looked up by our own names: time, gyro_x,
    ..."""
    time_unit: Literal["s", "ms", "us", "ns"] | None = None
    """Unit of the stamps; without it detected."""
    gyro_unit: Literal["rad/s", "deg/s"] | None = None
    """Unit of the gyro; without it detected."""
    accel_unit: Literal["m/s2", "g", "mg"] | None = None
    """Unit of the accelerometer; without it detected."""
    accel_sign: Literal["android", "ios", "detect"] = "android"
    """At rest, level, the up axis reads +1 g (android) or −1 g (ios); detect assumes that the
    screen points up."""
    order: Literal["sort", "refuse"] = "sort"
    """Rows out of order are sorted, or refused."""
    rate: float | None = None
    """Rate of the result, Hz; without it the faster sensor's own."""
    separator: str | None = None
    """Of the columns; without it detected."""
    name: str | None = None
    """Of the sequence; without it that of the file OUT."""


def main(argv: Arguments[str] | None = None) -> None:
    """Run one command. Raises `InputError` for what the user can mend."""
    arguments = list(sys.argv[1:] if argv is None else argv)
    commands: dict[str, tuple[type, str, Callable[[Any], None]]] = {
        "list": (ListOptions, LIST, show_list),
        "check": (CheckOptions, CHECK, check),
        "convert": (ConvertOptions, CONVERT, convert),
        "import": (ImportOptions, IMPORT, import_file),
    }
    if arguments[:1] in (["-h"], ["--help"]):
        print(OVERVIEW)
        return
    if not arguments or arguments[0] not in commands:
        close = difflib.get_close_matches(arguments[0], commands, n=1) if arguments else []
        raise InputError(
            "command",
            f"unknown '{arguments[0]}'" if arguments else "is missing",
            f"did you mean '{close[0]}'?"
            if close
            else f"give one of {', '.join(commands)}; --help explains them",
        )
    kind, description, run = commands[arguments[0]]
    run(
        cli.parse(
            kind, description=description, argv=arguments[1:], prog=f"{PROGRAM} {arguments[0]}"
        )
    )


def _console() -> Console:
    console = Console(highlight=False, markup=False)
    # Into a file or a pipe no line is cut to a terminal's width.
    return console if console.is_terminal else Console(highlight=False, markup=False, width=200)


def file_name(name: str) -> str:
    """A sequence's name as that of a file."""
    return re.sub(r"[^\w.+-]+", "_", name).lstrip(".") or "_"


# --- list
# ------------------------------------------------------------------------------------------------------------


def show_list(_: ListOptions) -> None:
    """Two tables: what there is and what of it is here, and where it is had."""
    here = Table(title="Datasets", title_justify="left", show_lines=True)
    for column in ("dataset", "Hz", "splits", "licence", "found here"):
        here.add_column(column, overflow="fold", justify="right" if column == "Hz" else "left")
    had = Table(
        title="Where they are had, and the layout that is expected",
        title_justify="left",
        show_lines=True,
    )
    for column in ("dataset", "where", "layout"):
        had.add_column(column, overflow="fold")
    for name in registry.names():
        dataset = registry.get(name)
        here.add_row(
            name,
            f"{dataset.rate:g}",
            ", ".join(dataset.splits),
            dataset.licence,
            _found_here(dataset),
        )
        had.add_row(name, dataset.source, dataset.layout if dataset.needs_root else "–")
    console = _console()
    console.print(here)
    console.print(had)
    bases = [os.environ["GNIO_DATA"]] if os.environ.get("GNIO_DATA") else []
    console.print(
        f"looked in {' and '.join([*bases, 'data'])}; another place is named by --data-root, or GNIO_DATA for all of them"
    )


def _found_here(dataset: Dataset) -> str:
    try:
        root = registry.find_root(dataset.name) if dataset.needs_root else Path(".")
    except InputError:
        return "not found"
    place = f"{root}: " if dataset.needs_root else "computed: "
    try:
        found, splits, _ = find_recordings(dataset, root, "all")
    except InputError as error:
        return f"{place}no recording ({error})"
    return f"{place}{len(found)} recordings ({', '.join(f'{split} {len(names)}' for split, names in splits.items())})"


# --- check
# -----------------------------------------------------------------------------------------------------------


class Row(NamedTuple):
    """One line of the table."""

    name: str
    split: str
    check: SelfCheck | None
    """None where it could not be read."""
    reason: str
    """Why it is left out; empty where it is not."""


def check(options: CheckOptions) -> None:
    """The table, the reasons and notes, and on request pictures, JSON and Markdown."""
    _check_workers(options.workers)
    for option, path in (("--json", options.json), ("--markdown", options.markdown)):
        if path is not None and path.is_dir():
            raise InputError(option, f"{path} is a folder", "name a file")
    if options.plots is not None and options.plots.exists() and not options.plots.is_dir():
        raise InputError("--plots", f"{options.plots} is a file", "name a folder")
    dataset, root = resolve(options.dataset_or_root, options.dataset)
    found, splits, notes = find_recordings(dataset, root, options.split)
    items = [(recording, dataset, options.plots) for recording in found.values()]
    with cli.progress() as progress:
        results = list(
            map_in_processes(
                _checked,
                items,
                options.workers or suggested_workers(len(items)),
                lambda share: progress("checking", share),
            )
        )

    rows = []
    for name, (checks, problem, warned) in zip(found, results, strict=True):
        split = _spell_splits(name, splits)
        rows += [
            Row(sequence, split, found_, "; ".join(found_.failures)) for sequence, found_ in checks
        ]
        if problem:
            rows.append(Row(name, split, None, problem))
        notes += [note for note in warned if note not in notes]
    console = _console()
    place = f" at {root}" if dataset.needs_root else ""
    console.print(_table(rows, f"{dataset.name}{place}, split {options.split}"))
    left_out = [row for row in rows if row.reason]
    for row in left_out:
        console.print(f"left out: {row.name}: {row.reason}", soft_wrap=True)
    for note in notes:
        console.print(f"note: {note}", soft_wrap=True)
    kept = [row for row in rows if not row.reason]
    hours = sum(row.check.duration for row in kept if row.check) / 3600
    console.print(f"{len(kept)} of {len(rows)} sequences are used, {hours:.2f} h")
    if options.json:
        _write(
            options.json,
            json.dumps(
                _figures(rows, dataset, root, options.split, notes), indent=2, ensure_ascii=False
            )
            + "\n",
        )
    if options.markdown:
        _write(options.markdown, _markdown(rows))
    if options.plots:
        console.print(f"pictures: {options.plots}", soft_wrap=True)
    if not kept:
        raise InputError(
            root, f"none of {len(rows)} sequences can be used", "see the reasons above"
        )


def resolve(what: str, name: str | None) -> tuple[Dataset, Path]:
    """Dataset and root that `check DATASET_OR_ROOT [--dataset NAME]` means. Raises `InputError`
    when that is not clear."""
    if name is not None:
        dataset = registry.get(name)
        return dataset, registry.find_root(name, what) if dataset.needs_root else Path(what)
    if what in registry.names():
        dataset = registry.get(what)
        return dataset, registry.find_root(
            what, hint=f"give its folder with --dataset {what}"
        ) if dataset.needs_root else Path(".")
    root = Path(what)
    if not root.is_dir():
        if os.sep in what or what.startswith("."):
            raise InputError(
                what, "no such folder", "give the name of a dataset, or the folder of one"
            )
        registry.get(what)  # raises, with the names that are known
    fitting = [
        dataset
        for dataset in map(registry.get, registry.names())
        if dataset.needs_root and _fits(dataset, root)
    ]
    # EuRoC's layout is TUM-VI's, too: the folder's own name may tell.
    fitting = [
        dataset for dataset in fitting if dataset.name == root.resolve().name.lower()
    ] or fitting
    if len(fitting) != 1:
        fits = (
            f"has the layout of {' and of '.join(dataset.name for dataset in fitting)}"
            if fitting
            else "has the layout of no dataset"
        )
        raise InputError(
            root, fits, f"say which it is: --dataset NAME, one of {', '.join(registry.names())}"
        )
    return fitting[0], root


def _fits(dataset: Dataset, root: Path) -> bool:
    try:
        find_recordings(dataset, root, "all")
    except InputError:
        return False
    return True


def _checked(
    recording: Recording, dataset: Dataset, plots: Path | None
) -> tuple[list[tuple[str, SelfCheck]], str, tuple[str, ...]]:
    """The figures of one recording, why there are none, and the notes; without the sequences, which
    are large."""
    found = check_recording(recording, dataset)
    if plots is not None and found.sequences:
        from gnio_jax.data import pictures  # Matplotlib takes a second to import

        for sequence, figures in found.sequences:
            pictures.save(
                plots / f"{file_name(sequence.name)}.png", pictures.overview(sequence, figures)
            )
    return (
        [(sequence.name, figures) for sequence, figures in found.sequences],
        found.problem,
        found.notes,
    )


def _spell_splits(name: str, splits: dict[str, tuple[str, ...]]) -> str:
    """The splits a recording is in; that it is one of all needs no saying where there is another."""
    own = [split for split, names in splits.items() if name in names]
    return ", ".join(split for split in own if split != "all" or len(own) == 1)


_COLUMNS = (
    "sequence",
    "split",
    "s",
    "Hz",
    "mean of R·accel\nm/s²",
    "gyro\n°/10 s",
    "speed\nm/s",
    "accel\ncorr.",
    "valid",
    "",
)


def _cells(row: Row) -> list[str]:
    check = row.check
    if check is None:
        return [row.name, row.split, *["–"] * 7, "left out"]
    return [
        row.name,
        row.split,
        f"{check.duration:.1f}",
        f"{check.rate:.1f}",
        "–"
        if np.isnan(check.gravity_mean).any()
        else " ".join(f"{round(value, 2) + 0.0:.2f}" for value in check.gravity_mean),
        _number(check.gyro_consistency_degrees, ".2f"),
        _number(check.median_speed, ".2f"),
        _number(check.accel_correlation_horizontal, ".2f"),
        f"{check.share_valid:.1%}",
        "left out" if row.reason else "used",
    ]


def _number(value: float, style: str) -> str:
    return "–" if math.isnan(value) else format(value, style)


def _table(rows: list[Row], title: str) -> Table:
    table = Table(title=title, title_justify="left")
    for column in _COLUMNS:
        text = column in ("sequence", "split", "")
        table.add_column(
            column,
            overflow="fold",
            justify="left" if text else "right",
            no_wrap=not text,
            min_width=14 if column == "sequence" else None,
        )
    for row in rows:
        table.add_row(*_cells(row), style="red" if row.reason else None)
    return table


def _markdown(rows: list[Row]) -> str:
    lines = [
        [column.replace("\n", " ") for column in _COLUMNS],
        ["---", "---", *["--:"] * 7, "---"],
        *(_cells(row) for row in rows),
    ]
    return "".join(f"| {' | '.join(cell.replace('|', '¦') for cell in line)} |\n" for line in lines)


def _figures(
    rows: list[Row], dataset: Dataset, root: Path, split: str, notes: list[str]
) -> dict[str, Any]:
    """The table as it goes into a JSON file, which knows no NaN."""

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray | tuple):
            return [plain(entry) for entry in value]
        return (
            None
            if isinstance(value, float) and math.isnan(value)
            else value.item()
            if isinstance(value, np.generic)
            else value
        )

    sequences = {
        row.name: {
            "split": row.split,
            "used": not row.reason,
            "reason": row.reason,
            **(
                {key: plain(value) for key, value in row.check._asdict().items()}
                if row.check
                else {}
            ),
        }
        for row in rows
    }
    return {
        "dataset": dataset.name,
        "root": str(root) if dataset.needs_root else None,
        "split": split,
        "sequences": sequences,
        "notes": notes,
    }


def _write(path: Path, text: str) -> None:
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _check_workers(workers: int | None) -> None:
    if workers is not None and workers < 1:
        raise InputError("--workers", f"must be at least 1, found {workers}")


# --- convert
# ---------------------------------------------------------------------------------------------------------

_JOURNAL = ".converted"
"""Folder in OUT: one JSON for each recording that is done, and settings.json."""


class Converted(NamedTuple):
    """What became of one recording."""

    kept: tuple[str, ...]
    """Stems of the files."""
    left_out: dict[str, str]
    """Sequence -> reason."""
    seconds: float
    notes: tuple[str, ...]
    there_already: bool


def convert(options: ConvertOptions) -> None:
    """Write what is not there yet, then the lists."""
    _check_workers(options.workers)
    if options.rate is not None and not 1.0 <= options.rate <= 10000.0:
        raise InputError(
            "--rate", f"{options.rate:g} Hz is no rate to resample to", "give 1 to 10000 Hz"
        )
    dataset = registry.get(options.dataset)
    root = Path(".")
    if dataset.needs_root:
        root = registry.find_root(dataset.name, None if options.root == "-" else options.root)
    out = options.out
    if dataset.needs_root and out.resolve() == root.resolve():
        raise InputError(out, "is the folder that is read", "choose another one for the result")
    found, splits, notes = find_recordings(dataset, root, options.split)
    files: dict[str, str] = {}
    for name in found:
        if (other := files.setdefault(file_name(name), name)) != name:
            raise InputError(
                root,
                f"'{other}' and '{name}' would be one file, {file_name(name)}.h5",
                "rename one of them",
            )
    _claim(out, {"dataset": dataset.name, "rate": options.rate})
    results = {
        name: done for name in found if (done := _done(_journal(out, name), out)) is not None
    }
    missing = [name for name in found if name not in results]
    items = [(found[name], dataset, out, options.rate) for name in missing]
    with cli.progress() as progress:
        results |= zip(
            missing,
            map_in_processes(
                _convert_one,
                items,
                options.workers or suggested_workers(len(items)),
                lambda share: progress("converting", share),
            ),
            strict=True,
        )
    results = {name: results[name] for name in found}

    for split, names in splits.items():
        kept = [stem for name in names for stem in results[name].kept]
        if kept:
            _write(out / f"{split}.txt", "".join(f"{stem}\n" for stem in kept))
        else:
            (out / f"{split}.txt").unlink(missing_ok=True)
            notes.append(
                f"split '{split}' has no list: none of its {len(names)} recordings can be used"
            )
    console = _console()
    for name, reason in (pair for result in results.values() for pair in result.left_out.items()):
        console.print(f"left out: {name}: {reason}", soft_wrap=True)
    for note in dict.fromkeys(
        [*notes, *(note for result in results.values() for note in result.notes)]
    ):
        console.print(f"note: {note}", soft_wrap=True)
    kept = sum(len(result.kept) for result in results.values())
    if not kept:
        raise InputError(
            root, f"none of {len(found)} recordings can be used", "see the reasons above"
        )
    hours = sum(result.seconds for result in results.values()) / 3600
    again = sum(len(result.kept) for result in results.values() if result.there_already)
    counts = ", ".join(
        f"{split} {sum(len(results[name].kept) for name in names)}"
        for split, names in splits.items()
    )
    there = f"; {again} of them were there already" if again else ""
    console.print(f"{out}: {kept} sequences, {hours:.2f} h ({counts}){there}", soft_wrap=True)
    trained = "train" in splits and "val" in splits
    console.print(
        f"next: python train.py --dataset csv --data-root {out}"
        if trained
        else f"next: {PROGRAM} check {out} --dataset csv",
        soft_wrap=True,
    )


def _claim(out: Path, settings: dict[str, Any]) -> None:
    """Make `out` the place of one conversion; raises `InputError` if it is that of another, or
    holds recordings of another origin."""
    path = out / _JOURNAL / "settings.json"
    if out.exists() and not out.is_dir():
        raise InputError(out, "is a file", "name a folder")
    if path.is_file():
        try:
            there = json.loads(path.read_text(encoding="utf-8"))
        except (OSError, ValueError) as error:
            raise InputError(path, f"cannot be read ({error})", "choose another folder") from None
        if there != settings:
            found, wanted = (
                f"{entry.get('dataset')} at {f'{rate:g} Hz' if (rate := entry.get('rate')) else 'its own rate'}"
                for entry in (there, settings)
            )
            raise InputError(out, f"holds {found}, not {wanted}", "choose another folder")
    elif any(
        entry.suffix in (".h5", ".hdf5", ".csv", ".txt")
        for entry in (out.iterdir() if out.is_dir() else ())
    ):
        raise InputError(
            out, "holds recordings or lists that no conversion has written", "choose another folder"
        )
    else:
        _write(path, json.dumps(settings))


def _convert_one(
    recording: Recording, dataset: Dataset, out: Path, rate: float | None
) -> Converted:
    """Write the sequences of a recording that pass the self-check."""
    found = check_recording(recording, dataset)
    if found.problem:  # not noted as done: it may be mended
        return Converted((), {recording.name: found.problem}, 0.0, found.notes, False)
    kept, left_out, seconds = [], {}, 0.0
    asked = {
        "check_pedestrian": dataset.pedestrian,
        "check_min_correlation": -1.0
        if dataset.min_correlation is None
        else dataset.min_correlation,
    }
    for sequence, figures in found.sequences:
        if figures.failures:
            left_out[sequence.name] = "; ".join(figures.failures)
            continue
        sequence = sequence if rate is None else resample(sequence, rate)
        stem = file_name(sequence.name)
        write_hdf5(
            out / f"{stem}.h5", sequence._replace(attributes={**asked, **sequence.attributes})
        )
        kept.append(stem)
        seconds += figures.duration
    result = Converted(tuple(kept), left_out, seconds, found.notes, False)
    _write(_journal(out, recording.name), json.dumps(result._asdict()))
    return result


def _journal(out: Path, name: str) -> Path:
    return out / _JOURNAL / f"{file_name(name)}.json"


def _done(journal: Path, out: Path) -> Converted | None:
    """What the journal says of a recording, if its files are there and whole."""
    try:
        entry = json.loads(journal.read_text(encoding="utf-8"))
        result = Converted(
            tuple(entry["kept"]),
            dict(entry["left_out"]),
            float(entry["seconds"]),
            tuple(entry["notes"]),
            True,
        )
        for stem in result.kept:
            read_hdf5(out / f"{stem}.h5")
    except (OSError, ValueError, KeyError, TypeError):  # InputError is a ValueError
        return None
    return result


# --- import
# ----------------------------------------------------------------------------------------------------------


def import_file(options: ImportOptions) -> None:
    """Write the file, say what was assumed and what it looks like, and what to do with it."""
    if options.out.suffix.lower() not in (".h5", ".hdf5"):
        raise InputError("--out", f"'{options.out}' is no name of an HDF5 file", "name it NAME.h5")
    if options.out.is_dir():
        raise InputError("--out", f"'{options.out}' is a folder", "name a file in it, NAME.h5")
    columns = {
        name: value
        for name, value in dataclasses.asdict(options.columns).items()
        if value is not None
    }
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sequence, notes = importing.import_recording(
            options.file,
            columns,
            accel_path=options.accel_path,
            time_unit=options.time_unit,
            gyro_unit=options.gyro_unit,
            accel_unit=options.accel_unit,
            accel_sign=options.accel_sign,
            order=options.order,
            rate=options.rate,
            separator=options.separator,
            name=options.name or options.out.stem,
        )
    write_hdf5(options.out, sequence)
    console = _console()
    console.print(f"{options.out}: {sequence.name}", soft_wrap=True)
    for note in [*notes, *(str(warning.message) for warning in caught)]:
        console.print(f"  {note}", soft_wrap=True)
    for line in _looks(sequence.time, sequence.gyro, sequence.accel):
        console.print(f"  {line}", soft_wrap=True)
    folder = options.out.parent
    lists = [split for split in csv.SPLITS if (folder / f"{split}.txt").is_file()]
    if lists:
        console.print(
            f"  {folder} has lists: add the line {options.out.stem} to {lists[-1]}.txt, or it is not read",
            soft_wrap=True,
        )
    console.print(
        f"next: python evaluate.py --dataset csv --data-root {folder} --split test --init static",
        soft_wrap=True,
    )


def _looks(time: np.ndarray, gyro: np.ndarray, accel: np.ndarray) -> Iterable[str]:
    """What a person can judge: is that as long, as fast and as lively as what was recorded?"""
    step = float(np.median(np.diff(time)))
    yield f"{time[-1] - time[0]:.1f} s at {1.0 / step:.4g} Hz"
    pull, turn = np.linalg.norm(accel, axis=1), np.linalg.norm(gyro, axis=1)
    yield f"|accel| {np.median(pull):.2f} m/s² in the median, {pull.min():.2f} to {pull.max():.2f}"
    yield f"|gyro| {np.median(turn):.2f} rad/s in the median, up to {turn.max():.2f}"
    span = max(round(0.5 / step), 1)
    chunks = len(pull) // span
    if chunks:
        pull, turn = (values[: chunks * span].reshape(chunks, span) for values in (pull, turn))
        still = (pull.std(axis=1) < 0.2) & (turn.mean(axis=1) < 0.1)
        yield f"it rests {still.mean():.0%} of the time"
