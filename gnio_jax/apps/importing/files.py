"""The tables of a log: one text, the texts of a zip, of a folder or of a gzip, the sheets of a
workbook. Nothing is unpacked to the disk."""

from __future__ import annotations

import contextlib
import csv
import functools
import gzip
import io
import warnings
import zipfile
from collections import Counter
from collections.abc import Callable
from functools import partial
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import pandas as pd

from gnio_jax.data.parsing import text as parsing
from gnio_jax.data.parsing.consoles import console_of
from gnio_jax.data.parsing.tables import Table, parsing_as
from gnio_jax.errors import InputError, require_packages

XLS_MAGIC, GZIP_MAGIC = b"\xd0\xcf\x11\xe0", b"\x1f\x8b"
"""First bytes of an OLE file (.xls) and of a gzip."""
LARGEST = 512 * 2**20
"""Largest unpacked size of a table, bytes: six hours of a sensor at 200 Hz are less (ours)."""
MOST_TABLES = 200
"""Largest number of tables; a logger writes one for each sensor (ours)."""
MOST_ROWS, MOST_CELLS = 1 << 20, 30_000_000
"""Largest number of rows of a sheet, as in Excel, and of cells of a workbook (ours)."""
_SUFFIXES = (".csv", ".txt", ".tsv", ".dat", ".log", ".gcsv", ".json")


_Content = Callable[[], bytes | None]
"""A function that gives the text of a table; None: it is that of the file at its path."""


class LogFile(NamedTuple):
    """A table of a log, not yet read."""

    name: str
    """Name within a zip, folder or workbook, such as "meta/time.csv"."""
    path: Path
    """Path for messages."""
    layout: parsing.Layout
    content: _Content
    read: Callable[[], tuple[Table, list[str]]]
    """A function that gives the table, and notes about what is left out of it."""

    @property
    def location(self) -> PurePosixPath:
        """Its folder and name."""
        return PurePosixPath(self.name)


def log_file(
    name: str, path: Path, content: _Content = lambda: None, head: bytes | None = None
) -> LogFile:
    """A table with the shape that its first bytes `head` have (None: those of `content`)."""
    head = parsing.head_of(path, content() if head is None else head)
    console = console_of(head, lambda rows: parsing.layout_of(path, rows).separator)
    if console is not None:
        text = content()
        rows = console.rows(path.read_bytes() if text is None else text)
        content, head = partial(bytes, rows), rows
    layout = parsing.layout_of(path, head)
    if console is not None and console.names:
        layout = layout._replace(labels=console.columns)

    @functools.cache
    def read() -> tuple[Table, list[str]]:
        notes: list[str] = []
        frame, rows = parsing.tolerant_frame(path, layout, content(), notes)
        if console is not None:
            notes.append(f"{path.name}: lines of a serial console are read as rows")
        if words := [line for line in layout.preamble if parsing.is_row(line)]:
            problem = f"{len(words)} lines above the header are not rows"
            notes.append(f"{path.name}: {problem} ('{parsing.shorten(words[0], 40)}')")
        frame.columns = list(layout.labels or map(str, frame.columns))
        return Table(path, frame, before=layout.before, content=content(), rows=rows), notes

    return LogFile(name, path, layout, content, read)


def spell_names(files: list[LogFile]) -> str:
    """Names of files, for messages."""
    return parsing.shorten(", ".join(file.name for file in files) or "no CSV file", 200)


def files_of(path: Path) -> list[LogFile]:
    """The tables at a path. Those of a zip or folder that are no text are left out. Raises
    `InputError` for a damaged file or one that unpacks to more than a logger writes."""
    if path.is_dir():
        files = sorted(file for file in (*path.glob("*"), *path.glob("*/*")) if file.is_file())
        return _texts(path, {file.relative_to(path).as_posix(): file for file in files})
    magic = parsing.head_of(path)[:4]
    if magic == XLS_MAGIC:
        return _sheets(path, "xlrd")
    if magic.startswith(GZIP_MAGIC):
        with parsing_as(path, "a gzip"), gzip.open(path) as file:
            content = file.read(LARGEST + 1)
        _check_size(len(content), path)
        return [log_file(path.stem, path, partial(bytes, content))]
    if not magic.startswith(b"PK"):
        return [log_file(path.name, path)]
    with parsing_as(path, "a zip"), zipfile.ZipFile(path) as archive:
        members = archive.infolist()
    names = Counter(member.filename for member in members if not member.is_dir())
    if twice := [name for name, count in names.items() if count > 1]:
        raise InputError(path, f"holds {parsing.shorten(twice[0])} twice", "leave one of them")
    if any(member.filename == "xl/workbook.xml" for member in members):  # ECMA-376, part 2
        _check_size(sum(member.file_size for member in members), path)
        return _sheets(path, "openpyxl")
    return _texts(path, {member.filename: None for member in members})


