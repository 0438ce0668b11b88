"""The filter is consistent (NEES, NIS): Monte Carlo with noises as it assumes them, correlated
errors among them; and by autodiff the Jacobian of a measurement in its own frame."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from gnio_jax import filtering, geometry
from gnio_jax.filtering.displacement import Displacement, linearise_displacement
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.state import CLONE
from gnio_jax.filtering.update import Step
from gnio_jax.windows import cut_window
from tests.support.compiling import optimised, quick
from tests.support.walks import errors, simulate, with_correlated_errors
from tests.support.whole_covariance import covariance

RUNS, INTERVALS, N, CLONES, DT = 64, 600, 10, 10, 0.01
NOISE = filtering.NoiseModel(5e-4, 5e-3, 1e-6, 2e-5, measurement_scale=1.0)
CONFIG = filtering.FilterConfig(DT, N, CLONES, gate_threshold=1e9, history="core")
ERRORS = filtering.CorrelatedError(0.9, 0.5)
STD = filtering.InitialStd(gyro_bias=1e-2, accel_bias=0.1)
"""Wide, so that much is to be found."""
SIGMA = 0.03
PARTS = {
    "tilt": [0, 1],
    "yaw": [2],
    "velocity": [3, 4, 5],
    "position": [6, 7, 8],
    "gyro bias": [9, 10, 11],
    "accel bias": [12, 13, 14],
}


@functools.cache
def program():
    """(correlated error, covariance of a measurement, start and signals of each run) -> final
    states and histories. A correlated error without size changes nothing (`test_scan`)."""

    def run(correlation, spread, rotation, velocity, position, gyro, accel, displacement):
        start = filtering.initial_state(
            filtering.Filter(CONFIG, start=STD), rotation, velocity, position
        )
        covariance = jnp.tile(spread[None], (len(displacement), 1, 1))
        noise = NOISE._replace(correlation=correlation)
        return filtering.run_filter(
            filtering.Filter(CONFIG, noise), start, gyro, accel, displacement, covariance
        )

    return optimised(jax.vmap(run, in_axes=(None, None, *6 * [0])))


@functools.cache
def walks():
    return simulate(1, RUNS, INTERVALS, N, CLONES, DT, NOISE, STD, SIGMA)


def monte_carlo(runs, sigma, share=0.0):
    """Errors (r, K, 15), covariances (r, K, 15, 15), NIS (r, K) and the final states of simulated
    runs from the prior."""
    final, history = program()(ERRORS._replace(share=share), sigma**2 * np.eye(3), *runs[:6])
    assert (np.asarray(history.healthy) == 1).all()
    return errors(runs, history), np.asarray(history.covariance), np.asarray(history.nis), final


def nees(error, spread):
    """Average over runs, by degree of freedom: 1 for a consistent filter."""
    solved = np.linalg.solve(spread, error[..., None])[..., 0]
    return (np.einsum("...i,...i", error, solved) / error.shape[-1]).mean(0)


def nees_of(error, spread, index):
    return nees(error[..., index], spread[:, :, index][..., index])


def bounds(freedoms, level=0.95):
    return [chi2.ppf(q, freedoms) / freedoms for q in ((1 - level) / 2, (1 + level) / 2)]


def test_certainty_agrees_with_the_errors():
    """NEES of every part and NIS lie in the 95 % bounds of the average over 64 runs, from wide
    priors of the biases, which are found: to a fifth of their prior in a minute."""
    runs = walks()
    error, spread, nis, final = monte_carlo(runs, SIGMA)
    for name, index in PARTS.items():
        nees_by_time = nees_of(error, spread, index)[20:]
        low, high = bounds(len(index) * RUNS)
        assert low < nees_by_time.mean() < high, (name, nees_by_time.mean())
        # Of single times one in twenty is outside, and their errors are those of times nearby.
        assert np.mean((nees_by_time > low) & (nees_by_time < high)) > 0.6, name
    low, high = bounds(3 * RUNS)
    by_time = nis[:, CLONES:].mean(0) / 3
    assert np.mean((by_time > low) & (by_time < high)) > 0.92
    assert abs(by_time.mean() - 1) < 0.012  # 38,000 innovations, white as they should be
    sigma = np.sqrt(spread[:, -1].diagonal(axis1=1, axis2=2)).mean(0)
    for values in (sigma, np.sqrt((error[:, -1] ** 2).mean(0))):
        share = values[9:] / np.repeat([STD.gyro_bias, STD.accel_bias], 3)
        assert (share < 0.2).all(), share

    # where it is relative to the oldest clone: what the window's displacement is about
    whole = np.asarray(jax.vmap(covariance)(final))
    last = np.s_[15 + CLONE * CLONES + 3 : 15 + CLONE * (CLONES + 1)]
    first = np.s_[18:21]
    window_covariance = whole[:, last, last] + whole[:, first, first]
    window_covariance = window_covariance - whole[:, last, first] - whole[:, first, last]
    offsets = np.asarray(final.clone_offset)
    wrong = runs.position[:, -1] - runs.position[:, -1 - CLONES] - (offsets[:, -1] - offsets[:, 0])
    assert low < nees(wrong, window_covariance) < high


CORRELATED_SIGMA = 0.05


@functools.cache
def correlated():
    return with_correlated_errors(walks(), CLONES, CORRELATED_SIGMA, ERRORS, N * DT)


def test_the_filter_is_consistent_with_correlated_errors():
    runs, position = correlated(), PARTS["position"]
    error, spread, nis, _ = monte_carlo(runs, CORRELATED_SIGMA, ERRORS.share)
    assert 0.9 < nis[:, 100:].mean() / 3 < 1.1
    for name, index in PARTS.items():
        assert 0.7 < nees_of(error, spread, index)[100:].mean() < 1.4, name
    white, too_small, _, _ = monte_carlo(runs, CORRELATED_SIGMA)
    assert nees_of(white, too_small, position)[100:].mean() > 4
    squares = [np.mean(e[:, 100:, position] ** 2) for e in (error, white)]
    assert squares[0] < squares[1]


@pytest.mark.slow
def test_the_smoother_is_consistent_with_correlated_errors():
    runs = correlated()
    spread = np.tile(CORRELATED_SIGMA**2 * np.eye(3), (INTERVALS, 1, 1))
    noise = NOISE._replace(correlation=ERRORS)

    @optimised
    @jax.vmap
    def run(rotation, velocity, position, *signals):
        state = filtering.initial_state(
            filtering.Filter(CONFIG, start=STD), rotation, velocity, position
        )
        return filtering.smooth(filtering.Filter(CONFIG, noise), state, *signals, spread)

    smoothed = jax.device_get(run(*(part[:16] for part in runs[:6])))
    error = errors(jax.tree.map(lambda leaf: leaf[:16], runs), smoothed)
    for index in list(PARTS.values())[:4]:
        # The yaw's error hardly changes along a walk: a mean over time is no narrower.
        low, high = bounds(len(index) * 16, 0.999)
        mean_nees = nees_of(error, smoothed.covariance, index)[100:-100].mean()
        assert low < mean_nees < high, index


OWN = filtering.FilterConfig(0.02, 4, 3)


@quick
def told_by_a_network(R, gyro, accel, bias, weights, displacement):
    """What the network predicts, turned into the world, the derivative of its innovation by θ, and
    that of the filter."""

    def network(window):
        up = jnp.mean(window[:, :3], axis=0)
        up = up / jnp.linalg.norm(up)
        axis = jnp.stack([up[1], -up[0], jnp.zeros_like(up[0])])  # up × z
        turn = geometry.hat(axis)
        return (jnp.eye(3) + turn + turn @ turn / (1 + up[2])) @ window[:, :3].T @ weights

    def cut(theta):
        return geometry.exp(-theta) @ R

    def prediction(theta):
        return network(cut_window(cut(theta), gyro, accel, jnp.zeros(3), bias, OWN.cut, OWN.dt))

    def innovation(theta):
        return prediction(theta) - geometry.yaw_rotation(cut(theta)).T @ displacement

    nothing, single = jnp.zeros(3), filtering.FilterConfig(0.01, 1, 1)
    state = filtering.initial_state(filtering.Filter(single), jnp.eye(3), nothing, nothing)
    clones = jnp.stack([R, jnp.eye(3)]), jnp.stack([-displacement, nothing])
    state = state._replace(clone_rotation=clones[0], clone_offset=clones[1])
    step = Step(Imu(np.zeros((1, 3)), np.zeros((1, 3)), None), 1, 0, single, NOISE)
    measured = Displacement(nothing, jnp.eye(3), jnp.bool_(True), "own")
    linear, defined = linearise_displacement(measured, state, step)
    linearisation = linear.jacobian["oldest_rotation"], defined
    return (
        geometry.yaw_rotation(R) @ prediction(nothing),
        jax.jacfwd(innovation)(nothing),
        linearisation,
    )


@pytest.mark.parametrize("angles", [(0.3, 0.9, -2.0), (0.4, np.pi / 2, 1.0)])
def test_own_frame_jacobian_is_that_of_an_equivariant_network(angles):
    """Autodiff through the window as it is cut and a network that turns with it, at any attitude,
    on the nose too. It levels its window by the mean specific force: small tilts change nothing."""
    config = OWN
    rng = np.random.default_rng(4)
    R, n = Rotation.from_euler("xyz", angles).as_matrix(), config.window
    gyro, bias = rng.normal(size=(n, 3)), 0.1 * rng.normal(size=3)
    attitudes = [R]
    for w in gyro[:-1]:
        attitudes.append(attitudes[-1] @ Rotation.from_rotvec(w * config.dt).as_matrix())
    force = rng.normal(size=(n, 3))
    force = force - force.mean(0) + [0, 0, 9.81]  # on average the device does not accelerate
    accel = np.einsum("kji,kj->ki", attitudes, force) + bias
    weights = 0.2 * rng.normal(size=n)
    displacement = weights @ force  # in the world
    prediction, slope, (jacobian, defined) = told_by_a_network(
        R, gyro, accel, bias, weights, displacement
    )
    np.testing.assert_allclose(prediction, displacement, atol=1e-9)
    assert bool(defined)
    np.testing.assert_allclose(jacobian, slope, atol=1e-7)
    assert np.abs(jacobian[:, 2]).max() > 0.5
