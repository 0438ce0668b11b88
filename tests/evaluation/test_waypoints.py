"""Walks with waypoints in the place of poses: start, alignment, metrics, folder and pictures, on
walks whose whole truth is known."""

import itertools
import math

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from gnio_jax.errors import InputError
from gnio_jax.evaluation import (
    Trajectory,
    Undefined,
    measure,
    never_moves,
    page,
    plots,
    prepare,
    report,
    score,
    tabulate,
)
from gnio_jax.evaluation.estimate import in_one_frame
from gnio_jax.evaluation.metrics import OF_FILTER, OF_WAYPOINTS
from gnio_jax.evaluation.report import Report
from gnio_jax.evaluation.trajectory import align_to_waypoints, positions_at
from gnio_jax.types import Waypoints
from tests.support.estimates import SETTINGS, estimate
from tests.support.estimators import CONFIG, NETWORK, loose, summed, tight, with_waypoints
from tests.support.reports import BASE
from tests.support.trajectories import moved_by, perturbed, walk

TURNED = Rotation.from_euler("z", 2.1)
ROWS = np.array([0, 90, 210, 330, 560, 700, 899])
"""Of a walk of 900, where it is tapped."""


def tapped(truth, rows=ROWS):
    return Waypoints(truth.time[rows], truth.position[rows, :2])


def unseen(name, seed, scale=1.0):
    """A made-up estimate, too long or short, in a frame of its own."""
    truth = estimate(name, seed)
    path = moved_by(truth.trajectory, TURNED, [5.0, -3.0, 1.0])
    return truth._replace(
        trajectory=path._replace(position=path.position * [scale, scale, 1.0]),
        reference=Trajectory(path.time, path.position * np.nan, path.orientation * np.nan),
        waypoints=tapped(truth.reference, np.arange(0, 400, 57)),
    )


# The alignment
# --------------------------------------------------------------------------------------------------


def least(path, waypoints):
    """The smallest root mean square there is, by a search over turn and shift."""
    true = waypoints.position
    rows = np.searchsorted(path.time, waypoints.time)
    ours = path.position[rows, :2]

    def cost(motion):
        angle, *shift = motion
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        return np.mean(np.sum((ours @ turn.T + shift - true) ** 2, 1))

    starts = ([angle, 0.0, 0.0] for angle in np.arange(-3.0, 3.0, 1.0))
    return math.sqrt(min(minimize(cost, each, tol=1e-12).fun for each in starts))


@pytest.mark.parametrize("rows", [ROWS, ROWS[:2], [100, 101, 102]])
@pytest.mark.parametrize("shape", ["wandering", "collinear", "still", "one place"])
def test_the_alignment_is_the_best_turn_and_shift(rows, shape):
    truth = walk()
    flat = {"wandering": 1.0, "collinear": [1.0, 0.0, 0.0], "still": 1.0, "one place": 0.0}[shape]
    waypoints = tapped(truth._replace(position=truth.position * flat), rows)
    path = moved_by(perturbed(truth), TURNED, [5.0, -3.0, 1.0])
    if shape == "still":
        path = path._replace(position=0.0 * path.position + 4.0)
    aligned = align_to_waypoints(path, waypoints)
    there = positions_at(aligned, waypoints.time)
    found = np.sqrt(np.mean(np.sum((there - waypoints.position) ** 2, 1)))
    assert found == pytest.approx(least(path, waypoints), abs=1e-6)
    # A rigid motion about z, of the attitudes too.
    angle = aligned.orientation, path.orientation
    turn = Rotation.from_quat(angle[0], scalar_first=True)
    turn = (turn * Rotation.from_quat(angle[1], scalar_first=True).inv()).as_rotvec()
    np.testing.assert_allclose(turn[:, :2], 0.0, atol=1e-9)
    moved = Rotation.from_rotvec(turn[0]).apply(path.position)
    np.testing.assert_allclose(np.diff(aligned.position, axis=0), np.diff(moved, axis=0), atol=1e-9)
    np.testing.assert_allclose(aligned.position[:, 2], path.position[:, 2], atol=1e-12)


