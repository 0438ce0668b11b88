"""What the pages say runs: their Python, and their command lines as far as the parser."""

import ast
import dataclasses
import importlib
import inspect
import re

import jax
import numpy as np
import pytest

import gnio_jax
from gnio_jax import config as configuration
from gnio_jax import data, models, networks
from gnio_jax.apps.publish import publish
from gnio_jax.config import DataConfig, ModelConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.filtering import measurements
from gnio_jax.models import registry
from tests.support import pages, tiny_run
from tests.support.command_lines import understood
from tests.support.networks import drawn

SMALLER = {
    "README.md": {
        "width=16": "width=2",
        "6000": "220",
        "6001": "221",
        "300": "11",
        "range(15)": "range(2)",
        "skiprows=1": "skiprows=1, max_rows=300",
    },
    "docs/differentiable_filter.md": {"20 * 100": "20 * 25", "range(20)": "range(5)"},
    "docs/many_sequences.md": {"2000": "400", "np.arange(4)": "np.arange(2)", ", 100)": ", 6)"},
    "docs/notebooks/learn_noise.py": {"SECONDS = 30": "SECONDS = 2", "STEPS = 150": "STEPS = 2"},
}
"""Fewer samples and steps than on the page: page -> what stands there -> what runs."""
HELP = {"--help", "-H", "--completion", "--version", "COMMAND"}
"""Words that leave with a text; COMMAND stands for any command."""
NEW_FILES = {"gnio_jax/data/readers/mine.py", "tests/support/mine_files.py"}
"""What CONTRIBUTING asks a reader to write."""
RUN = [block for block in pages.python_blocks() if not block.reason]
CODE = {
    f"{block.page}:{block.line} {block.reason}": block.code for block in pages.python_blocks()
} | {path.name: path.read_text(encoding="utf-8") for path in pages.ROOT.glob("docs/notebooks/*.py")}
"""Where it stands, and why it is not run, if it is not: it must compile and name what there is."""


@pytest.fixture(scope="module")
def walks():
    return data.load("synthetic", split="test")[:1]


@pytest.fixture
def one_walk(walks, monkeypatch):
    """The embedded walks are computed once for all pages."""
    monkeypatch.setattr(data, "load", lambda *_, **__: walks)


def run(page, code, names=None):
    """Execute the code of a page, made smaller; returns its names."""
    names = {} if names is None else names
    for passage, smaller in SMALLER.get(page, {}).items():
        assert passage in code, f"{page} has no '{passage}' any more"
        code = re.sub(rf"(?<!\d){re.escape(passage)}(?!\d)", smaller, code)
    with jax.numpy_rank_promotion("allow"):  # as a reader's JAX has it
        exec(compile(code, page, "exec"), names)
    return names


def code_of(page):
    return "\n".join(block.code for block in RUN if block.page == page)


@pytest.mark.slow
def test_the_examples_of_the_readme(one_walk, tmp_path, capsys, monkeypatch):
    """With weights that NumPy has drawn: those of each shape would be a program."""
    monkeypatch.setattr(models, "initialise", lambda model, _: drawn(models.variable_shapes(model)))
    monkeypatch.chdir(pages.ROOT)
    with tiny_run.registry_entry():
        config = TrainConfig(data=DataConfig(rate=50.0), model=ModelConfig(name="tiny"))
        network = networks.read_network(tiny_run.save(tmp_path / "run", config))
        monkeypatch.setattr(networks, "load", lambda _: network)
        run("README.md", code_of("README.md"))
    last, shape, *steps = capsys.readouterr().out.replace("\n ", " ").splitlines()
    assert last.startswith("2.9 [") and last.count(".") == 13
    assert shape == "(11, 3)"
    losses, densities = np.array([line.split() for line in steps], float).T
    assert losses[1] < losses[0] and densities[1] < densities[0] < 1e-2


