"""Each metric against values by hand, plain loops and drawn errors; and the metrics of a sequence
with their names and reasons."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.metrics import Filtered
from gnio_jax.evaluation.trajectory import Trajectory, align, write_tum
from tests.support.trajectories import (
    PITCHES,
    STEP,
    lost,
    masked,
    moved_by,
    perturbed,
    pitched,
    quaternions,
    walk,
)

EYES = np.broadcast_to(np.eye(3), (900, 3, 3))
TURNED = Rotation.from_euler("z", 1.2)


def filtered(covariance, nis=np.nan, accepted=1.0):
    rows = len(covariance)
    return Filtered(covariance, np.full(rows, nis), np.full(rows, accepted))


def rms(errors):
    return np.sqrt(np.mean(np.sum(np.square(errors), 1)))


def test_absolute_errors_of_an_offset_and_of_a_jump():
    path = walk()
    estimate = path.position + np.array([3.0, 4.0, 12.0])
    values = metrics.measure(path._replace(position=estimate), path, "none").values
    expected = {"ate": 13.0, "ate_2d": 5.0}
    expected |= {"ate_ronin": 13.0 / np.sqrt(3), "ate_ronin_2d": 5.0 / np.sqrt(2)}
    assert {name: values[name] for name in expected} == pytest.approx(expected)
    assert metrics.rte(estimate, path.position, STEP) == pytest.approx(0.0, abs=1e-12)
    jump = np.array([[0.0, 0, 0], [2.0, 0, 0]])
    assert metrics.ate(jump, 0 * jump) == pytest.approx(np.sqrt(2))
    stretched = path._replace(position=path.position * [1.1, 1.0, 1.0])
    values = metrics.measure(stretched, masked(path, slice(0, 99)), "none").values
    errors = 0.1 * np.abs(path.position[99:, 0])
    for name, of in {"mean": np.mean, "median": np.median, "max": np.max}.items():
        assert values[f"ate_{name}"] == pytest.approx(of(errors)) == values[f"ate_{name}_2d"]


def test_drift():
    truth = np.zeros((101, 3))
    truth[:, 0] = np.arange(101) * STEP * 2
    estimate = truth * [1.05, 1, 1]
    assert metrics.drift(estimate, truth, STEP) == pytest.approx(5.0)
    holed = truth.copy()
    holed[20:80] = np.nan  # the error of the estimate grows in the hole too
    assert metrics.drift(estimate, holed, STEP) == pytest.approx(5.0)


def test_rte_equals_a_loop_and_is_scaled_for_a_short_walk():
    truth, lag = walk(), 600
    estimate, reference = perturbed(truth), masked(truth, slice(620, 640))
    error = estimate.position - reference.position
    pairs = [(i, i + lag) for i in range(300)]
    errors = [error[j] - error[i] for i, j in pairs if np.isfinite(error[[i, j]]).all()]
    assert len(errors) == 280
    values = metrics.measure(estimate, reference, "none").values
    assert values["rte_60s"] == pytest.approx(rms(errors), rel=1e-12)
    assert values["rte_60s_ronin_2d"] == pytest.approx(values["rte_60s_2d"] / np.sqrt(2))
    still, off = np.zeros((301, 3)), np.zeros((301, 3))
    off[:, 0] = np.linspace(0, 2.0, 301)  # 2 m in 30 s
    assert metrics.rte(off, still, STEP) == pytest.approx(4.0)


HOLES = [(40, 41), (77, 78), (300, 301), (500, 502), (640, 641)]
"""Rows without a reference (start, stop), at 10 Hz. The rows before and after the fourth hole are
0.3 s apart, which may hide a jump of the reference."""
UNBROKEN = [(0, 500), (502, 900)]


def bridged(position):
    """The positions with a straight line across each hole but the fourth, row by row."""
    path = position.copy()
    for start, stop in HOLES:
        for row in range(start, stop):
            share = (row - start + 1) / (stop - start + 1)
            path[row] = (1 - share) * position[start - 1] + share * position[stop]
    return path


@pytest.mark.parametrize("metres", [1.0, 10.0])
def test_rte_distance_equals_a_loop_and_the_error_of_a_scaled_line(metres):
    truth, estimate = (path.position[:, :2] for path in (walk(), perturbed(walk())))
    reference, path = truth.copy(), bridged(truth)
    for start, stop in HOLES:
        reference[start:stop] = np.nan
    errors, across = [], 0
    for start, stop in UNBROKEN:
        for i in range(start, stop):
            walked, j = 0.0, i
            while j + 1 < stop and walked < metres - 1e-9:
                walked += np.linalg.norm(path[j + 1] - path[j])
                j += 1
            if walked >= metres - 1e-9 and np.isfinite(reference[[i, j]]).all():
                errors.append(estimate[j] - estimate[i] - truth[j] + truth[i])
                across += np.isnan(reference[i:j]).any()
    assert across > 5
    value = metrics.rte_distance(estimate, reference, STEP, metres)
    assert value == pytest.approx(rms(errors), rel=1e-9)
    line = np.zeros((501, 2))
    line[:, 0] = np.arange(501) * 0.125
    assert metrics.rte_distance(line * 1.1, line, STEP, metres) == pytest.approx(0.1 * metres)
    slow = np.outer(np.arange(20.0), [3.0, 0.0])  # rows 3 s apart, which is no hole
    assert metrics.rte_distance(slow * 1.1, slow, 3.0, 9.0) == pytest.approx(0.9)
    line[::2] = np.nan  # every second row is missing
    assert metrics.rte_distance(line * 1.1, line, STEP, metres) == pytest.approx(0.1 * metres)
    with pytest.raises(metrics.Undefined, match="unbroken"):
        metrics.rte_distance(line, np.full_like(line, np.nan), STEP, metres)


def test_rpe_equals_a_loop():
    truth, seconds = walk(tilt=0.3), 10.0
    estimate = perturbed(truth)
    lag, errors, errors_se3 = round(seconds / STEP), [], []
    turns, turns_true = (
        Rotation.from_quat(t.orientation, scalar_first=True) for t in (estimate, truth)
    )
    for i in range(len(truth.time) - lag):
        _, _, z, w = (turns[i] * turns_true[i].inv()).as_quat()
        angle = -2 * np.arctan(z / w)  # the twist about z, turned back
        moved, true = (path.position[i + lag] - path.position[i] for path in (estimate, truth))
        errors.append(Rotation.from_euler("z", angle).apply(moved) - true)
        errors_se3.append(turns[i].inv().apply(moved) - turns_true[i].inv().apply(true))
    for dims in (2, 3):
        value = metrics.rpe(estimate, truth, STEP, seconds, dims)
        assert value == pytest.approx(rms(np.array(errors)[:, :dims]), rel=1e-9)
    value = metrics.rpe(estimate, truth, STEP, seconds, full=True)
    assert value == pytest.approx(rms(errors_se3), rel=1e-9)


@pytest.mark.parametrize("step", [0.4, 0.7, 1.9, 3.0, 150.0])
def test_an_error_over_a_time_is_of_rows_that_are_so_far_apart(step):
    """An estimate that errs by 0.1 m in each second, with rows from 0.4 s to minutes apart."""
    rows = np.arange(60.0)
    position = np.outer(rows * step, [1.0, 0.0, 0.0])
    truth = Trajectory(rows * step, position, np.tile([1.0, 0, 0, 0], (60, 1)))
    estimate = truth._replace(position=1.1 * position)
    measures = metrics.measure(estimate, truth)
    for name, seconds in {"rpe_1s": 1, "rpe_se3": 1, "rpe_10s": 10, "rte_60s": 60}.items():
        interval = max(round(seconds / step), 1) * step
        if abs(interval - seconds) <= 0.25 * seconds:
            assert measures.values[name] == pytest.approx(0.1 * interval), name
        else:
            assert measures.values[name] is None, name
            assert f"{seconds} s apart, because each takes {step:g} s" in measures.reasons[name]
    assert measures.values["ate"] > 0 and not measures.diverged


def test_path_length_of_a_scaled_circle_and_of_noise():
    angle = np.linspace(0, 2 * np.pi, 1201)
    circle = 10 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)  # 62.8 m in 120 s
    length = 120 * 20 * np.sin(np.pi / 120)
    assert metrics.path_length(circle, STEP) == pytest.approx(length, rel=1e-12)
    holes = circle.copy()
    holes[300:400] = np.nan
    # The chord across ten seconds without a reference is not counted.
    assert metrics.path_length(holes, STEP) == pytest.approx(109 / 120 * length, rel=1e-12)
    scattered = circle.copy()
    scattered[::3] = np.nan
    assert metrics.path_length(scattered, STEP) == pytest.approx(length, rel=0.01)
    for scale, reference in ((0.8, circle), (0.0, circle), (0.8, holes)):
        ratio = metrics.path_length_ratio(circle * scale, reference, STEP)
        assert ratio == pytest.approx(scale)
    truth = np.zeros((1201, 3))
    truth[:, 0] = np.arange(1201) * STEP
    noisy = truth + np.random.default_rng(0).normal(0, 0.02, truth.shape)
    # The last rows, which are no whole second, count too.
    assert metrics.path_length(truth[:996], STEP) == pytest.approx(99.5)
    assert metrics.path_length_ratio(noisy, truth, STEP) == pytest.approx(1.0, abs=2e-3)
    assert np.linalg.norm(np.diff(noisy, axis=0), axis=1).sum() > 1.05 * 120


def test_stationary_drift():
    truth = np.zeros((1000, 3))
    truth[400:, 0] = np.minimum(np.arange(600), 300) * STEP  # stands 40 s, walks 30 s, stands 30 s
    still = metrics.standing(truth, STEP)
    assert still[:400].all() and still[701:].all() and not still[402:699].any()
    estimate = truth.copy()
    estimate[:, 1] += np.arange(1000) * STEP * 0.02  # 1.2 m a minute
    assert metrics.stationary_drift(estimate, truth, STEP) == pytest.approx(1.2, rel=1e-3)
    for rows in (20, 21):  # still for 1.9 and for 2 s
        brief = np.zeros((60, 3))
        brief[:, 0] = np.r_[np.arange(15), np.full(rows, 15), np.arange(16, 61 - rows)] * STEP
        assert metrics.standing(brief, STEP).sum() == (0 if rows == 20 else 21)


def test_yaw_errors_wrap():
    def level(yaw):
        return quaternions(Rotation.from_euler("z", yaw[:, None]))

    yaw_true = np.linspace(0, 20, 601)
    truth = level(yaw_true)
    assert metrics.yaw_rmse(level(yaw_true + np.radians(10)), truth) == pytest.approx(10.0)
    growing = yaw_true + np.radians(5) * np.linspace(0, 100, 601)  # 500° in 60 s, several turns
    assert metrics.yaw_drift(level(growing), truth, STEP) == pytest.approx(500 * 60, rel=1e-9)


@pytest.mark.parametrize("pitch", PITCHES)
def test_yaw_errors_of_a_tilted_phone(pitch):
    """A noise of 0.1° about both horizontal axes is no yaw error, though the body's x axis may be
    vertical. A wrong heading is measured, and removed by the alignment."""
    truth = pitched(pitch)
    noise = np.zeros((900, 3))
    noise[:, :2] = np.random.default_rng(1).normal(0, np.radians(0.1), (900, 2))
    turn = Rotation.from_rotvec(noise) * Rotation.from_quat(np.roll(truth.orientation, -1, 1))
    values = metrics.measure(truth._replace(orientation=quaternions(turn)), truth).values
    most = {"yaw_rmse": 0.01, "yaw_drift": 1.0, "rpe_1s": 1e-4, "rpe_10s": 1e-3, "ate": 1e-3}
    assert all(values[name] < limit for name, limit in most.items())
    turn = Rotation.from_euler("z", 40, degrees=True)
    estimate = moved_by(truth, turn, [5.0, -3.0, 1.0])
    assert metrics.measure(estimate, truth, "none").values["yaw_rmse"] == pytest.approx(40.0)
    assert metrics.rte(estimate.position, truth.position, STEP, 10.0) > 1.0
    values = metrics.measure(estimate, truth, filtered=filtered(EYES)).values
    for name in ("rpe_1s", "rpe_10s_2d", "rpe_se3", "ate", "nees", "yaw_rmse"):
        assert values[name] == pytest.approx(0, abs=1e-6)


def test_a_piece_counts_if_the_pose_is_known_at_both_of_its_ends():
    time = STEP * np.arange(300)
    position = np.stack([10.0 * time, 0 * time, 0 * time], axis=1)
    truth = Trajectory(time, position, np.tile([1.0, 0.0, 0.0, 0.0], (300, 1)))
    first, last, length = metrics.pieces(truth, STEP)
    assert len(first) > 20
    holed = truth._replace(orientation=truth.orientation.copy())
    holed.orientation[[first[3], last[7]]] = np.nan
    missing = np.isin(first, [first[3], last[7]]) | np.isin(last, [first[3], last[7]])
    pieces = np.stack([first, last, length])[:, ~missing]
    assert missing[7] and 1 < missing.sum() < len(first)
    np.testing.assert_array_equal(metrics.pieces(holed, STEP), pieces)
    stretched = truth._replace(position=1.01 * position)
    assert metrics.t_rel(stretched, holed, STEP) == pytest.approx(1.0, rel=0.02)


def test_holes_of_the_longest_time_are_joined_though_the_step_is_not_exact():
    for step in (0.05, 0.1, 0.2 / 3):
        rows = round(metrics.LONGEST_HOLE / step)
        reference = np.outer(np.arange(10.0 * rows), [1.0, 0.0]) * step
        holed = reference.copy()
        holed[1 : 2 * rows][np.arange(2 * rows - 1) % rows != rows - 1] = np.nan
        # Reading a step of a file may cost its last bits.
        for exact in (step, step * (1 + 1e-9), step * (1 - 1e-9)):
            drift = 1.1 * reference
            error = metrics.rte_distance(drift, holed, exact, 1.0)
            assert error == pytest.approx(0.1, rel=0.25)
            (stretch,) = metrics._walked_distances(holed, exact)
            assert len(stretch[1]) == len(holed)


def test_errors_of_pieces_are_those_of_kittis_benchmark():
    """Against a plain loop with homogeneous matrices, with a long hole and single holes in the
    reference."""
    rng, rows = np.random.default_rng(6), 1500
    time = STEP * np.arange(rows)
    yaw = np.cumsum(0.02 * np.sin(0.05 * time) * STEP)
    attitude = Rotation.from_euler("ZYX", np.stack([yaw, 0.02 * np.sin(time), 0 * yaw], 1))
    position = np.cumsum(attitude.apply([9.0 * STEP, 0.0, 0.0]), axis=0)
    truth = Trajectory(time, position, quaternions(attitude))
    turn = Rotation.from_rotvec(np.cumsum(rng.normal(size=(rows, 3)), axis=0) * 1e-3)
    drift = np.cumsum(rng.normal(size=(rows, 3)), axis=0) * 0.05
    # A rigid motion of the whole estimate is no error.
    estimate = moved_by(
        Trajectory(time, position + drift, quaternions(turn * attitude)), TURNED, [5.0, 3.0, 1.0]
    )
    driven = truth.position.copy()  # straight across the single holes
    for row in (3, 250, 1200):  # pieces would begin at the last two
        driven[row] = (position[row - 1] + position[row + 1]) / 2
        truth.position[row] = np.nan
    truth.orientation[255] = np.nan
    truth.position[700:720] = np.nan

    def poses(path):
        matrices = np.tile(np.eye(4), (rows, 1, 1))
        turned = np.isfinite(path.orientation).all(1)
        attitude = np.roll(path.orientation[turned], -1, 1)
        matrices[turned, :3, :3] = Rotation.from_quat(attitude).as_matrix()
        matrices[~turned] = np.nan
        matrices[:, :3, 3] = path.position
        return matrices

    ours, true = poses(estimate), poses(truth)
    pieces = []
    for start, stop in ((0, 700), (720, rows)):
        for i in range(start, stop, 10):  # a second
            for length in range(100, 801, 100):
                walked, j = 0.0, i
                while j + 1 < stop and walked <= length:
                    j += 1
                    walked += np.linalg.norm(driven[j] - driven[j - 1])
                if walked > length and np.isfinite([true[i], true[j]]).all():
                    motions = [np.linalg.solve(path[i], path[j]) for path in (ours, true)]
                    error = np.linalg.solve(*motions)
                    cosine = np.clip((np.trace(error[:3, :3]) - 1) / 2, -1, 1)
                    pieces.append(np.array([np.linalg.norm(error[:3, 3]), np.arccos(cosine)]))
                    pieces[-1] /= length
    expected = np.mean(pieces, axis=0)
    assert len(pieces) > 30
    assert metrics.t_rel(estimate, truth, STEP) == pytest.approx(100 * expected[0], rel=1e-9)
    assert metrics.r_rel(estimate, truth, STEP) == pytest.approx(np.degrees(expected[1]), rel=1e-6)
    assert metrics.t_rel(truth, truth, STEP) == pytest.approx(0, abs=1e-9)
    assert metrics.measure(estimate, truth).values["r_rel"] == pytest.approx(
        np.degrees(expected[1]), rel=1e-6
    )
    assert not metrics.OF_PIECES.keys() & metrics.measure(walk(), walk()).values.keys()


def test_the_nees_of_a_consistent_filter_is_one():
    random = np.random.default_rng(0)
    root = random.normal(size=(20000, 3, 3))
    covariance = np.einsum("nij,nkj->nik", root, root) + 0.1 * np.eye(3)
    error = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), random.normal(size=(20000, 3)))
    squared = metrics.normalised_squared(error, covariance)
    unit = np.array([1e-9, 1.0, 1e9])  # it does not depend on units
    scaled = metrics.normalised_squared(unit * error, unit[:, None] * covariance * unit)
    expected = np.einsum("ni,nij,nj->n", error, np.linalg.inv(covariance), error)
    for result in (squared, scaled):
        np.testing.assert_allclose(result, expected, rtol=1e-9)
    assert metrics.mean_normalised(squared, 3) == pytest.approx(1.0, abs=0.03)
    assert metrics.coverage(squared, 3) == pytest.approx(95, abs=0.7)
    assert metrics.coverage(np.array([1.0, np.nan, 7.8, 7.9]), 3) == pytest.approx(200 / 3)
    assert metrics.coverage(np.array([5.98, 6.0]), 2) == 50  # of 95 % with two degrees of freedom


def test_nees_does_not_depend_on_the_frame():
    truth, sigma = walk(), np.array([2.0, 1.0, 0.5])
    results = filtered(np.broadcast_to(np.diag(sigma**2), (900, 3, 3)))
    error = np.random.default_rng(3).normal(size=(900, 3)) * sigma
    error[0] = 0
    estimate = truth._replace(position=truth.position + error)
    turned = moved_by(truth, TURNED, [1.0, 2.0, 3.0])
    straight, elsewhere = (
        metrics.measure(estimate, reference, filtered=results).values
        for reference in (truth, turned)
    )
    for name in ("nees", "nees_2d", "nees_coverage", "nees_coverage_2d"):
        assert straight[name] == pytest.approx(elsewhere[name])
    assert straight["nees"] == pytest.approx(np.mean(np.sum((error / sigma) ** 2, 1)) / 3)


def test_nees_has_no_value_where_the_reference_begins_after_the_start():
    """The errors since a later row are smaller than those that the covariance counts."""
    truth, results = walk(), filtered(EYES, 3.0)
    names = ("nees", "nees_2d", "nees_coverage", "nees_coverage_2d")
    whole = metrics.measure(perturbed(truth), truth, filtered=results)
    assert not whole.reasons and all(whole.values[name] > 0 for name in names)
    for row in (1, 10):  # In a second the covariance hardly grows.
        reference = masked(truth, slice(0, row))
        assert metrics.measure(perturbed(truth), reference, filtered=results).values["nees"] > 0
    for row, seconds in ((11, "1.1"), (450, "45.0")):
        reference = masked(truth, slice(0, row))
        measures = metrics.measure(perturbed(truth), reference, filtered=results)
        for name in names:
            assert measures.values[name] is None
            reason = f"the reference begins {seconds} s after the filter's start"
            assert measures.reasons[name] == reason
        assert measures.values["nis"] == pytest.approx(1.0) and measures.values["ate"] > 0
        assert not measures.diverged


def test_a_singular_or_indefinite_covariance_has_an_infinite_nees():
    truth, covariance = walk(), EYES.copy()
    for bad in (
        np.full((3, 3), np.nan),
        np.full((3, 3), 1e30),
        np.eye(3) + 1e40 * np.outer([1, 2, 3], [1, 2, 3]),
        np.diag([1.0, -1.0, 1.0]),
        [[1, 2, 0], [2, 1, 0], [0, 0, 1]],
    ):
        covariance[150:] = bad
        measures = metrics.measure(perturbed(truth, scale=0), truth, filtered=filtered(covariance))
        for tag in ("", "_2d"):
            assert measures.values[f"nees{tag}"] == np.inf
            assert measures.values[f"nees_coverage{tag}"] == pytest.approx(100 / 6)
        assert not measures.diverged and np.isfinite(measures.values["ate"])
        assert measures.reasons["nees"] == "the filter's covariance is not positive definite"


def test_no_metric_counts_an_untrusted_row():
    truth = walk()
    estimate, reference, trusted = (
        perturbed(truth),
        masked(truth, slice(100, 150)),
        np.ones(900, bool),
    )
    trusted[100:150] = False
    wrong = estimate._replace(position=estimate.position.copy())
    wrong.position[~trusted] += 1e3
    ate = rms((estimate.position - truth.position)[trusted])
    assert metrics.ate(wrong.position, reference.position) == pytest.approx(ate)
    a, b = metrics.measure(wrong, reference), metrics.measure(estimate, reference)
    assert a == b and not a.reasons


def test_a_reference_without_orientation_is_no_divergence():
    """Its rows count where no attitude is needed. The first row with an attitude aligns the
    estimate."""
    truth = walk()
    reference = truth._replace(orientation=truth.orientation.copy())
    reference.orientation[:50] = np.nan
    estimate = moved_by(truth, TURNED, [5.0, -3.0, 1.0])
    measures = metrics.measure(estimate, reference)
    assert not measures.reasons
    for name in ("ate", "rpe_10s", "rpe_se3", "yaw_rmse"):
        assert measures.values[name] == pytest.approx(0, abs=1e-6)
    broken = estimate._replace(orientation=estimate.orientation.copy())
    broken.orientation[-50:] = np.nan  # an estimate without an orientation has no error
    assert np.isnan(metrics.yaw_rmse(broken.orientation, reference.orientation))
    assert np.isnan(metrics.rpe(broken, reference, STEP, 1.0))


def test_metrics_have_names_and_reasons():
    truth = walk()
    results = filtered(EYES, 3.0)
    results.nis[0], results.accepted[:2] = np.nan, [np.nan, 0.0]
    measures = metrics.measure(perturbed(truth), truth, filtered=results)
    assert not measures.reasons
    with_poses = set(metrics.NAMES) - metrics.OF_WAYPOINTS.keys() - metrics.OF_PIECES.keys()
    assert with_poses == measures.values.keys() - {"duration", "path_length"}
    expected = {"nis": 1.0, "duration": 89.9, "accepted": 100 * 898 / 899}
    assert {name: measures.values[name] for name in expected} == pytest.approx(expected)
    blind = metrics.measure(truth, masked(truth, slice(None)))
    assert blind.values["ate"] is None and blind.reasons["ate"] == "no trusted reference"
    assert blind.values["duration"] == pytest.approx(89.9)
    # An error that cannot be measured is not infinite.
    gone = metrics.measure(lost(truth, 500), masked(truth, slice(None)))
    assert gone.values["ate"] is None and gone.reasons["ate"] == "no trusted reference"
    pair = (Trajectory(*(part[:5] for part in path)) for path in (lost(truth, 3), truth))
    brief = metrics.measure(*pair)
    assert brief.values["ate"] == np.inf and brief.values["rpe_1s"] is None
    assert gone.diverged and brief.diverged and "not finite" not in brief.reasons["rpe_1s"]
    short = metrics.measure(*(Trajectory(*(field[:5] for field in truth)) for _ in range(2)))
    assert short.values["ate"] == 0.0 and short.values["rpe_1s"] is None
    assert "1 s" in short.reasons["rpe_1s"]


def test_a_diverged_estimate_has_infinite_errors():
    truth = walk()
    estimate, results = perturbed(truth), filtered(EYES, 3.0)
    whole = metrics.measure(estimate, truth, filtered=results)
    broken = metrics.measure(lost(estimate, 500), truth, filtered=results)
    of_reference = {"duration", "path_length"}
    shares = {"nees_coverage", "nees_coverage_2d", "nis_coverage", "accepted"}
    assert broken.values.keys() == whole.values.keys() and not whole.reasons
    infinite = {name for name, value in broken.values.items() if value == np.inf}
    assert infinite == whole.values.keys() - of_reference - shares
    assert all(broken.values[name] == 0 for name in shares)
    assert all(broken.values[name] == whole.values[name] for name in of_reference)
    assert set(broken.reasons.values()) == {"the estimate is not finite from 50.0 s on"}
    assert broken.diverged and not whole.diverged
    far = estimate._replace(position=np.full((900, 3), 1e300))
    far.position[0] = 0
    measures = metrics.measure(far, truth)
    assert measures.values["ate"] == np.inf and measures.reasons["ate"].startswith(
        "the error is too"
    )
    assert measures.diverged


def test_agreement_with_evo(tmp_path):
    pytest.importorskip("evo.core.metrics")
    from evo.core import metrics as evo
    from evo.core.trajectory import PoseTrajectory3D
    from evo.tools import file_interface

    truth = walk(tilt=0.3)
    estimate = moved_by(perturbed(truth), Rotation.from_rotvec([0.1, -0.2, 0.7]), [5.0, -3.0, 1.0])
    yaw_only = perturbed(truth)._replace(orientation=truth.orientation)
    yaw_only = moved_by(yaw_only, Rotation.from_euler("z", 1.0), [1.0, 2.0, 3.0])
    reference, turned = (
        PoseTrajectory3D(t.position.copy(), t.orientation.copy(), t.time) for t in (truth, yaw_only)
    )
    write_tum(tmp_path / "estimate.txt", estimate)
    other = file_interface.read_tum_trajectory_file(tmp_path / "estimate.txt")

    def rmse(metric, path):
        metric.process_data((reference, path))
        return pytest.approx(metric.get_statistic(evo.StatisticsType.rmse), rel=1e-8)

    part = evo.PoseRelation.translation_part
    assert metrics.ate(estimate.position, truth.position) == rmse(evo.APE(part), other)
    for seconds in (1.0, 10.0):
        rows = round(seconds / STEP)
        rpe = evo.RPE(part, delta=rows, delta_unit=evo.Unit.frames, all_pairs=True)
        assert metrics.rpe(estimate, truth, STEP, seconds, full=True) == rmse(rpe, other)
    assert metrics.rpe(yaw_only, truth, STEP, 10.0) == rmse(rpe, turned)
    other.align(reference)
    aligned = align(estimate, truth, "se3").position
    assert metrics.ate(aligned, truth.position) == rmse(evo.APE(part), other)