def test_positions_lie_between_rows_and_not_beyond_the_ends():
    path = walk()
    begin, end = path.time[[0, -1]]
    found = positions_at(path, np.array([begin - 0.15, begin + 0.025, end + 0.15, end + 0.3]))
    between = 0.75 * path.position[0, :2] + 0.25 * path.position[1, :2]
    np.testing.assert_allclose(found[:3], [path.position[0, :2], between, path.position[-1, :2]])
    assert np.isnan(found[3]).all()
    assert np.isnan(positions_at(path, np.array([begin - 0.3]))).all()
    late = Waypoints(np.array([begin, end + 1.0, end + 2.0]), np.zeros((3, 2)))
    with pytest.raises(Undefined, match="fewer than two waypoints"):
        align_to_waypoints(path, late)


# Metrics
# --------------------------------------------------------------------------------------------------


def spread(points):
    return np.sqrt(np.mean(np.sum((points - points.mean(0)) ** 2, 1)))


@pytest.mark.parametrize("scale", [1.0, 0.8, 1.25, 0.0])
def test_a_walk_that_is_short_by_a_factor(scale):
    """All is known by hand: each leg is too short by the factor, whatever the frame."""
    truth = walk()
    path = moved_by(truth._replace(position=scale * truth.position), TURNED, [5.0, -3.0, 1.0])
    found = measure(path, truth._replace(position=truth.position * np.nan), waypoints=tapped(truth))
    legs = np.diff(truth.position[ROWS, :2], axis=0)
    lengths = np.linalg.norm(legs, axis=1)
    expected = {
        "duration": np.ptp(truth.time),
        "path_length": lengths.sum(),
        "legs": 6,
        "leg_ratio": scale,
        "leg_path_ratio": scale,
        "leg_error": abs(1 - scale) * np.sqrt(np.mean(lengths**2)),
        "waypoint_rms": abs(1 - scale) * spread(truth.position[ROWS, :2]),
    }
    assert found.values == pytest.approx(expected, abs=1e-9)
    assert not found.reasons and not found.diverged


def test_a_late_tap_moves_the_path_and_no_median():
    truth = walk()
    late = tapped(truth)
    late = late._replace(time=late.time + np.array([0, 0, 0, 0.9, 0, 0, 0]))
    found = measure(truth, truth, waypoints=late).values
    assert found["leg_ratio"] == pytest.approx(1.0, abs=1e-6)
    assert found["leg_path_ratio"] != pytest.approx(1.0, abs=1e-3)
    assert found["leg_error"] > 0.3


def test_waypoints_at_one_place_have_an_error_and_no_ratio():
    truth = walk()
    still = Waypoints(truth.time[ROWS], np.ones((7, 2)))
    found = measure(truth, truth, waypoints=still)
    assert found.values["waypoint_rms"] == pytest.approx(spread(truth.position[ROWS, :2]))
    assert found.values["leg_ratio"] is None and "no leg of 1 m" in found.reasons["leg_ratio"]
    assert found.values["leg_path_ratio"] is None
    few = still._replace(time=still.time + np.ptp(truth.time))
    lacking = measure(truth, truth, waypoints=few)
    assert {lacking.values[x] for x in OF_WAYPOINTS} == {None}
    assert "fewer than two" in lacking.reasons["waypoint_rms"]


def test_who_never_moves_is_as_far_off_as_the_waypoints_are_spread():
    short = unseen("short", 0, scale=0.7)
    still = score(never_moves([short]))["short"]
    assert still.values["leg_ratio"] == 0.0
    assert still.values["waypoint_rms"] == pytest.approx(spread(short.waypoints.position))
    # Innovations need no reference: a filter is judged by them here too.
    found = score([short])["short"].values
    assert found.keys() == {"duration", "path_length", "legs", *OF_WAYPOINTS, *OF_FILTER}
    assert found["nis"] == pytest.approx(1.0)


