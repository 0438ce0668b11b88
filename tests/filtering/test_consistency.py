"""Is the filter as certain as it may be? Monte Carlo with noises as it assumes them, correlated
errors among them, and the Jacobian of the network's own frame by autodiff."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from gnio_jax import filtering, geometry
from gnio_jax.filtering.state import CLONE
from gnio_jax.types import Prediction
from gnio_jax.windows import cut_window
from tests.support.compiling import optimised, quick
from tests.support.measured import displacement_residual
from tests.support.walks import errors, simulate, yaw_matrix
from tests.support.whole_covariance import covariance

RUNS, INTERVALS, N, CLONES, DT = 64, 900, 10, 10, 0.01
NOISE = filtering.NoiseModel(5e-4, 5e-3, 1e-6, 2e-5, measurement_scale=1.0)
PARTS = {
    "tilt": [0, 1],
    "yaw": [2],
    "velocity": [3, 4, 5],
    "position": [6, 7, 8],
    "gyro bias": [9, 10, 11],
    "accel bias": [12, 13, 14],
}


CONFIG = filtering.FilterConfig(DT, N, CLONES, gate_threshold=1e9, history="core")
ERRORS = filtering.CorrelatedError(0.9, 0.5)


@functools.cache
def program():
    """(std, correlated error, covariance of a measurement, start and signals of each run) -> final
    states and histories. A correlated error without size changes nothing (`test_scan`)."""

    def run(std, correlation, spread, rotation, velocity, position, gyro, accel, displacement):
        start = filtering.initial_state(CONFIG, rotation, velocity, position, std=std)
        covariance = jnp.tile(spread[None], (len(displacement), 1, 1))
        noise = NOISE._replace(correlation=correlation)
        return filtering.run_filter(start, gyro, accel, displacement, covariance, CONFIG, noise)

    return optimised(jax.vmap(run, in_axes=(None, None, None, *6 * [0])))


WIDE = filtering.InitialStd(gyro_bias=1e-2, accel_bias=0.1)


@functools.lru_cache(1)
def walks(std, sigma):
    return simulate(1, RUNS, INTERVALS, N, CLONES, DT, NOISE, std, sigma)


def monte_carlo(runs, std, sigma, share=0.0):
    """Errors (r, K, 15), covariances (r, K, 15, 15), NIS (r, K) and the final states of simulated
    runs from the prior."""
    given = std, ERRORS._replace(share=share), sigma**2 * np.eye(3)
    final, history = program()(*given, *runs[:6])
    assert (np.asarray(history.healthy) == 1).all()
    return errors(runs, history), np.asarray(history.covariance), np.asarray(history.nis), final


def nees(error, spread):
    """Average over runs, by degree of freedom: 1 for a consistent filter."""
    d = error.shape[-1]
    return (
        np.einsum("...i,...i", error, np.linalg.solve(spread, error[..., None])[..., 0]) / d
    ).mean(0)


def bounds(freedoms, level=0.95):
    return [chi2.ppf(q, freedoms) / freedoms for q in ((1 - level) / 2, (1 + level) / 2)]


def test_certainty_agrees_with_the_errors():
    """NEES of every part and NIS lie in the 95 % bounds of the average over 64 runs."""
    std = filtering.InitialStd()
    runs = walks(std, 0.03)
    error, spread, nis, final = monte_carlo(runs, std, 0.03)
    for name, index in PARTS.items():
        found = nees(error[..., index], spread[:, :, index][..., index])
        low, high = bounds(len(index) * RUNS)
        assert low < found[20:].mean() < high, (
            name,
            found[20:].mean(),
        )  # of single times one in twenty is outside
        assert np.mean((found[20:] > low) & (found[20:] < high)) > 0.75, name
    low, high = bounds(3 * RUNS)
    by_time = nis[:, CLONES:].mean(0) / 3
    assert np.mean((by_time > low) & (by_time < high)) > 0.92
    assert abs(by_time.mean() - 1) < 0.01  # 57,000 innovations, white as they should be

    # where it is relative to the oldest clone: what the window's displacement is about
    whole = np.asarray(jax.vmap(covariance)(final))
    last = np.s_[15 + CLONE * CLONES + 3 : 15 + CLONE * (CLONES + 1)]
    first = np.s_[18:21]
    moved = (
        whole[:, last, last]
        + whole[:, first, first]
        - whole[:, last, first]
        - whole[:, first, last]
    )
    offsets = np.asarray(final.clone_offset)
    wrong = runs.position[:, -1] - runs.position[:, -1 - CLONES] - (offsets[:, -1] - offsets[:, 0])
    low, high = bounds(3 * RUNS)
    assert low < nees(wrong, moved) < high


def test_biases_converge_from_a_wide_prior():
    """From σ(b_g) = 1e-2: horizontal gyro and accelerometer biases to a tenth of their prior σ, in
    the filter's word and in truth.

    z takes longer where it is the gyro's, since yaw is seen by turning only; the whole run moves in
    every direction here."""
    error, spread, _, _ = monte_carlo(walks(WIDE, 0.02), WIDE, 0.02)
    sigma = np.sqrt(spread[:, -1].diagonal(axis1=1, axis2=2)).mean(0)
    found = np.sqrt((error[:, -1] ** 2).mean(0))
    for values in (sigma, found):
        gyro, accel = values[9:12] / WIDE.gyro_bias, values[12:15] / WIDE.accel_bias
        assert (gyro[:2] < 0.1).all() and (accel < 0.1).all(), (gyro, accel)
        assert gyro[2] < 0.2, gyro
        print(f"\nbias, share of the prior: gyro {gyro.round(3)}, accel {accel.round(3)}")


CORRELATED_SIGMA = 0.05


@functools.cache
def correlated():
    """Walks whose displacements have errors as the model has them, drawn in NumPy."""
    sigma, share, decay = CORRELATED_SIGMA, ERRORS.share, np.exp(-N * DT / ERRORS.seconds)
    runs, rng = walks(filtering.InitialStd(), 0.03), np.random.default_rng(3)
    seen, state = np.full_like(runs.displacement, np.nan), rng.normal(size=(RUNS, 3))
    for k in range(INTERVALS):
        state = decay * state + np.sqrt(1 - decay**2) * rng.normal(size=(RUNS, 3))
        if k >= CLONES:
            moved = runs.position[:, k] - runs.position[:, k - CLONES]
            seen[:, k] = np.einsum("rji,rj->ri", yaw_matrix(runs.rotation[:, k - CLONES]), moved)
        white = np.sqrt(1 - share**2) * rng.normal(size=(RUNS, 3))
        seen[:, k] += sigma * (share * state + white)
    return runs._replace(displacement=seen)


def test_it_is_as_certain_as_it_may_be_with_correlated_errors():
    """Taken for white they make the filter too certain, and worse."""
    runs, std, sigma = correlated(), filtering.InitialStd(), CORRELATED_SIGMA
    error, spread, nis, _ = monte_carlo(runs, std, sigma, ERRORS.share)
    assert 0.9 < nis[:, 100:].mean() / 3 < 1.1
    for name, index in PARTS.items():
        found = nees(error[..., index], spread[:, :, index][..., index])[100:].mean()
        assert 0.7 < found < 1.4, (name, found)
    position = PARTS["position"]
    white, too_small, _, _ = monte_carlo(runs, std, sigma)
    assert nees(white[..., position], too_small[:, :, position][..., position])[100:].mean() > 4
    squares = [np.mean(e[:, -1, position] ** 2) for e in (error, white)]
    assert squares[0] < squares[1]


@pytest.mark.slow
def test_the_smoother_is_consistent_with_correlated_errors():
    runs = correlated()
    spread = np.tile(CORRELATED_SIGMA**2 * np.eye(3), (INTERVALS, 1, 1))
    noise = NOISE._replace(correlation=ERRORS)

    @optimised
    @jax.vmap
    def run(rotation, velocity, position, *signals):
        state = filtering.initial_state(CONFIG, rotation, velocity, position)
        return filtering.smooth(state, *signals, spread, CONFIG, noise)

    smoothed = jax.device_get(run(*(part[:16] for part in runs[:6])))
    error = errors(jax.tree.map(lambda leaf: leaf[:16], runs), smoothed)
    for index in list(PARTS.values())[:4]:
        block = smoothed.covariance[:, :, index][..., index]
        # The yaw's error hardly changes along a walk: a mean over time is no narrower.
        low, high = bounds(len(index) * 16, 0.999)
        assert low < nees(error[..., index], block)[100:-100].mean() < high, index


# The network in the loop --------------------------------------------------------------------------


OWN = filtering.FilterConfig(0.02, 4, 3)


@quick
def told_by_a_network(R, gyro, accel, bias, weights, seen):
    """What the network says, turned into the world, the derivative of its innovation by θ, and
    the filter's."""

    def network(window):
        up = jnp.mean(window[:, :3], axis=0)
        up = up / jnp.linalg.norm(up)
        axis = jnp.stack([up[1], -up[0], jnp.zeros_like(up[0])])  # up × z
        turn = geometry.hat(axis)
        return (jnp.eye(3) + turn + turn @ turn / (1 + up[2])) @ window[:, :3].T @ weights

    def cut(theta):
        return geometry.exp(-theta) @ R

    def said(theta):
        return network(cut_window(cut(theta), gyro, accel, jnp.zeros(3), bias, OWN.cut, OWN.dt))

    def innovation(theta):
        return said(theta) - geometry.yaw_rotation(cut(theta)).T @ seen

    nothing = jnp.zeros(3)
    found = displacement_residual(R, seen, nothing, "own")
    return geometry.yaw_rotation(R) @ said(nothing), jax.jacfwd(innovation)(nothing), found


