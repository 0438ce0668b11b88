"""Many sequences shared out among devices: the same numbers as one after the other, whatever their
number."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from tests.support.compiling import quick

CONFIG = filtering.FilterConfig(dt=0.01, samples_per_clone=5, clones_per_window=2)
NOISE = filtering.NoiseModel.per_sample(1e-2, 3e-2, CONFIG.dt)


def signals(count):
    rng = np.random.default_rng(3)
    gyro = 0.3 * rng.standard_normal((count, 30, 3))
    accel = np.array([0.0, 0.0, 9.81]) + 0.5 * rng.standard_normal((count, 30, 3))
    return (
        gyro,
        accel,
        0.1 * rng.standard_normal((count, 6, 3)),
        np.tile(0.01 * np.eye(3), (count, 6, 1, 1)),
    )


def one(noise, gyro, accel, displacement, covariance):
    state = filtering.initial_state(CONFIG, np.eye(3), np.zeros(3), np.zeros(3))
    return filtering.run_filter(state, gyro, accel, displacement, covariance, CONFIG, noise)


alone, spread = quick(one), quick(filtering.over_sequences(one, shared=1))


def test_same_as_one_after_the_other():
    """Three sequences on two devices: one is filled up."""
    count = 3
    assert len(jax.devices()) == 2
    found = spread(NOISE, *signals(count))
    assert len({shard.device for shard in found[1].position.addressable_shards}) == 2
    found = jax.device_get(found)  # indexed in JAX, every leaf would be two programs
    for k in range(count):
        ours = jax.tree.map(lambda leaf, k=k: leaf[k], found)
        expected = alone(NOISE, *(signal[k] for signal in signals(count)))
        jax.tree.map(
            lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12), ours, expected
        )


def test_gradient_of_what_is_shared_sums_over_the_sequences():
    """d/dw Σ ½ (w xᵢ)² = w Σ xᵢ², the additional sequence that fills the devices up left out."""
    x = jnp.array([1.0, -2.0, 3.0])
    mapped = filtering.over_sequences(lambda w, x: 0.5 * (w * x) ** 2, shared=1)
    of_shared, of_each = jax.jit(jax.grad(lambda w, x: jnp.sum(mapped(w, x)), argnums=(0, 1)))(
        jnp.float64(0.5), x
    )
    np.testing.assert_allclose(of_shared, 0.5 * 14.0, rtol=1e-14)
    np.testing.assert_allclose(of_each, 0.25 * np.array(x), rtol=1e-14)


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
