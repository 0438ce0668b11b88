"""The filter's programs compile once per shape, and their parts agree with and without jit."""

import functools

import chex
import jax.numpy as jnp
import numpy as np
import pytest
from absl.testing import parameterized
from scipy.spatial.transform import Rotation

from gnio_jax import filtering, geometry
from gnio_jax.filtering import scan, smoother
from gnio_jax.filtering import tracker as online
from gnio_jax.filtering.displacement import scaled_displacement
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.propagation import core_transition, integrate, propagate
from gnio_jax.filtering.update import Step
from gnio_jax.types import Prediction
from gnio_jax.windows import WINDOW_CUTS, cut_window
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


def test_smooth(monkeypatch):
    program = once(smoother._smooth.__wrapped__, static_argnames=("config", "frame"))
    monkeypatch.setattr(smoother, "_smooth", program)
    for seed in range(2):
        given = start(), *signals(seed), *measurements(seed)
        smoothed = filtering.smooth(*given, CONFIG, NOISE)
        chex.assert_tree_all_finite(smoothed.position)


def test_tracker(monkeypatch):
    """Neither clone steps, nor looks ahead, nor holes, nor a new start compile anything."""
    for name in ("advance", "look_ahead"):
        monkeypatch.setattr(online, name, chex.assert_max_traces(getattr(online, name), n=1))
    tracker = filtering.Tracker(predict, CONFIG, NOISE, start())
    gyro, accel = signals(0, intervals=10)
    poses = []
    for k in range(len(gyro)):
        time = k * DT + (0.1 if k > 9 else 0.0)
        poses.append(tracker.push(time, gyro[k], accel[k]))
        assert np.isfinite(tracker.pose().position).all()
    assert sum(pose is not None for pose in poses) > 5
    tracker._start(tracker.filter_state())
    assert np.isfinite(tracker.pose().position).all()


# With and without jit
# ------------------------------------------------------------------------------------------------


variants = functools.partial(
    chex.all_variants, with_device=False, without_device=False, with_pmap=False
)
ATTITUDE = Rotation.from_euler("xyz", [0.4, -0.7, 2.5]).as_matrix()
VECTOR = np.array([0.3, -0.2, 0.9])


def assert_agree(found, wanted):
    chex.assert_trees_all_close(found, wanted, rtol=1e-12, atol=1e-14)


class Variants(chex.TestCase):
    """Each function plainly called against its variants, jitted and not."""

    @variants
    @parameterized.named_parameters(
        ("exp", geometry.exp, VECTOR),
        ("exp_at_zero", geometry.exp, 0 * VECTOR),
        ("right_jacobian", geometry.right_jacobian, VECTOR),
        ("orthonormalize", geometry.orthonormalize, ATTITUDE + 1e-6),
        ("level", geometry.level, VECTOR),
        ("yaw_rotation", geometry.yaw_rotation, ATTITUDE),
    )
    def test_geometry(self, function, value):
        value = jnp.asarray(value)
        assert_agree(self.variant(function)(value), function(value))

    @variants
    @parameterized.named_parameters(*((cut, cut) for cut in WINDOW_CUTS))
    def test_cut_window(self, name):
        cut = functools.partial(cut_window, cut=WINDOW_CUTS[name], dt=DT)
        given = jnp.asarray(ATTITUDE), *map(jnp.asarray, signals(0)), 0.1 * VECTOR, VECTOR
        assert_agree(self.variant(cut)(*given), cut(*given))

    @variants
    def test_propagate(self):
        def interval(state, gyro, accel, anchored):
            moved = integrate(state.mean, Imu(gyro, accel, None), NOISE, DT)
            transition = core_transition(moved, jnp.zeros(0), anchored)
            return propagate(state, moved, transition, 1)

        given = start(), *map(jnp.asarray, signals(0, intervals=1)), jnp.ones(())
        assert_agree(self.variant(interval)(*given), interval(*given))

    @variants
    def test_update(self):
        state = start()._replace(
            step=jnp.int32(5),
            clone_offset=jnp.asarray([[-1.0, 0, 0], [-0.5, 0, 0], [0, 0, 0]]),
            clone_covariance=0.1 * jnp.eye(18),
        )
        imu = Imu(*map(jnp.asarray, signals(0, intervals=1)), None)

        def correct(state, displacement):
            noise = NOISE._replace(measurement_scale=1.0)
            measurement = scaled_displacement(displacement, 0.01 * jnp.eye(3), noise, "given")
            return measurement.update(state, Step(imu, 2, 0, CONFIG, noise))

        displacement = jnp.array([1.1, 0.1, 0.0])
        found = self.variant(correct)(state, displacement)
        assert_agree(found, correct(state, displacement))
        assert bool(found[1].accepted)