def test_an_estimate_that_diverged_has_infinite_errors_and_its_legs():
    lost = unseen("lost", 0)
    there = np.arange(400)[:, None] < 200
    path = lost.trajectory
    path = Trajectory(path.time, *(np.where(there, part, np.nan) for part in path[1:]))
    found = measure(path, lost.reference, filtered=lost.filtered, waypoints=lost.waypoints)
    assert found.diverged and found.values["waypoint_rms"] == math.inf
    assert found.values["legs"] == 7 and found.values["nis_coverage"] == 0.0
    far = lost.trajectory._replace(position=lost.trajectory.position * 1e200)
    assert measure(far, lost.reference, waypoints=lost.waypoints).diverged


# From a sequence to an estimate
# --------------------------------------------------------------------------------------------------


def test_the_start_is_level_and_says_so(clean):
    (ready,), left_out = prepare([with_waypoints(clean)], CONFIG)
    assert not left_out and ready.waypoints is not None
    up = ready.start.rotation @ ready.accel[:50].mean(0)
    np.testing.assert_allclose(up[:2], 0.0, atol=0.6)
    assert up[2] > 9.0 and not ready.start.position.any() and not ready.start.velocity.any()
    assert np.isnan(ready.reference.position).all()
    assert "waypoints, no poses" in ready.notes[0]
    # As from the gravity of a sequence without any reference.
    (blind,), _ = prepare([with_waypoints(clean)._replace(waypoints=None)], CONFIG, init="static")
    np.testing.assert_array_equal(ready.start.rotation, blind.start.rotation)


@pytest.mark.parametrize(
    ("asked", "remedy"),
    [
        ({"gyro_bias": "reference"}, "--gyro-bias zero"),
        ({"orientation": "reference"}, "--orientation filter"),
    ],
)
def test_what_needs_a_pose_is_refused_by_name(clean, asked, remedy):
    with pytest.raises(InputError, match=f"{clean.name}: has waypoints, no poses.*{remedy}"):
        prepare([with_waypoints(clean)], CONFIG, **asked)