@pytest.mark.slow
def test_the_loop_of_ones_own(one_walk, capsys):
    run("docs/differentiable_filter.md", code_of("docs/differentiable_filter.md"))
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    losses = [float(loss) for _, loss in lines[:5]]
    assert losses[-1] < losses[0]
    assert float(lines[5][-1]) < 3 and " ".join(lines[6]) == "taken 3 of 3"


@pytest.mark.slow
def test_many_sequences_and_draws(one_walk, capsys):
    """The spread of six runs of 2 s is what the filter says, give or take a half."""
    names = run("docs/many_sequences.md", code_of("docs/many_sequences.md"))
    shape, rms, expected, _, nees = capsys.readouterr().out.splitlines()
    assert shape == "positions (2, 20, 3)"
    assert 0.5 < float(rms.split()[-1]) / float(expected.split()[-1]) < 1.5
    assert 0.3 < float(nees.split()[4]) < 2.0
    # A sequence of the batch is the run of this sequence alone.
    starts = (part[1] for part in names["starts"])
    signals = (names[name][1] for name in ("gyro", "accel", "measured"))
    alone = names["run"](*starts, *signals).position
    np.testing.assert_allclose(names["history"].position[1], alone, atol=1e-9)


def test_a_measurement_of_ones_own(capsys):
    """The car's velocity is found, and turns with it; without the measurement it is not."""
    try:
        run("docs/measurements.md", code_of("docs/measurements.md"))
    finally:
        measurements._MEASUREMENTS.pop("keel", None)
    without, constrained, accepted, heights = capsys.readouterr().out.splitlines()
    assert abs(float(without.split()[1])) > 0.5 and without.endswith("taken []")
    assert abs(float(constrained.split()[1])) < 0.1
    assert constrained.endswith("taken ['keel']")
    assert int(accepted.split()[1]) > 390 and heights == "heights 200"


def test_a_car_and_the_other_sensors_of_a_phone(capsys):
    run("docs/vehicles.md", code_of("docs/vehicles.md"))
    state, mounting, *errors = capsys.readouterr().out.splitlines()
    assert state == "yaw 0.027 rad"
    assert mounting.startswith("yaw 0.50 rad, ±0.0")
    without, magnetometer = (abs(float(line.split()[-1].strip("°"))) for line in errors)
    assert without > 40 and magnetometer < 10


def test_weights_that_are_loaded(tmp_path, monkeypatch):
    """`mine` is a tiny network."""
    config = TrainConfig(data=DataConfig(rate=50.0), model=ModelConfig(name="tiny"))
    monkeypatch.setenv("GNIO_WEIGHTS", str(tmp_path))
    names = {"gnio_jax": gnio_jax, "windows": np.zeros((2, 50, 6), np.float32)}
    with tiny_run.registry_entry():
        folder = tiny_run.save(tmp_path / "run", config)
        publish(folder, tmp_path / "mine", "mine", "nobody's walks", "CC0")
        run("docs/weights.md", code_of("docs/weights.md"), names)
    assert names["prediction"].displacement.shape == (2, 3)


def test_a_network_with_memory_continues():
    names = run("docs/networks_with_memory.md", code_of("docs/networks_with_memory.md"))
    assert int(names["state"].memory.intervals) == 60 and int(names["state"].step) == 60
    assert names["later"].accepted.shape == (30,)


def test_a_head_of_ones_own(monkeypatch):
    """The network is known to a configuration, and its head has the place of GNIO's."""
    monkeypatch.setattr(registry, "_MODELS", dict(registry._MODELS))
    run("docs/networks.md", code_of("docs/networks.md"))
    model = models.from_config(ModelConfig(name="deeper", width=2))
    shapes = models.variable_shapes(model, 64)
    assert shapes["params"]["head"].keys() == {"hidden", "displacement"}
    assert shapes["params"]["bank"] and shapes["params"]["uncertainty"]
    prediction = jax.eval_shape(model.apply, shapes, jax.ShapeDtypeStruct((2, 64, 6), np.float32))
    assert prediction.displacement.shape == (2, 3)


