"""Tables of text as people have them: preamble, header, row of units, rows, columns.

`layout_of` finds the shape in the first lines. `strict_frame` reads a published layout and refuses
what is not in it; `tolerant_frame` leaves out damaged rows and names them. Limits are ours.
"""

from __future__ import annotations

import codecs
import contextlib
import csv
import io
import re
from collections import Counter
from collections.abc import Iterator
from itertools import accumulate, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Int

from gnio_jax.data.parsing.stamps import most_damaged_rows, parse_times
from gnio_jax.errors import InputError

HEAD, FIRST_LINES, PUBLISHED_LINES = 1 << 17, 400, 20
"""Bytes and lines in which the shape of a table is searched, and lines of a published one."""
MOST_COLUMNS = 2000
NUMERIC_SHARE = 0.9
"""Share of numbers among the cells of a column from which others are damaged."""
SEPARATORS = (",", ";", "\t", "|", " ")
"""Separators of cells; " " means any run of blanks."""
NO_ROW = "holds no row"
"""The problem of a table with nothing below its header."""
_CONTROLS = bytes({*range(32)} - {*b"\t\n\v\f\r"})
_MARK = re.compile(r"^\s*(#|//|%|@|!)+\s*")
_DIGITS = r"[+\-\u2212]?(\d+([.,]\d*)?|[.,]\d+)(e[+-]?\d+)?|[+-]?(nan|inf|infinity)"
_NUMBER = re.compile(_DIGITS, re.IGNORECASE)
_THOUSANDS = r"[+-]?[1-9]\d{0,2}(\.\d{3})+(,\d*)?"


class Layout(NamedTuple):
    """The shape of a table of text."""

    encoding: str
    separator: str
    decimal: str
    """Decimal mark: a point or a comma."""
    labels: tuple[str, ...]
    """Names of the columns; none if there is no header."""
    subheaders: tuple[tuple[str, ...], ...]
    """Cells of other lines of names above the rows, such as units; those nearest to them first."""
    before: int
    """Number of lines before the first row."""
    width: int
    """Number of columns."""
    preamble: tuple[str, ...]
    """Other lines above the rows that are not blank."""


def shorten(text: object, most: int = 80) -> str:
    """A text from a file in a form that a message can quote: one line of at most `most` printable
    characters."""
    words = " ".join(str(text).strip()[: 4 * most].split())
    line = "".join(c if c.isprintable() else "\ufffd" for c in words)
    return line if len(line) <= most else line[: most - 3] + "..."


# --- from bytes to lines


def encoding_of(path: object, head: bytes) -> str:
    """The encoding of a text by its first bytes: UTF-8 or UTF-16, else the code page of Windows.
    Raises `InputError` if it is no text."""
    if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        return "utf-16"
    if head[1:2] == b"\0" and head[1::2].count(0) > 0.4 * len(head) / 2:
        return "utf-16-le"
    body = head.rstrip(b"\0")
    if len(body) - len(body.translate(None, _CONTROLS)) > 0.03 * len(body):
        raise InputError(path, "is no text", "export the recording as CSV")
    try:
        codecs.getincrementaldecoder("utf-8")().decode(body)
    except UnicodeDecodeError:
        return "cp1252"
    return "utf-8-sig" if head.startswith(codecs.BOM_UTF8) else "utf-8"  # the parser's fast path


def head_of(path: Path, content: bytes | None = None) -> bytes:
    """The first bytes of a file, or of `content` instead. Raises `InputError`, also for a file that
    begins as no recording does."""
    try:
        with path.open("rb") if content is None else io.BytesIO(content) as file:
            head = file.read(HEAD)
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})") from None
    start = head[:512].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if start.startswith(b"version https://git-lfs"):
        raise InputError(path, "is a pointer of Git LFS, not the data", "get it by git lfs pull")
    if start.startswith(b"<"):
        raise InputError(path, "is a web page or XML, not the data", "download the file itself")
    if re.match(rb'[\[{]\s*["\[{\]}]', start):
        raise InputError(path, "is JSON", "export the recording as CSV")
    return head


def open_text(path: Path, content: bytes | None = None, encoding: str = "") -> io.TextIOWrapper:
    """The text of a file, or `content` instead; a byte order mark is dropped."""
    encoding = encoding or encoding_of(path, head_of(path, content))
    source = path.open("rb") if content is None else io.BytesIO(content)
    return io.TextIOWrapper(source, encoding=encoding, errors="replace")


def is_row(line: str) -> bool:
    """Whether a line is neither blank nor a comment."""
    return not line.startswith("#") and bool(line.strip())


def cells_of(line: str, separator: str) -> list[str]:
    """The cells of a line, without blanks and quotes."""
    if '"' in line and separator != " ":
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    else:
        cells = line.strip("\r\n").split(None if separator == " " else separator)
    return [cell.strip(" \t\"'\r\n\0\ufeff") for cell in cells]


def without_mark(line: str) -> str:
    """A line without the mark of a comment."""
    return _MARK.sub("", line)