def _texts(path: Path, members: dict[str, Path | None]) -> list[LogFile]:
    """The tables among the files of a zip (name → None) or folder (name → file)."""
    files, problems = list[LogFile](), list[InputError]()
    # macOS adds a file "._Gyroscope.csv" to each Gyroscope.csv.
    hidden = {name for name in members if PurePosixPath(name).name.startswith(".")}
    texts = [name for name in members if name.lower().endswith(_SUFFIXES) and name not in hidden]
    if len(texts) > MOST_TABLES:
        raise InputError(path, f"holds {len(texts)} CSV files", "give one recording of a logger")
    for name in texts:
        file, member = members[name], partial(_member, path, name)
        head = member(parsing.HEAD) if file is None else None
        try:
            one = log_file(name, file) if file else log_file(name, path / name, member, head)
            files.append(one)
        except InputError as error:
            problems.append(error)
    if problems and not files:
        raise problems[0]
    return files


def _member(path: Path, name: str, most: int = -1) -> bytes:
    """The content of a file of a zip, or its first `most` bytes."""
    with parsing_as(path, "a zip"), zipfile.ZipFile(path) as archive:
        _check_size(archive.getinfo(name).file_size, path / name)
        with archive.open(name) as file:  # it gives at most the announced size
            return file.read(most)


def _check_size(size: int, file: Path) -> None:
    if size > LARGEST:
        problem = f"unpacks to {size / 2**20:.0f} MiB"
        raise InputError(file, problem, f"no table may exceed {LARGEST / 2**20:.0f} MiB")


def _sheets(path: Path, engine: str) -> list[LogFile]:
    """The sheets of a workbook as texts."""
    require_packages(path, "excel", engine)
    with parsing_as(path, "a workbook"), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # warnings about styles
        texts = _new_sheets(path) if engine == "openpyxl" else _old_sheets(path)
    return [log_file(n, path / n, partial(bytes, text)) for n, text in texts.items() if text]


def _old_sheets(path: Path) -> dict[str, bytes]:
    """Those of a workbook of Excel 97, whose sheets have at most 256 columns and 65,536 rows."""
    # The library writes remarks about a damaged file to the standard output.
    options: dict[str, Any] = {"engine": "xlrd", "engine_kwargs": {"logfile": io.StringIO()}}
    sheets: dict[Any, pd.DataFrame] = pd.read_excel(path, sheet_name=None, header=None, **options)
    return {str(n): one.to_csv(index=False, header=False).encode() for n, one in sheets.items()}


def _new_sheets(path: Path) -> dict[str, bytes]:
    """Those of a workbook of ECMA-376. A row has all cells before its last one, so that a small
    file may have any number of them."""
    from openpyxl import load_workbook

    texts, count = dict[str, bytes](), 0
    with contextlib.closing(load_workbook(path, read_only=True, data_only=True)) as book:
        for sheet in book.worksheets:
            rows, out = list[list[str]](), io.StringIO()
            sheet.reset_dimensions()  # some programs state wrong ones
            for row in sheet.iter_rows():
                count += len(row) + 1
                is_long = len(rows) >= MOST_ROWS or count > MOST_CELLS
                if len(row) > parsing.MOST_COLUMNS or is_long:
                    problem = f"sheet '{parsing.shorten(sheet.title)}' has a cell in column"
                    problem += f" {len(row)} of row {len(rows) + 1}, which is too far out"
                    raise InputError(path, problem, "export the sensors' columns alone")
                rows.append([_cell_text(cell) for cell in row])
            width = max(map(len, rows), default=0)
            writer = csv.writer(out, lineterminator="\n")
            writer.writerows([*row, *[""] * (width - len(row))] for row in rows)
            texts[sheet.title] = out.getvalue().encode() if width else b""
    return texts


def _cell_text(cell: Any) -> str:
    """The text of a cell; none for one that is empty or has an error."""
    return "" if cell.value is None or cell.data_type == "e" else str(cell.value)
