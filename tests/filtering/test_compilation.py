"""The filter's programs compile once per shape, and their parts agree with and without jit."""

import chex
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import filtering
from gnio_jax.filtering import scan
from gnio_jax.types import Prediction
from tests.support.compiling import quick

N, CLONES, DT = 2, 2, 0.01
INTERVALS = 4
CONFIG = filtering.FilterConfig(DT, N, CLONES)
NOISE = filtering.NoiseModel()


@pytest.fixture(autouse=True)
def trace_counts():
    """chex counts the traces of a function over the whole process."""
    chex.clear_trace_counter()


def once(function, **options):
    """Jitted, and an AssertionError where it is traced a second time."""
    return quick(chex.assert_max_traces(function, n=1), **options)


def signals(seed, intervals=INTERVALS):
    rng = np.random.default_rng(seed)
    gyro = 0.1 * rng.standard_normal((N * intervals, 3))
    accel = [0.0, 0.0, 9.81] + 0.1 * rng.standard_normal((N * intervals, 3))
    return gyro, accel


def measurements(seed):
    rng = np.random.default_rng(seed)
    spread = np.tile(0.01 * np.eye(3), (INTERVALS, 1, 1))
    return 0.01 * rng.standard_normal((INTERVALS, 3)), spread


def start():
    return filtering.initial_state(CONFIG, np.eye(3), np.zeros(3), np.zeros(3))


def predict(windows):
    pooled = jnp.mean(windows[:, :, :3], axis=1)
    return Prediction(0.01 * pooled, jnp.full((1, 3), -1.0, jnp.float32))


# Once per shape
# ------------------------------------------------------------------------------------------------


def test_run_filter(monkeypatch):
    """Another recording, another noise, given as a number or an array, a state carried on."""
    program = once(scan._run_filter.__wrapped__, static_argnames=("config", "frame"))
    monkeypatch.setattr(scan, "_run_filter", program)
    state, _ = filtering.run_filter(start(), *signals(0), *measurements(0), CONFIG, NOISE)
    louder = NOISE._replace(gyro_density=jnp.asarray(1e-3))
    _, history = filtering.run_filter(state, *signals(1), *measurements(1), CONFIG, louder)
    chex.assert_tree_all_finite((history.position, history.covariance_diagonal))
    with pytest.raises(AssertionError, match="traced"):
        other = filtering.FilterConfig(DT, N, CLONES, gate_threshold=9.0)
        filtering.run_filter(start(), *signals(0), *measurements(0), other, NOISE)


def test_run_odometry():
    """The state that a run leaves has the types of the one that it began from."""

    def run(state, gyro, accel, noise):
        return filtering.run_odometry(predict, state, gyro, accel, CONFIG, noise)

    program = once(run)
    state, _ = program(start(), *signals(0), NOISE)
    final, history = program(state, *signals(1), NOISE)
    chex.assert_trees_all_equal_shapes_and_dtypes(final, start())
    chex.assert_tree_all_finite((history.position, history.covariance_diagonal))
