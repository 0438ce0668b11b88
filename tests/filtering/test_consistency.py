"""Is the filter as certain as it may be? Monte Carlo with noises as it assumes them, what is unobservable, Jacobians by autodiff."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiling import quick
from scipy.spatial.transform import Rotation
from scipy.stats import chi2
from walks import errors, simulate

from gnio_jax import filtering, geometry
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.propagation import interval
from gnio_jax.filtering.state import CLONE, MOVE, OFFSET, THETA, VELOCITY, covariance
from gnio_jax.filtering.update import displacement_residual, retract

RUNS, INTERVALS, N, CLONES, DT, SIGMA = 64, 600, 10, 10, 0.01, 0.03
NOISE = filtering.NoiseModel(5e-4, 5e-3, 1e-6, 2e-5)
PARTS = {"tilt": [0, 1], "yaw": [2], "velocity": [3, 4, 5], "position": [6, 7, 8], "gyro bias": [9, 10, 11], "accel bias": [12, 13, 14]}


@functools.cache
def monte_carlo(std, jacobians="latest", intervals=INTERVALS, sigma=SIGMA):
    """Errors (r, K, 15), covariances (r, K, 15, 15), NIS (r, K) and the final states of simulated runs from the prior."""
    runs = simulate(1, RUNS, intervals, N, CLONES, DT, NOISE, std, sigma)
    config = filtering.FilterConfig(DT, N, CLONES, measurement_scale=1.0, gate_threshold=1e9, history="core", jacobians=jacobians)
    spread = np.tile(sigma**2 * np.eye(3), (intervals, 1, 1))

    @jax.jit
    @jax.vmap
    def run(rotation, velocity, position, *signals):
        return filtering.run_filter(filtering.initial_state(config, rotation, velocity, position, std=std), *signals, spread, config, NOISE)

    final, history = run(*runs[:6])
    assert (np.asarray(history.healthy) == 1).all()
    return runs, errors(runs, history), np.asarray(history.covariance), np.asarray(history.nis), final


def nees(error, spread):
    """Average over runs, by degree of freedom: 1 for a consistent filter."""
    d = error.shape[-1]
    return (np.einsum("...i,...i", error, np.linalg.solve(spread, error[..., None])[..., 0]) / d).mean(0)


def bounds(freedoms, level=0.95):
    return [chi2.ppf(q, freedoms) / freedoms for q in ((1 - level) / 2, (1 + level) / 2)]


def test_certainty_agrees_with_the_errors():
    """NEES of every part and NIS lie in the 95 % bounds of the average over 64 runs."""
    runs, error, spread, nis, final = monte_carlo(filtering.InitialStd())
    for name, index in PARTS.items():
        found = nees(error[..., index], spread[:, :, index][..., index])
        low, high = bounds(len(index) * RUNS)
        assert low < found[20:].mean() < high, (name, found[20:].mean())  # of single times one in twenty is outside
        assert np.mean((found[20:] > low) & (found[20:] < high)) > 0.75, name
    low, high = bounds(3 * RUNS)
    by_time = nis[:, CLONES:].mean(0) / 3
    assert np.mean((by_time > low) & (by_time < high)) > 0.92
    assert abs(by_time.mean() - 1) < 0.01  # 38,000 innovations, white as they should be

    # where it is relative to the oldest clone: what the window's displacement is about
    whole = np.asarray(jax.vmap(covariance)(final))
    last = np.s_[15 + CLONE * CLONES + 3 : 15 + CLONE * (CLONES + 1)]
    first = np.s_[18:21]
    moved = whole[:, last, last] + whole[:, first, first] - whole[:, last, first] - whole[:, first, last]
    offsets = np.asarray(final.clone_offset)
    wrong = runs.position[:, -1] - runs.position[:, -1 - CLONES] - (offsets[:, -1] - offsets[:, 0])
    low, high = bounds(3 * RUNS)
    assert low < nees(wrong, moved) < high


def test_biases_converge_from_a_wide_prior():
    """From σ(b_g) = 1e-2: horizontal gyro and accelerometer biases to a tenth of their prior σ, in the filter's word and in truth.

    z takes longer where it is the gyro's, since yaw is seen by turning only; the whole run moves in every direction here."""
    prior = filtering.InitialStd(gyro_bias=1e-2, accel_bias=0.1)
    _, error, spread, _, _ = monte_carlo(prior, intervals=900, sigma=0.02)
    sigma = np.sqrt(spread[:, -1].diagonal(axis1=1, axis2=2)).mean(0)
    found = np.sqrt((error[:, -1] ** 2).mean(0))
    for values in (sigma, found):
        gyro, accel = values[9:12] / prior.gyro_bias, values[12:15] / prior.accel_bias
        assert (gyro[:2] < 0.1).all() and (accel < 0.1).all(), (gyro, accel)
        assert gyro[2] < 0.2, gyro
        print(f"\nbias, share of the prior: gyro {gyro.round(3)}, accel {accel.round(3)}")


