"""The filter gains no yaw that nobody measured: Monte Carlo from a wide yaw and a wide velocity,
behind holes, with fixes and smoothed, and what a turn of the world leaves as it is."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from gnio_jax.filtering.gaps import Imu
from gnio_jax.filtering.state import (
    arc_covariance,
    core_covariance,
    invariant_errors,
    unroll_clones,
)
from gnio_jax.filtering.update import Step
from tests.support import manifold
from tests.support.compiling import optimised, quick
from tests.support.walks import errors, simulate
from tests.support.whole_covariance import covariance

RUNS, N, CLONES, DT, SIGMA = 100, 5, 10, 0.02, 0.05
NOISE = filtering.NoiseModel(5e-4, 5e-3, 1e-6, 2e-5, measurement_scale=1.0)
WIDE = filtering.InitialStd(velocity=1.0, yaw=0.1)
YAW, PLACE, SPEED = [2], [6, 7], [3, 4]


def config_of(error):
    return filtering.FilterConfig(DT, N, CLONES, gate_threshold=1e9, history="core", error=error)


def monte_carlo(error, std, intervals=120, hole=0, fix_every=0, fix_std=1.0, smoothed=False):
    """Errors (r, K, 15) and covariances (r, K, 15, 15) of simulated runs whose start is as the
    filter assumes it. `hole` samples are missing after 10 s; a fix comes every `fix_every`
    intervals."""
    config = config_of(error)
    walks = simulate(1, RUNS, intervals, N, CLONES, DT, NOISE, std, SIGMA)
    valid = np.ones(intervals * N, bool)
    valid[500 : 500 + hole] = False
    displacement = walks.displacement.copy()
    if hole:
        # A window in which the filter coasted is no measurement.
        first = (500 + max(hole, 1)) // N
        displacement[:, 100 : first + CLONES + 1] = np.nan
    position = np.full((RUNS, intervals, 3), np.nan)
    if fix_every:
        rows = np.arange(fix_every - 1, intervals, fix_every)
        white = np.random.default_rng(5).normal(size=(RUNS, len(rows), 3))
        position[:, rows] = walks.position[:, rows] + fix_std * white
    fix = filtering.Fix(
        position,
        np.broadcast_to(fix_std**2 * np.eye(3), (RUNS, intervals, 3, 3)),
        *np.zeros((2, RUNS, intervals)),
        np.full((RUNS, intervals), np.inf),
    )

    def run(rotation, velocity, position, gyro, accel, displacement, fix):
        ekf = filtering.Filter(config, NOISE, std)
        state = filtering.initial_state(ekf, rotation, velocity, position)
        spread = jnp.tile(SIGMA**2 * jnp.eye(3)[None], (intervals, 1, 1))
        signals = ekf, state, gyro, accel, displacement, spread, jnp.asarray(valid)
        if smoothed:
            return filtering.smooth(*signals, measurements=(fix,))
        return filtering.run_filter(*signals, measurements=(fix,))[1]

    history = optimised(jax.vmap(run))(*walks[:5], displacement, fix)
    return errors(walks, history), np.asarray(history.covariance)


def nees(result, index, row):
    """The mean over the runs, by degree of freedom."""
    error, spread = result[0][:, row][:, index], result[1][:, row][:, index][:, :, index]
    solved = np.linalg.solve(spread, error[..., None])[..., 0]
    return np.mean(np.sum(error * solved, axis=1)) / len(index)


@functools.cache
def wide(error):
    return monte_carlo(error, WIDE)


def test_a_wide_start_stays_as_uncertain_as_it_is():
    """The mean over 100 runs of the squared error of one yaw has a standard deviation of 0.14."""
    result = wide("invariant")
    assert 0.6 < nees(result, YAW, -1) < 1.4
    assert nees(result, PLACE, -1) < 1.6 and nees(result, SPEED, -1) < 1.6
    sigma = np.sqrt(result[1][:, -1, 2, 2]).mean()
    assert 0.9 < sigma / np.sqrt((result[0][:, -1, 2] ** 2).mean()) < 1.1
    additive = wide("additive")
    assert nees(additive, YAW, -1) > 5 and nees(additive, PLACE, -1) > 5


@pytest.mark.slow
@pytest.mark.parametrize("hole, worst_place", [(10, 0.5), (25, 0.5), (45, 0.5)])
def test_behind_a_hole_the_yaw_stays_uncertain(hole, worst_place):
    std = filtering.InitialStd(velocity=0.3)
    result = monte_carlo("invariant", std, 240, hole)
    assert nees(result, YAW, -1) < 1.2
    assert nees(result, PLACE, -1) < worst_place


@pytest.mark.slow
def test_fixes_show_the_yaw_and_no_more_than_they_show():
    std = filtering.InitialStd(velocity=1.0, yaw=0.5, position=10.0)
    result = monte_carlo("invariant", std, fix_every=10)
    for row in (19, 59, 119):
        assert nees(result, YAW, row) < 2.2, row
        assert nees(result, PLACE, row) < 1.6, row
    assert nees(monte_carlo("additive", std, fix_every=10), YAW, -1) > 50
    smoothed = monte_carlo("invariant", std, fix_every=10, smoothed=True)
    for row in (19, 59, 119):
        assert nees(smoothed, YAW, row) < 1.5, row
        assert nees(smoothed, PLACE, row) < 1.6, row


@pytest.mark.slow
def test_fixes_alone_show_a_narrow_yaw_as_the_exact_posterior_does_and_a_wide_one_less():
    """The posterior is that of filters with a known yaw, each for one value of a grid, with the
    likelihood of their fixes. The wide start is the limit that docs/filter.md states."""
    runs, intervals, fix_std, rows = 40, 120, 0.3, np.arange(9, 120, 10)
    open_gate = np.full((runs, intervals), np.inf)
    nothing = jnp.full((intervals, 3), jnp.nan), jnp.tile(jnp.eye(3)[None], (intervals, 1, 1))

    @functools.partial(jax.jit, static_argnames="error")
    def run(error, yaw, rotation, velocity, position, gyro, accel, fix):
        std = filtering.InitialStd(velocity=1.0, yaw=yaw, position=10.0)

        def one(rotation, velocity, position, gyro, accel, fix):
            ekf = filtering.Filter(config_of(error), NOISE, std)
            state = filtering.initial_state(ekf, rotation, velocity, position)
            signals = ekf, state, gyro, accel, *nothing
            return filtering.run_filter(*signals, measurements=(fix,))[1]

        return jax.vmap(one)(rotation, velocity, position, gyro, accel, fix)

    for yaw, least, most in ((0.1, 0.85, 1.1), (0.5, 0.4, 0.8)):
        std = filtering.InitialStd(velocity=1.0, yaw=yaw, position=10.0)
        walks = simulate(1, runs, intervals, N, CLONES, DT, NOISE, std, SIGMA)
        position = np.full((runs, intervals, 3), np.nan)
        white = np.random.default_rng(5).normal(size=(runs, len(rows), 3))
        position[:, rows] = walks.position[:, rows] + fix_std * white
        spread = np.broadcast_to(fix_std**2 * np.eye(3), (runs, intervals, 3, 3))
        fix = filtering.Fix(position, spread, *np.zeros((2, runs, intervals)), open_gate)
        history = run("invariant", yaw, *walks[:5], fix)
        grid, weights = np.linspace(-3, 3, 25) * yaw, []
        for turn in grid:
            rotation = Rotation.from_euler("z", turn).as_matrix() @ walks.rotation0
            outcome = run("additive", 1e-4, rotation, *walks[1:5], fix).outcomes["fix"]
            fits = jnp.where(outcome.present, -0.5 * outcome.nis - jnp.log(outcome.volume), 0.0)
            weights.append(np.asarray(fits.sum(axis=1)) - 0.5 * (turn / yaw) ** 2)
        weights = np.exp(weights - np.max(weights, axis=0))
        weights /= weights.sum(axis=0)
        mean = weights.T @ grid
        variance = np.mean(weights.T @ grid**2 - mean**2)
        reported = np.asarray(history.covariance)[:, -1, 2, 2].mean()
        assert least < np.sqrt(reported / variance) < most, yaw


@pytest.mark.slow
def test_the_smoother_is_as_uncertain_as_it_may_be():
    result = monte_carlo("invariant", WIDE, smoothed=True)
    for row in (20, 60, 119):
        assert 0.6 < nees(result, YAW, row) < 1.4, row
        assert nees(result, PLACE, row) < 1.6, row


def test_the_smoother_turns_back_through_displacements_and_fixes():
    std = filtering.InitialStd(velocity=1.0, yaw=0.2, position=10.0)
    result = monte_carlo("invariant", std, 60, fix_every=10, fix_std=0.3, smoothed=True)
    for row in (9, 20, 40, 59):
        assert 0.6 < nees(result, YAW, row) < 1.4, row
        assert 0.6 < nees(result, PLACE, row) < 1.4, row


def test_the_arc_is_the_second_moment_of_what_a_turn_moves_beyond_the_first_order():
    """By quadrature over a normal error of the yaw, with levers of velocity and position."""
    sigma, levers = 0.02, np.array([[1.5, -0.4, 0.7], [-30.0, 12.0, 2.0]])
    ahead = np.cross([0.0, 0.0, 1.0], levers)  # e_z × l
    entries = np.zeros(15)
    entries[2], entries[3:9] = 1.0, ahead.ravel()
    arc = np.asarray(arc_covariance(jnp.asarray(sigma**2 * np.outer(entries, entries))))
    nodes, weights = np.polynomial.hermite_e.hermegauss(20)
    turns = Rotation.from_rotvec(np.outer(sigma * nodes, [0.0, 0.0, 1.0]))
    remainder = np.concatenate(
        [
            turns.apply(lever) - lever - np.outer(sigma * nodes, step)
            for lever, step in zip(levers, ahead, strict=True)
        ],
        axis=1,
    )
    expected = np.einsum("k,ki,kj->ij", weights / weights.sum(), remainder, remainder)
    scale = np.sqrt(np.diag(expected)).max()
    np.testing.assert_allclose(arc[3:9, 3:9], expected, atol=1e-2 * scale**2)
    np.testing.assert_allclose(arc[3:5, 3:5], expected[:2, :2], rtol=1e-2)
    np.testing.assert_allclose(arc[3:5, 6:8], expected[:2, 3:5], rtol=1e-2)
    assert not np.delete(arc, np.s_[3:9], axis=0).any()


def test_smoothed_states_of_a_large_turn_are_of_one_motion():
    """Without noise of the IMU they are those that the IMU makes of the first, although a fix at
    the end turns all of them by a large angle."""
    intervals, tiny, rng = 12, 1e-9, np.random.default_rng(8)
    gyro, accel = rng.normal(size=(intervals * N, 3)), np.empty((intervals * N, 3))
    first = attitude = Rotation.from_euler("xyz", [0.2, -0.3, 0.5])
    for k, rate in enumerate(gyro):
        accel[k] = attitude.inv().apply([12.0, 3.0, 9.81])
        attitude = attitude * Rotation.from_rotvec(rate * DT)
    pose = first.as_matrix(), np.array([1.0, 0.0, 0.0]), np.zeros(3)
    end = manifold.integrate((*pose, np.zeros(3), np.zeros(3)), gyro, accel, DT)
    position = np.full((intervals, 3), np.nan)
    position[-1] = Rotation.from_euler("z", 0.5).apply(end[2])
    spread = np.tile(1e-6 * np.eye(3), (intervals, 1, 1))
    open_gate = np.full(intervals, np.inf)
    fix = filtering.Fix(position, spread, *np.zeros((2, intervals)), open_gate)

    @quick
    def smoothed(gyro, accel, fix):
        std = filtering.InitialStd(tiny, 0.4, tiny, tiny, tiny, tiny)
        noise = filtering.NoiseModel(tiny, tiny, tiny, tiny)
        ekf = filtering.Filter(config_of("invariant"), noise, std)
        state = filtering.initial_state(ekf, *pose)
        signals = ekf, state, gyro, accel, np.full((intervals, 3), np.nan), spread
        return filtering.smooth(*signals, measurements=(fix,))

    poses = [np.asarray(part) for part in smoothed(gyro, accel, fix)[:5]]
    turn = poses[0][-1] @ end[0].T
    assert 0.3 < np.arctan2(turn[1, 0], turn[0, 0]) < 0.6
    for k in range(intervals - 1):
        rows = slice((k + 1) * N, (k + 2) * N)
        moved = manifold.integrate([part[k] for part in poses], gyro[rows], accel[rows], DT)
        error = manifold.minus(moved, [part[k + 1] for part in poses])
        np.testing.assert_allclose(error, 0.0, atol=1e-8, err_msg=str(k))


@functools.cache
def one_walk():
    return simulate(3, 1, 40, N, CLONES, DT, NOISE, filtering.InitialStd(yaw=0.4), SIGMA)


def run_pieces(error, pieces, turn=0.0):
    """The final state of one walk, filtered piece by piece, in a world that is turned about z."""
    walk, config = one_walk(), config_of(error)
    c, s = np.cos(turn), np.sin(turn)
    world = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    std = filtering.InitialStd(velocity=1.0, yaw=0.4, tilt=0.05)
    pose = world @ walk.rotation0[0], world @ walk.velocity0[0], world @ walk.position0[0]
    state = filtering.initial_state(filtering.Filter(config, start=std), *pose)
    spread = np.tile(SIGMA**2 * np.eye(3), (40, 1, 1))
    begin = 0
    for end in pieces:
        rows, samples = slice(begin, end), slice(begin * N, end * N)
        signals = walk.gyro[0, samples], walk.accel[0, samples]
        state, _ = program(config)(state, *signals, walk.displacement[0, rows], spread[rows])
        begin = end
    return state


@functools.cache
def program(config):
    return quick(
        lambda state, *signals: filtering.run_filter(
            filtering.Filter(config, NOISE), state, *signals, frame="own"
        )
    )


def test_a_run_in_pieces_is_the_run():
    """Wherever it is cut: the offsets then have another anchor, and the errors another point to
    which they refer."""
    whole = run_pieces("invariant", [40])
    for pieces in ([13, 40], [20, 40], [3, 24, 40]):
        state = run_pieces("invariant", pieces)
        for name in ("rotation", "velocity", "position", "gyro_bias", "clone_rotation"):
            np.testing.assert_allclose(
                getattr(state, name), getattr(whole, name), atol=1e-10, err_msg=name
            )
        np.testing.assert_allclose(covariance(state), covariance(whole), atol=1e-9)


def test_a_turned_world_turns_the_estimate():
    turn = 2.0
    c, s = np.cos(turn), np.sin(turn)
    world = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    state, turned = run_pieces("invariant", [40]), run_pieces("invariant", [40], turn)
    np.testing.assert_allclose(turned.rotation, world @ state.rotation, atol=1e-10)
    np.testing.assert_allclose(turned.position, world @ state.position, atol=1e-9)
    np.testing.assert_allclose(turned.velocity, world @ state.velocity, atol=1e-9)


@quick
def updated(state, residual, spread):
    """A run's state before and after an update with a position in the world, or with the velocity
    in the body, both with additive errors again."""
    config = config_of("invariant")
    step = Step(Imu(np.zeros((1, 3)), np.zeros((1, 3)), None), CLONES, 0, config, NOISE)
    inside, eye, results = invariant_errors(state, config), np.eye(3), []
    for jacobian, frame in (
        ({"position": eye}, "world"),
        ({"velocity": eye, "since_oldest": 0.5 * eye}, "carrier"),
    ):
        linear = filtering.linearise(inside, residual, spread, **jacobian)
        after, _, _ = filtering.measure(inside, linear, step, frame=frame)
        results.append(unroll_clones(after, 0))
    return results


def dense_update(state, rows, residual, spread, world):
    """The same in the whole error θ, v, p, b_g, b_a | θ_i, p_i, with the exponential of SE(3) by
    SciPy: mean (rotation, velocity, position, positions of the clones) and covariance."""
    whole = np.asarray(covariance(state))
    clones = np.asarray(state.anchor) + np.asarray(state.clone_offset)
    parts = [(0, 3), (0, 6), *((15 + 6 * i, 18 + 6 * i) for i in range(len(clones)))]
    values = np.stack([state.velocity, state.position, *clones])

    def motion(theta, change):
        block = np.zeros((4, 4))
        block[:3, :3], block[:3, 3] = np.cross(np.eye(3), theta), change
        return expm(block)[:3]

    def moved(error):
        """The values after an error, and G at them: −hat of each move."""
        pairs = [(error[i : i + 3], error[j : j + 3]) for i, j in parts]
        new = np.stack([x + motion(*pair)[:, 3] for x, pair in zip(values, pairs, strict=True)])
        reset = np.eye(len(whole))
        for (theta, part), move in zip(parts, new - values, strict=True):
            reset[part : part + 3, theta : theta + 3] = -np.cross(np.eye(3), move)
        return new, reset

    def gain_of(whole):
        return np.linalg.solve(rows @ whole @ rows.T + spread, rows @ whole).T

    error = gain_of(whole) @ residual
    if world:  # again, where the covariance is that at the new values
        new, reset = moved(error)
        turned = reset @ whole @ reset.T
        change = np.zeros(len(whole))
        for (_, part), move in zip(parts, new - values, strict=True):
            change[part : part + 3] = move
        change[:3] = error[:3]
        gain = gain_of(turned)
        back = np.linalg.inv(reset)
        error = back @ gain @ (residual + rows @ (reset @ error - change))
        whole = back @ (turned - gain @ rows @ turned) @ back.T
    else:
        whole = whole - gain_of(whole) @ rows @ whole
    new, reset = moved(error)
    rotation = motion(error[:3], np.zeros(3))[:, :3] @ np.asarray(state.rotation)
    return rotation, new, reset @ whole @ reset.T


def test_an_update_is_that_of_the_group():
    """By large corrections, of which the second order is seen: a position in the world, which is
    taken a second time at the new estimate, and a quantity that turns with the carrier."""
    state = run_pieces("invariant", [24])
    size = len(covariance(state))
    position, carrier = np.zeros((3, size)), np.zeros((3, size))
    position[:, 6:9] = carrier[:, 3:6] = np.eye(3)
    carrier[:, 6:9], carrier[:, 18:21] = 0.5 * np.eye(3), -0.5 * np.eye(3)
    residual, spread = np.array([0.8, -0.6, 0.2]), 0.01 * np.eye(3)
    results = updated(state, residual, spread)
    for rows, world, after in zip((position, carrier), (True, False), results, strict=True):
        rotation, (velocity, dense_position, *clones), whole = dense_update(
            state, rows, residual, spread, world
        )
        np.testing.assert_allclose(after.rotation, rotation, atol=1e-10)
        np.testing.assert_allclose(after.velocity, velocity, atol=1e-10)
        np.testing.assert_allclose(after.position, dense_position, atol=1e-10)
        offsets = np.asarray(after.anchor) + np.asarray(after.clone_offset)
        np.testing.assert_allclose(offsets, clones, atol=1e-10)
        np.testing.assert_allclose(covariance(after), whole, atol=1e-9)


@quick
def updated_twice(state, residual, spread):
    """A run's state after two updates in one interval, for several second ones: with errors of one
    form throughout, and with errors that are expressed at the new estimate in between."""
    config = config_of("invariant")
    step = Step(Imu(np.zeros((1, 3)), np.zeros((1, 3)), None), CLONES, 0, config, NOISE)
    eye, pairs = np.eye(3), []
    inside = invariant_errors(state, config)
    linear = filtering.linearise(inside, residual, spread, since_oldest=eye, oldest_rotation=eye)
    first, _, _ = filtering.measure(inside, linear, step)
    anew = invariant_errors(unroll_clones(first, 0), config)
    for frame in ("carrier", "world"):
        for jacobian in (
            {"position": eye, "velocity": -0.3 * eye},
            {"velocity": eye, "rotation": 0.2 * eye},
            {"since_oldest": eye, "oldest_rotation": 0.5 * eye},
        ):
            pair = []
            for before in (first, anew):
                linear = filtering.linearise(before, -0.5 * residual, spread, **jacobian)
                after, _, _ = filtering.measure(before, linear, step, frame=frame)
                pair.append(unroll_clones(after, 0))
            pairs.append(pair)
    return first, pairs


def test_a_second_update_knows_what_the_first_has_moved():
    state = run_pieces("invariant", [24])
    first, pairs = updated_twice(state, np.array([0.8, -0.6, 0.2]), 0.01 * np.eye(3))
    assert np.abs(first.shift.position).max() > 0.1 and np.abs(first.shift.velocity).max() > 0.1
    assert np.abs(first.clone_shift[0]).max() > 0.05
    for after, expected in pairs:
        for name in ("rotation", "velocity", "position", "clone_rotation", "gyro_bias"):
            np.testing.assert_allclose(
                getattr(after, name), getattr(expected, name), atol=1e-10, err_msg=name
            )
        places, expected_places = (
            np.asarray(end.anchor) + np.asarray(end.clone_offset) for end in (after, expected)
        )
        np.testing.assert_allclose(places, expected_places, atol=1e-10)
        np.testing.assert_allclose(covariance(after), covariance(expected), atol=1e-10)
        assert np.abs(covariance(after) - covariance(unroll_clones(first, 0))).max() > 1e-4


@quick
def outcomes_of(state, residual, spread):
    """Outcomes of one measurement of velocity and position by its frame, and the covariance that
    the filter reports before it."""
    config = config_of("invariant")
    step = Step(Imu(np.zeros((1, 3)), np.zeros((1, 3)), None), CLONES, 0, config, NOISE)
    inside, eye, outcomes = invariant_errors(state, config), np.eye(3), {}
    blocks = {"since_oldest": eye, "oldest_rotation": eye}
    moving = filtering.linearise(inside, residual, spread, **blocks)
    inside, _, _ = filtering.measure(inside, moving, step)
    linear = filtering.linearise(inside, residual, spread, velocity=-0.4 * eye, position=eye)
    for frame in ("carrier", "world"):
        outcomes[frame] = filtering.measure(inside, linear, step, frame=frame)[1]
    return outcomes, core_covariance(inside, config)


def test_a_measurement_in_the_world_is_tested_against_the_reported_covariance():
    """Which has the arc of the yaw. A quantity of the carrier turns with it and has none."""
    state = run_pieces("invariant", [24])
    residual, spread = np.array([0.8, -0.6, 0.2]), 0.01 * np.eye(3)
    outcomes, reported = jax.device_get(outcomes_of(state, residual, spread))
    rows = np.zeros((3, 15))
    rows[:, 3:6], rows[:, 6:9] = -0.4 * np.eye(3), np.eye(3)
    whole = rows @ reported @ rows.T + spread
    nis, volume = residual @ np.linalg.solve(whole, residual), np.sqrt(np.linalg.det(whole))
    assert outcomes["world"].nis == pytest.approx(nis, rel=1e-9)
    assert outcomes["world"].volume == pytest.approx(volume, rel=1e-9)
    assert outcomes["carrier"].nis > 1.001 * nis


@quick
def walked_straight(position):
    """Where a walk of 16 m and later, from rest and straight ahead by the filter's first yaw, ends
    with these fixes, 1 m each and each tested: positions, rotations, and whether they were
    taken."""
    intervals = len(position)
    std = filtering.InitialStd(1e-4, 0.5, 0.01, 0.1, accel_bias=1e-3)
    noise = filtering.NoiseModel(1e-4, 1e-3, 1e-6, 1e-5)
    ekf = filtering.Filter(config_of("invariant"), noise, std)
    state = filtering.initial_state(ekf, np.eye(3), np.zeros(3), np.zeros(3))
    accel = np.tile([0.0, 0.0, 9.81], (intervals * N, 1))
    accel[:100, 0] = 1.0  # for 2 s
    spread = np.tile(np.eye(2), (intervals, 1, 1))
    threshold = np.full(intervals, 9.21)
    fix = filtering.Fix(position, spread, *np.zeros((2, intervals)), threshold)
    nothing = np.full((intervals, 3), np.nan), np.tile(np.eye(3), (intervals, 1, 1))
    signals = np.zeros_like(accel), accel, *nothing
    _, history = filtering.run_filter(ekf, state, *signals, measurements=(fix,))
    return history.position, history.rotation, history.outcomes["fix"].accepted


@pytest.mark.parametrize("yaw, acceptance", [(0.8, True), (3.0, False)])
def test_a_fix_on_the_arc_of_an_uncertain_yaw_is_taken(yaw, acceptance):
    """With a standard deviation of 0.5 rad, one at 0.8 rad lies 5 m beside the tangent of the arc,
    five times its own standard deviation. One in the opposite direction is refused."""
    rows, position = np.arange(79, 100, 5), np.full((100, 2), np.nan)
    distance = 2.0 + 2.0 * ((rows + 1) * N * DT - 2.0)
    position[rows] = distance[:, None] * [np.cos(yaw), np.sin(yaw)]
    places, rotations, accepted = walked_straight(position)
    assert (np.asarray(accepted)[rows] == acceptance).all()
    if acceptance:
        np.testing.assert_allclose(places[-1, :2], position[-1], atol=0.2)
        turned = np.arctan2(rotations[-1, 1, 0], rotations[-1, 0, 0])
        assert turned == pytest.approx(yaw, abs=0.02)
