"""Errors that are considered and not estimated: their sensitivity against filters with them."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering, geometry
from gnio_jax.filtering import tracker as online
from gnio_jax.filtering.consider import disturb
from gnio_jax.filtering.displacement import Displacement, linearise_displacement
from gnio_jax.filtering.update import Step
from gnio_jax.types import Prediction
from tests.support.checks import checked_at_first
from tests.support.compiling import optimised
from tests.support.walks import errors, simulate

N, CLONES, STRIDES, DT, SIGMA, RUNS, TRACKED = 5, 4, 80, 0.02, 0.03, 12, 2
CONFIG = filtering.FilterConfig(DT, N, CLONES, gate_threshold=1e9, history="core")
NOISE = filtering.NoiseModel(
    2e-3, 2e-2, 1e-6, 1e-4, std_factor=(0.5, 0.5, 0.5**0.5), measurement_scale=2.0
)
START = filtering.InitialStd(gyro_bias=1e-4, velocity=0.1)
STD = filtering.ConsideredStd(gyro_bias=0.02, scale=0.1, heading=0.08, slope=0.05)
SPREAD = np.array([*[STD.gyro_bias] * 3, *STD[1:4]])


@functools.cache
def walks():
    """Runs as the filter assumes them, told with the σ that comes out after the scaling."""
    runs = simulate(7, RUNS, STRIDES, N, CLONES, DT, NOISE, START, SIGMA)
    root_scale = np.sqrt(2.0) * np.array(NOISE.std_factor)
    return runs, np.broadcast_to(SIGMA / root_scale, (RUNS, STRIDES, 3))


def drawn():
    return SPREAD * np.random.default_rng(1).standard_normal((RUNS, 6))


def run_and_sensitivity(c, more, rotation, velocity, position, gyro, accel, displacement, std):
    """A filter that is disturbed by `c` and then by `more`: its history, the sensitivity where the
    displacements do not turn with its yaw frame, and the consider covariance where they do."""
    bias = c[:3] + more[:3]
    start = filtering.initial_state(
        filtering.Filter(CONFIG, start=START), rotation, velocity, position, bias
    )
    measurements = disturb(disturb(displacement, c), more), jax.vmap(jnp.diag)(std**2)

    def repeated(start, displacement, covariance, frame):
        signals = start, gyro, accel, displacement, covariance
        return filtering.run_filter(filtering.Filter(CONFIG, NOISE), *signals, frame=frame)[1]

    history = repeated(start, *measurements, "own")
    displacement, covariance = history.unscaled_displacements(NOISE)
    fixed, turning = (
        filtering.sensitivity(
            functools.partial(repeated, covariance=covariance, frame=frame), start, displacement
        )
        for frame in ("own", "turning")
    )
    return history, fixed, filtering.considered_covariance(turning, STD)


PROGRAM = jax.jit(jax.vmap(run_and_sensitivity))


@functools.cache
def filtered():
    """All runs, each with errors drawn from `STD`: history, sensitivity and what is considered;
    and the history of the first run as a function of more errors, of as many as there are runs."""
    runs, std = walks()
    inputs = runs.rotation0, runs.velocity0, runs.position0, runs.gyro, runs.accel
    arguments = drawn(), np.zeros((RUNS, 6)), *inputs, runs.displacement, std
    first = [np.repeat(leaf[:1], RUNS, axis=0) for leaf in arguments]
    results = jax.device_get(PROGRAM(*arguments))
    return results, lambda more: jax.device_get(PROGRAM(first[0], more, *first[2:])[0])


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
        differences = [getattr(ahead, name) - getattr(behind, name) for name in names]
        yield np.concatenate([Rotation.from_matrix(turn).as_rotvec(), *differences], axis=1) / (
            2 * step
        )


def test_the_sensitivity_is_the_change_of_the_filter():
    (_, sensitivity, _), run_with = filtered()
    for entry, derivative in enumerate(central(run_with(steps_of_each()))):
        size = np.abs(derivative).max(axis=0)
        assert size[[6, 7, 8]].max() > 1e-2, entry
        np.testing.assert_allclose(
            sensitivity[0, :, :, entry] / (size + 1e-6), derivative / (size + 1e-6), atol=1e-5
        )


RELABELLED = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""From the axes of the body to others, of which x was z: it is nearly vertical."""


def mean_force(windows):
    """A network that turns with the frame of its window: a tenth of the mean specific force."""
    force = 0.1 * windows[:, :, :3].mean(axis=1) * jnp.array([[1.0, 1.0, 0.0]], jnp.float32)
    return Prediction(force, jnp.full_like(force, jnp.log(0.1)))


