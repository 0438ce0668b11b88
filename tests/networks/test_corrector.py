"""A trained corrector before filter and network, found by a name and published with the network."""

import hashlib

import numpy as np
import pytest

from gnio_jax import models, networks
from gnio_jax.config import DataConfig, FilterSettings, ModelConfig, TrainConfig
from gnio_jax.data.simulated.walks import pedestrian
from gnio_jax.errors import InputError
from gnio_jax.evaluation import prepare
from gnio_jax.networks import Card, TrainedNetwork, folder, read_network
from tests.support.networks import drawn

IN_BODY = DataConfig(rate=50.0, window_rotation="body_axes")


def save(path, config):
    model = models.from_experiment(config)
    shapes = {"batch_stats": {}, **models.variable_shapes(model, config.data.input_samples)}
    path.mkdir()
    networks.write_network(path, TrainedNetwork(config, model, drawn(shapes), 1, 0))
    return path


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """A run with a corrector, and one that names it."""
    parent = tmp_path_factory.mktemp("runs")
    model = ModelConfig(name="ionet", width=3, corrector="airimu")
    first = save(parent / "imu", TrainConfig(data=IN_BODY, model=model))
    settings = FilterSettings(corrector=str(first))
    config = TrainConfig(
        data=DataConfig(rate=50.0), model=ModelConfig(name="ionet", width=3), filter=settings
    )
    return first, save(parent / "behind", config)


def test_a_published_network_has_its_corrector_within(runs, tmp_path):
    first, behind = runs
    network = networks.with_corrector(read_network(behind))
    corrector = read_network(first).variables["params"]["corrector"]
    card = Card("named", "ionet", "walks", "CC0", 1, 0, "", "a test", {})
    folder.write_published(tmp_path / "named.zip", network, card, "# named")
    named = read_network(tmp_path / "named.zip")
    assert named.config.filter.corrector == "imu"  # no folder of this machine
    loaded_corrector = networks.load_corrector(named.config.filter, 50.0, named)
    kernels = (
        tree["gru1"]["input"]["kernel"]
        for tree in (loaded_corrector.variables["params"], corrector)
    )
    np.testing.assert_array_equal(*kernels)
    # The network itself is unchanged.
    assert named.variables.keys() == read_network(behind).variables.keys()


def test_a_corrector_has_a_digest_unless_it_comes_with_the_network(runs):
    first, behind = runs
    network = read_network(behind)
    digest = hashlib.sha256((first / "weights.safetensors").read_bytes()).hexdigest()
    assert networks.digest_corrector(network.config.filter, network) == digest
    carried = networks.with_corrector(network)
    assert networks.digest_corrector(network.config.filter, carried) is None
    assert networks.digest_corrector(FilterSettings(), network) is None


def test_a_wrong_corrector_is_refused_in_one_line(runs):
    first, behind = runs
    settings = FilterSettings(corrector=str(behind))
    with pytest.raises(InputError, match="a network without a corrector; name one with model"):
        networks.load_corrector(settings, 50.0)
    with pytest.raises(InputError, match="works at 50 Hz; name one of 100 Hz"):
        networks.load_corrector(FilterSettings(corrector=str(first)), 100.0)
    assert networks.load_corrector(FilterSettings(), 100.0) is None


def test_a_recording_is_corrected_before_it_is_prepared(runs):
    network = read_network(runs[1])
    corrector = networks.load_corrector(network.config.filter, 50.0)
    walk = pedestrian(1, 1, "handheld", seconds=8.0, rate=50.0)
    (plain,), _ = prepare([walk], network.config.data)
    (corrected,), _ = prepare([walk], network.config.data, corrector=corrector)
    accel, gyro, variance = corrector.correct(walk.accel, walk.gyro)
    count = len(corrected.gyro)
    np.testing.assert_array_equal(corrected.gyro, gyro[:count])
    np.testing.assert_array_equal(corrected.accel, accel[:count])
    np.testing.assert_array_equal(corrected.variance, variance[:count])
    assert plain.variance is None and np.abs(corrected.gyro - plain.gyro).max() > 1e-3
