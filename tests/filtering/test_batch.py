"""Many sequences shared out among devices: the same numbers as one after the other."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.filtering import batch
from gnio_jax.filtering.batch import Batch, batches, padded_masks, padded_signals


@pytest.mark.parametrize("x", [[1.0, -2.0, 3.0], [-2.0]])
def test_same_as_one_after_the_other_with_its_derivative(x):
    """Three sequences on two devices: one is filled up, and counts nowhere; and one sequence alone.
    d/dw Σ ½ (w xᵢ)² = w Σ xᵢ²."""
    assert len(jax.devices()) == 2
    w, x = jnp.float64(0.5), jnp.array(x)
    mapped = jax.jit(filtering.over_sequences(lambda w, x: 0.5 * (w * x) ** 2, shared=1))
    values = mapped(w, x)
    assert len({shard.device for shard in values.addressable_shards}) == min(2, len(x))
    np.testing.assert_allclose(values, 0.5 * (0.5 * np.array(x)) ** 2, rtol=1e-14)
    slopes = jax.jit(jax.grad(lambda w, x: jnp.sum(mapped(w, x)), argnums=(0, 1)))
    of_shared, of_each = slopes(w, x)
    np.testing.assert_allclose(of_shared, 0.5 * float(jnp.sum(x**2)), rtol=1e-14)
    np.testing.assert_allclose(of_each, 0.25 * np.array(x), rtol=1e-14)


@pytest.mark.parametrize("count", [1, 3])
def test_on_one_device_also_of_what_is_no_array(monkeypatch, count):
    device = jax.devices()[0]
    monkeypatch.setattr(jax, "devices", lambda *_: [device])
    x = jnp.arange(1.0, 1.0 + count)
    outputs = filtering.over_sequences(lambda w, x: {"x": w * x, "w": 1.0}, shared=1)(2.0, x)
    np.testing.assert_array_equal(outputs["x"], 2.0 * np.asarray(x))
    np.testing.assert_array_equal(outputs["w"], np.ones(count))


def test_batches_are_few_and_of_similar_lengths_and_the_last_is_filled_up():
    """With its shortest member. They are not fuller than their number needs."""
    lengths = [30, 50, 10, 40, 20]
    for most in (3, 4):
        assert batches(lengths, most) == [Batch([1, 3, 0], 50), Batch([4, 2, 2], 50)]
    assert batches(lengths, 5) == batches(lengths, 16) == [Batch([1, 3, 0, 4, 2], 50)]
    assert batches([], 3) == []


def test_another_length_is_compiled_where_padding_takes_longer(monkeypatch):
    """Than a compilation, which is as long as 25 intervals here. The second batch has 10 intervals
    of padding, and the third would have 20 more; the last two have 4 and 8."""
    assert [part.intervals for part in batches([9, 36_000, 35_990, 10], 1)] == [
        *(36_000, 36_000),
        *(10, 10),
    ]
    monkeypatch.setattr(batch, "COMPILED_INTERVALS", 25)
    lengths = [part.intervals for part in batches([50, 40, 30, 26, 22], 1)]
    assert lengths == [50, 50, 30, 30, 30]


def test_recordings_begin_together_and_are_filled_up_behind_their_ends():
    """With rest and the last force, which no mask excludes; a longer one is cut."""
    signals = [(np.full((m, 3), 1.0 * m), np.arange(3.0 * m).reshape(m, 3)) for m in (2, 5)]
    gyro, accel = padded_signals(signals, 4)
    np.testing.assert_array_equal(gyro[0, :, 0], [2, 2, 0, 0])
    np.testing.assert_array_equal(accel[0, :, 0], [0, 3, 3, 3])
    np.testing.assert_array_equal(gyro[1, :, 0], [5, 5, 5, 5])
    np.testing.assert_array_equal(accel[1, :, 2], [2, 5, 8, 11])
    masks = [None, np.array([False, True]), np.array([True, False, True, True, False])]
    expected = [[1, 1, 1, 1], [0, 1, 1, 1], [1, 0, 1, 1]]
    np.testing.assert_array_equal(padded_masks(masks, 4), np.array(expected, bool))
    assert padded_masks([None, None], 4) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "flags, devices",
    [("", "len(os.sched_getaffinity(0))"), ("--xla_force_host_platform_device_count=3", "3")],
)
@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinity on this system")
def test_cores_as_devices(flags, devices):
    script = (
        "import os, jax; from gnio_jax import filtering; filtering.cores_as_devices(); "
        f"assert len(jax.devices()) == {devices}"
    )
    environment = os.environ | {"JAX_PLATFORMS": "cpu", "XLA_FLAGS": flags}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-500:]


def test_arguments_without_sequences_are_refused():
    add = filtering.over_sequences(lambda row, other: row + other)
    for arguments, sizes in (
        ((np.zeros((0, 3)), np.zeros((0, 3))), "found 0, 0"),
        ((np.zeros((2, 3)), np.zeros((3, 3))), "found 2, 3"),
        ((np.zeros((2, 3)), 1.0), "found 2, none"),
        ((), "found none"),
    ):
        with pytest.raises(ValueError, match=rf"^over_sequences: .*{sizes}; `shared` \(0\)"):
            add(*arguments)
    with_shared = filtering.over_sequences(lambda number, row: row + number, shared=1)
    np.testing.assert_array_equal(with_shared(1.0, np.zeros((2, 3))), np.ones((2, 3)))
