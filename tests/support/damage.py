"""What copying, editing, converting or an attacker may do to a file.

A `Damage` is drawn by `damages` and done by `after`. Its tables are in `damage_values`.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import re
from collections.abc import Callable
from pathlib import PurePosixPath
from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest
from hypothesis import strategies as st

from tests.support.damage_values import (
    ARRAYS,
    BYTES,
    CELLS,
    FACTORS,
    LEAVES,
    LINES,
    NUMBERS,
    PLACES,
    ROWS,
    SHAPES,
    TEXT,
    TYPES,
    YAMLS,
)


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


def _pick(items: list, share: float) -> int:
    return min(int(share * len(items)), len(items) - 1)


def _random(damage: Damage) -> np.random.Generator:
    return np.random.default_rng(int(damage.where * 2**30) + int(damage.much * 2**30))


def _order(count: int, damage: Damage) -> np.ndarray:
    """Rows after dropping, repeating, turning round or shuffling some of them."""
    rows, span = np.arange(count), _span(count, damage)
    if damage.what == "drop rows":
        return np.delete(rows, span)
    if damage.what == "repeat rows":
        return np.insert(rows, span.start, rows[span])
    rows[span] = (
        rows[span][::-1]
        if damage.what == "reverse rows"
        else _random(damage).permutation(rows[span])
    )
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
        case "empty":
            return b""
        case "blank":
            return b" \n\n"
        case "noise":
            return _random(damage).bytes(1 + int(4096 * damage.much))
        case "twice":
            return content + content
        case "deep":
            return b"[" * 20_000
        case "content":
            return damage.token
    raise AssertionError(damage.what)


def of_text(content: bytes, damage: Damage) -> bytes:
    text = content.decode("utf-8", errors="surrogateescape")
    match damage.what:
        case "CRLF":
            text = text.replace("\n", "\r\n")
        case "CR":
            text = text.replace("\n", "\r")
        case "BOM":
            text = "\ufeff" + text
        case "UTF-16":
            return text.encode("utf-16", errors="replace")
        case "Latin-1":
            return (
                content[: int(damage.where * len(content))]
                + "é".encode("latin-1")
                + content[int(damage.where * len(content)) :]
            )
        case "semicolons":
            text = text.replace(",", ";") if "," in text else text.replace(" ", ";")
        case "tabs":
            text = re.sub("[, ]", "\t", text)
        case "comma for point":
            text = text.replace(",", ";").replace(".", ",")
        case _:
            lines = text.split("\n")
            separator = "," if any("," in line for line in lines[1:3]) else " "
            text = "\n".join(_of_lines(lines, separator, damage))
    return text.encode("utf-8", errors="surrogateescape")


def _of_lines(lines: list[str], separator: str, damage: Damage) -> list[str]:
    if damage.what in ROWS:
        return [lines[row] for row in _order(len(lines), damage)]
    if damage.what == "blank lines":
        row = _pick(lines, damage.where)
        return [*lines[:row], "", "  ", "\t", *lines[row:]]
    if damage.what == "stray line":
        row = _pick(lines, damage.where)
        return [*lines[:row], str(damage.token), *lines[row:]]
    if damage.what == "no header":
        return lines[1:]
    if damage.what == "header again":
        row = _pick(lines, damage.where)
        return [*lines[:row], lines[0], *lines[row:]]
    cells = [line.split(separator) for line in lines]
    widest = max(len(row) for row in cells)
    column = min(int(damage.much * widest), widest - 1)
    row = _pick(cells, damage.where)
    if damage.what == "cell":
        cells[row][min(column, len(cells[row]) - 1)] = str(damage.token)
    elif damage.what == "short row":
        cells[row] = cells[row][:column]
    elif damage.what == "long row":
        cells[row] = [*cells[row], str(damage.token)]
    else:
        for number, entries in enumerate(cells):
            if len(entries) <= column or (
                number == 0 and damage.what in ("column", "scale column")
            ):
                continue
            if damage.what == "column":
                entries[column] = str(damage.token)
            elif damage.what == "scale column":
                with contextlib.suppress(ValueError):
                    entries[column] = repr(float(entries[column]) * damage.token)
            elif damage.what == "drop column":
                del entries[column]
            elif damage.what == "repeat column":
                entries.insert(column, entries[column])
            else:  # swap columns
                other = (column + 1) % len(entries)
                entries[column], entries[other] = entries[other], entries[column]
    return [separator.join(entries) for entries in cells]


def of_arrays(arrays: dict[str, np.ndarray], damage: Damage) -> dict[str, np.ndarray]:
    """Fields of HDF5, npz and feather, or the one array of npy."""
    arrays = dict(arrays)
    name = sorted(arrays)[_pick(sorted(arrays), damage.where)]
    array = arrays[name]
    if damage.what in ROWS:  # of this field alone, or of all that are as long
        for other, values in arrays.items():
            if (
                array.ndim
                and values.ndim
                and (other == name or (damage.token and len(values) == len(array)))
            ):
                arrays[other] = values[_order(len(values), damage._replace(where=damage.much))]
    elif damage.what == "drop field":
        del arrays[name]
    elif damage.what == "rename field":
        arrays[f"{name}_"] = arrays.pop(name)
    elif damage.what == "value" and array.size and array.dtype.kind == "f":
        array = array.copy()
        array.reshape(-1)[_pick(range(array.size), damage.much)] = damage.token
        arrays[name] = array
    elif damage.what == "values" and array.dtype.kind == "f":
        arrays[name] = np.full_like(array, damage.token)
    elif damage.what == "scale field" and array.dtype.kind == "f":
        with np.errstate(all="ignore"):
            arrays[name] = array * damage.token
    elif damage.what == "type":
        with np.errstate(all="ignore"):
            kind = [("x", "<f8")] if damage.token == "struct" else damage.token
            arrays[name] = array.astype(kind) if array.dtype.kind in "fiub" else array
    elif damage.what == "shape":
        shapes: dict[str, Callable[[np.ndarray], np.ndarray]] = {
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
        if array.ndim and array.size:
            arrays[name] = shapes[damage.token](array)
    return arrays


def of_json(content: bytes, damage: Damage) -> bytes:
    """A value by another one, or gone; the paths of all values and containers are numbered."""
    tree = json.loads(content)
    places: list[tuple[Any, Any]] = []

    def visit(node: Any) -> None:
        for key in (
            node if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else ()
        ):
            places.append((node, key))
            visit(node[key])

    visit(tree)
    node, key = places[_pick(places, damage.where)]
    if damage.what == "drop value":
        del node[key]
    elif damage.what == "root":
        tree = damage.token
    else:
        node[key] = damage.token
    return json.dumps(tree).encode()


# --- containers of arrays


def _unpack(name: str, content: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """(fields, attributes) of a file. A field is a path in HDF5, a column in feather."""
    if name.endswith(".npy"):
        return {"": np.load(io.BytesIO(content))}, {}
    if name.endswith(".npz"):
        with np.load(io.BytesIO(content)) as file:
            return {field: file[field] for field in file.files}, {}
    if name.endswith(".feather"):
        feather = pytest.importorskip("pyarrow.feather")
        table = feather.read_table(io.BytesIO(content))
        return {field: table[field].to_numpy() for field in table.column_names}, {}
    arrays: dict[str, np.ndarray] = {}
    with h5py.File(io.BytesIO(content)) as file:
        file.visititems(
            lambda field, node: (
                arrays.update({field: node[()]}) if isinstance(node, h5py.Dataset) else None
            )
        )
        return arrays, dict(file.attrs)


def _pack(name: str, arrays: dict[str, np.ndarray], attributes: dict[str, Any]) -> bytes:
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
            flat = (
                flat.astype("<f8")
                if flat.dtype.kind == "c"
                else flat.astype(flat.dtype.newbyteorder("="))
            )
            columns[field] = pyarrow.array(
                np.resize(flat, longest) if len(flat) else [None] * longest
            )
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
        arrays, attributes = _unpack(name, content)
        return _pack(name, of_arrays(arrays, damage), attributes)
    return of_text(content, damage)


def damages(files: list[str]) -> st.SearchStrategy[Damage]:
    """One damage to one of the files, as its kind of file can have it."""
    share = st.floats(0.0, 1.0, width=32)

    @functools.cache  # a strategy is checked anew where it is made anew
    def of_file(file: str) -> st.SearchStrategy[Damage]:
        def some(
            what: tuple[str, ...], tokens: tuple[Any, ...] = (None,)
        ) -> st.SearchStrategy[Damage]:
            return st.builds(
                Damage, st.just(file), st.sampled_from(what), share, share, st.sampled_from(tokens)
            )

        ways = [some(BYTES), some(PLACES)]
        if file.endswith((".csv", ".txt")):
            scaled = some(("scale column",), FACTORS)
            listed = (file.endswith(".txt") and "list" in file.lower()) or PurePosixPath(
                file
            ).stem.lower() in ("test", "train", "val")
            ways += [
                some(TEXT, CELLS).filter(lambda damage: damage.what != "scale column"),
                scaled,
                some(("cell", "stray line"), CELLS),
            ]
            ways += [some(("stray line",), LINES)] * (2 if listed else 0)
        elif file.endswith(".json"):
            ways += [some(("json value", "drop value", "root"), LEAVES)] * 2
        elif file.endswith(".yaml"):
            ways += [some(("content",), YAMLS)]
        else:
            ways += [
                some(("value", "values"), NUMBERS),
                some(("scale field",), FACTORS),
                some(("type",), TYPES),
                some(("shape",), SHAPES),
                some(("drop field", "rename field", *ROWS), (False, True)),
            ]
        return st.one_of(ways)

    return st.sampled_from(files).flatmap(of_file)
