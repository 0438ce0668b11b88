"""Errors that are considered and not estimated: their sensitivity against filters that have them,
and whether the covariance with them is that of the errors of simulated walks."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from gnio_jax.filtering import tracker as online
from gnio_jax.filtering.consider import disturbed
from gnio_jax.types import Prediction
from tests.support.checks import checked_at_first
from tests.support.walks import errors, simulate

N, CLONES, STRIDES, DT, SIGMA, RUNS = 5, 4, 100, 0.02, 0.03, 24
HALF = RUNS // 2
CONFIG = filtering.FilterConfig(DT, N, CLONES, gate_threshold=1e9, history="core")
NOISE = filtering.NoiseModel(
    2e-3, 2e-2, 1e-6, 1e-4, std_factor=(0.5, 0.5, 0.5**0.5), measurement_scale=2.0
)
START = filtering.InitialStd(gyro_bias=1e-4, velocity=0.1)
STD = filtering.ConsideredStd(gyro_bias=0.02, scale=0.1, heading=0.08, slope=0.05)
SPREAD = np.array([*[STD.gyro_bias] * 3, *STD[1:]])


@functools.cache
def walks():
    """Runs as the filter assumes them, told with the σ that comes out after the scaling."""
    runs = simulate(7, RUNS, STRIDES, N, CLONES, DT, NOISE, START, SIGMA)
    root_scale = np.sqrt(2.0) * np.array(NOISE.std_factor)
    return runs, np.broadcast_to(SIGMA / root_scale, (RUNS, STRIDES, 3))


def drawn():
    """The errors of each run, from `STD`."""
    return SPREAD * np.random.default_rng(1).standard_normal((RUNS, 6))


def run(c, more, rotation, velocity, position, gyro, accel, displacement, std):
    """A filter that is disturbed by `c` and then by `more`: its start and its history."""
    bias = c[:3] + more[:3]
    start = filtering.initial_state(CONFIG, rotation, velocity, position, bias, std=START)
    given = disturbed(disturbed(displacement, c), more), jax.vmap(jnp.diag)(std**2)
    return start, repeated(start, gyro, accel, *given)


def repeated(start, gyro, accel, displacement, covariance):
    given = displacement, covariance, CONFIG, NOISE
    return filtering.run_filter(start, gyro, accel, *given, frame="own")[1]


def run_and_sensitivity(c, more, *given):
    start, history = run(c, more, *given)
    displacement, covariance = history.given(NOISE)

    def again(start, displacement):
        return repeated(start, *given[3:5], displacement, covariance)

    return history, filtering.sensitivity(again, start, displacement)


@functools.cache
def filtered():
    """All runs, each with errors drawn from `STD`: history and sensitivity, and the history of the
    first run as a function of more errors, of as many as there are runs."""
    runs, std = walks()
    disturbances = drawn()
    given = (runs.rotation0, runs.velocity0, runs.position0, runs.gyro, runs.accel)
    both, alone = jax.jit(jax.vmap(run_and_sensitivity)), jax.jit(jax.vmap(run))
    given = (*given, runs.displacement, std)
    found = both(disturbances, np.zeros((RUNS, 6)), *given)
    first = jax.tree.map(lambda leaf: np.repeat(leaf[:1], RUNS, axis=0), (disturbances, *given))
    return jax.device_get(found), lambda more: jax.device_get(alone(first[0], more, *first[1:])[1])


STEPS = np.repeat([1e-5, 1e-4], 3)


def steps_of_each():
    """More errors for differences: one entry after the other, ahead and then behind."""
    more = np.zeros((RUNS, 6))
    more[:6], more[6:12] = np.diag(STEPS), -np.diag(STEPS)
    return more


def central(estimates):
    """The derivatives by each error of θ, v, p, b_g, b_a, from runs with `steps_of_each`."""
    for entry, step in enumerate(STEPS):
        ahead, behind = (
            jax.tree.map(lambda leaf, r=r: leaf[r], estimates) for r in (entry, 6 + entry)
        )
        turn = ahead.rotation @ np.swapaxes(behind.rotation, 1, 2)
        names = ("velocity", "position", "gyro_bias", "accel_bias")
        rest = [getattr(ahead, name) - getattr(behind, name) for name in names]
        yield np.concatenate([Rotation.from_matrix(turn).as_rotvec(), *rest], axis=1) / (2 * step)


def test_the_sensitivity_is_the_change_of_the_filter():
    (_, found), run_with = filtered()
    for entry, wanted in enumerate(central(run_with(steps_of_each()))):
        size = np.abs(wanted).max(axis=0)
        assert size[[6, 7, 8]].max() > 1e-2, entry
        np.testing.assert_allclose(
            found[0, :, :, entry] / (size + 1e-6), wanted / (size + 1e-6), atol=1e-5
        )


def test_the_covariance_with_them_is_that_of_the_errors():
    runs, _ = walks()
    (history, found), _ = filtered()
    added = jax.jit(jax.vmap(lambda s: filtering.considered_covariance(s, STD)))(found)

    def nees(covariance):
        error = errors(runs, history)[:, CLONES:, 6:9]
        chosen = np.asarray(covariance)[:, CLONES:, 6:9, 6:9]
        squares = np.einsum("rki,rkij,rkj->rk", error, np.linalg.inv(chosen), error)
        return squares[:, ::10].mean() / 3

    assert nees(history.covariance) > 5
    assert nees(history.covariance + added) == pytest.approx(1, abs=0.35)


def test_displacements_are_disturbed_as_they_are_said_to_be():
    rng = np.random.default_rng(0)
    u = rng.standard_normal((5, 3))
    u[2], u[3, :2] = np.nan, 0.0
    c = np.array([9.0, 9.0, 9.0, 0.2, -0.3, 0.1])
    wanted = np.exp(0.2) * Rotation.from_euler("z", -0.3).apply(np.nan_to_num(u))
    wanted[:, 2] += 0.1 * np.hypot(u[:, 0], u[:, 1])
    np.testing.assert_allclose(disturbed(u, c), np.where(np.isnan(u), np.nan, wanted), atol=2e-7)
    derivative = jax.jit(jax.jacfwd(lambda c: disturbed(u, c)))
    slope = derivative(c)
    assert np.isfinite(np.asarray(slope)[[0, 1, 3, 4]]).all()
    # Where there are no errors it is that of the formula, standing still too.
    slope, lifted = np.asarray(derivative(np.zeros(6))), np.hypot(u[:, 0], u[:, 1])
    nothing = np.zeros(len(u))
    across = np.stack([-u[:, 1], u[:, 0], nothing], axis=1)
    up = np.stack([nothing, nothing, lifted], axis=1)
    known = [0, 1, 3, 4]
    wanted = np.stack([u, across, up], axis=2)
    np.testing.assert_allclose(slope[known][:, :, 3:], wanted[known], atol=2e-6)
    assert not slope[known][:, :, :3].any()


def test_nothing_considered_adds_nothing():
    ones = np.ones((2, 15, 6))
    assert not np.any(filtering.considered_covariance(ones, filtering.ConsideredStd()))
    only = filtering.considered_covariance(ones, filtering.ConsideredStd(slope=2.0))
    np.testing.assert_array_equal(only, np.full((2, 15, 15), 4.0))


# The tracker
# ------------------------------------------------------------------------------------------------


class Told:
    """A network whose next displacement the test chooses, and the number of its calls."""

    def __init__(self):
        self.displacement, self.calls = np.zeros(3), 0
        root_scale = np.sqrt(2.0) * np.array(NOISE.std_factor)
        self.log_std = np.log(SIGMA / root_scale)

    def __call__(self, windows):
        told = jax.pure_callback(self._next, jax.ShapeDtypeStruct((3,), float), windows[0, 0, 0])
        return Prediction(told[None], jnp.asarray(self.log_std)[None], {})

    def _next(self, _):
        self.calls += 1
        return self.displacement


TOLD = Told()


@functools.cache
def compiled():
    """The program of every tracker below."""
    tracker = filtering.Tracker(TOLD, CONFIG, NOISE, started(0), considered=STD)
    return tracker._advance, tracker._look_ahead


@pytest.fixture
def built(monkeypatch):
    ready = compiled()
    monkeypatch.setattr(online, "compile_programs", lambda *_: ready)


def started(r, more=0.0):
    """The start of a run with its own errors and more."""
    runs, _ = walks()
    bias = (drawn()[r] + more)[:3]
    pose = runs.rotation0[r], runs.velocity0[r], runs.position0[r]
    return filtering.initial_state(CONFIG, *pose, bias, std=START)


@functools.cache
def told_of_run(r):
    runs, _ = walks()
    return np.asarray(disturbed(runs.displacement[r], drawn()[r]))


def disturbed_in_numpy(u, c):
    turned = np.exp(c[3]) * Rotation.from_euler("z", c[4]).apply(u)
    return turned + np.array([0.0, 0.0, c[5] * np.hypot(*u[:2])])


def push(tracker, r, samples, more=None):
    """Push samples of a run, with more errors; the poses of the clone steps."""
    runs, _ = walks()
    poses = []
    for k in checked_at_first(samples, 30):
        told = np.nan_to_num(told_of_run(r)[k // N])
        TOLD.displacement = told if more is None else disturbed_in_numpy(told, more)
        pose = tracker.push(k * DT, runs.gyro[r, k], runs.accel[r, k])
        poses += [] if pose is None else [pose]
    return poses


def tracker_of(r, more=None):
    state = started(r, 0.0 if more is None else more)
    return filtering.Tracker(TOLD, CONFIG, NOISE, state, considered=STD)


@functools.cache
def tracked():
    """The poses of half of the runs, and the calls of the network."""
    TOLD.calls = 0
    return [push(tracker_of(r), r, range(N * STRIDES)) for r in range(HALF)], TOLD.calls


def test_the_tracker_has_the_covariance_of_the_whole_run(built):
    (history, found), _ = filtered()
    added = jax.jit(jax.vmap(lambda s: filtering.considered_covariance(s, STD)))(found)
    wanted = (history.covariance + np.asarray(added))[:HALF]
    poses, calls = tracked()
    covariance = np.array([[pose.covariance for pose in row] for row in poses])
    std = np.sqrt(np.diagonal(wanted, axis1=2, axis2=3))
    scale = std[:, :, :, None] * std[:, :, None, :]
    np.testing.assert_allclose(covariance / scale, wanted / scale, atol=1e-9)
    position = np.array([[pose.position for pose in row] for row in poses])
    np.testing.assert_allclose(position, history.position[:HALF], atol=1e-9)
    assert calls == HALF * (STRIDES - CLONES)  # of the derivatives none calls it again


def without_considered(tracker):
    """The covariance of the tracker's pose, from P alone after its last clone step."""
    state, stream = tracker._core.filter, tracker._stream
    estimate, memory = online.estimated(state, jnp.zeros(3), None, None), state.imu
    for row in stream.rows(stream.known):
        estimate, memory = tracker._look_ahead(estimate, memory, row)
    return np.asarray(estimate.covariance)


