"""Every command that names a network takes the folder of a run, a package and a name."""

import importlib.util
import json
from pathlib import Path

import numpy as np
import pytest

from gnio_jax.config import DataConfig, ModelConfig, TrainConfig
from gnio_jax.networks import Card, folder, read_network
from tests.support import tiny_run

EXAMPLE = Path(__file__).parents[2] / "examples" / "walk.csv"
COMMANDS = {
    "evaluate": "evaluate --dataset synthetic --network {network}",
    "calibrate": "calibrate --network {network}",
    "out of fold": "calibrate --network {run} --out-of-fold {network} {network}",
    "compare": "compare {network} {run} --dataset synthetic",
    "track": f"track {EXAMPLE} --network {{network}}",
    "live": f"live {EXAMPLE} --network {{network}}",
    "export": "export {network}",
    "publish": "publish {network} --out out --data walks --license CC0",
    "train from": "train --config quickstart --init-from {network} --workdir out",
    "poses by": "train --config quickstart --set data.poses_by={network} --workdir out",
}


class Found(Exception):
    """A command reads a network, whose path is the argument."""


@pytest.fixture(scope="module")
def parent(tmp_path_factory):
    """A run `walk` of a tiny network, and `package.zip` and `named`, which are published."""
    parent = tmp_path_factory.mktemp("networks")
    with tiny_run.registry_entry():
        config = TrainConfig(data=DataConfig(rate=50.0), model=ModelConfig("tiny"))
        network = read_network(tiny_run.save(parent / "walk", config))
        card = Card("named", "tiny", "simulated walks", "CC0", 1, 0, "", "a test", {})
        for name in ("package.zip", "names/named"):
            folder.write_published(parent / name, network, card, "# named")
        yield parent


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_takes_every_form(command, parent, gnio, undrawn, monkeypatch, tmp_path):
    if command == "export" and not importlib.util.find_spec("jax2onnx"):
        pytest.skip("gnio export needs jax2onnx")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GNIO_WEIGHTS", str(parent / "names"))
    run, read = parent / "walk", folder._read_files

    def note(path):
        if command == "out of fold" and path == run:
            return read(path)
        raise Found(path)

    monkeypatch.setattr(folder, "_read_files", note)
    forms = {parent / "package.zip": parent / "package.zip", "named": parent / "names" / "named"}
    forms |= {run: run} if command != "out of fold" else {}
    for network, path in forms.items():
        with pytest.raises(Found) as error:
            gnio(*COMMANDS[command].format(network=network, run=run).split())
        assert error.value.args == (path,)


def test_a_name_is_evaluated_at_once(parent, gnio, monkeypatch, tmp_path):
    """With the figures of the run; nothing is written to the published network."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("GNIO_WEIGHTS", str(parent / "names"))
    before = sorted((parent / "names").rglob("*"))
    words = ("--dataset", "synthetic", "--split", "val", "--estimator", "integrate", "--no-plots")
    figures = []
    for network in ("named", parent / "package.zip", parent / "walk"):
        output = gnio("evaluate", "--network", network, *words)
        results = parent / "walk" / "eval" if network == parent / "walk" else Path("evaluations")
        results = results if network == parent / "walk" else results / Path(network).stem
        report = results / "synthetic_val_integrate" / "metrics.json"
        assert f"results: {report.parent}" in output
        figures.append(json.loads(report.read_text())["mean"])
    assert sorted((parent / "names").rglob("*")) == before
    for other in figures[1:]:
        for name, value in figures[0].items():
            np.testing.assert_equal(other[name], value)
