"""What copying, editing, converting or an attacker may do to a file.

A `Damage` is drawn by `damages` and done by `after`.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import re
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest
from hypothesis import strategies as st

# What may happen to a file.
ROWS = ("drop rows", "repeat rows", "reverse rows", "shuffle rows")
BYTES = tuple("cut behead flip hole empty blank noise twice deep".split())
PLACES = ("delete", "rename", "folder", "dangling link", "looping link")
TEXTS = {
    "CRLF": lambda text: text.replace("\n", "\r\n"),
    "CR": lambda text: text.replace("\n", "\r"),
    "BOM": lambda text: "\ufeff" + text,
    "semicolons": lambda text: text.replace("," if "," in text else " ", ";"),
    "tabs": lambda text: re.sub("[, ]", "\t", text),
    "comma for point": lambda text: text.replace(",", ";").replace(".", ","),
}
TEXT = (
    *ROWS,
    *TEXTS,
    "UTF-16",
    "Latin-1",
    "blank lines",
    "stray line",
    "no header",
    "header again",
)
TEXT += (*3 * ("cell",), "short row", "long row", "column", *2 * ("scale column",))
TEXT += ("drop column", "repeat column", "swap columns")
ARRAYS = (*ROWS, "drop field", "rename field", *3 * ("value",), "values", "scale field", "type")
ARRAYS += ("shape",)

# What may stand in it afterwards.
CELLS = ("", " ", *"text NaN nan None null inf -inf 1e400 1e300 1e30 -1e30 1e9 -1 0 1,5".split())
CELLS += ("1;5", "0x10", "--", "1e-320", "True", "2020-01-01", '"', '"1"', "'", "\x00", "#", "1 2")
CELLS += ("é", "9" * 400, "99999999999999999999")
LINES = ("not there", "../walk", "/", ".", "..", "", "# comment", "walk,walk", "a\x00b", "x" * 5000)
LINES += ("\ufeff", "é\u2028b", "C:\\walk", "~", "*", "**")
FACTORS = (0.0, -1.0, 1e-9, 1e-6, 1e-3, 0.5, 1.03, 2.0, 9.80665, 57.29578, 1e3, 1e6, 1e9)
FACTORS += (1e30, 1e300)
NUMBERS = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e3, 1e6, -1e9, 1e30, 1e300, 5e-324)
TYPES = ("<f4", ">f8", "<f2", "<i8", "u1", "c16", "S8", "bool", "struct")
LEAVES = (None, "x", "", [], {}, [[1]], True, -1, 0, 1e30, 10**400, float("nan"), float("inf"))
LEAVES += ([float("nan")] * 3, [0, 0, 0, 0], ["a"] * 4, -0.5, "1")
NO_DATE = b"T_BS: 2001-99-99\n"
GALAXY = b"T_BS: {data: [1, 0, 0, 1e300, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}\n"
BILLIONS = "".join(
    f"{name}: &{name} [{', '.join(9 * [before])}]\n"
    for before, name in zip("x *a *b *c *d *e *f".split(), "abcdefg", strict=True)
).encode()
BILLIONS += b"T_BS: {data: [*g, *g, *g, *g]}\n"
MOUNTS = ("[1, 2]", "{data: x}", "{data: [a, b]}", "", "{data: &a [*a]}", "1")
MOUNTS += ("!!python/object/apply:os.system ['true']", "!!binary x", "!!int ''", "!!timestamp x")
MOUNTS += ("!!bool x", "{data: [.nan, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}")
MOUNTS += ("{data: [2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}",)
YAMLS = (NO_DATE, GALAXY, BILLIONS, *(f"T_BS: {text}\n".encode() for text in MOUNTS))
YAMLS += (b"- 1\n", b"a: b: c\n", b"\tT_BS: 1\n", b"? [T_BS]\n: 1\n")
SHAPES = {
    "turned": np.transpose,
    "flat": np.ravel,
    "deeper": lambda a: a[..., None],
    "none": lambda a: a[:0],
    "one": lambda a: a[:1],
    "scalar": lambda a: a.reshape(-1)[0],
    "wider": lambda a: np.stack([a, a], axis=-1).reshape(len(a), -1),
    "narrower": lambda a: a[..., :-1],
    "rolled": lambda a: np.roll(a, 1, axis=-1),
}


class Damage(NamedTuple):
    """One thing that happens to one file. `where` and `much` are shares of it: of its bytes, rows,
    columns or fields."""

    file: str
    what: str
    where: float = 0.5
    much: float = 0.1
    token: Any = None


def _span(count: int, damage: Damage) -> slice:
    first = min(int(damage.where * count), max(count - 1, 0))
    return slice(first, first + max(int(damage.much * count), 1))


def _place(count: int, share: float) -> int:
    return min(int(share * count), count - 1)


def _random(damage: Damage) -> np.random.Generator:
    return np.random.default_rng(int(damage.where * 2**30) + int(damage.much * 2**30))


def _order(count: int, damage: Damage) -> np.ndarray:
    """Rows after dropping, repeating, turning round or shuffling some of them."""
    rows, span = np.arange(count), _span(count, damage)
    if damage.what == "drop rows":
        return np.delete(rows, span)
    if damage.what == "repeat rows":
        return np.insert(rows, span.start, rows[span])
    back = damage.what == "reverse rows"
    rows[span] = rows[span][::-1] if back else _random(damage).permutation(rows[span])
    return rows


def of_bytes(content: bytes, damage: Damage) -> bytes:
    count = len(content)
    match damage.what:
        case "cut":
            return content[: int(damage.where * count)]
        case "behead":
            return content[int(damage.where * count) :]
        case "flip":
            array = np.frombuffer(content, dtype=np.uint8).copy()
            if count:
                places = _random(damage).integers(0, count, 1 + int(8 * damage.much))
                array[places] ^= _random(damage).integers(1, 256, len(places)).astype(np.uint8)
            return array.tobytes()
        case "hole":  # what a download that was resumed wrongly leaves
            span = _span(count, damage)
            return content[: span.start] + bytes(len(content[span])) + content[span.stop :]
        case "noise":
            return _random(damage).bytes(1 + int(4096 * damage.much))
    return {
        "empty": b"",
        "blank": b" \n\n",
        "twice": content + content,
        "deep": b"[" * 5_000,
        "content": damage.token,
    }[damage.what]


def of_text(content: bytes, damage: Damage) -> bytes:
    text = content.decode("utf-8", errors="surrogateescape")
    if damage.what == "UTF-16":
        return text.encode("utf-16", errors="replace")
    if damage.what == "Latin-1":
        middle = int(damage.where * len(content))
        return content[:middle] + "é".encode("latin-1") + content[middle:]
    if damage.what in TEXTS:
        text = TEXTS[damage.what](text)
    else:
        lines = text.split("\n")
        separator = "," if any("," in line for line in lines[1:3]) else " "
        text = "\n".join(_of_lines(lines, separator, damage))
    return text.encode("utf-8", errors="surrogateescape")


def _of_lines(lines: list[str], separator: str, damage: Damage) -> list[str]:
    row = _place(len(lines), damage.where)
    between = {
        "blank lines": ["", "  ", "\t"],
        "stray line": [str(damage.token)],
        "header again": lines[:1],
    }
    if damage.what in between:
        return [*lines[:row], *between[damage.what], *lines[row:]]
    if damage.what in ROWS:
        return [lines[row] for row in _order(len(lines), damage)]
    if damage.what == "no header":
        return lines[1:]
    cells = [line.split(separator) for line in lines]
    column = _place(max(map(len, cells)), damage.much)
    if damage.what == "cell":
        cells[row][min(column, len(cells[row]) - 1)] = str(damage.token)
    elif damage.what == "short row":
        cells[row] = cells[row][:column]
    elif damage.what == "long row":
        cells[row].append(str(damage.token))
    else:
        headed = damage.what in ("column", "scale column")
        for entries in cells[headed:]:
            if len(entries) > column:
                _of_column(entries, column, damage)
    return [separator.join(entries) for entries in cells]


def _of_column(entries: list[str], column: int, damage: Damage) -> None:
    match damage.what:
        case "column":
            entries[column] = str(damage.token)
        case "scale column":
            with contextlib.suppress(ValueError):
                entries[column] = repr(float(entries[column]) * damage.token)
        case "drop column":
            del entries[column]
        case "repeat column":
            entries.insert(column, entries[column])
        case "swap columns":
            other = (column + 1) % len(entries)
            entries[column], entries[other] = entries[other], entries[column]


def of_arrays(arrays: dict[str, np.ndarray], damage: Damage) -> dict[str, np.ndarray]:
    """Fields of HDF5, npz and feather, or the one array of npy."""
    arrays = dict(arrays)
    name = sorted(arrays)[_place(len(arrays), damage.where)]
    array = arrays[name]
    real = array.dtype.kind == "f"
    if damage.what in ROWS:  # of this field alone, or of all that are as long
        for other, values in arrays.items():
            alike = values.ndim and damage.token and array.ndim and len(values) == len(array)
            if array.ndim and (other == name or alike):
                arrays[other] = values[_order(len(values), damage._replace(where=damage.much))]
    elif damage.what == "drop field":
        del arrays[name]
    elif damage.what == "rename field":
        arrays[f"{name}_"] = arrays.pop(name)
    elif damage.what == "value" and array.size and real:
        arrays[name] = array.copy()
        arrays[name].reshape(-1)[_place(array.size, damage.much)] = damage.token
    elif damage.what == "values" and real:
        arrays[name] = np.full_like(array, damage.token)
    elif damage.what == "scale field" and real:
        with np.errstate(all="ignore"):
            arrays[name] = array * damage.token
    elif damage.what == "type" and array.dtype.kind in "fiub":
        with np.errstate(all="ignore"):
            kind = [("x", "<f8")] if damage.token == "struct" else damage.token
            arrays[name] = array.astype(kind)
    elif damage.what == "shape" and array.ndim and array.size:
        arrays[name] = SHAPES[damage.token](array)
    return arrays


def of_json(content: bytes, damage: Damage) -> bytes:
    """A value by another one, or gone; the paths of all values and containers are numbered."""
    tree = json.loads(content)
    places: list[tuple[Any, Any]] = []

    def visit(node: Any) -> None:
        if isinstance(node, dict | list):
            for key in node if isinstance(node, dict) else range(len(node)):
                places.append((node, key))
                visit(node[key])

    visit(tree)
    node, key = places[_place(len(places), damage.where)]
    if damage.what == "drop value":
        del node[key]
    elif damage.what == "root":
        tree = damage.token
    else:
        node[key] = damage.token
    return json.dumps(tree).encode()


# --- containers of arrays


def unpacked(name: str, content: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """(fields, attributes) of a file. A field is a path in HDF5, a column in feather."""
    if name.endswith(".npy"):
        return {"": np.load(io.BytesIO(content))}, {}
    if name.endswith(".npz"):
        with np.load(io.BytesIO(content)) as file:
            return dict(file), {}
    if name.endswith(".feather"):
        feather = pytest.importorskip("pyarrow.feather")
        table = feather.read_table(io.BytesIO(content))
        return {field: table[field].to_numpy() for field in table.column_names}, {}
    arrays: dict[str, np.ndarray] = {}

    def visit(field: str, node: Any) -> None:
        if isinstance(node, h5py.Dataset):
            arrays[field] = node[()]

    with h5py.File(io.BytesIO(content)) as file:
        file.visititems(visit)
        return arrays, dict(file.attrs)


def packed(name: str, arrays: dict[str, np.ndarray], attributes: dict[str, Any]) -> bytes:
    out = io.BytesIO()
    if name.endswith(".npy"):
        if arrays:
            np.save(out, next(iter(arrays.values())), allow_pickle=False)
    elif name.endswith(".npz"):
        np.savez(out, **arrays)
    elif name.endswith(".feather"):
        import pyarrow
        from pyarrow import feather

        longest = max((np.size(values) for values in arrays.values()), default=0)
        columns = {}
        for field, values in arrays.items():
            flat = (values.astype("S8") if values.dtype.names else values).ravel()
            kind = "<f8" if flat.dtype.kind == "c" else flat.dtype.newbyteorder("=")
            rows = np.resize(flat.astype(kind), longest) if len(flat) else [None] * longest
            columns[field] = pyarrow.array(rows)
        feather.write_feather(pyarrow.table(columns), out)
    else:
        with h5py.File(out, "w") as file:
            for field, values in arrays.items():
                file.create_dataset(field, data=values)
            file.attrs.update(attributes)
    return out.getvalue()


def after(content: bytes, damage: Damage) -> bytes:
    """The file's content after the damage."""
    name = damage.file
    if damage.what in BYTES or damage.what == "content":
        return of_bytes(content, damage)
    if damage.what in ("json value", "drop value", "root"):
        return of_json(content, damage)
    if damage.what in ARRAYS and not name.endswith((".csv", ".txt")):
        arrays, attributes = unpacked(name, content)
        return packed(name, of_arrays(arrays, damage), attributes)
    return of_text(content, damage)


