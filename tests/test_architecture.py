"""What each room may import: the arrow of docs/architecture.md, read from the sources."""

import ast
import functools
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "gnio_jax"

BASE = {"config", "cores", "decimation", "errors", "files", "geometry", "numerics", "reporting"}
BASE |= {"parallel", "types", "windows"}
ROOMS = {
    "data": BASE,
    "models": BASE,
    "filtering": BASE,
    "training": BASE | {"data", "models", "filtering"},
    "evaluation": BASE | {"data", "models", "filtering", "training"},
    "calibration": BASE | {"data", "models", "filtering", "training", "evaluation"},
    "interop": BASE | {"models", "training"},
    "tables": BASE | {"data", "models", "training", "evaluation", "calibration"},
    "apps": BASE | {"data", "models", "filtering", "training", "evaluation", "calibration"},
    "commands": BASE
    | {"data", "filtering", "training", "evaluation", "calibration", "interop"}
    | {"tables", "apps"},
    **{name: BASE for name in BASE},
}
"""Rooms and top-level modules, and what each may import of the package besides itself."""

ONNX = {"apps.onnx.conversion", "apps.onnx.driver"}
LIBRARIES = {
    "bokeh": {"evaluation.page"},
    "flax": {"models", "training", "evaluation", "interop"},
    "jax2onnx": {"apps.onnx.conversion"},
    "loky": {"data.loading"},
    "mcap": {"apps.importing.ros", "apps.export"},
    "matplotlib": {"data", "evaluation.plots", "tables.plots"},
    "onnx": ONNX,
    "onnxruntime": ONNX,
    "optax": {"training"},
    "orbax": {"training.checkpoint"},
    "rerun": {"apps.rerun"},
    "rosbags": {"apps.importing.ros", "apps.export"},
    "rich.console.Console": {"commands"},
    "rich.progress": {"commands"},
    "safetensors": {"apps.packages"},
    "tensorboardX": {"training.run_folder"},
}
"""Libraries that only these rooms or modules import."""

REFUSED = set("found own each given there known place seen about asked kept told here both".split())
REFUSED |= set("these those wanted taken laid made left rest apart since late".split())
"""Words that do not say what a variable holds."""
OLD_NAMES = ("apps/live", "apps/track", "calibration", "commands/calibrate")
OLD_NAMES += ("config", "evaluation", "filtering", "training")
"""Rooms and modules whose variables still have such names."""
TWO_MEANINGS = {"Estimate", "Inputs", "Outcome", "Recording", "Run", "Source", "Summary"}
"""Names that two classes of these rooms still share."""


@functools.cache
def imports():
    """(module without the package's name, what it imports) of every import of the package."""
    return list(read_imports())


def read_imports():
    for path in sorted(PACKAGE.rglob("*.py")):
        module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                yield from ((module, alias.name) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{module}: relative import"
                yield from ((module, f"{node.module}.{alias.name}") for alias in node.names)


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_a_room_imports_only_what_stands_before_it(room):
    for module, name in imports():
        if module.split(".")[0] == room and name.startswith("gnio_jax."):
            other = name.split(".")[1]
            # `python -m gnio_jax.data` is the command of that name.
            allowed = {"commands"} if module.endswith("__main__") else ROOMS[room] | {room}
            assert other in allowed, f"gnio_jax/{module} imports {name}"


@pytest.mark.parametrize("library", sorted(LIBRARIES))
def test_a_library_stays_in_its_rooms(library):
    for module, name in imports():
        if f"{name}.".startswith(f"{library}."):
            places = {module, module.split(".")[0]}
            assert places & LIBRARIES[library], f"gnio_jax/{module} imports {name}"


def test_every_module_has_a_room():
    rooms = {module.split(".")[0] for module, _ in imports()}
    assert rooms - {"__init__", "__main__"} <= ROOMS.keys()


def test_a_variable_is_a_noun():
    for path in sorted(PACKAGE.rglob("*.py")):
        module = path.relative_to(PACKAGE).as_posix()
        if module.startswith(OLD_NAMES):
            continue
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            name = node.arg if isinstance(node, ast.arg) else ""
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                name = node.id
            assert name not in REFUSED, f"gnio_jax/{module}: a variable is called '{name}'"


def test_the_name_of_a_class_has_one_meaning():
    homes = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef) and node.name not in TWO_MEANINGS:
                home = homes.setdefault(node.name, path)
                assert home == path, f"{home} and {path} have a class '{node.name}'"


def test_no_test_module_imports_another():
    for path in (PACKAGE.parent / "tests").rglob("test_*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tests"):
                names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
                assert not any(name.startswith("test_") for name in names), path
