"""What copying, editing, converting or an attacker may do to a file.

A `Damage` is drawn by `damages` and done by `after`.
"""

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
WHOLE = {
    "empty": lambda content: b"",
    "blank": lambda content: b" \n\n",
    "twice": lambda content: content + content,
    "deep": lambda content: b"[" * 5_000,
}
BYTES = ("cut", "behead", "flip", "hole", *WHOLE)
PLACES = ("delete", "rename", "folder", "dangling link", "looping link")
TEXTS = {
    "CRLF": lambda text: text.replace("\n", "\r\n"),
    "CR": lambda text: text.replace("\n", "\r"),
    "BOM": lambda text: "\ufeff" + text,
    "semicolons": lambda text: text.replace("," if "," in text else " ", ";"),
    "tabs": lambda text: re.sub("[, ]", "\t", text),
    "comma for point": lambda text: text.replace(",", ";").replace(".", ","),
}
TEXT = (*ROWS, *TEXTS, "UTF-16", "Latin-1", "blank lines", "stray line", "no header")
TEXT += (*3 * ("cell",), "short row", "long row", "column", "drop column", "swap columns")

# What may stand in it afterwards.
CELLS = ("", " ", *"text NaN nan None inf -inf 1e400 1e300 1e30 -1e30 1e9 -1 0 1,5 0x10 --".split())
CELLS += ("1e-320", "True", "2020-01-01", '"', '"1"', "\x00", "#", "1 2", "é", "9" * 400)
LINES = ("not there", "../walk", "/", ".", "", "# comment", "walk,walk", "a\x00b", "x" * 5000)
LINES += ("\ufeff", "é\u2028b", "C:\\walk", "~", "**")
FACTORS = (0.0, -1.0, 1e-9, 1e-3, 0.5, 1.03, 9.80665, 57.29578, 1e3, 1e6, 1e9, 1e30, 1e300)
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
MOUNTS = ("[1, 2]", "{data: x}", "{data: [a, b]}", "", "{data: &a [*a]}", "!!binary x", "!!int ''")
MOUNTS += ("{data: [.nan, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}",)
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
}


class Damage(NamedTuple):
    """One thing that happens to one file. `where` and `much` are shares of it: of its bytes, rows,
    columns or fields."""

    file: str
    what: str
    where: float = 0.5
    much: float = 0.1
    token: Any = None


def _span(count, damage):
    first = min(int(damage.where * count), max(count - 1, 0))
    return slice(first, first + max(int(damage.much * count), 1))


def _place(count, share):
    return min(int(share * count), count - 1)


def _random(damage):
    return np.random.default_rng(int(damage.where * 2**30) + int(damage.much * 2**30))


def _order(count, damage):
    """Rows after dropping, repeating, turning round or shuffling some of them."""
    rows, span = np.arange(count), _span(count, damage)
    if damage.what == "drop rows":
        return np.delete(rows, span)
    if damage.what == "repeat rows":
        return np.insert(rows, span.start, rows[span])
    back = damage.what == "reverse rows"
    rows[span] = rows[span][::-1] if back else _random(damage).permutation(rows[span])
    return rows


def of_bytes(content, damage):
    count = len(content)
    match damage.what:
        case "content":
            return damage.token
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
    return WHOLE[damage.what](content)


def of_text(content, damage):
    text = content.decode("utf-8", errors="surrogateescape")
    if damage.what == "UTF-16":
        return text.encode("utf-16", errors="replace")
    if damage.what == "Latin-1":
        middle = int(damage.where * len(content))
        return content[:middle] + "é".encode("latin-1") + content[middle:]
    if damage.what in TEXTS:
        text = TEXTS[damage.what](text)
    else:
        text = "\n".join(_of_lines(text.split("\n"), damage))
    return text.encode("utf-8", errors="surrogateescape")