def test_what_is_added_is_the_change_of_the_tracker(built):
    """Against trackers that have more errors: before the first clone step, at one and after it."""
    stops = 2, 20 * N, 20 * N + 3

    def visited(more=None):
        tracker, before = tracker_of(0, more), 0
        for stop in stops:
            push(tracker, 0, range(before, stop), more)
            before = stop
            yield tracker, tracker.pose()

    wanted = np.zeros((len(stops), 15, 15))
    for entry, step in enumerate([1e-5, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4]):
        more = step * np.eye(6)[entry]
        pairs = zip(visited(more), visited(-more), strict=True)
        for place, ((_, ahead), (_, behind)) in enumerate(pairs):
            turn = Rotation.from_matrix(ahead.rotation @ behind.rotation.T).as_rotvec()
            names = "velocity", "position", "gyro_bias", "accel_bias"
            rest = [getattr(ahead, name) - getattr(behind, name) for name in names]
            column = np.concatenate([turn, *rest]) / (2 * step) * SPREAD[entry]
            wanted[place] += np.outer(column, column)
    for place, (tracker, pose) in enumerate(visited()):
        added = pose.covariance - without_considered(tracker)
        std = np.sqrt(np.diag(pose.covariance))
        assert np.abs((added - wanted[place]) / np.outer(std, std)).max() < 1e-6, place
        assert np.abs(added / np.outer(std, std)).max() > 0.5