def rows_of(path: Path, layout: Layout, content: bytes | None) -> Iterator[tuple[int, list[str]]]:
    """(line from 1, cells) of each row below the header."""
    with open_text(path, content, layout.encoding) as file:
        for number, line in enumerate(file, 1):
            if number > layout.before and is_row(line):
                yield number, cells_of(line, layout.separator)


# --- from lines to the shape


def layout_of(path: Path, content: bytes | None = None, separator: str | None = None) -> Layout:
    """The shape of a table, from its first lines. The separator is the one that gives the most
    numbers in rows of the same length; the header is the line above the rows with as many cells, no
    number and the most names. Raises `InputError` if it is no text or too wide."""
    head = head_of(path, content)
    encoding = encoding_of(path, head)
    lines = head.decode(encoding, errors="replace").splitlines()
    cells = max((max(map(line.count, SEPARATORS[:-1])) for line in lines), default=0)
    words = max((len(line.split()) for line in lines), default=0)
    if max(cells, words) > MOST_COLUMNS:
        raise InputError(path, f"has more than {MOST_COLUMNS} columns", "give the sensors' alone")
    lines = lines[:-1] if len(head) == HEAD and len(lines) > 1 else lines  # it may be cut
    stated = re.match(r'\W*sep=(.)"?\s*$', lines[0], re.IGNORECASE) if lines else None
    marks = [separator] if separator else [stated[1]] if stated else SEPARATORS
    mark, rows, data = marks[0], list[list[str]](), list[int]()
    for most in (PUBLISHED_LINES if separator else FIRST_LINES, len(lines)):
        tables = {mark: [cells_of(line, mark) for line in lines[:most]] for mark in marks}
        scores = {mark: _score(rows) for mark, rows in tables.items()}
        mark = max(marks, key=lambda mark: scores[mark][0])
        rows, data = tables[mark], scores[mark][1]
        if data:
            break
    else:  # a header without rows, or a table of words
        first = next((n for n, line in enumerate(lines) if is_row(line)), len(lines) - 1)
        line = lines[first] if lines else ""
        mark = separator or max(SEPARATORS[:-1], key=line.count)
        labels = tuple(cells_of(line, mark if mark in line else " "))
        return Layout(encoding, mark, ".", labels, (), first + 1, len(labels), ())
    if (width := len(rows[data[0]])) > MOST_COLUMNS:
        raise InputError(path, f"has {width} columns", f"{MOST_COLUMNS} are the most")
    filled = max(n + 1 for row in data for n, cell in enumerate(rows[row]) if cell)
    headers: dict[int, tuple[str, ...]] = {}
    for number in range(data[0] - 1, -1, -1):
        cells = cells_of(without_mark(lines[number]), mark)
        is_whole = filled <= len(cells) <= width or (len(cells) == width + 1 and not cells[-1])
        if is_whole and any(cells) and not any(_NUMBER.fullmatch(cell) for cell in cells):
            headers[number] = (*cells, *[""] * width)[:width]
        elif headers and lines[number].strip():
            break
    preamble = [lines[n] for n in range(data[0]) if n not in headers and lines[n].strip()]
    header = max(headers, key=lambda number: len(set(headers[number]) - {""}), default=-1)
    labels = headers.pop(header, ())
    for groups in headers.values():  # names of sensors over their axes: each holds up to the next
        upper = accumulate(groups, lambda before, group: group or before)
        joined = tuple(f"{a} {b}".strip() for a, b in zip(upper, labels, strict=True))
        # Three axes more; a title over a column that is written twice is no sensor.
        labels = joined if len(set(joined)) > len(set(labels)) + 2 else labels
    is_comma = any(re.search(r"\d,\d", cell) for n in data for cell in rows[n])
    others, decimal = tuple(headers.values()), "," if is_comma else "."
    return Layout(encoding, mark, decimal, labels, others, data[0], width, tuple(preamble))


def _count_numbers(cells: list[str]) -> int:
    """Number of numbers in a line, if most of its cells are that; otherwise 0."""
    count = sum(bool(_NUMBER.fullmatch(cell)) for cell in cells)
    return count if len(cells) > 1 and 2 * count > sum(map(bool, cells)) else 0


def _score(rows: list[list[str]]) -> tuple[int, list[int]]:
    """Number of numbers in the rows of the usual width, and these rows."""
    counts = [_count_numbers(cells) for cells in rows]
    widths = Counter(len(cells) for cells, n in zip(rows, counts, strict=True) if n).most_common(1)
    data = [n for n, cells in enumerate(rows) if counts[n] and len(cells) == widths[0][0]]
    return sum(counts[n] for n in data), data


# --- from the shape to columns


