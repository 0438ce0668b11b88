"""What may happen to a file, and what may stand in it afterwards: the tables of `damage`."""

from __future__ import annotations

import numpy as np

ROWS = ("drop rows", "repeat rows", "reverse rows", "shuffle rows")

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
