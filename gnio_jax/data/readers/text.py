"""Text files as data sets publish them: columns of numbers, and lists of sequences. A parser that
is quick over millions of rows."""

from __future__ import annotations

import io
import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd

from gnio_jax.data.parsing.tables import open_text, shortened
from gnio_jax.errors import InputError


def read_csv(
    path: str | os.PathLike[str],
    separator: str = ",",
    header: bool = True,
    content: bytes | None = None,
    decimal: str = ".",
) -> pd.DataFrame:
    """The columns of a text file by their names (stripped of blanks and of a leading '#'), or by
    their places from 0 without a header.

    Lines that begin with '#' are no data; the last of them before the data names the columns if
    `header`, or else the first line does. `separator` " " stands for any run of blanks. `content`
    is what the file holds where it is part of an archive; `path` is then its name in messages.
    Raises `InputError` naming the file when it is missing, empty or no table.
    """
    path = Path(path)
    try:
        comments, first = _before_data(path, content)
        names = next((line for line in reversed(comments) if line.startswith("#")), None)
        skip = len(comments)
        if header and names is None:
            names, skip = first, skip + 1
        table = pd.read_csv(
            path if content is None else io.BytesIO(content),
            header=None,
            skiprows=skip,
            comment="#",
            sep=r"\s+" if separator == " " else separator,
            skipinitialspace=True,
            skip_blank_lines=True,
            low_memory=False,
            decimal=decimal,
        )
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})") from None
    except InputError:
        raise
    except pd.errors.EmptyDataError:
        raise InputError(path, "holds no row", "copy it again") from None
    except (UnicodeDecodeError, pd.errors.ParserError, ValueError) as error:
        raise InputError(
            path,
            f"is no table of text ({shortened(error, 200)})",
            "it may be cut short or damaged: copy it again",
        ) from None
    if header:
        table.columns = _labels(names or "", separator, table.shape[1], path)
    return table


def _before_data(path: Path, content: bytes | None) -> tuple[list[str], str]:
    """(lines of comments and blanks before the first line that is neither, that line)."""
    before = []
    with open_text(path, content) as file:
        for line in file:
            if not line.startswith("#") and line.strip():
                return before, line
            before.append(line)
    raise InputError(path, "holds no row", "copy it again")


def _labels(names: str, separator: str, width: int, path: Path) -> list[str]:
    """The names of `width` columns."""
    entries = names.lstrip("#").strip().split(None if separator == " " else separator)
    labels = [entry.strip() for entry in entries]
    if len(labels) == width + 1 and not labels[-1]:
        labels = labels[:-1]
    if len(labels) != width:
        raise InputError(
            path, f"its header names {len(labels)} columns, its rows have {width}", "copy it again"
        )
    return labels


def numbers(table: pd.DataFrame, columns: Iterable[object], path: object) -> np.ndarray:
    """(rows, columns) float64 of the named columns; NaN stays. Raises `InputError` for a column
    that is missing or holds text."""
    out = []
    for name in columns:
        if name not in table.columns:
            known = ", ".join(str(column) for column in table.columns)
            raise InputError(path, f"column '{name}' is missing", f"found: {shortened(known, 600)}")
        values = table[name]
        if isinstance(values, pd.DataFrame):
            raise InputError(path, f"column '{name}' is there {values.shape[1]} times", "leave one")
        try:
            out.append(values.to_numpy(dtype=np.float64, na_value=np.nan))
        except (TypeError, ValueError, OverflowError):  # Python's integers have no end
            as_number = pd.Series(
                pd.to_numeric(values.astype(str), errors="coerce"), dtype=np.float64
            )
            row = int(np.argmax(~np.isfinite(as_number.to_numpy()) & values.notna().to_numpy()))
            cell = shortened(values.iloc[row])
            raise InputError(
                path, f"column '{name}' holds '{cell}' in its row {row + 1}, no number"
            ) from None
    return np.stack(out, axis=1)
