"""Walks with waypoints in the place of poses, whose whole truth is known."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import (
    Trajectory,
    align,
    folder,
    measure,
    never_moves,
    page,
    plots,
    prepare,
    score,
)
from gnio_jax.evaluation.estimate import in_one_frame
from gnio_jax.evaluation.metrics import OF_FILTER, OF_WAYPOINTS
from gnio_jax.evaluation.trajectory import positions_at
from gnio_jax.evaluation.views import make_view
from gnio_jax.types import Waypoints
from tests.support.estimates import SETTINGS, estimate, reported
from tests.support.estimators import CONFIG, with_waypoints
from tests.support.reports import BASE
from tests.support.trajectories import lost, moved_by, perturbed, walk

TURNED = Rotation.from_euler("z", 2.1)
ROWS = np.array([0, 90, 210, 330, 560, 700, 899])
"""Of a walk of 900, where it is tapped."""


def tapped(truth, rows=ROWS):
    return Waypoints(truth.time[rows], truth.position[rows, :2])


def scaled_estimate(name, seed, scale=1.0):
    """An estimate that is too long or too short, in another frame than the reference."""
    truth = estimate(name, seed)
    path = moved_by(truth.trajectory, TURNED, [5.0, -3.0, 1.0])
    return truth._replace(
        trajectory=path._replace(position=path.position * [scale, scale, 1.0]),
        reference=Trajectory(path.time, path.position * np.nan, path.orientation * np.nan),
        waypoints=tapped(truth.reference, np.arange(0, 400, 57)),
    )


def spread(points):
    return np.sqrt(np.mean(np.sum((points - points.mean(0)) ** 2, 1)))


def least(path, waypoints):
    """The smallest root mean square, by a search over turn and shift."""
    ours = path.position[np.searchsorted(path.time, waypoints.time), :2]

    def cost(motion):
        turn = Rotation.from_euler("z", motion[0]).as_matrix()[:2, :2]
        return np.mean(np.sum((ours @ turn.T + motion[1:] - waypoints.position) ** 2, 1))

    starts = ([angle, 0.0, 0.0] for angle in (-2.0, 0.0, 2.0))
    return math.sqrt(min(minimize(cost, start, tol=1e-12).fun for start in starts))


@pytest.mark.parametrize(
    "rows, tapped_by, moved_by_itself",
    [
        (ROWS, 1.0, 1.0),
        ([100, 101, 102], [1.0, 0.0, 0.0], 1.0),  # collinear
        (ROWS, 0.0, 1.0),  # in one place
        (ROWS, 1.0, 0.0),  # and one who stands still
    ],
)
def test_the_alignment_is_the_best_turn_and_shift(rows, tapped_by, moved_by_itself):
    truth = walk()
    waypoints = tapped(truth._replace(position=truth.position * tapped_by), rows)
    path = moved_by(perturbed(truth), TURNED, [5.0, -3.0, 1.0])
    path = path._replace(position=moved_by_itself * path.position + 4.0)
    aligned = align(path, waypoints)
    error = positions_at(aligned, waypoints.time) - waypoints.position
    rms = math.sqrt(np.mean(np.sum(error**2, 1)))
    assert rms == pytest.approx(least(path, waypoints), abs=1e-6)
    # A rigid motion about z, of the attitudes too.
    ours, theirs = (Rotation.from_quat(p.orientation, scalar_first=True) for p in (aligned, path))
    turn = (ours * theirs.inv()).as_rotvec()
    np.testing.assert_allclose(turn[:, :2], 0.0, atol=1e-9)
    moved = Rotation.from_rotvec(turn[0]).apply(path.position)
    np.testing.assert_allclose(np.diff(aligned.position, axis=0), np.diff(moved, axis=0), atol=1e-9)
    np.testing.assert_allclose(aligned.position[:, 2], path.position[:, 2], atol=1e-12)


def test_positions_lie_between_rows_and_not_beyond_the_ends():
    path = walk()
    begin, end = path.time[[0, -1]]
    positions = positions_at(path, np.array([begin - 0.15, begin + 0.025, end + 0.15, end + 0.3]))
    between = 0.75 * path.position[0, :2] + 0.25 * path.position[1, :2]
    np.testing.assert_allclose(
        positions[:3], [path.position[0, :2], between, path.position[-1, :2]]
    )
    assert np.isnan(positions[3]).all()
    assert np.isnan(positions_at(path, np.array([begin - 0.3]))).all()


def test_a_path_that_is_short_by_a_factor_has_known_errors():
    """Each leg is too short by the factor, whatever the frame."""
    truth = walk()
    lengths = np.linalg.norm(np.diff(truth.position[ROWS, :2], axis=0), axis=1)
    for scale in (0.8, 0.0):
        path = moved_by(truth._replace(position=scale * truth.position), TURNED, [5.0, -3.0, 1.0])
        nowhere = truth._replace(position=truth.position * np.nan)
        measures = measure(path, nowhere, waypoints=tapped(truth))
        expected = {"duration": np.ptp(truth.time), "path_length": lengths.sum(), "legs": 6}
        expected |= {"leg_ratio": scale, "leg_path_ratio": scale}
        expected["leg_error"] = (1 - scale) * np.sqrt(np.mean(lengths**2))
        expected["waypoint_rms"] = (1 - scale) * spread(truth.position[ROWS, :2])
        assert measures.values == pytest.approx(expected, abs=1e-9)
        assert not measures.reasons and not measures.diverged


def test_late_equal_and_distant_waypoints_have_known_errors():
    """A late tap changes the path and no median. Waypoints at one place have an error and no ratio,
    and waypoints after the walk have neither."""
    truth = walk()
    delayed = tapped(truth)
    delayed = delayed._replace(time=delayed.time + np.array([0, 0, 0, 0.9, 0, 0, 0]))
    measures = measure(truth, truth, waypoints=delayed).values
    assert measures["leg_ratio"] == pytest.approx(1.0, abs=1e-6) and measures["leg_error"] > 0.3
    assert measures["leg_path_ratio"] != pytest.approx(1.0, abs=1e-3)
    still = Waypoints(truth.time[ROWS], np.ones((7, 2)))
    measures = measure(truth, truth, waypoints=still)
    assert measures.values["waypoint_rms"] == pytest.approx(spread(truth.position[ROWS, :2]))
    assert measures.values["leg_ratio"] is None and "no leg of 1 m" in measures.reasons["leg_ratio"]
    assert measures.values["leg_path_ratio"] is None
    after = still._replace(time=still.time + np.ptp(truth.time))
    lacking = measure(truth, truth, waypoints=after)
    assert {lacking.values[x] for x in OF_WAYPOINTS} == {None}
    assert "fewer than two" in lacking.reasons["waypoint_rms"]


def test_an_estimate_that_never_moves_and_one_that_diverged():
    """The error of the first is the spread of the waypoints, that of the second is infinite. The
    innovations of the filter need no reference."""
    short = scaled_estimate("short", 0, scale=0.7)
    still = score(never_moves([short]))["short"]
    assert still.values["leg_ratio"] == 0.0
    assert still.values["waypoint_rms"] == pytest.approx(spread(short.waypoints.position))
    measures = score([short])["short"].values
    assert measures.keys() == {"duration", "path_length", "legs", *OF_WAYPOINTS, *OF_FILTER}
    assert measures["nis"] == pytest.approx(1.0)
    gone = short._replace(trajectory=lost(short.trajectory, 200))
    measures = score([gone])["short"]
    assert measures.diverged and measures.values["waypoint_rms"] == math.inf
    assert measures.values["legs"] == 7 and measures.values["nis_coverage"] == 0.0
    far = short.trajectory._replace(position=short.trajectory.position * 1e200)
    assert measure(far, short.reference, waypoints=short.waypoints).diverged


def test_the_start_is_level_and_has_a_note(clean):
    (ready,), left_out = prepare([with_waypoints(clean)], CONFIG)
    assert not left_out and ready.waypoints is not None
    up = ready.start.rotation @ ready.accel[:50].mean(0)
    np.testing.assert_allclose(up[:2], 0.0, atol=0.6)
    assert up[2] > 9.0 and not ready.start.position.any() and not ready.start.velocity.any()
    assert np.isnan(ready.reference.position).all()
    assert "waypoints, no poses" in ready.notes[0]
    # A sequence without any reference starts in the same way.
    (blind,), _ = prepare([with_waypoints(clean)._replace(waypoints=None)], CONFIG, init="static")
    np.testing.assert_array_equal(ready.start.rotation, blind.start.rotation)


@pytest.fixture(scope="module")
def estimates():
    return [scaled_estimate("a/b", 0, scale=0.9), scaled_estimate("c", 1, scale=0.8)]


@pytest.fixture(scope="module")
def report(estimates):
    groups = {"a/b": "F1", "c": "F2"}
    settings = SETTINGS | {"recordings": dict.fromkeys(groups, 40.0), "reference": "waypoints"}
    return reported(estimates, groups, settings=settings)


def test_the_folder_keeps_the_waypoints(estimates, report, tmp_path):
    folder.write(tmp_path, report, estimates, BASE, plots=False)
    assert sorted(x.name for x in (tmp_path / "waypoints").iterdir()) == ["a_b.txt", "c.txt"]
    for ours, theirs in zip(
        folder.read_estimates(tmp_path, list(report.scores)), estimates, strict=True
    ):
        assert not ours.reference.known.any()
        for one, other in zip(ours.waypoints, theirs.waypoints, strict=True):
            np.testing.assert_allclose(one, other, atol=1e-6)
    assert folder.read(tmp_path).scores == report.scores


def test_picture_and_page_show_where_the_estimate_is_at_the_waypoints(estimates, report):
    view = make_view(estimates[0])
    aligned = in_one_frame(estimates[0]).trajectory
    passed = positions_at(aligned, estimates[0].waypoints.time)
    np.testing.assert_allclose(view.at_waypoints, passed)
    rms = np.sqrt(np.mean(view.errors**2))
    assert rms == pytest.approx(report.scores["a/b"].values["waypoint_rms"])
    plan, error = plots.sequence(view).axes[:2]
    lines = [line.get_xydata() for line in plan.lines]
    joined = np.stack([view.waypoints.position, view.at_waypoints], 1)
    assert all(any(np.array_equal(ends, line) for line in lines) for ends in joined)
    (marks,) = (line for line in error.lines if line.get_label() == "at waypoints")
    np.testing.assert_array_equal(marks.get_ydata(), view.errors)
    of_all = plots.error_cdf([make_view(estimate) for estimate in estimates], report)
    assert "rms at waypoints" in of_all.axes[1].get_xlabel()
    columns = page.make_columns(view, 150)  # of the page, each waypoint once
    rows = np.flatnonzero(np.isfinite(columns["waypoint_x"]))
    np.testing.assert_allclose(columns["time"][rows], view.waypoints.time, atol=0.15)
    np.testing.assert_allclose(columns["waypoint_error"][rows], view.errors, rtol=1e-6)
    corners = page.frame([page.PageRun("x", {}, [view], {})], "a/b")
    assert corners["x"][0] <= view.waypoints.position[:, 0].min()