@pytest.mark.parametrize(
    "angles",
    [
        (0.0, 0.0, 0.0),
        (0.3, 0.9, -2.0),
        (-2.0, -1.4, 3.1),
        (0.4, np.pi / 2, 1.0),
        (0.1, -np.pi / 2, 0.0),
    ],
)
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
    seen = weights @ force  # in the world
    told, slope, found = told_by_a_network(R, gyro, accel, bias, weights, seen)
    np.testing.assert_allclose(told, seen, atol=1e-9)
    assert bool(found.defined)
    np.testing.assert_allclose(found.jacobian[:, :3], slope, atol=1e-7)
    assert np.abs(found.jacobian[:, 2]).max() > 0.5


PITCHES, TIGHT_RUNS, TIGHT_INTERVALS, SIGMA = (0.0, 45.0, 70.0, 84.0, 90.0), 32, 200, 0.03


@functools.cache
def tight():
    """(tables, start, gyro, accel) -> history of `run_odometry`, batched over runs, with a network
    that knows the truth, but for its noise, and tells it in the frame of its window, which it finds
    out from the window alone."""
    length = N * CLONES

    @optimised
    @jax.vmap
    def run(world, norms, displacement, noise, rotation, velocity, position, gyro, accel):
        def predict(windows):
            seen = windows[0, :, :3].astype(jnp.float64)
            size = jnp.linalg.norm(seen, axis=1)  # no rotation changes it: which window is this?
            k = jnp.argmin(jnp.sum((size[None] - norms) ** 2, axis=1))
            truth = jax.lax.dynamic_slice(world, (k * N, 0), (length, 3))
            seen, truth = seen - seen.mean(0)[None], truth - truth.mean(0)[None]
            # seen = turn · truth, and the part of the turn about z is the frame's
            turn = jnp.linalg.solve(truth.T @ truth, truth.T @ seen).T
            angle = jnp.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
            said = geometry.rotation_z(angle) @ displacement[k] + noise[k]
            return Prediction(said[None], jnp.full((1, 3), np.log(SIGMA)))

        state = filtering.initial_state(CONFIG, rotation, velocity, position)
        return filtering.run_odometry(predict, state, gyro, accel, CONFIG, NOISE)[1]

    return run