def damages(files: list[str]) -> st.SearchStrategy[Damage]:
    """One damage to one of the files, as its kind of file can have it."""
    share = st.floats(0.0, 1.0, width=32)

    @functools.cache  # a strategy is checked anew where it is made anew
    def of_file(file: str) -> st.SearchStrategy[Damage]:
        def some(what: tuple[str, ...], tokens: tuple = (None,)) -> st.SearchStrategy[Damage]:
            kinds, tokens = st.sampled_from(what), st.sampled_from(tokens)
            return st.builds(Damage, st.just(file), kinds, share, share, tokens)

        ways = [some(BYTES), some(PLACES)]
        if file.endswith((".csv", ".txt")):
            cells = tuple(what for what in TEXT if what != "scale column")
            ways += [some(cells, CELLS), some(("scale column",), FACTORS)]
            ways += [some(("cell", "stray line"), CELLS)]
            stem = PurePosixPath(file).stem.lower()
            if stem in ("test", "train", "val") or (file.endswith(".txt") and "list" in file):
                ways += [some(("stray line",), LINES)] * 2
        elif file.endswith(".json"):
            ways += [some(("json value", "drop value", "root"), LEAVES)] * 2
        elif file.endswith(".yaml"):
            ways += [some(("content",), YAMLS)]
        else:
            ways += [some(("value", "values"), NUMBERS), some(("scale field",), FACTORS)]
            ways += [some(("type",), TYPES), some(("shape",), tuple(SHAPES))]
            ways += [some(("drop field", "rename field", *ROWS), (False, True))]
        return st.one_of(ways)

    return st.sampled_from(files).flatmap(of_file)
