"""Tables of numbers from files: text, HDF5, NumPy's formats, feather; and JSON.

A `Table` checks a column in one place: whether it exists, whether it has numbers, and whether it is
complete. Rows are counted from 1 in every message, as in an editor, with header and comments
included.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int, Num
from scipy.spatial.transform import Rotation

from gnio_jax.data.parsing.stamps import first_rows, first_stamp, seconds
from gnio_jax.data.parsing.text import head_of, is_row, layout_of, open_text, strict_frame
from gnio_jax.data.parsing.text import shorten as shorten
from gnio_jax.data.validation import UNIT_NORM_TOLERANCE, check_increasing
from gnio_jax.errors import InputError, require_packages
from gnio_jax.numerics import rotations, wxyz_from_xyzw

if TYPE_CHECKING:
    import h5py

LARGEST_RATIO = 100
"""Largest ratio of the size of a compressed field of HDF5 in memory to that in the file."""


def damage_error(path: object, problem: str) -> InputError:
    """The error for a file whose content cannot be the published one."""
    return InputError(path, problem, "copy it again")


@contextmanager
def parsing_as(path: Path, kind: str) -> Iterator[None]:
    """Convert errors of a parser to an `InputError`. Only the parser's own calls belong inside,
    because otherwise our own errors would be reported as damage of the file."""
    try:
        yield
    except (InputError, AssertionError, NameError, ImportError):
        raise  # no damaged file causes these: they are ours, or those of the installation
    except MemoryError:
        problem = f"does not fit into memory as {kind}"
        raise InputError(path, problem, "if it should be smaller, copy it again") from None
    except Exception as error:  # a damaged file may cause any other error in a parser
        if path.is_file():
            head_of(path)
        reason = f"it may be cut short ({shorten(error, 200)})"
        raise damage_error(path, f"cannot be read as {kind}, {reason}") from None


def _is_odd(cell: object) -> bool:
    """Whether a cell is a text that Python reads as a number, though no logger writes it: `1_0`, or
    digits of another script."""
    return isinstance(cell, str) and ("_" in cell or not cell.isascii())


class Table(NamedTuple):
    """Columns of one file: by name, or by their places from 0 if there is no header."""

    path: Path
    columns: Mapping[Any, Any]
    """Series for text and feather; arrays for NumPy's formats and HDF5, which may have several
    axes."""
    kind: str = "column"
    """Word for one of them in messages: column or field."""
    before: int = 0
    """Number of lines before the first row of a text file."""
    content: bytes | None = None
    """Content of a text file that is part of an archive."""
    rows: Int[np.ndarray, " n"] | None = None
    """Numbers of the rows among those of the text, from 0; None: all."""

    def rename(self, names: Iterable[str]) -> Table:
        """The columns of a text under these names, in their order."""
        return self._replace(columns=pd.DataFrame(self.columns).set_axis([*names], axis=1))

    def width(self) -> int:
        """Number of columns."""
        return len(list(self.columns))

    def take(self, *names: Any, width: int | None = None, gaps: bool = False) -> np.ndarray:
        """Float64 of one column (n,), of several side by side (n, k), or of one field with `width`
        axes (n, width).

        Raises `InputError` if one is missing, has no numbers or another shape, and without `gaps`
        also if one is NaN or infinite.
        """
        axes = () if width is None else (width,)
        parts = [self._numbers(name, axes) for name in names]
        values = np.stack(parts, axis=1) if len(parts) > 1 else parts[0]
        finite = np.isfinite(values)
        if not gaps and not finite.all():
            row, *axis = np.argwhere(~finite)[0].tolist()
            name = names[axis[0] if len(names) > 1 else 0]
            count = (~finite.reshape(len(finite), -1)).any(axis=1).sum()
            problem = f"is NaN or Inf in {count} rows, first in row {self.row(row)}"
            remedy = "repair or cut the recording there"
            raise InputError(self.path, f"{self.kind} '{name}' {problem}", remedy)
        return values

    def axes(self, prefix: str, letters: str = "xyz", gaps: bool = False) -> np.ndarray:
        """The columns `prefix` + letter side by side."""
        return self.take(*(prefix + letter for letter in letters), gaps=gaps)

    def stamps(self, name: Any) -> Num[np.ndarray, " n"]:
        """A complete column of stamps. Integers remain integers, because ns of unix time have more
        digits than a float."""
        column = self._column(name)
        whole = column.ndim == 1 and column.dtype.kind in "iu"
        return np.asarray(column) if whole else self.take(name)

    def clock(
        self,
        name: Any,
        unit: str,
        start: float | int | None = None,
        repeats: Literal["refused", "dropped", "kept"] = "refused",
    ) -> tuple[Float[np.ndarray, " m"], float | int, slice | Int[np.ndarray, " m"]]:
        """Time (s since `start`), `start` and rows of a column of stamps in `unit`; `start` is the
        earliest stamp if none is given.

        `repeats` decides about rows that repeat a stamp or come late: they are an error, or the
        first row of each stamp is taken, in their order, or they remain for `assemble`. Raises
        `InputError` for this error, and if the stamps span too much time (`first_stamp`).
        """
        stamps, field = self.stamps(name), name if isinstance(name, str) else "time"
        first = first_stamp(stamps, unit, self.path, field)
        start = first if start is None else start
        rows = first_rows(stamps, self.path, field) if repeats == "dropped" else slice(None)
        time = seconds(stamps[rows], start, unit)
        if repeats == "refused":
            check_increasing(time, self.path, self.row)
        return time, start, rows

    def rotations(
        self,
        *names: Any,
        width: int | None = None,
        scalar_first: bool = True,
        rows: slice | Bool[np.ndarray, " n"] | Int[np.ndarray, " m"] = slice(None),
    ) -> Rotation:
        """Rotations of unit quaternions in these rows. Raises `InputError` as `take` does, and if a
        norm differs from 1 by more than `UNIT_NORM_TOLERANCE`."""
        wxyz = self.take(*names, width=width, gaps=True)
        numbers = np.arange(len(wxyz))[rows]
        norm = np.linalg.norm(wxyz[numbers], axis=1)
        bad = ~(np.abs(norm - 1.0) <= UNIT_NORM_TOLERANCE)
        if bad.any():
            first = int(np.argmax(bad))
            labels = "', '".join(map(str, names))
            subject = f"s '{labels}' are" if len(names) > 1 else f" '{labels}' is"
            problem = f"{self.kind}{subject} not a unit quaternion in {bad.sum()} rows, first in"
            problem += f" row {self.row(int(numbers[first]))} (norm {norm[first]:.4g})"
            raise InputError(self.path, problem, "check the column order and normalize")
        return rotations(wxyz[numbers] if scalar_first else wxyz_from_xyzw(wxyz[numbers]))

    def row(self, index: int) -> int:
        """The row of the file, counted from 1, with entry `index` of every column."""
        index = index if self.rows is None else int(self.rows[index])
        if not self.before and self.content is None:
            return index + 1
        with open_text(self.path, self.content) as file:
            numbers = (n for n, line in enumerate(file, 1) if n > self.before and is_row(line))
            return next(islice(numbers, index, None), self.before + index + 1)

    def _column(self, name: Any) -> Any:
        if name not in self.columns:
            names = shorten(", ".join(str(column) for column in self.columns), 600)
            raise InputError(self.path, f"{self.kind} '{name}' is missing", f"found: {names}")
        column = self.columns[name]
        if isinstance(column, pd.DataFrame):
            problem = f"column '{name}' is there {column.shape[1]} times"
            raise InputError(self.path, problem, "leave one")
        return column

    def _numbers(self, name: Any, axes: tuple[int, ...]) -> np.ndarray:
        """A column with these axes and as many rows as the first one, at least two."""
        column, what = self._column(name), f"{self.kind} '{name}'"
        if not isinstance(column, np.ndarray):
            try:  # the columns of a frame have the same length
                if column.dtype.kind != "O" or not column.map(_is_odd).any():
                    return column.to_numpy(dtype=np.float64, na_value=np.nan)
                raise ValueError
            except (TypeError, ValueError, OverflowError):  # Python's integers may be of any size
                cells = pd.to_numeric(column.where(~column.map(_is_odd), "").astype(str), "coerce")
                bad = ~np.isfinite(pd.Series(cells, dtype=np.float64).to_numpy())
                row = int(np.argmax(bad & column.notna().to_numpy()))
                cell = f"'{shorten(column.iloc[row])}' in its row {self.row(row)}"
                raise InputError(self.path, f"{what} holds {cell}, no number") from None
        if column.dtype.kind not in "fiu":
            raise damage_error(self.path, f"{what} holds {column.dtype}, expected numbers")
        rows = np.shape(next(iter(self.columns.values())))[:1] or (0,)
        if column.shape != rows + axes or rows[0] < 2:
            expected = rows + axes if rows[0] >= 2 else f"at least two rows of {axes or 'numbers'}"
            raise damage_error(self.path, f"{what} has shape {column.shape}, expected {expected}")
        return column.astype(np.float64)


# --- text


def text_of(path: Path) -> str:
    """The content of a text file, without a byte order mark."""
    head_of(path)
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError as error:
        raise damage_error(path, f"is no text ({shorten(error)})") from None


def read_text(
    path: Path,
    separator: str = ",",
    header: bool = True,
    content: bytes | None = None,
    widths: tuple[int, ...] = (),
) -> Table:
    """The columns of a published table by their names, or by their places from 0 without a
    `header`.

    The header is the line above the rows with as many cells and no number; it may be a comment, and
    other lines above the rows must be comments. `separator` " " means any run of blanks. `content`
    is the content of a file that is part of an archive; `path` is then its name in messages. Raises
    `InputError` naming the file and the line if it is missing, empty or no such table, or if its
    number of columns is none of `widths`.
    """
    layout = layout_of(path, content, separator)
    if not header:  # whatever stands above the rows is read as one, and refused by its column
        with open_text(path, content, layout.encoding) as file:
            before = next((n for n, line in enumerate(file) if is_row(line)), 0)
        layout = layout._replace(before=before)
    frame = strict_frame(path, layout, content)
    if widths and frame.shape[1] not in widths:
        problem = f"has {frame.shape[1]} columns, expected {' or '.join(map(str, widths))}"
        raise InputError(path, problem, "take the file as published")
    subheaders = (layout.separator.join(cells) for cells in layout.subheaders)
    words = [line for line in (*layout.preamble, *subheaders) if is_row(line)]
    if header and words:
        problem = f"has a line with '{shorten(words[0], 60)}' above its rows of {layout.width}"
        raise InputError(path, f"{problem} numbers", "gnio data import reads such a table")
    if header and layout.labels:
        frame.columns = list(layout.labels)
    return Table(path, frame, before=layout.before, content=content)


# --- other formats


def hdf5_node(group: h5py.Group, name: str, path: Path) -> Any:
    """The node of an HDF5 group with this name ("group/field"); None if there is none. Raises
    `InputError` for a link to another place."""
    import h5py

    node: Any = group
    for part in name.split("/"):
        if not isinstance(node, h5py.Group):
            return None
        if isinstance(node.get(part, getlink=True), h5py.ExternalLink | h5py.SoftLink):
            raise damage_error(path, f"field '{name}' is a link")
        node = node.get(part)
    return node


def hdf5_field(group: h5py.Group, name: str, path: Path) -> np.ndarray | None:
    """The array with this name; None if there is none.

    Raises `InputError` for a link to another place, and for an array that would be far larger in
    memory than in the file.
    """
    import h5py

    node = hdf5_node(group, name, path)
    if not isinstance(node, h5py.Dataset):
        return None
    most = LARGEST_RATIO * node.id.get_storage_size() + 1_000_000
    chunk = math.prod(node.chunks or ()) * node.dtype.itemsize  # it is unpacked as a whole
    size = max(node.nbytes, chunk)
    if node.external or node.is_virtual or size > most:
        problem = f"would take {size} bytes, which the file does not hold"
        raise damage_error(path, f"field '{name}' {problem}")
    return np.asarray(node)


def read_hdf5_fields(path: Path, names: Iterable[str]) -> Table:
    """The fields `names` (at any depth, "group/field") that exist in an HDF5 file."""
    import h5py

    with parsing_as(path, "HDF5"), h5py.File(path, "r") as file:
        fields = {name: hdf5_field(file, name, path) for name in names}
    return Table(path, {n: values for n, values in fields.items() if values is not None}, "field")


def read_npz(path: Path) -> Table:
    """The arrays of an npz."""
    with parsing_as(path, "npz"), np.load(path, allow_pickle=False) as file:
        return Table(path, dict(file), "field")


def read_npy(path: Path, names: Mapping[str, slice], width: int) -> Table:
    """The fields, by name, of the table (N, `width`) of floats in an npy; one column is (N,)."""
    with parsing_as(path, "a NumPy array"):
        # The file is mapped, because a damaged header may state more rows than fit into memory.
        table = np.load(path, mmap_mode="r", allow_pickle=False)
    if table.ndim != 2 or table.shape[1] != width or table.dtype.kind != "f" or len(table) < 2:
        problem = f"holds {table.dtype} of shape {table.shape}, expected floats (N, {width})"
        raise damage_error(path, problem)
    fields = {name: np.asarray(table[:, columns]) for name, columns in names.items()}
    fields = {n: field[:, 0] if field.shape[1] == 1 else field for n, field in fields.items()}
    return Table(path, fields, "field")


def read_feather(path: Path) -> Table:
    """The columns of a feather file; needs pyarrow."""
    require_packages(path, "idol", "pyarrow")
    from pyarrow import feather

    if not path.exists():
        raise InputError(path, "no such file")
    with parsing_as(path, "feather"):
        # The metadata of pandas about its index are not needed here.
        return Table(path, feather.read_table(str(path)).to_pandas(ignore_metadata=True))


def json_object(path: Path, remedy: str = "copy it again") -> dict[str, Any]:
    """The object in a JSON file; `remedy` is the advice if it cannot be opened."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", remedy) from None
    except (ValueError, RecursionError) as error:
        raise damage_error(path, f"is no JSON ({shorten(error, 200)})") from None
    if not isinstance(content, dict):
        raise damage_error(path, "is not a JSON object")
    return content
