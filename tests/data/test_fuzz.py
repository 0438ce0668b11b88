"""Damaged files of every layout end in a plausible sequence or in one line that names the file,
never in anything else.

A short recording is written once per layout; each example copies it and does to one or two of its
files what copying, editing, converting or an attacker may do to them. What must hold is stated in
`check_sequence` and `check_refusal`, without the package's help.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import pickle
import re
import shutil
import signal
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterator
from datetime import timedelta
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple

import h5py
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from gnio_jax import data
from gnio_jax.types import InputError, Sequence
from tests.support.layouts import LAYOUTS, Layout

SECONDS_PER_EXAMPLE = 20
# --- what may happen to a file
# ---------------------------------------------------------------------------------------


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


ROWS = ("drop rows", "repeat rows", "reverse rows", "shuffle rows")


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


BYTES = ("cut", "behead", "flip", "hole", "empty", "blank", "noise", "twice", "deep")

CELLS = (
    "",
    " ",
    "text",
    "NaN",
    "nan",
    "None",
    "null",
    "inf",
    "-inf",
    "1e400",
    "1e300",
    "1e30",
    "-1e30",
    "1e9",
    "-1",
    "0",
    "1,5",
    "1;5",
    "0x10",
    "--",
    "1e-320",
    "True",
    "2020-01-01",
    '"',
    '"1"',
    "'",
    "\x00",
    "#",
    "1 2",
    "é",
    "9" * 400,
    "99999999999999999999",
)
FACTORS = (
    0.0,
    -1.0,
    1e-9,
    1e-6,
    1e-3,
    0.5,
    1.03,
    2.0,
    9.80665,
    57.29578,
    1e3,
    1e6,
    1e9,
    1e30,
    1e300,
)


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


TEXT = (
    *ROWS,
    "CRLF",
    "CR",
    "BOM",
    "UTF-16",
    "Latin-1",
    "semicolons",
    "tabs",
    "comma for point",
    "blank lines",
    "stray line",
    "no header",
    "header again",
    "cell",
    "cell",
    "cell",
    "short row",
    "long row",
    "column",
    "scale column",
    "scale column",
    "drop column",
    "repeat column",
    "swap columns",
)
LINES = (
    "not there",
    "../walk",
    "/",
    ".",
    "..",
    "",
    "# comment",
    "walk,walk",
    "a\x00b",
    "x" * 5000,
    "\ufeff",
    "é\u2028b",
    "C:\\walk",
    "~",
    "*",
    "**",
)

NUMBERS = (np.nan, np.inf, -np.inf, 0.0, -1.0, 1e3, 1e6, -1e9, 1e30, 1e300, 5e-324)
TYPES = ("<f4", ">f8", "<f2", "<i8", "u1", "c16", "S8", "bool", "struct")


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


SHAPES = ("turned", "flat", "deeper", "none", "one", "scalar", "wider", "narrower", "rolled")
ARRAYS = (
    *ROWS,
    "drop field",
    "rename field",
    "value",
    "value",
    "value",
    "values",
    "scale field",
    "type",
    "shape",
)

LEAVES = (
    None,
    "x",
    "",
    [],
    {},
    [[1]],
    True,
    -1,
    0,
    1e30,
    10**400,
    float("nan"),
    float("inf"),
    [float("nan")] * 3,
    [0, 0, 0, 0],
    ["a"] * 4,
    -0.5,
    "1",
)


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


BILLIONS = "".join(
    f"{name}: &{name} [{', '.join(9 * [before])}]\n"
    for before, name in zip("x *a *b *c *d *e *f".split(), "abcdefg", strict=True)
)
YAMLS = tuple(
    text.encode()
    for text in (
        "T_BS: 2001-99-99\n",
        "T_BS: [1, 2]\n",
        "T_BS: {data: x}\n",
        "T_BS: {data: [a, b]}\n",
        "T_BS:\n",
        "- 1\n",
        "a: b: c\n",
        "T_BS: {data: &a [*a]}\n",
        "T_BS: !!python/object/apply:os.system ['true']\n",
        "\tT_BS: 1\n",
        "T_BS: {data: [.nan, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}\n",
        "? [T_BS]\n: 1\n",
        "T_BS: {data: [1, 0, 0, 1e300, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}\n",
        "T_BS: !!binary x\n",
        "T_BS: !!int ''\n",
        "T_BS: {data: [2, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}\n",
        "T_BS: !!timestamp x\n",
        "T_BS: !!bool x\n",
        "T_BS: 1\n",
        f"{BILLIONS}T_BS: {{data: [*g, *g, *g, *g]}}\n",
    )
)

PLACES = ("delete", "rename", "folder", "dangling link", "looping link")


# --- containers of arrays
# --------------------------------------------------------------------------------------------


def _unpack(name: str, content: bytes) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """(fields, attributes) of a file; a field is known by its path in HDF5, its column in feather."""
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


def damages(layout: Layout, files: list[str]) -> st.SearchStrategy[Damage]:
    share = st.floats(0.0, 1.0, width=32)

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


# --- writing and loading
# ---------------------------------------------------------------------------------------------


@functools.cache
def written(name: str) -> dict[str, bytes]:
    """The files of a layout's undamaged recording, by their paths."""
    layout = LAYOUTS[name]
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        layout.write(root, layout.shortest)
        return {
            path.relative_to(root).as_posix(): path.read_bytes()
            for path in sorted(root.rglob("*"))
            if path.is_file()
        }