def test_the_sensitivity_does_not_depend_on_which_axis_of_the_phone_is_vertical():
    """A phone that lies on its side has its x axis near the vertical, where the yaw of this axis
    turns with every small tilt. Window, displacement and covariance turn with it."""
    runs, _ = walks()
    noise = NOISE._replace(std_factor=(1.0, 1.0, 1.0))
    ekf = filtering.Filter(CONFIG, noise, START)

    @functools.partial(jax.jit, static_argnames="frame")
    def run(rotation, gyro, accel, frame):
        state = filtering.initial_state(ekf, rotation, runs.velocity0[0], runs.position0[0])
        _, history = filtering.run_odometry(mean_force, ekf, state, gyro, accel)
        displacement, covariance = history.unscaled_displacements(noise)

        def repeat_run(state, displacement):
            rows = displacement, covariance
            return filtering.run_filter(ekf, state, gyro, accel, *rows, frame=frame)[1]

        return history, filtering.sensitivity(repeat_run, state, displacement)

    labels = np.eye(3), RELABELLED
    imu = [
        (runs.rotation0[0] @ to_other.T, runs.gyro[0] @ to_other.T, runs.accel[0] @ to_other.T)
        for to_other in labels
    ]
    (history, rows), (other, other_rows) = (
        jax.device_get(run(*signals, CONFIG.derivative_frame)) for signals in imu
    )
    assert np.abs(other.rotation[:, 2, 0]).max() > 0.99
    np.testing.assert_allclose(other.rotation, history.rotation @ RELABELLED.T, atol=1e-5)
    np.testing.assert_allclose(other.position, history.position, atol=1e-4)
    in_other_axes = np.einsum("kdc,bc->kdb", rows[:, :9, :3], RELABELLED)
    for part in (slice(0, 3), slice(3, 6), slice(6, 9)):
        for expected, actual in (
            (in_other_axes[:, part], other_rows[:, part, :3]),
            (rows[:, part, 3:], other_rows[:, part, 3:]),
        ):
            scale = np.abs(expected).max()
            np.testing.assert_allclose(actual / scale, expected / scale, atol=1e-3)
    fixed = np.asarray(run(*imu[1], "own")[1])  # a displacement that does not turn
    assert np.abs(fixed - other_rows)[:, :3].max() > 0.03 * np.abs(other_rows[:, :3]).max()


@pytest.mark.parametrize("pitch", [np.pi / 2, np.pi / 2 - 1e-9, 1.2])
def test_a_displacement_that_turns_with_its_frame_has_a_derivative_at_any_pitch(pitch):
    """By the rotation of the oldest clone: only its turn about z changes the residual."""
    moved = np.array([0.7, -0.4, 0.2])
    config = dataclasses.replace(CONFIG, error="additive")
    step = Step(None, CLONES, 0, config, NOISE)
    exact = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    rotation = exact if pitch == np.pi / 2 else Rotation.from_euler("y", pitch).as_matrix()
    rotation = Rotation.from_euler("z", 0.3).as_matrix() @ rotation
    measured = Displacement(np.zeros(3), np.eye(3), jnp.bool_(True), "turning")

    def residual(turn):
        state = walking_state(geometry.exp(turn) @ rotation, moved)
        linear, _ = linearise_displacement(measured, state, step)
        return linear.residual, linear.jacobian["oldest_rotation"]

    derivative, of_jacobian = jax.jacfwd(residual)(np.zeros(3))
    first, jacobian = residual(np.zeros(3))
    expected = np.zeros((3, 3))
    expected[:, 2] = np.cross([0.0, 0.0, 1.0], -np.asarray(first))
    np.testing.assert_allclose(derivative, expected, atol=1e-12)
    np.testing.assert_allclose(derivative, -np.asarray(jacobian), atol=1e-12)
    assert np.isfinite(of_jacobian).all() and not np.asarray(of_jacobian)[..., :2].any()


def walking_state(rotation, moved):
    """A state whose oldest clone has this rotation, and that has moved since then."""
    nothing = np.zeros(3)
    ekf = filtering.Filter(CONFIG)
    state = filtering.initial_state(ekf, np.eye(3), nothing, nothing)
    rotations = jnp.asarray(state.clone_rotation).at[0].set(rotation)
    return state._replace(clone_rotation=rotations, offset=jnp.asarray(moved))


