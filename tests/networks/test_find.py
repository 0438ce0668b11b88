"""Networks by path and by name, and the network that comes with gnio-jax."""

import dataclasses
import hashlib
import os
import shutil

import numpy as np
import pytest

import gnio_jax
from gnio_jax import config as configuration
from gnio_jax.config import DataConfig, ModelConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.networks import Card, find, folder, newest_run, read_network
from tests.support import tiny_run
from tests.support.checks import unchecked
from tests.support.compiling import quick

FACTS = Card("walk", "tiny", "simulated walks", "CC0", 1, 0, "", "a test", {})


@pytest.fixture
def run(tmp_path):
    with tiny_run.registry_entry():
        config = TrainConfig(data=DataConfig(rate=50.0), model=ModelConfig("tiny"), seed=7)
        yield tiny_run.save(tmp_path / "trained" / "walk", config)


@pytest.fixture
def networks(run, tmp_path):
    """A folder of networks: `walk` and `small.zip`, and `other`, which is not published."""
    parent = tmp_path / "networks"
    parent.mkdir()
    folder.write_published(parent / "walk", read_network(run), FACTS, "# walk")
    folder.write_published(parent / "small.zip", read_network(run), FACTS, "# walk")
    shutil.copytree(run, parent / "other")
    configuration.save(parent / "begun" / "config.yaml", TrainConfig())  # it has no weights yet
    return parent


def refused(network, *words):
    with pytest.raises(InputError) as mistake:
        gnio_jax.load_pretrained(network)
    text = str(mistake.value)
    assert "\n" not in text and all(word in text for word in words), text


def test_names_are_those_of_folders_and_zips(networks, run, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(find, "SHIPPED", tmp_path / "trained")
    assert list(find.list_networks()) == ["walk"]
    monkeypatch.setenv("GNIO_WEIGHTS", f"{networks}{os.pathsep}{tmp_path / 'trained'}")
    assert list(find.list_networks()) == ["walk", "other", "small"]
    assert find.find_network("walk") == run  # the first one counts
    assert gnio_jax.load_pretrained("small").config.seed == 7
    assert gnio_jax.load_pretrained(networks / "walk").card is not None
    refused("wolk", "no such network", "did you mean 'walk'?", "known names: walk, other, small")
    refused(tmp_path, "holds no network (config.yaml is missing)")
    network = gnio_jax.load_pretrained("small")
    with unchecked():
        refused(network, "network: is a TrainedNetwork; give its folder, its zip or its name")
    begun = "holds no weights (weights.safetensors is missing)"
    refused(networks / "begun", begun, "let gnio train finish its first epoch")
    monkeypatch.setenv("GNIO_WEIGHTS", str(tmp_path / "nowhere"))
    refused("walk", "$GNIO_WEIGHTS", "nowhere")


def test_of_two_networks_of_one_name_the_first_is_found(tmp_path, monkeypatch):
    """The name of a network of gnio-jax stands for no other."""
    folders = [tmp_path / name for name in ("shipped", "first", "second")]
    for directory, names in zip(folders, ("a", "ab", "abc"), strict=True):
        for name in names:
            (directory / name).mkdir(parents=True)
            for file in (folder.CONFIG, folder.WEIGHTS):
                (directory / name / file).touch()
    monkeypatch.setattr(find, "SHIPPED", folders[0])
    monkeypatch.setenv("GNIO_WEIGHTS", os.pathsep.join(map(str, folders[1:])))
    expected = {name: directory / name for name, directory in zip("abc", folders, strict=True)}
    assert find.list_networks() == expected


def test_the_default_is_shipped_or_the_newest_run(networks, run, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GNIO_WEIGHTS", raising=False)
    monkeypatch.setattr(find, "SHIPPED", networks)
    assert find.find_network() == networks / "other"
    monkeypatch.setattr(find, "SHIPPED", tmp_path)
    refused(None, "runs: holds no run")
    shutil.copytree(run, tmp_path / "runs" / "mine")
    assert find.find_network().name == "mine"


def test_the_newest_run_is_the_one_trained_last(tmp_path):
    with pytest.raises(InputError, match="holds no run; train one with gnio train, or name"):
        newest_run(tmp_path)
    for age, name in [(30, "old"), (10, "new")]:
        configuration.save(tmp_path / name / "config.yaml", TrainConfig())
        (tmp_path / name / "metrics.jsonl").write_text("")
        for path in (tmp_path / name).iterdir():
            os.utime(path, (1e9 - age, 1e9 - age))
    assert newest_run(tmp_path).name == "new"
    os.utime(tmp_path / "old" / "metrics.jsonl")  # trained on
    assert newest_run(tmp_path).name == "old"
    (tmp_path / "old" / "calibration.json").write_text("{}")  # a calibrated copy
    assert newest_run(tmp_path).name == "new"


def test_the_shipped_network_is_the_default_and_small(monkeypatch):
    monkeypatch.delenv("GNIO_WEIGHTS", raising=False)
    path = find.SHIPPED / "pedestrian"
    assert find.find_network() == path == find.find_network("pedestrian")
    assert sum(file.stat().st_size for file in path.iterdir()) < 1.1e6
    text = folder.read_text(path)
    for words in ("Tyrex", "CeCILL 2.1", "gnio calibrate", "oxiod_sessions_test_ekf | 7 | 3 |"):
        assert words in text


def test_the_shipped_network_answers():
    """The arrays are those that were published; a phone that lies still goes next to nowhere."""
    name, published = (
        "pedestrian",
        "2dff7eeda7be55b01b8171843c03a4c0a0a8af712a9b691693eed5ac22b570ae",
    )
    path = find.SHIPPED / name
    digest = hashlib.sha256((path / folder.WEIGHTS).read_bytes()).hexdigest()
    assert digest == published
    network = gnio_jax.load_pretrained(name)
    assert (network.name, network.digest, network.step) == (name, digest, 6020)
    config, recipe = network.config, configuration.load(configuration.find_experiment(name))
    assert config.augment == recipe.augment and config.segments.seconds == 12.0
    of_last_stage = {"epochs": 70, "batch_size": 12, "learning_rate": 5e-4, "best_by": "latest"}
    assert config.optim == dataclasses.replace(recipe.optim, **of_last_stage)
    assert config.datasets == ("tyrex", "indoor_location")
    assert (config.model.name, config.model.equivariance) == ("gru", "four_headings")
    still = np.zeros((1, config.data.input_samples, 6), np.float32)
    still[..., 2] = 9.81
    prediction = quick(network.model.apply)(network.variables, still)
    assert np.linalg.norm(prediction.displacement) < 0.1