_copies: list[Path] = []


@functools.cache
def copy(name: str) -> Path:
    """The same files on disk, for links to what is not damaged."""
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    _copies.append(folder)
    for file, content in written(name).items():
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).write_bytes(content)
    return folder


@pytest.fixture(scope="module", autouse=True)
def _copies_are_removed() -> Iterator[None]:
    yield
    for folder in _copies:
        shutil.rmtree(folder, ignore_errors=True)
    _copies.clear()
    copy.cache_clear()


def write_damaged(name: str, root: Path, happened: list[Damage]) -> None:
    contents = {}
    for damage in happened:
        if damage.what not in PLACES:
            contents[damage.file] = after(
                contents.get(damage.file, written(name)[damage.file]), damage
            )
    places = {damage.file: damage.what for damage in happened if damage.what in PLACES}
    for file in written(name):
        path = root / file
        path.parent.mkdir(parents=True, exist_ok=True)
        match places.get(file):
            case "delete":
                pass
            case "rename":
                path.with_name("old_" + path.name).write_bytes(
                    contents.get(file, written(name)[file])
                )
            case "folder":
                path.mkdir()
            case "dangling link":
                path.symlink_to("nowhere")
            case "looping link":
                path.symlink_to(path.name)
            case _ if file in contents:
                path.write_bytes(contents[file])
            case _:
                os.link(copy(name) / file, path)


class TooLong(BaseException):
    """No `Exception`, so that no loader can catch it."""


