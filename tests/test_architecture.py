"""What each room may import: the arrow of docs/architecture.md, read from the sources."""

import ast
import functools
import graphlib
from pathlib import Path
from typing import NamedTuple

import pytest

PACKAGE = Path(__file__).parents[1] / "gnio_jax"

BASE = {"config", "cores", "decimation", "drawing", "errors", "files", "geometry", "numerics"}
BASE |= {"parallel", "plugins", "reporting", "types", "windows"}
ROOMS = {
    "data": BASE,
    "models": BASE,
    "filtering": BASE,
    "networks": BASE | {"models"},
    "training": BASE | {"data", "models", "filtering", "networks"},
    "evaluation": BASE | {"data", "models", "filtering", "networks", "training"},
    "calibration": BASE | {"data", "models", "filtering", "networks", "training", "evaluation"},
    "interop": BASE | {"models", "networks"},
    "tables": BASE | {"data", "models", "networks", "training", "evaluation", "calibration"},
    "apps": BASE | {"data", "models", "filtering", "networks", "evaluation"},
    "commands": BASE
    | {"data", "filtering", "networks", "training", "evaluation", "calibration", "interop"}
    | {"tables", "apps"},
    **{name: BASE for name in BASE},
}
"""Rooms and top-level modules, and what each may import of the package besides itself."""

ONNX = {"apps.onnx.conversion", "apps.onnx.driver"}
LIBRARIES = {
    "bokeh": {"evaluation.page"},
    "flax": {"models", "networks", "training", "evaluation"},
    "jax2onnx": {"apps.onnx.conversion"},
    "loky": {"data.workers"},
    "mcap": {"apps.importing.bags", "apps.export"},
    "matplotlib": {"drawing", "data.pictures", "evaluation.plots", "tables.plots"},
    "onnx": ONNX,
    "onnxruntime": ONNX,
    "optax": {"training"},
    "orbax": {"training.checkpoint"},
    "rerun": {"apps.rerun"},
    "rosbags": {"apps.importing.bags", "apps.export"},
    "rich.console.Console": {"commands"},
    "rich.progress": {"commands"},
    "safetensors": {"networks.folder"},
    "sklearn": {"training.support_vectors"},
    "tensorboardX": {"training.run_folder"},
}
"""Libraries that only these rooms or modules import."""

REFUSED = set("found own each given there known place seen about asked kept told here both".split())
REFUSED |= set("these those wanted taken laid made left rest apart since late".split())
"""Words that do not say what a variable holds."""


VAGUE = set("look expect tell told ask late few way listed opened where".split())
"""Names that do not say what a function does."""


class Import(NamedTuple):
    """An import of the package, anywhere in a module."""

    module: str
    """The module without the package's name."""
    name: str
    """What it imports, with the package's name."""
    function_import: bool
    """Whether a function imports it."""


@functools.cache
def imports():
    return list(read_imports())


def read_imports():
    for path in sorted(PACKAGE.rglob("*.py")):
        module = ".".join(path.relative_to(PACKAGE).with_suffix("").parts)
        tree = ast.parse(path.read_text(encoding="utf-8"))
        functions = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)]
        bodies = {node for function in functions for node in ast.walk(function)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                yield from (Import(module, alias.name, node in bodies) for alias in node.names)
            elif isinstance(node, ast.ImportFrom):
                assert node.level == 0, f"{module}: relative import"
                for alias in node.names:
                    yield Import(module, f"{node.module}.{alias.name}", node in bodies)


def imports_of_modules():
    """The imports of modules of the package, whose names then are those of the modules."""
    modules = {entry.module.removesuffix(".__init__") for entry in imports()}
    for entry in imports():
        name = entry.name.removeprefix("gnio_jax.")
        while name not in modules and "." in name:
            name = name.rpartition(".")[0]
        if entry.name.startswith("gnio_jax.") and name in modules:
            yield entry._replace(module=entry.module.removesuffix(".__init__"), name=name)


@pytest.mark.parametrize("room", sorted(ROOMS))
def test_a_room_imports_only_what_stands_before_it(room):
    for module, name, _ in imports():
        if module.split(".")[0] == room and name.startswith("gnio_jax."):
            other = name.split(".")[1]
            # `python -m gnio_jax.data` is the command of that name.
            allowed = {"commands"} if module.endswith("__main__") else ROOMS[room] | {room}
            assert other in allowed, f"gnio_jax/{module} imports {name}"


@pytest.mark.parametrize("library", sorted(LIBRARIES))
def test_a_library_stays_in_its_rooms(library):
    for module, name, _ in imports():
        if f"{name}.".startswith(f"{library}."):
            places = {module, module.split(".")[0]}
            assert places & LIBRARIES[library], f"gnio_jax/{module} imports {name}"


def test_every_module_has_a_room():
    rooms = {entry.module.split(".")[0] for entry in imports()}
    assert rooms - {"__init__", "__main__"} <= ROOMS.keys()


def test_imports_have_no_circle():
    graph = {}
    for module, name, _ in imports_of_modules():
        graph.setdefault(module, set()).add(name)
    graphlib.TopologicalSorter(graph).prepare()  # raises CycleError with the modules


SLOW = {"bokeh", "matplotlib"}
"""Libraries that take up to a second to import, for which only a picture should wait."""


def test_a_late_import_inside_a_room_waits_for_a_slow_library_and_nothing_else():
    """Any other one hides what the room is made of."""
    drawing = {entry.module for entry in imports() if entry.name.split(".")[0] in SLOW}
    for module, name, function_import in imports_of_modules():
        if function_import and module.split(".")[0] == name.split(".")[0]:
            assert name in drawing, f"gnio_jax/{module} imports {name} in a function"


def test_a_variable_is_a_noun():
    root = PACKAGE.parent
    for folder in (PACKAGE, root / "tests", root / "benchmarks"):
        for path in sorted(folder.rglob("*.py")):
            module = path.relative_to(root).as_posix()
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                name = node.arg if isinstance(node, ast.arg) else ""
                if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
                    name = node.id
                assert name not in REFUSED, f"{module}: a variable is called '{name}'"


NOUNS = {"speed", "feed"}
"""Nouns that end as participles do."""


def test_a_function_does_not_have_the_name_of_a_participle():
    """`open_bag` and not `opened`, `with_measured_rate` and not `measured`."""
    for path in sorted(PACKAGE.rglob("*.py")):
        module = path.relative_to(PACKAGE).as_posix()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.FunctionDef):
                continue
            decorators = {ast.unparse(decorator) for decorator in node.decorator_list}
            if decorators & {"property", "functools.cached_property"}:  # a quantity
                continue
            name = node.name.strip("_")
            participle = name.endswith("ed") and "_" not in name and name not in NOUNS
            refused = participle or name in REFUSED | VAGUE
            assert not refused, f"gnio_jax/{module}: a function is called '{node.name}'"


def test_a_function_has_at_most_95_lines():
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef):
                lines = (node.end_lineno or node.lineno) - node.lineno + 1
                assert lines <= 95, f"{path}: '{node.name}' has {lines} lines"


def test_the_name_of_a_class_has_one_meaning():
    homes = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                home = homes.setdefault(node.name, path)
                assert home == path, f"{home} and {path} have a class '{node.name}'"


def test_no_test_module_imports_another():
    for path in (PACKAGE.parent / "tests").rglob("test_*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("tests"):
                names = [*(node.module or "").split("."), *(alias.name for alias in node.names)]
                assert not any(name.startswith("test_") for name in names), path