def test_a_dataset_of_two_csv_files(walks, tmp_path):
    walk = data.resample(walks[0], 100.0)
    (tmp_path / "anna_1").mkdir()
    (tmp_path / "test.txt").write_text("anna_1\n", encoding="utf-8")
    columns = {
        "imu": ("time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z", walk.gyro, walk.accel),
        "poses": ("time,qw,qx,qy,qz,px,py,pz", walk.orientation, walk.position),
    }
    for name, (header, *parts) in columns.items():
        rows = np.column_stack([walk.time, *parts])
        path = tmp_path / "anna_1" / f"{name}.csv"
        np.savetxt(path, rows, delimiter=",", header=header, comments="")
    names = run("CONTRIBUTING.md", code_of("CONTRIBUTING.md"))
    (recording,) = names["DATASET"].recordings(tmp_path, "test")
    (sequence,) = recording.read()
    assert (sequence.name, data.group(sequence)) == ("anna_1", "anna")
    np.testing.assert_allclose(sequence.position, walk.position, atol=1e-6)
    np.testing.assert_allclose(sequence.gyro, walk.gyro, atol=1e-9)
    assert sequence.valid.all() and not data.self_check(sequence).failures


def test_the_block_of_networks_with_memory():
    run("docs/networks_with_memory.md", code_of("docs/networks_with_memory.md"))


def test_the_imports_of_the_reference():
    run("docs/api/index.md", code_of("docs/api/index.md"))


def test_every_block_that_runs_has_a_test():
    tested = {"README.md", "docs/differentiable_filter.md", "docs/networks.md", "docs/weights.md"}
    tested |= {"docs/measurements.md", "docs/many_sequences.md", "docs/networks_with_memory.md"}
    tested |= {"docs/api/index.md", "docs/vehicles.md", "CONTRIBUTING.md"}
    assert {block.page for block in RUN} == tested


@pytest.mark.parametrize("location", CODE)
def test_code_names_what_there_is(location):
    """It compiles, and what it takes from gnio_jax is there."""
    tree = ast.parse(CODE[location], location)
    modules = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module.split(".")[0] == "gnio_jax":
            for alias in node.names:
                modules[alias.asname or alias.name] = member(node.module, alias.name)
        elif isinstance(node, ast.Import):
            for alias in node.names:
                importlib.import_module(alias.name)
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            owner = modules.get(node.value.id)
            if owner is not None:
                assert hasattr(owner, node.attr), f"{location}: {node.value.id}.{node.attr}"


def member(module, name):
    try:
        return importlib.import_module(f"{module}.{name}")
    except ModuleNotFoundError:
        return getattr(importlib.import_module(module), name)


@pytest.mark.slow
def test_the_notebook_that_learns(one_walk, capsys):
    """Two seconds, two steps: the gradient is the difference quotient that is printed beside it."""
    pytest.importorskip("matplotlib").use("Agg")
    page = "docs/notebooks/learn_noise.py"
    run(page, (pages.ROOT / page).read_text(encoding="utf-8"))
    printed = capsys.readouterr().out
    gradient = [float(word) for word in re.search(r"gradient \[(.*)\]", printed)[1].split()]
    quotient = [float(re.search(rf"{name}: (.*)", printed)[1]) for name in ("gyro", "accel.*")]
    np.testing.assert_allclose(gradient, quotient, atol=2e-4)


@pytest.mark.parametrize(
    "line", pages.command_lines(), ids=lambda line: f"{line.page}: {' '.join(line.words)[:60]}"
)
def test_a_command_line_is_understood(line, monkeypatch):
    """By the parser of the command, which runs nothing; a config that it names is there."""
    monkeypatch.chdir(pages.ROOT)
    if HELP & set(line.words):
        return
    try:
        settings = understood(line.words)
    except InputError as error:
        # A sentence may leave out what the option or the command is about.
        assert line.quoted and re.search("is missing|expected .*argument", str(error)), error
        return
    for option in ("config", "base"):
        name = getattr(settings, option, None)
        if name is not None and name != "FILE":
            configuration.find_experiment(name)


def test_an_unknown_option_does_not_parse():
    with pytest.raises(InputError, match="unknown option"):
        understood(["track", "walk.zip", "--wieghts", "mine"])