@contextlib.contextmanager
def at_most(seconds: int) -> Iterator[None]:
    def stop(*_: Any) -> None:
        raise TooLong(f"no end after {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def outcome(name: str, happened: list[Damage]) -> tuple[list[Sequence] | InputError, str]:
    """(sequences or the refusal, everything that was said) of a load after the damage."""
    layout = LAYOUTS[name]
    with (
        tempfile.TemporaryDirectory() as folder,
        warnings.catch_warnings(record=True) as said,
        pytest.MonkeyPatch.context() as patch,
    ):
        warnings.simplefilter("always")
        patch.setenv("GNIO_CACHE", f"{folder}/cache")
        root = Path(folder) / "root"
        root.mkdir()
        try:
            write_damaged(name, root, happened)
        except (
            RuntimeError,
            KeyError,
            IndexError,
            ValueError,
            TypeError,
            OSError,
            EOFError,
            zipfile.BadZipFile,
        ):
            return [], "two damages that do not go together"
        try:
            with at_most(SECONDS_PER_EXAMPLE):
                result: list[Sequence] | InputError = data.load(layout.dataset, root, layout.split)
        except InputError as error:
            result = error
        lines = [
            str(warning.message) for warning in said if issubclass(warning.category, UserWarning)
        ]
        for line in [*lines, *([str(result)] if isinstance(result, InputError) else [])]:
            assert len(line.splitlines()) == 1, f"not one line: {line!r}"
            assert len(line) < 2000, f"nobody reads {len(line)} characters"
        return result, "\n".join(
            [*lines, *([str(result)] if isinstance(result, InputError) else [])]
        ).replace(str(root), "ROOT")


# --- what must hold
# --------------------------------------------------------------------------------------------------


def check_sequence(sequence: Sequence, name: str) -> None:
    dataset = data.get(LAYOUTS[name].dataset)
    count = len(sequence.time)
    assert (
        count >= 2
        and sequence.gyro.shape
        == sequence.accel.shape
        == sequence.position.shape
        == sequence.velocity.shape
        == (count, 3)
    )
    assert (
        sequence.orientation.shape == (count, 4)
        and sequence.valid.shape == (count,)
        and sequence.valid.dtype == np.bool_
    )
    for values in (sequence.time, sequence.gyro, sequence.accel):
        assert values.dtype == np.float64 and np.isfinite(values).all()
    steps = np.diff(sequence.time)
    rate = 1.0 / np.median(steps)
    assert steps.min() > 0 and np.abs(steps * rate - 1.0).max() < 5e-3, "the clock is not uniform"
    assert (
        (10 * 0.999 < rate < 2000 * 1.001)
        if dataset.name == "csv"
        else abs(rate / dataset.rate - 1.0) < 0.06
    ), f"{rate} Hz"
    assert sequence.time[-1] - sequence.time[0] < 2.5 * LAYOUTS[name].shortest, (
        "longer than the recording"
    )
    assert np.abs(sequence.gyro).max() < 110.0, (
        f"gyro reaches {np.abs(sequence.gyro).max():.3g} rad/s"
    )
    assert np.abs(sequence.accel).max() < 1100.0, (
        f"accel reaches {np.abs(sequence.accel).max():.3g} m/s²"
    )
    assert 5.0 < np.median(np.linalg.norm(sequence.accel, axis=1)) < 50.0
    valid = sequence.valid
    np.testing.assert_allclose(np.linalg.norm(sequence.orientation[valid], axis=1), 1.0, atol=1e-9)
    if sequence.device_orientation is not None:
        assert sequence.device_orientation.shape == (count, 4)
        norm = np.linalg.norm(sequence.device_orientation, axis=1)
        np.testing.assert_allclose(norm[np.isfinite(norm)], 1.0, atol=1e-9)
    assert (
        np.isfinite(sequence.position[valid]).all() and np.isfinite(sequence.velocity[valid]).all()
    )
    speed = np.abs(sequence.velocity[valid]).max(initial=0.0)
    assert speed < 330.0, f"velocity reaches {speed:.3g} m/s"
    moved = (
        np.abs(np.diff(sequence.position, axis=0))
        .max(axis=1)[valid[1:] & valid[:-1]]
        .max(initial=0.0)
    )
    assert moved < max(11.0, 330.0 / rate), f"position jumps by {moved:.3g} m"
    assert np.abs(sequence.position[valid]).max(initial=0.0) < 2e8
    assert all(
        isinstance(value, str | float | int | bool) for value in sequence.attributes.values()
    )


def check_refusal(said: str, name: str, happened: list[Damage]) -> None:
    """What was said names a damaged file; or, where files are gone, the root; or the recording,
    which only the self-check refuses."""
    names = [PurePosixPath(damage.file).name for damage in happened]
    gone = any(damage.what in PLACES for damage in happened) and "ROOT" in said
    assert any(file in said for file in names) or gone or "self-check" in said, (
        f"names no damaged file: {said}"
    )
    fields = [
        damage
        for damage in happened
        if damage.what in ("drop field", "rename field", "value", "type", "shape")
    ]
    if len(happened) == 1 and fields and not happened[0].file.endswith(".npy"):
        assert re.search(r"(field|column)s? '", said) or "self-check" in said, (
            f"names no field: {said}"
        )


def check(name: str, happened: list[Damage]) -> tuple[list[Sequence] | InputError, str]:
    result, said = outcome(name, happened)
    if isinstance(result, InputError):
        check_refusal(said, name, happened)
    else:
        for sequence in result:
            check_sequence(sequence, name)
    return result, said


# --- the tests
# -------------------------------------------------------------------------------------------------------

EXAMPLES = {
    "oxiod raw": 12,
    "oxiod syn": 12,
    "oxiod Nexus": 12,
    "oxiod Tango": 8,
    "idol": 40,
    "euroc": 40,
    "tumvi": 40,
    "kitti packets": 40,
}
"""Of the slower layouts; 60 of the others."""


@pytest.mark.parametrize("name", LAYOUTS)
def test_an_undamaged_recording_is_read(name):
    result, said = check(name, [])
    assert not isinstance(result, InputError), said
    (sequence,) = result
    assert sequence.valid.mean() > 0.9 and said == ""


@pytest.mark.parametrize("name", LAYOUTS)
def test_a_damaged_recording_is_plausible_or_refused_by_name(name):
    layout = LAYOUTS[name]
    files = list(layout.targets or written(name))
    one = damages(layout, files)

    @settings(
        max_examples=EXAMPLES.get(name, 60),
        derandomize=True,
        database=None,
        deadline=timedelta(seconds=SECONDS_PER_EXAMPLE),
        suppress_health_check=list(HealthCheck),
    )
    @given(st.lists(one, min_size=1, max_size=2))
    def run(happened: list[Damage]) -> None:
        check(name, happened)

    run()


# What was wrong once. Each is (layout, damages, what must be said; None: it must be read, and
# plausible).
_EURO = "MH_04_difficult/mav0/imu0"
_OXTS = LAYOUTS["kitti packets"].targets
_FLIGHT = "clover/yawForward/maxSpeed5p0/test/stamped_groundtruth_imu.txt"
ONCE_WRONG = {
    "nested JSON, tlio": (
        "tlio",
        [Damage("walk/imu0_resampled_description.json", "deep")],
        "imu0_resampled_description.json: field",
    ),
    "nested JSON, ronin": ("ronin", [Damage("a011_2/info.json", "deep")], "info.json: is no JSON"),
    "nested JSON, idol": (
        "idol",
        [Damage("building1/known/metadata.json", "deep")],
        "metadata.json: is no JSON",
    ),
    "nested YAML": (
        "euroc",
        [Damage(f"{_EURO}/sensor.yaml", "deep")],
        "sensor.yaml: cannot be read as YAML",
    ),
    "YAML of no date": (
        "euroc",
        [Damage(f"{_EURO}/sensor.yaml", "content", token=YAMLS[0])],
        "sensor.yaml: cannot be read as YAML",
    ),
    "YAML of billions": (
        "euroc",
        [Damage(f"{_EURO}/sensor.yaml", "content", token=YAMLS[-1])],
        "sensor.yaml: field 'T_BS' is no pose",
    ),
    "lever of a galaxy": (
        "euroc",
        [Damage(f"{_EURO}/sensor.yaml", "content", token=YAMLS[12])],
        "sensor.yaml: field 'T_BS' is no pose",
    ),
    "long name, tlio": (
        "tlio",
        [Damage("test_list.txt", "stray line", 1.0, token="x" * 5000)],
        "test_list.txt: 1 of 2 listed sequences are absent",
    ),
    "long name, csv": (
        "csv",
        [Damage("test.txt", "stray line", 1.0, token="x" * 5000)],
        "test.txt: 1 of 2 listed sequences are absent",
    ),
    "long entry, oxiod": (
        "oxiod raw",
        [Damage("handheld/Test.txt", "deep")],
        "Test.txt: entry '[[[",
    ),
    "marked list": ("tlio", [Damage("test_list.txt", "BOM")], None),
    "marked table": ("csv", [Damage("walk.csv", "BOM")], None),
    "hole in a table": ("csv", [Damage("walk.csv", "hole", 0.3, 0.3)], "walk.csv: "),
    "stamp of no time": (
        "kitti packets",
        [Damage(_OXTS[0], "stray line", 0.5, token="now")],
        "timestamps.txt: line 351 ('now') is no stamp",
    ),
    "hole in stamps": (
        "kitti packets",
        [Damage(_OXTS[0], "hole", 0.001, 0.12)],
        "timestamps.txt: line 1 ('2011-09-26",
    ),
    "integer without end": (
        "ronin",
        [Damage("a011_2/info.json", "json value", 0.99, token=10**400)],
        "info.json: field 'ekf_ori_error' is no number",
    ),
    "vector without end": (
        "ronin",
        [Damage("a011_2/info.json", "json value", 0.15, token=10**400)],
        "info.json: field 'imu_init_gyro_bias'",
    ),
    "text for numbers": (
        "ronin",
        [Damage("a011_2/data.hdf5", "type", 0.35, token="S8")],
        "data.hdf5: field 'synced/game_rv' holds",
    ),
    "gyro beyond range": (
        "ronin",
        [Damage("a011_2/data.hdf5", "value", 0.6, 0.73, 1e9)],
        "data.hdf5: field 'gyro' is beyond 100 rad/s in 1 rows",
    ),
    "accel beyond range": (
        "csv",
        [Damage("walk.csv", "cell", 0.5, 0.99, "1e30")],
        "walk.csv: field 'accel' is beyond 1000 m/s² in 1 rows",
    ),
    "velocity beyond all": (
        "csv",
        [Damage("walk.csv", "cell", 0.5, 0.01, "1e30")],
        "walk.csv: field 'velocity' is beyond 300 m/s in 1 rows",
    ),
    "position that jumps": (
        "csv",
        [Damage("walk.csv", "cell", 0.5, 0.5, "1e6")],
        "walk.csv: field 'position' jumps in 2 rows",
    ),
    "position far away": (
        "csv",
        [Damage("walk.csv", "column", 0.5, 0.5, "1e30")],
        "walk.csv: field 'position' is beyond",
    ),
    "velocity of a flight": (
        "blackbird",
        [Damage(_FLIGHT, "column", 0.5, 0.9, "1e30")],
        "stamped_groundtruth_imu.txt: field 'velocity'",
    ),
    "position of a car": (
        "kitti packets",
        [Damage(_OXTS[2], "cell", 0.0, 0.0, "1e300")],
        "0000000200.txt: field 'lat' is 1e+300",
    ),
    "NaN of a car": (
        "kitti packets",
        [Damage(_OXTS[2], "cell", 0.0, 0.4, "NaN")],
        "0000000200.txt: field 'ay' is nan",
    ),
    "device of booleans": (
        "hdf5",
        [Damage("walk.h5", "type", 0.17, token="bool")],
        "walk.h5: field 'device_orientation' is not an array of numbers",
    ),
    "single precision": ("hdf5", [Damage("walk.h5", "type", 0.28, token="<f4")], None),
    "hours as seconds": (
        "hdf5",
        [Damage("walk.h5", "scale field", 0.7, token=1e9)],
        "walk.h5: field 'time' is not in seconds",
    ),
    "stamps of no clock": (
        "ridi text",
        [Damage("hang_leg1/acce.txt", "scale column", 0.0, 0.0, 1e-9)],
        "acce.txt: field 'time' runs at",
    ),
    "attitudes of no clock": (
        "ridi text",
        [Damage("hang_leg1/orientation.txt", "scale column", 0.0, 0.0, 1e-9)],
        "orientation.txt: field 'time' does not increase",
    ),
    "poses of no clock": (
        "ridi text",
        [Damage("hang_leg1/pose.txt", "scale column", 0.0, 0.0, 1e-9)],
        "pose.txt: its stamps",
    ),
    "position without end": (
        "csv",
        [Damage("walk.csv", "cell", 0.5, 0.5, "9" * 400)],
        None,
    ),  # infinite, hence not valid
    "row without end": (
        "euroc",
        [Damage(f"{_EURO}/data.csv", "stray line", 0.5, 0.5, "9" * 400)],
        f"{_EURO}/data.csv: ",
    ),
    "cell without end, oxiod": (
        "oxiod Tango",
        [Damage("large scale/floor1/syn/imu1.csv", "cell", 0.5, 0.5, "9" * 400)],
        "imu1.csv: ",
    ),
    "another recording": (
        "ridi text",
        [Damage("hang_leg1/acce.txt", "scale column", 0.0, 0.0, 0.5)],
        "acce.txt: field 'time'",
    ),
}


@pytest.mark.parametrize("once", ONCE_WRONG)
def test_what_was_wrong_once(once):
    name, happened, expected = ONCE_WRONG[once]
    result, said = check(name, happened)
    if expected is None:
        assert not isinstance(result, InputError) and len(result) == 1 and said == "", said
    else:
        assert expected in said, said


# --- pickles
# ---------------------------------------------------------------------------------------------------------


class Bomb:
    """Whoever unpickles it makes a folder."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.folder),)


def objects(bomb: Bomb, count: int = 1) -> np.ndarray:
    array = np.empty(count, dtype=object)
    array[:] = [bomb] * count
    return array


def of_numpy(bomb: Bomb) -> bytes:
    out = io.BytesIO()
    np.save(out, objects(bomb), allow_pickle=True)
    return out.getvalue()


def of_numpy_zip(bomb: Bomb) -> bytes:
    """The gyro and accelerometer of an otherwise sound piece."""
    out = io.BytesIO()
    with np.load(io.BytesIO(next(iter(written("kitti npz").values())))) as file:
        arrays = {field: file[field] for field in file.files}
    arrays["u"] = objects(bomb, len(arrays["t"]))
    np.savez(out, allow_pickle=True, **arrays)
    return out.getvalue()


def of_hdf5(bomb: Bomb, name: str, field: str) -> bytes:
    """Pickled bytes in place of a field, and as its attribute: what PyTables and pandas load."""
    content = next(
        content for file, content in written(name).items() if file.endswith((".h5", ".hdf5"))
    )
    out = io.BytesIO(content)
    with h5py.File(out, "r+") as file:
        del file[field]
        file[field] = np.void(pickle.dumps(bomb))
        file[field].attrs["TITLE"] = np.void(pickle.dumps(bomb))
        file.attrs["pandas_type"] = np.void(pickle.dumps(bomb))
    return out.getvalue()


def of_feather(bomb: Bomb) -> bytes:
    """A column of the extension type that old versions of pyarrow unpickled."""
    pyarrow, feather = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.feather")
    table = feather.read_table(io.BytesIO(written("idol")["building1/known/3.feather"]))
    about = {
        "ARROW:extension:name": "arrow.py_extension_type",
        "ARROW:extension:metadata": pickle.dumps(bomb),
    }
    field = pyarrow.field("timestamp", table["timestamp"].type, metadata=about)
    table = table.set_column(table.column_names.index("timestamp"), field, table["timestamp"])
    out = io.BytesIO()
    feather.write_feather(table, out)
    return out.getvalue()


PICKLES: dict[str, tuple[str, str, Callable[[Bomb], bytes]]] = {
    "npy of objects": ("tlio", "walk/imu0_resampled.npy", of_numpy),
    "npy": ("tlio", "walk/imu0_resampled.npy", pickle.dumps),
    "npz of objects": ("kitti npz", "train__2011_09_26_drive_0014_extract0.npz", of_numpy_zip),
    "npz": ("kitti npz", "train__2011_09_26_drive_0014_extract0.npz", pickle.dumps),
    "field of RoNIN": (
        "ronin",
        "a011_2/data.hdf5",
        lambda bomb: of_hdf5(bomb, "ronin", "synced/acce"),
    ),
    "RoNIN": ("ronin", "a011_2/data.hdf5", pickle.dumps),
    "field of Blackbird": (
        "blackbird",
        "clover/yawForward/maxSpeed5p0/test/data.hdf5",
        lambda bomb: of_hdf5(bomb, "blackbird", "traj_target"),
    ),
    "field of our own": ("hdf5", "walk.h5", lambda bomb: of_hdf5(bomb, "hdf5", "gyro")),
    "device of our own": (
        "hdf5",
        "walk.h5",
        lambda bomb: of_hdf5(bomb, "hdf5", "device_orientation"),
    ),
    "our own": ("hdf5", "walk.h5", pickle.dumps),
    "feather": ("idol", "building1/known/3.feather", pickle.dumps),
    "table of text": ("csv", "walk.csv", pickle.dumps),
    "JSON": ("ronin", "a011_2/info.json", pickle.dumps),
    "YAML": (
        "euroc",
        f"{_EURO}/sensor.yaml",
        lambda bomb: f"T_BS: !!python/object/apply:os.mkdir ['{bomb.folder}']\n".encode(),
    ),
}


@pytest.mark.parametrize("kind", PICKLES)
def test_what_would_execute_is_refused_unexecuted(tmp_path, kind):
    name, file, make = PICKLES[kind]
    trap = tmp_path / "trap"
    content = make(Bomb(trap))
    assert not trap.exists() and content != written(name)[file]
    result, said = check(name, [Damage(file, "content", token=content)])
    assert not trap.exists(), "it was executed"
    assert isinstance(result, InputError) and PurePosixPath(file).name in said


def test_an_extension_type_of_feather_is_not_unpickled(tmp_path):
    trap = tmp_path / "trap"
    check("idol", [Damage("building1/known/3.feather", "content", token=of_feather(Bomb(trap)))])
    assert not trap.exists()


def test_the_trap_works(tmp_path):
    """Were pickles loaded, the tests above would see it."""
    with np.load(io.BytesIO(of_numpy_zip(Bomb(tmp_path / "zip"))), allow_pickle=True) as file:
        assert file["u"].dtype == object
    np.load(io.BytesIO(of_numpy(Bomb(tmp_path / "npy"))), allow_pickle=True)
    pickle.loads(pickle.dumps(Bomb(tmp_path / "raw")))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["npy", "raw", "zip"]
