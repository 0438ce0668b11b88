"""A batch that two devices share: the same numbers as on one, and each has its part."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.sharding import PartitionSpec

from gnio_jax.config import DataConfig, ModelConfig, OptimConfig, ThroughFilter, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.reporting import Silence
from gnio_jax.scaling import devices
from gnio_jax.training import loop, on_windows, run_folder, step
from tests.support.drawn_state import drawn_state
from tests.support.tlio_files import write_sequence


@pytest.fixture(scope="module")
def config(tmp_path_factory):
    root = tmp_path_factory.mktemp("tlio")
    for name in "ab":
        write_sequence(root / name)
    for split, name in (("train", "a"), ("val", "b"), ("test", "b")):
        (root / f"{split}_list.txt").write_text(f"{name}\n")
    optim = OptimConfig(epochs=2, batch_size=16, learning_rate=1e-3, statistics_windows=32)
    model = ModelConfig(width=2, bank_size=3)
    data = DataConfig(rate=50.0)
    return TrainConfig("tlio", str(root), data=data, model=model, optim=optim)


def trained(config):
    """Losses and gradient norms of each of five steps, figures of validation, parameters."""
    training = on_windows.set_up(config, Silence())
    drawn = drawn_state(training.model, training.optimizer, config.data.seen)
    state, order, found = devices.everywhere(drawn), training.order(0), []
    for first in range(5):
        state, progress = training.take_steps(state, order, first, 1, 1.0)
        found.append((progress.sums, progress.gradient_norms))
    state, row = training.validate(training.settled(state), 5)
    return jax.device_get((found, row, state.batch_stats)), state


@pytest.fixture(scope="module")
def on_two(config):
    with devices.sharing(devices.chosen(2)):
        return trained(config)


def test_two_devices_learn_what_one_learns(config, on_two):
    """Statistics of batch normalisation are those of the whole batch, or nothing would agree."""
    alone, _ = trained(config)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, 2e-4, 1e-5), on_two[0], alone)


def test_each_device_has_the_state_and_its_part_of_the_batch(config, on_two):
    _, state = on_two
    for leaf in jax.tree.leaves(state):
        assert leaf.sharding.is_fully_replicated and len(leaf.devices()) == 2
    with devices.sharing(devices.chosen(2)):
        training = on_windows.set_up(config, Silence())
        which = devices.everywhere(np.arange(16, dtype=np.int32))
        draw = jax.jit(lambda: step.draw_windows(jax.random.key(0), training.source, which, config))
        windows, _ = draw()
    assert windows.imu.sharding.spec[0] == "batch"
    assert [shard.data.shape[0] for shard in windows.imu.addressable_shards] == [8, 8]


def test_a_cpu_is_one_device_unless_asked_for_more():
    assert devices.chosen() == jax.devices()[:1]
    assert devices.chosen(2) == jax.devices()[:2]
    for limit, expected in ((3, "--devices: is 3, but process 0 has 2"), (0, "--devices: must be")):
        with pytest.raises(InputError, match=expected):
            devices.chosen(limit)


def test_a_batch_that_cannot_be_shared_evenly_is_told(config):
    optim = dataclasses.replace(config.optim, batch_size=15)
    changed = dataclasses.replace(config, optim=optim, data_root="nowhere")
    with devices.sharing(devices.chosen(2)), pytest.raises(InputError, match="2 devices cannot"):
        on_windows.set_up(changed, Silence())  # before it reads anything


def test_through_the_filter_there_is_no_number_of_devices():
    config = TrainConfig(through_filter=ThroughFilter(("head",)))
    with pytest.raises(InputError, match="--devices: is for training on windows; leave it out"):
        loop.train(config, devices=2)


def test_processes_with_other_samples_or_weights_are_told(monkeypatch):
    """As `require_same` compares them: the digests differ where an array does."""
    monkeypatch.setattr(run_folder, "several", lambda: True)

    def digests(samples, weights):
        found = {}
        compared = lambda what, digest, _: found.update({what: digest})  # noqa: E731
        monkeypatch.setattr(run_folder, "require_same", compared)
        tree = {"imu": samples, "start": np.arange(3)}
        run_folder.compare_processes(TrainConfig(), {"train": ["a"]}, tree, {"scale": weights})
        return found

    samples, weights = np.arange(12.0).reshape(4, 3), jnp.float32(1)
    before = digests(samples, weights)
    for other, what in (
        ((samples[:3], weights), "samples of the same recordings"),
        ((samples + 1e-9, weights), "samples of the same recordings"),
        ((samples, jnp.float32(2)), "weights to begin with"),
    ):
        after = digests(*other)
        assert [name for name in before if before[name] != after[name]] == [what]


def test_with_one_device_nothing_is_placed_nor_constrained():
    rows = jnp.arange(6)
    with devices.sharing(devices.chosen(1)):
        assert devices.count() == 1 and devices.described() == "cpu"
        assert devices.shared_out(rows) is rows and devices.kept_everywhere(rows) is rows
        assert devices.everywhere(np.arange(6)).sharding == rows.sharding
    with devices.sharing(devices.chosen(2)):
        assert devices.count() == 2 and devices.described() == "2 × cpu"
        assert devices.everywhere(np.arange(6)).sharding.spec == PartitionSpec()