def test_a_recording_with_poses_beside_it_is_as_it_was(walks):
    posed = walks[0]
    both, _ = prepare([posed, with_waypoints(walks[2])], CONFIG)
    (alone,), _ = prepare([posed], CONFIG)
    (first, second), (own,) = tight(both, batch_size=1), tight([alone], batch_size=1)
    for ours, theirs in zip(first.trajectory, own.trajectory, strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert first.waypoints is None and second.waypoints is not None


@pytest.mark.parametrize("way", [tight, loose, summed])
def test_every_estimator_takes_them_along(clean, way):
    recordings, _ = prepare([with_waypoints(clean)], CONFIG, orientation="filter")
    (found,) = way(recordings, NETWORK)
    assert found.waypoints is recordings[0].waypoints
    assert np.isfinite(score([found])[clean.name].values["waypoint_rms"])


# The folder, the tables, and what is drawn
# --------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def unseen_ones():
    return [unseen("a/b", 0, scale=0.9), unseen("c", 1, scale=0.8)]


@pytest.fixture(scope="module")
def made(unseen_ones):
    groups = {"a/b": "F1", "c": "F2"}
    settings = SETTINGS | {"recordings": dict.fromkeys(groups, 40.0), "reference": "waypoints"}
    return Report(
        settings,
        score(unseen_ones),
        {"never_moves": score(never_moves(unseen_ones))},
        groups,
        {},
        {},
    )


def test_the_folder_holds_the_waypoints_and_gives_them_back(
    unseen_ones, made, tmp_path, monkeypatch
):
    monkeypatch.setattr(plots, "DOTS_PER_INCH", 30)
    report.write(tmp_path / "e", made, unseen_ones, BASE, plots=False)
    assert sorted(x.name for x in (tmp_path / "e" / "waypoints").iterdir()) == ["a_b.txt", "c.txt"]
    back = report.read_estimates(tmp_path / "e", list(made.scores))
    for ours, theirs in zip(back, unseen_ones, strict=True):
        assert not ours.reference.known.any()
        np.testing.assert_allclose(ours.waypoints.time, theirs.waypoints.time, atol=1e-6)
        np.testing.assert_allclose(ours.waypoints.position, theirs.waypoints.position, atol=1e-6)
    assert report.read(tmp_path / "e").scores == made.scores
    broken = tmp_path / "e" / "waypoints" / "c.txt"
    broken.write_text("1 2\n")
    with pytest.raises(InputError, match="2 columns"):
        report.read_estimates(tmp_path / "e", list(made.scores))


def test_pictures_show_where_the_estimate_is_at_the_waypoints(unseen_ones, made):
    seen = plots.view(unseen_ones[0])
    aligned = in_one_frame(unseen_ones[0]).trajectory
    np.testing.assert_allclose(
        seen.taps.passed, positions_at(aligned, unseen_ones[0].waypoints.time)
    )
    rms = np.sqrt(np.mean(seen.errors**2))
    assert rms == pytest.approx(made.scores["a/b"].values["waypoint_rms"])
    figure = plots.sequence(seen)
    plan, error = figure.axes[:2]
    lines = [line.get_xydata() for line in plan.lines]
    joined = np.stack([seen.taps.position, seen.taps.passed], 1)
    assert all(any(np.array_equal(ends, line) for line in lines) for ends in joined)
    (marks,) = (line for line in error.lines if line.get_label() == "at waypoints")
    np.testing.assert_array_equal(marks.get_ydata(), seen.taps.error)
    spread = plots.error_cdf([plots.view(each) for each in unseen_ones], made)
    assert "rms at waypoints" in spread.axes[1].get_xlabel()


def test_the_page_holds_each_waypoint_once(unseen_ones):
    seen = plots.view(unseen_ones[0])
    found = page.columns(seen, 150)
    rows = np.flatnonzero(np.isfinite(found["waypoint_x"]))
    assert len(rows) == len(seen.taps.time)
    np.testing.assert_allclose(found["time"][rows], seen.taps.time, atol=0.15)
    np.testing.assert_allclose(found["waypoint_error"][rows], seen.taps.error, rtol=1e-6)
    corners = page.frame([page.Run("x", {}, [seen], {})], "a/b")
    assert corners["x"][0] <= seen.taps.position[:, 0].min()


@pytest.mark.parametrize("mixed", [False, True])
def test_the_table_on_the_screen_has_the_columns_that_there_are(made, mixed, capsys):
    from rich.console import Console

    scores = dict(made.scores)
    if mixed:
        scores |= score([estimate("posed", 3)])
    shown = made._replace(scores=scores, groups={name: name for name in scores})
    console = Console(width=80)
    with console.capture() as captured:
        console.print(tabulate.render(shown))
    lines = captured.get().splitlines()
    heads = " ".join("\n".join(lines[:6]).split())
    assert max(map(len, lines)) <= 80 and not any("…" in line for line in lines)
    assert "leg ratio" in heads.replace("\n", " ") or ("leg" in heads and "ratio" in heads)
    assert ("ATE" in heads) == mixed
    assert tabulate.column("leg_ratio").best == 1.0


def test_rows_of_waypoint_walks_are_compared_by_their_own_errors(made):
    better = made._replace(
        scores={
            name: own._replace(values=own.values | {"waypoint_rms": own.values["waypoint_rms"] / 2})
            for name, own in made.scores.items()
        }
    )
    ((_, cell),) = tabulate.cells([[made], [better]], ["waypoint_rms"]).values()
    assert cell.difference.better == 2 and cell.difference.mean < 0
    lost = {
        name: own._replace(values=own.values | {"waypoint_rms": math.inf}, diverged=True)
        for name, own in itertools.islice(better.scores.items(), 1)
    }
    worse = better._replace(scores=better.scores | lost)
    ((_, cell),) = tabulate.cells([[made], [worse]], ["waypoint_rms"]).values()
    assert cell.difference.withheld