def test_yaw_is_consistent_only_with_first_estimates():
    """With a wide prior the latest-estimate filter becomes too sure of its yaw; with the first ones it does not."""
    prior = filtering.InitialStd(gyro_bias=1e-2)
    by_yaw = {}
    for jacobians in ("latest", "first"):
        _, error, spread, nis, _ = monte_carlo(prior, jacobians, intervals=900, sigma=0.02)
        by_yaw[jacobians] = nees(error[..., [2]], spread[:, :, [2]][..., [2]])[300:].mean()
        assert abs(nis[:, CLONES:].mean() / 3 - 1) < 0.02
    print(f"\nNEES of yaw, mean over time: {by_yaw}")
    assert bounds(RUNS)[0] < by_yaw["first"] < bounds(RUNS, 0.99)[1]
    assert by_yaw["latest"] > 1.1 * by_yaw["first"] and by_yaw["latest"] > bounds(RUNS)[1]


@pytest.mark.parametrize("jacobians", ["latest", "first"])
def test_measurements_tell_nothing_of_the_yaw(jacobians):
    """With a perfect gyro, no displacement in the body's yaw frame can say where north is, if the start does not either: its
    velocity is as uncertain about z as its yaw."""
    prior = filtering.InitialStd(tilt=0.01, yaw=0.0, velocity=0.5, gyro_bias=0.0, accel_bias=0.05)
    noise = filtering.NoiseModel(0.0, 5e-3, 0.0, 2e-5)
    runs = simulate(3, 1, 120, N, CLONES, DT, noise, prior, 0.05)
    config = filtering.FilterConfig(DT, N, CLONES, measurement_scale=1.0, gate_threshold=1e9, jacobians=jacobians)
    state = filtering.initial_state(config, *[runs[i][0] for i in range(3)], std=prior)
    turning = np.zeros(21)
    turning[2], turning[3:6] = 1.0, np.cross([0.0, 0, 1], state.velocity)
    state = state._replace(core_covariance=state.core_covariance + 0.01 * np.outer(turning, turning))
    _, history = filtering.run_filter(state, runs.gyro[0], runs.accel[0], runs.displacement[0],
                                      np.tile(0.05**2 * np.eye(3), (120, 1, 1)), config, noise)
    left = np.asarray(history.covariance_diagonal)[:, 2] / 0.01
    if jacobians == "first":
        np.testing.assert_allclose(left, 1.0, rtol=1e-6)
    else:
        assert left[-1] < 0.99  # what the latest-estimate filter believes to have learnt


def random_state(config, seed=0):
    rng = np.random.default_rng(seed)
    clones = config.clones_per_window + 1
    rotations = Rotation.from_rotvec(0.8 * rng.normal(size=(clones, 3))).as_matrix()
    velocity, position, gyro_bias, accel_bias = rng.normal(size=(4, 3))
    state = filtering.initial_state(config, rotations[-1], velocity, position, 0.1 * gyro_bias, accel_bias)
    offsets = rng.normal(size=(clones, 3))
    return state._replace(clone_rotation=jnp.asarray(rotations), clone_offset=jnp.asarray(offsets), offset=jnp.asarray(offsets[-1]),
                          move=jnp.asarray(rng.normal(size=3)), step=jnp.int32(clones))


def test_transition_is_the_derivative_of_the_retraction():
    config = filtering.FilterConfig(0.05, 6, 3)
    state = random_state(config)
    rng = np.random.default_rng(1)
    imu = Imu(jnp.asarray(4 * rng.normal(size=(6, 3))), jnp.asarray(8 * rng.normal(size=(6, 3))), None)

    def end(error):
        moved = state._replace(rotation=geometry.exp(error[THETA]) @ state.rotation, velocity=state.velocity + error[VELOCITY],
                               offset=state.offset + error[OFFSET], gyro_bias=state.gyro_bias + error[9:12],
                               accel_bias=state.accel_bias + error[12:15])
        motion = interval(moved, imu, filtering.NoiseModel(), config.dt)
        return jnp.concatenate([geometry.log(motion.rotation @ reference.rotation.T), motion.velocity, motion.offset,
                                moved.gyro_bias, moved.accel_bias])

    reference = quick(lambda: interval(state, imu, filtering.NoiseModel(), config.dt))()
    np.testing.assert_allclose(reference.transition, quick(jax.jacfwd(end))(jnp.zeros(15)), atol=1e-6)


def test_measurement_jacobian_is_the_derivative_of_the_retraction():
    config = filtering.FilterConfig(0.05, 6, 3)
    state = random_state(config, 2)
    newest, oldest = 3, 0

    def predicted(errors):
        core = jnp.zeros(21).at[MOVE].set(errors[-3:])
        moved = retract(state, core, errors[:-3].reshape(-1, CLONE), newest)
        return geometry.yaw_rotation(moved.clone_rotation[oldest]).T @ (moved.offset + moved.move - moved.clone_offset[oldest])

    moved = state.offset + state.move - state.clone_offset[oldest]
    _, jacobian, _ = quick(displacement_residual)(state.clone_rotation[oldest], moved, jnp.zeros(3), moved)
    expected = np.zeros((3, 4 * CLONE + 3))
    expected[:, :6], expected[:, -6:-3], expected[:, -3:] = jacobian[:, :6], jacobian[:, 6:], jacobian[:, 6:]
    np.testing.assert_allclose(expected, quick(jax.jacfwd(predicted))(jnp.zeros(4 * CLONE + 3)), atol=1e-6)
