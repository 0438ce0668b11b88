"""Training through the filter with walks that have waypoints: their error, and the sum with it."""

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

from gnio_jax.config import ThroughFilter
from gnio_jax.data import with_poses
from gnio_jax.filtering import FilterConfig, FilterHistory
from gnio_jax.training import filter_losses, segments
from gnio_jax.training.segments import MotionPath
from tests.support.compiling import literal, quick
from tests.support.surveyor import survey

K, N = 12, 4
"""Clone intervals, and samples of each."""

error_and_slope = literal(jax.value_and_grad(filter_losses.waypoint_error))


def tapped_path(rows=(3, 17, 30, 41)):
    """A path at the ends of its intervals, waypoints that are near it in another frame, and the
    path's own places at them."""
    rng = np.random.default_rng(0)
    position = np.cumsum(rng.normal([0.5, 0.2, 0.1], 0.4, (K + 1, 3)), axis=0)
    at = np.array([np.interp(rows, N * np.arange(K + 1), x) for x in position[:, :2].T]).T
    angle = rng.uniform(-3, 3)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    waypoint = np.full((K * N, 2), np.nan)
    waypoint[list(rows)] = 1.3 * at @ turn.T + rng.normal(0, 0.8, (len(rows), 2)) + [40.0, -70.0]
    return position, waypoint, at


def slowly(at, places):
    """The error with the best turn and shift as an optimiser finds them, and plain NumPy."""

    def off(motion):
        angle, *shift = motion
        c, s = np.cos(angle), np.sin(angle)
        return at @ np.array([[c, s], [-s, c]]) + shift - places

    def squares(motion):
        return np.sum(off(motion) ** 2)

    starts = [(a, *(places.mean(0) - at.mean(0))) for a in np.linspace(-3, 3, 7)]
    best = min((minimize(squares, x, tol=1e-14) for x in starts), key=lambda fit: fit.fun)
    squared = np.sum(off(best.x) ** 2, axis=1)
    counted = 1.5**2 * np.log(1 + squared / 1.5**2)
    return counted.mean() / (np.sum(places.var(axis=0)) + 1.0)


def test_the_error_at_the_waypoints():
    position, waypoint, at = tapped_path()
    value, slope = error_and_slope(position, waypoint)
    present = np.isfinite(waypoint).all(axis=1)
    np.testing.assert_allclose(value, slowly(at, waypoint[present]), rtol=1e-6)
    # By finite differences along a direction; the height and what no waypoint touches do not count.
    direction = np.random.default_rng(0).standard_normal(position.shape)
    ends = [error_and_slope(position + h * direction, waypoint)[0] for h in (-1e-5, 1e-5)]
    np.testing.assert_allclose(np.sum(slope * direction), (ends[1] - ends[0]) / 2e-5, rtol=1e-5)
    assert not slope[:, 2].any() and not np.asarray(slope)[[2, 3, 6, 9, 12]].any()


def test_a_turned_and_shifted_path_is_right_and_one_that_never_moves_is_not():
    position, waypoint, at = tapped_path()
    present = np.isfinite(waypoint).all(axis=1)
    right = waypoint.copy()
    right[present] = at @ np.array([[0.0, 1.0], [-1.0, 0.0]]) + [5.0, 9.0]
    assert error_and_slope(position, right)[0] < 1e-25
    still, slope = error_and_slope(np.zeros_like(position), waypoint)
    squares = np.sum((waypoint[present] - waypoint[present].mean(axis=0)) ** 2, axis=1)
    counted = 1.5**2 * np.log(1 + squares / 1.5**2)
    np.testing.assert_allclose(still, counted.mean() / (squares.mean() + 1), rtol=1e-12)
    assert np.isfinite(slope).all()


def test_one_tap_far_from_its_place_counts_little():
    position, waypoint, at = tapped_path(rows=tuple(range(1, 47, 5)))
    present = np.isfinite(waypoint).all(axis=1)
    waypoint[present] = at
    waypoint[6] += 100.0
    value, slope = error_and_slope(position, waypoint)
    spread = np.sum(waypoint[present].var(axis=0)) + 1
    assert value * spread < 100 and np.abs(slope).max() * spread < 1.5


def test_few_waypoints_and_those_in_a_line_or_in_one_place_have_a_gradient():
    position = np.zeros((K + 1, 3))
    position[:, 0] = np.arange(K + 1)
    for rows in ((), (5,), (5, 6), (2, 20, 44)):
        for step in (0.0, 2.0):
            waypoint = np.full((K * N, 2), np.nan)
            waypoint[list(rows)] = step * np.arange(len(rows))[:, None]
            value, slope = error_and_slope(position, waypoint)
            assert np.isfinite(slope).all()
            if len(rows) < 2:
                assert value == 0 and not slope.any()
            elif step:
                assert value > 0 and slope[:, :2].any()


def test_segments_have_the_waypoints_of_their_walk_and_turn_with_it():
    walk = with_poses(survey(0).tapped(np.zeros(9)))
    posed = survey(1).truth
    source = segments.join_segments(
        [segments.segment_source([sequence], 100) for sequence in (walk, posed)]
    )
    assert source.tapped.sum() == len(walk.time) and source.tapped[0] and not source.tapped[-1]
    rows = np.flatnonzero(np.isfinite(source.waypoint).all(axis=1))
    np.testing.assert_allclose(rows / 50, walk.waypoints.time, atol=0.011)
    source = jax.tree.map(jnp.asarray, source)
    np.testing.assert_array_equal(source.waypoint[rows], walk.waypoints.position)
    start = int(rows[1]) - 40
    segment = segments.cut_segment(source, jnp.int32(start), 20, 5)
    assert segment.tapped and np.flatnonzero(np.isfinite(segment.waypoint[:, 0])).tolist() == [40]
    turned = segments.turn_segment(segment, jnp.float64(np.pi / 2))
    x, y = walk.waypoints.position[1]
    np.testing.assert_allclose(turned.waypoint[40], [-y, x], atol=1e-12)


def test_of_a_walk_with_waypoints_the_sum_has_these_in_the_place_of_poses():
    rng = np.random.default_rng(3)
    position, waypoint, _ = tapped_path()
    rotation = np.tile(np.eye(3), (K + 1, 1, 1))
    path = MotionPath(rotation, np.zeros((K + 1, 3)), position)
    nothing = {name: None for name in FilterHistory._fields}
    history = FilterHistory(**nothing)._replace(
        covariance=np.tile(np.eye(15), (K, 1, 1)),
        log_likelihood=rng.standard_normal(K),
        displacement=rng.standard_normal((K, 3)),
        nis=np.full(K, 3.0),
        healthy=np.ones(K),
    )
    settings = FilterConfig(0.05, N, 5, history="core"), ThroughFilter(innovation_weight=0.5)
    losses = quick(filter_losses.filter_losses, static_argnums=(3, 4))
    signals = np.zeros((K * N, 3)), np.zeros((K * N, 3))

    def losses_of(tapped, interpolated):
        truth = path._replace(position=path.position + interpolated)
        segment = segments.Segment(*signals, truth, waypoint, jnp.bool_(tapped))
        return losses(path, segment, history, *settings)

    interpolated = rng.standard_normal((K + 1, 3))
    one, other = losses_of(True, 0.0), losses_of(True, interpolated)
    expected = 100 * one.waypoints - 0.5 * history.log_likelihood.mean()
    np.testing.assert_allclose(one.total, expected, rtol=1e-12)
    assert one.total == other.total and other.displacement.max() > one.displacement.max()
    assert losses_of(False, interpolated).total != other.total