def test_the_reference_has_every_room():
    """A page for each room that says what is public, with all of it (`make docs` counts the names),
    and a line of the table for each name of the package."""
    docs = pages.ROOT / "docs"
    table = (docs / "api/index.md").read_text(encoding="utf-8")
    named = re.findall(r"^\| \[?`gnio_jax\.(\w+)`", table, re.MULTILINE)
    assert sorted(named) == sorted(gnio_jax.__all__)
    assert all(hasattr(gnio_jax, name) for name in gnio_jax.__all__)
    navigation = (pages.ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    for path in sorted((pages.ROOT / "gnio_jax").glob("*/__init__.py")):
        room = path.parent.name
        if "\n__all__ = " in path.read_text(encoding="utf-8"):
            page = (docs / "api" / f"{room}.md").read_text(encoding="utf-8")
            assert f"\n::: gnio_jax.{room}\n" in page
            assert f"api/{room}.md" in navigation and room in gnio_jax.__all__


def functions_of_the_reference():
    """Every function and every class with a constructor of its own that docs/api shows."""
    members = {}
    for page in (pages.ROOT / "docs/api").glob("*.md"):
        text = page.read_text(encoding="utf-8")
        for target, options in re.findall(r"^::: ([\w.]+)\n?(?: +options: (.*))?", text, re.M):
            try:
                module = importlib.import_module(target)
            except ModuleNotFoundError:
                home, _, name = target.rpartition(".")
                members[target] = member(home, name)
                continue
            listed = re.search(r"members: (?:\[(.*)\]|false)", options)
            names = getattr(module, "__all__", None) or [
                name
                for name, value in vars(module).items()
                if not name.startswith("_") and getattr(value, "__module__", "") == target
            ]
            names = filter(None, (listed[1] or "").split(", ")) if listed else names
            members |= {f"{target}.{name}": getattr(module, name) for name in names}
    return {
        name: value
        for name, value in members.items()
        if inspect.isfunction(value)
        or (inspect.isclass(value) and inspect.isfunction(value.__init__))
    }


def test_a_function_of_five_arguments_lists_them():
    """With all names and no other; fields of settings and tuples have docstrings of their own."""
    long = 0
    for name, value in functions_of_the_reference().items():
        if dataclasses.is_dataclass(value):
            continue
        arguments = list(inspect.signature(value).parameters)
        if len(arguments) >= 5:
            section = re.search(r"\nArgs:\n((?: .*\n?)+)", inspect.cleandoc(value.__doc__ or ""))
            assert section, f"{name}: its docstring has no section 'Args:'"
            assert re.findall(r"^ {4}(\w+): ", section[1], re.M) == arguments, name
            long += 1
    assert long >= 20


def test_every_network_is_named_where_people_look():
    readme = (pages.ROOT / "README.md").read_text(encoding="utf-8")
    assert [name for name in models.names() if f"`{name}`" not in readme] == []


@pytest.mark.parametrize("page", pages.pages(), ids=lambda page: page.name)
def test_a_file_that_a_page_names_is_there(page):
    """`room/file.py`, from the root or within the package; a placeholder has another form."""
    named = re.findall(r"`([a-z_]+/[a-z_/]+\.(?:py|yaml|md))`", page.read_text(encoding="utf-8"))
    homes = (pages.ROOT, pages.ROOT / "gnio_jax")
    lost = [name for name in named if not any((home / name).is_file() for home in homes)]
    assert {*lost} <= NEW_FILES, lost


@pytest.mark.parametrize("page", pages.pages(), ids=lambda page: page.name)
def test_a_link_within_the_repository_leads_somewhere(page):
    """To a file or folder, and of a page to one of its headings."""
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if re.match(r"https?:", target):
            continue
        name, _, heading = target.partition("#")
        destination = page.parent / name if name else page
        assert destination.exists(), target
        if heading:
            assert heading in headings(destination), target


def headings(page):
    titles = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title).lower().replace(" ", "-") for title in titles}