def _of_lines(lines, damage):
    row = _place(len(lines), damage.where)
    match damage.what:
        case "blank lines":
            return [*lines[:row], "", "  ", "\t", *lines[row:]]
        case "stray line":
            return [*lines[:row], str(damage.token), *lines[row:]]
        case "no header":
            return lines[1:]
        case what if what in ROWS:
            return [lines[index] for index in _order(len(lines), damage)]
    separator = "," if any("," in line for line in lines[1:3]) else " "
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


def _of_column(entries, column, damage):
    match damage.what:
        case "column":
            entries[column] = str(damage.token)
        case "scale column":
            with contextlib.suppress(ValueError):
                entries[column] = repr(float(entries[column]) * damage.token)
        case "drop column":
            del entries[column]
        case "swap columns":
            other = (column + 1) % len(entries)
            entries[column], entries[other] = entries[other], entries[column]


def of_arrays(arrays, damage):
    """Fields of HDF5, npz and feather, or the one array of npy."""
    arrays, token = dict(arrays), damage.token
    name = sorted(arrays)[_place(len(arrays), damage.where)]
    array = arrays[name]
    match damage.what, array.dtype.kind:
        case ("drop field", _):
            del arrays[name]
        case ("rename field", _):
            arrays[f"{name}_"] = arrays.pop(name)
        case ("value", "f") if array.size:
            arrays[name] = array.copy()
            arrays[name].reshape(-1)[_place(array.size, damage.much)] = token
        case ("values", "f"):
            arrays[name] = np.full_like(array, token)
        case ("scale field", "f"):
            arrays[name] = array * token
        case ("type", kind) if kind in "fiub":
            arrays[name] = array.astype([("x", "<f8")] if token == "struct" else token)
        case ("shape", _) if array.ndim and array.size:
            arrays[name] = SHAPES[token](array)
        case (what, _) if what in ROWS and array.ndim:  # of all that are as long, or of it alone
            alike = [key for key in arrays if token and arrays[key].shape[:1] == array.shape[:1]]
            for key in alike or [name]:
                rows = _order(len(array), damage._replace(where=damage.much))
                arrays[key] = arrays[key][rows]
    return arrays


def of_json(content, damage):
    """A value by another one, or gone; all values and containers are numbered."""
    tree = json.loads(content)
    places = []

    def visit(node):
        if isinstance(node, dict | list):
            for key in node if isinstance(node, dict) else range(len(node)):
                places.append((node, key))
                visit(node[key])

    visit(tree)
    node, key = places[_place(len(places), damage.where)]
    if damage.what == "drop value":
        del node[key]
    else:
        node[key] = damage.token
    return json.dumps(damage.token if damage.what == "root" else tree).encode()


# --- containers of arrays


def unpacked(name, content):
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
    arrays = {}

    def visit(field, node):
        if isinstance(node, h5py.Dataset):
            arrays[field] = node[()]

    with h5py.File(io.BytesIO(content)) as file:
        file.visititems(visit)
        return arrays, dict(file.attrs)


def packed(name, arrays, attributes):
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


def after(content, damage):
    """The file's content after the damage."""
    name = damage.file
    if damage.what in BYTES or damage.what == "content":
        return of_bytes(content, damage)
    if damage.what in ("json value", "drop value", "root"):
        return of_json(content, damage)
    if name.endswith((".csv", ".txt")):
        return of_text(content, damage)
    arrays, attributes = unpacked(name, content)
    with np.errstate(all="ignore"):
        return packed(name, of_arrays(arrays, damage), attributes)


def damages(files):
    """One damage to one of the files, as its kind of file can have it."""
    share = st.floats(0.0, 1.0, width=32)

    @functools.cache  # a strategy is checked anew where it is made anew
    def of_file(file):
        def some(what, tokens=(None,)):
            kinds, tokens = st.sampled_from(what), st.sampled_from(tokens)
            return st.builds(Damage, st.just(file), kinds, share, share, tokens)

        ways = [some(BYTES), some(PLACES)]
        if file.endswith((".csv", ".txt")):
            ways += [some(TEXT, CELLS), some(("scale column",), FACTORS)]
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