def tight_runs(pitch):
    runs = simulate(
        7,
        TIGHT_RUNS,
        TIGHT_INTERVALS,
        N,
        CLONES,
        DT,
        NOISE,
        filtering.InitialStd(),
        SIGMA,
        np.radians(pitch),
    )
    # window k ends with interval k + CLONES; its first sample is the first after interval k
    turns = Rotation.from_rotvec((runs.rate * DT).reshape(-1, 3)).as_matrix()
    turns = turns.reshape(*runs.rate.shape, 3)
    attitude, world = runs.attitude0, np.empty_like(runs.accel)
    for j in range(runs.accel.shape[1]):
        world[:, j] = np.einsum("rij,rj->ri", attitude, runs.accel[:, j])
        attitude = attitude @ turns[:, j]
    np.testing.assert_allclose(attitude, runs.rotation[:, -1], atol=1e-9)
    size = np.linalg.norm(runs.accel[:, N:], axis=2)
    windows = range(TIGHT_INTERVALS - CLONES)
    norms = np.stack([size[:, N * k : N * (k + CLONES)] for k in windows], 1)
    moved = runs.position[:, CLONES:] - runs.position[:, :-CLONES]
    noise = SIGMA * np.random.default_rng(8).normal(size=moved.shape)
    history = tight()(world[:, N:], norms, moved, noise, *runs[:5])
    assert (np.asarray(history.healthy) == 1).all()
    assert (np.asarray(history.accepted)[:, CLONES:] == 1).all()
    return errors(runs, history), np.asarray(history.covariance)


@pytest.mark.parametrize("pitch", PITCHES)
def test_attitude_is_consistent_whatever_the_pitch(pitch):
    """NEES(θ)/3 in the 99 % bounds of the average over runs at one time, level or on the nose."""
    error, spread = tight_runs(pitch)
    found = nees(error[..., :3], spread[..., :3, :3])[20:]
    low, high = bounds(3 * TIGHT_RUNS, 0.99)
    tilt = np.degrees(np.sqrt((error[:, 20:, :2] ** 2).sum(-1).mean()))
    print(f"\npitch {pitch:.0f}°: NEES(θ)/3 {found.mean():.2f}, tilt {tilt:.3f}° rms")
    assert low < found.mean() < high
    assert tilt < 0.25