def test_displacements_are_disturbed_as_they_are_said_to_be():
    rng = np.random.default_rng(0)
    u = rng.standard_normal((5, 3))
    u[2], u[3, :2] = np.nan, 0.0
    c = np.array([9.0, 9.0, 9.0, 0.2, -0.3, 0.1])
    expected = np.exp(0.2) * Rotation.from_euler("z", -0.3).apply(np.nan_to_num(u))
    expected[:, 2] += 0.1 * np.hypot(u[:, 0], u[:, 1])
    np.testing.assert_allclose(disturb(u, c), np.where(np.isnan(u), np.nan, expected), atol=2e-7)
    derivative = jax.jit(jax.jacfwd(lambda c: disturb(u, c)))
    slope = derivative(c)
    assert np.isfinite(np.asarray(slope)[[0, 1, 3, 4]]).all()
    # Where there are no errors it is that of the formula, standing still too.
    slope, lifted = np.asarray(derivative(np.zeros(6))), np.hypot(u[:, 0], u[:, 1])
    nothing = np.zeros(len(u))
    across = np.stack([-u[:, 1], u[:, 0], nothing], axis=1)
    up = np.stack([nothing, nothing, lifted], axis=1)
    finite_rows = [0, 1, 3, 4]
    expected_slope = np.stack([u, across, up], axis=2)
    np.testing.assert_allclose(slope[finite_rows][:, :, 3:], expected_slope[finite_rows], atol=2e-6)
    assert not slope[finite_rows][:, :, :3].any()


def test_nothing_considered_adds_nothing_and_a_negative_size_is_refused():
    ones = np.ones((2, 15, 6))
    assert not np.any(filtering.considered_covariance(ones, filtering.ConsideredStd()))
    only = filtering.considered_covariance(ones, filtering.ConsideredStd(slope=2.0))
    np.testing.assert_array_equal(only, np.full((2, 15, 15), 4.0))
    for name, wrong in (("scale", -1.0), ("slope", np.nan), ("raw_gyro_bias", -0.1)):
        with pytest.raises(ValueError, match=rf"^considered\.{name}: must be finite and not neg"):
            filtering.considered_covariance(ones, STD._replace(**{name: wrong}))


def test_the_bias_of_a_raw_gyro_is_considered_along_its_axis():
    """Where the axis is zero, the gyro is not raw."""
    rng = np.random.default_rng(3)
    sensitivity, axis = rng.standard_normal((4, 15, 6)), rng.standard_normal((4, 3))
    axis[1] = 0.0
    plain = filtering.considered_covariance(sensitivity, STD)
    raw = filtering.considered_covariance(sensitivity, STD._replace(raw_gyro_bias=0.3), axis)
    for row in range(4):
        along = 0.3 * sensitivity[row, :, :3] @ axis[row]
        np.testing.assert_allclose(raw[row] - plain[row], np.outer(along, along), atol=1e-12)
    np.testing.assert_array_equal(
        filtering.considered_covariance(sensitivity, STD._replace(raw_gyro_bias=0.3)), plain
    )


def with_arc(covariance, added):
    """P + A with the arc of its whole yaw in the place of the arc of P: ¾ l lᵀ each, where l is the
    covariance of yaw and velocity or position, turned by a quarter about z."""

    def arc(covariance):
        lever = np.zeros(covariance.shape[:-1])
        lever[..., [3, 6]], lever[..., [4, 7]] = (
            covariance[..., 2, [4, 7]],
            -covariance[..., 2, [3, 6]],
        )
        return 0.75 * lever[..., :, None] * lever[..., None, :]

    return covariance + added + arc(covariance + added) - arc(covariance)