def _parse(path: Path, layout: Layout, content: bytes | None) -> pd.DataFrame:
    try:
        return pd.read_csv(
            path if content is None else io.BytesIO(content),
            header=None,
            skiprows=layout.before,
            comment="#",
            sep=r"\s+" if layout.separator == " " else layout.separator,
            skipinitialspace=True,
            skip_blank_lines=True,
            low_memory=False,
            decimal=layout.decimal,
            encoding=layout.encoding,
            compression=None,
        )
    except pd.errors.EmptyDataError:
        raise InputError(path, NO_ROW, "take the file as the logger wrote it") from None


def strict_frame(path: Path, layout: Layout, content: bytes | None = None) -> pd.DataFrame:
    """The rows of a table. Raises `InputError` naming a row with another number of cells."""
    problem = "is not a table of text"
    try:
        frame = _parse(path, layout, content)
        if frame.shape[1] == (layout.width or frame.shape[1]):
            return frame
    except (UnicodeDecodeError, pd.errors.ParserError) as error:
        problem = f"{problem} ({shorten(error, 200)})"
    for number, cells in rows_of(path, layout, content):
        if len(cells) != layout.width:
            problem = f"row {number} has {len(cells)} cells, expected {layout.width}"
            break
    raise InputError(path, problem, "correct that, or take the file as published")


def tolerant_frame(
    path: Path, layout: Layout, content: bytes | None, notes: list[str]
) -> tuple[pd.DataFrame, Int[np.ndarray, " n"]]:
    """The rows of a table without a few damaged ones (`most_damaged_rows`), which are named in
    `notes`, and their numbers among the rows of the file, from 0. Columns of numbers are numbers,
    times of day are datetime64 in ns, others remain as they are. Raises `InputError` if more are
    damaged."""
    frame, is_mixed, width = None, False, layout.width
    with contextlib.suppress(UnicodeDecodeError, pd.errors.ParserError):
        frame = _parse(path, layout, content)
    if frame is not None and frame.iloc[:, -1].isna().any():  # the parser fills short rows
        text = path.read_bytes() if content is None else content
        count = text.split(b"\n", layout.before)[-1].count(layout.separator.encode())
        frame = frame if count == len(frame) * (width - 1) else None
    damaged = np.zeros(0 if frame is None else len(frame), dtype=bool)
    if frame is None or frame.shape[1] != width:
        rows = [cells for _, cells in rows_of(path, layout, content)]
        rows = [cells if any(cells[width:]) else cells[:width] for cells in rows]
        missing = width - np.array([len(cells) for cells in rows])
        unnamed = width - max(
            (n for n, label in enumerate(layout.labels, 1) if label), default=width
        )
        damaged = (missing < 0) | (missing > unnamed)  # separators end some rows
        wider = [len(cells) for cells in rows if len(cells) > width and _count_numbers(cells)]
        is_mixed = len(wider) > 1 and len(set(wider)) == 1  # rows of another kind are no damage
        frame = pd.DataFrame([[*cells, *[""] * width][:width] for cells in rows])
        frame = frame.replace("", np.nan)
    columns = {index: frame[index] for index in frame}
    for index, column in columns.items():
        if column.dtype.kind == "O":
            columns[index], valid, remark = _convert_column(column, damaged, layout.decimal)
            damaged = damaged | ~valid
            notes += [f"{path.name}: {remark}"] if remark else []
    if damaged.any():
        number, cells = next(islice(rows_of(path, layout, content), int(np.argmax(damaged)), None))
        problem = f"row {number} is not a row of {width} numbers: it has {len(cells)} cells"
        problem += f" ('{shorten(layout.separator.join(cells), 40)}')"
        if is_mixed or damaged.sum() > most_damaged_rows(len(damaged)):
            problem += f", as {damaged.sum() - 1} others"
            raise InputError(path, problem, "give a table whose rows have the same columns")
        notes.append(f"{path.name}: {problem}; {damaged.sum()} such rows are left out")
    return pd.DataFrame(columns).loc[~damaged].reset_index(drop=True), np.flatnonzero(~damaged)


def _convert_column(
    column: pd.Series, damaged: Bool[np.ndarray, " n"], decimal: str
) -> tuple[pd.Series, Bool[np.ndarray, " n"], str]:
    """A column of cells as numbers or times, if most are that; which of them are; and what is
    assumed about dates."""
    text = column.astype(str).str.strip(" \"'\0").str.replace("\u2212", "-")
    if decimal == "," and text[text.str.contains(".", regex=False)].str.fullmatch(_THOUSANDS).all():
        text = text.str.replace(".", "")
    blank = column.isna().to_numpy() | text.str.lower().isin(["", "nan"]).to_numpy()
    least = NUMERIC_SHARE * max((~blank & ~damaged).sum(), 1)
    numbers = pd.Series(pd.to_numeric(text.str.replace(",", "."), errors="coerce"))
    valid = numbers.notna().to_numpy()
    if (valid & ~blank & ~damaged).sum() >= least:
        return numbers, valid | blank, ""
    stamps, valid, remark = parse_times(text)
    if (valid & ~blank & ~damaged).sum() >= least:
        return pd.Series(stamps.astype("datetime64[ns]")), valid, remark
    return column, np.ones(len(column), dtype=bool), ""