def test_a_start_from_rest_considers_from_its_first_pose_on(built):
    waiting = filtering.Tracker(TOLD, CONFIG, NOISE, considered=STD)
    rest = [[0.0, 0.0, 0.0], [0.0, 0.0, 9.81]]
    pose = [waiting.push(k * DT, *rest) for k in range(50)][-1]
    variance = np.diag(pose.covariance)[9:12]
    assert (variance > 0.9 * STD.gyro_bias**2).all()


def test_a_negative_size_is_refused():
    wrong = STD._replace(scale=-1.0)
    with pytest.raises(ValueError, match=r"^considered\.scale: must be finite and not neg"):
        filtering.Tracker(TOLD, CONFIG, NOISE, started(0), considered=wrong)
    with pytest.raises(ValueError, match=r"^considered\.slope"):
        filtering.considered_covariance(np.ones((2, 15, 6)), STD._replace(slope=np.nan))


# The smoother
# ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_sensitivity_of_the_smoother_is_its_change():
    runs, _ = walks()
    (history, _), _ = filtered()
    runs, history, c = jax.tree.map(lambda leaf: leaf[0], (runs, history, drawn()))
    displacement, covariance = history.given(NOISE)
    pose, fixed = (runs.rotation0, runs.velocity0, runs.position0), (covariance, CONFIG, NOISE)

    def start(more):
        return filtering.initial_state(CONFIG, *pose, c[:3] + more[:3], std=START)

    def run(start, displacement):
        return filtering.smooth(start, runs.gyro, runs.accel, displacement, *fixed, frame="own")

    @jax.jit
    @jax.vmap
    def changed(more):
        return run(start(more), disturbed(displacement, more))

    sensitivity = jax.jit(lambda more: filtering.sensitivity(run, start(more), displacement))
    found = np.asarray(sensitivity(np.zeros(6)))
    for entry, wanted in enumerate(central(jax.device_get(changed(steps_of_each()[:HALF])))):
        size = np.abs(wanted).max(axis=0) + 1e-6
        np.testing.assert_allclose(found[:, :, entry] / size, wanted / size, atol=1e-5)