def test_the_arc_is_that_of_the_whole_yaw():
    root = np.random.default_rng(3).normal(size=(2, 5, 15, 15))
    covariance, added = root @ np.swapaxes(root, 2, 3)
    for error, expected in (
        ("invariant", with_arc(covariance, added)),
        ("additive", covariance + added),
    ):
        config = dataclasses.replace(CONFIG, error=error)
        total = filtering.with_considered(covariance, added, config)
        np.testing.assert_allclose(total, expected, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("size", [0.005, 0.02])
def test_the_bias_of_a_raw_gyro_is_covered(size):
    """Walks of 18 s with a vertical bias that the filter does not estimate and level ones that it
    does. The larger bias leaves the yaw uncertain by a third of a radian, so the place lies on an
    arc."""
    count, intervals, clones, sigma = 60, 180, 10, 0.05
    config = dataclasses.replace(CONFIG, clones_per_window=clones)
    noise = filtering.NoiseModel(1e-3, 1e-2, 1e-6, 1e-4, measurement_scale=1.0)
    std = filtering.InitialStd(gyro_bias=1e-4, velocity=0.3)
    ekf = filtering.Filter(config, noise, std)
    runs = simulate(7, count, intervals, N, clones, DT, noise, std, sigma)
    rng, up = np.random.default_rng(5), np.asarray(runs.rotation0)[:, 2]
    vertical = rng.normal(size=(count, 1)) * up
    level = 0.05 * rng.normal(size=(count, 3))
    level = level - np.sum(level * up, axis=1, keepdims=True) * up

    def run(rotation, velocity, position, gyro, accel, displacement, up):
        pose = rotation, velocity, position
        state = filtering.initial_state(ekf, *pose, level_gyro_bias=0.05)
        spread = jnp.tile(sigma**2 * jnp.eye(3)[None], (intervals, 1, 1))

        def repeated(state, displacement):
            return filtering.run_filter(ekf, state, gyro, accel, displacement, spread)[1]

        history = repeated(state, displacement)
        rows = filtering.sensitivity(repeated, state, displacement)
        raw = filtering.ConsideredStd(raw_gyro_bias=size)
        axis = jnp.broadcast_to(up[None], (intervals, 3))
        added = filtering.considered_covariance(rows, raw, axis)
        return history, filtering.with_considered(history.covariance, added, config)

    gyro = runs.gyro + (size * vertical + level)[:, None]
    signals = gyro, runs.accel, runs.displacement, up
    history, covariance = jax.device_get(optimised(jax.vmap(run))(*runs[:3], *signals))
    error = errors(runs, history)
    assert np.sqrt(covariance[:, -1, 2, 2].mean()) > 15 * size
    for row in (59, 119, 179):
        for entries in ([2], [6, 7]):
            part = error[:, row][:, entries]
            spread = covariance[:, row][:, entries][:, :, entries]
            solved = np.linalg.solve(spread, part[..., None])[..., 0]
            nees = np.mean(np.sum(part * solved, axis=1)) / len(entries)
            assert 0.5 < nees < 1.4, (row, entries)


class Told:
    """A network whose next displacement the test chooses, and the number of its calls."""

    def __init__(self):
        self.displacement, self.calls = np.zeros(3), 0
        root_scale = np.sqrt(2.0) * np.array(NOISE.std_factor)
        self.log_std = np.log(SIGMA / root_scale)

    def __call__(self, windows):
        displacement = jax.pure_callback(
            self._next, jax.ShapeDtypeStruct((3,), float), windows[0, 0, 0]
        )
        return Prediction(displacement[None], jnp.asarray(self.log_std)[None], {})

    def _next(self, _):
        self.calls += 1
        return self.displacement


TOLD = Told()


@pytest.fixture(scope="module")
def ready():
    tracker = filtering.Tracker(TOLD, filtering.Filter(CONFIG, NOISE, considered=STD), started(0))
    return tracker._advance, tracker._look_ahead


@pytest.fixture
def built(monkeypatch, ready):
    monkeypatch.setattr(online, "compile_programs", lambda *_: ready)


def started(r):
    runs, _ = walks()
    pose = runs.rotation0[r], runs.velocity0[r], runs.position0[r]
    return filtering.initial_state(filtering.Filter(CONFIG, start=START), *pose, drawn()[r, :3])


def test_the_tracker_has_the_covariance_of_the_whole_run(built):
    (history, _, added), _ = filtered()
    (runs, _), expected = walks(), with_arc(history.covariance, added)
    TOLD.calls = 0
    for r in range(TRACKED):
        tracker = filtering.Tracker(
            TOLD, filtering.Filter(CONFIG, NOISE, considered=STD), started(r)
        )
        displacements = np.nan_to_num(disturb(runs.displacement[r], drawn()[r]))
        poses = []
        for k in checked_at_first(range(N * STRIDES), 30):
            TOLD.displacement = displacements[k // N]
            pose = tracker.push(k * DT, runs.gyro[r, k], runs.accel[r, k])
            poses += [] if pose is None else [pose]
        std = np.sqrt(np.diagonal(expected[r], axis1=1, axis2=2))
        scale = std[:, :, None] * std[:, None, :]
        covariance = np.array([pose.covariance for pose in poses])
        np.testing.assert_allclose(covariance / scale, expected[r] / scale, atol=1e-9)
        positions = [pose.position for pose in poses]
        np.testing.assert_allclose(positions, history.position[r], atol=1e-9)
    assert TOLD.calls == TRACKED * (STRIDES - CLONES)  # of the derivatives none calls it again


def test_a_start_from_rest_considers_from_its_first_pose_on(built):
    waiting = filtering.Tracker(TOLD, filtering.Filter(CONFIG, NOISE, considered=STD))
    resting_sample = [[0.0, 0.0, 0.0], [0.0, 0.0, 9.81]]
    pose = [waiting.push(k * DT, *resting_sample) for k in range(50)][-1]
    variance = np.diag(pose.covariance)[9:12]
    assert (variance > 0.9 * STD.gyro_bias**2).all()
