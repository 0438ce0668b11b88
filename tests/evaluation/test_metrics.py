"""Each metric against values by hand, plain loops and drawn errors; and all of a sequence: names,
reasons, divergence."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.metrics import Filtered
from gnio_jax.evaluation.trajectory import Trajectory, Undefined
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


def filtered(covariance, nis=np.nan, accepted=1.0):
    rows = len(covariance)
    return Filtered(covariance, np.full(rows, nis), np.full(rows, accepted))


def test_constant_offset():
    path = walk()
    truth = path.position
    estimate = truth + np.array([3.0, 4.0, 12.0])
    assert metrics.ate(estimate, truth) == pytest.approx(13.0)
    assert metrics.ate(estimate[:, :2], truth[:, :2]) == pytest.approx(5.0)
    assert metrics.ate_mean(estimate, truth) == pytest.approx(13.0)
    found = metrics.measure(path._replace(position=estimate), path, "none").values
    assert found["ate_ronin"] == pytest.approx(13.0 / np.sqrt(3))
    assert found["ate_ronin_2d"] == pytest.approx(5.0 / np.sqrt(2))
    assert metrics.rte(estimate, truth, STEP) == pytest.approx(0.0, abs=1e-12)


def test_ate_is_not_ate_mean():
    truth = np.zeros((2, 3))
    estimate = np.array([[0.0, 0, 0], [2.0, 0, 0]])
    assert metrics.ate(estimate, truth) == pytest.approx(np.sqrt(2))
    assert metrics.ate_mean(estimate, truth) == pytest.approx(1.0)


def test_drift():
    truth = np.zeros((101, 3))
    truth[:, 0] = np.arange(101) * STEP * 2
    estimate = truth * [1.05, 1, 1]
    assert metrics.drift(estimate, truth, STEP) == pytest.approx(5.0)
    with pytest.raises(Undefined, match="under 1 m"):
        metrics.drift(estimate * 0.01, truth * 0.01, STEP)
    holed = truth.copy()
    holed[20:80] = np.nan  # the estimate goes wrong there too
    assert metrics.drift(estimate, holed, STEP) == pytest.approx(5.0)


def test_rte_against_a_loop_and_with_a_gap():
    truth, apart = walk(), 600
    estimate = perturbed(truth).position
    reference = masked(truth, slice(620, 640)).position
    errors = []
    for i in range(len(truth.time) - apart):
        j = i + apart
        if np.isfinite(reference[i]).all() and np.isfinite(reference[j]).all():
            errors.append(np.sum((estimate[j] - estimate[i] - reference[j] + reference[i]) ** 2))
    assert len(errors) == 280
    assert metrics.rte(estimate, reference, STEP) == pytest.approx(
        np.sqrt(np.mean(errors)), rel=1e-12
    )
    found = metrics.measure(perturbed(truth), masked(truth, slice(620, 640)), "none").values
    assert found["rte_60s"] == pytest.approx(np.sqrt(np.mean(errors)), rel=1e-12)
    assert found["rte_60s_ronin_2d"] == pytest.approx(found["rte_60s_2d"] / np.sqrt(2))


def test_rte_of_a_short_sequence_is_scaled():
    truth = np.zeros((301, 3))
    estimate = np.zeros((301, 3))
    estimate[:, 0] = np.linspace(0, 2.0, 301)  # 2 m in 30 s
    assert metrics.rte(estimate, truth, STEP) == pytest.approx(4.0)
    with pytest.raises(Undefined, match="single"):
        metrics.rte(estimate[:1], truth[:1], STEP)


@pytest.mark.parametrize("metres", [1.0, 10.0])
def test_rte_distance_against_a_loop(metres):
    truth = walk().position[:, :2]
    estimate = perturbed(walk()).position[:, :2]
    reference = truth.copy()
    reference[300] = np.nan
    errors = []
    for start, stop in [(0, 300), (301, 900)]:
        for i in range(start, stop):
            walked, j = 0.0, i
            while j + 1 < stop and walked < metres - 1e-9:
                walked += np.linalg.norm(truth[j + 1] - truth[j])
                j += 1
            if walked >= metres - 1e-9:
                errors.append(np.sum((estimate[j] - estimate[i] - truth[j] + truth[i]) ** 2))
    assert metrics.rte_distance(estimate, reference, metres) == pytest.approx(
        np.sqrt(np.mean(errors)), rel=1e-9
    )


def test_rte_distance_of_a_scaled_line():
    truth = np.zeros((501, 2))
    truth[:, 0] = np.arange(501) * 0.125
    assert metrics.rte_distance(truth * 1.1, truth, 1.0) == pytest.approx(0.1)
    assert metrics.rte_distance(truth * 1.1, truth, 10.0) == pytest.approx(1.0)
    with pytest.raises(Undefined, match="100 m"):
        metrics.rte_distance(truth, truth, 100.0)


def test_rpe_forgives_a_wrong_heading_and_rte_does_not():
    truth = walk(tilt=0.3)
    estimate = moved_by(truth, Rotation.from_euler("z", 1.2), [5.0, -3.0, 1.0])
    assert metrics.rpe(estimate, truth, STEP, 1.0) == pytest.approx(0.0, abs=1e-12)
    assert metrics.rpe(estimate, truth, STEP, 10.0, dims=2) == pytest.approx(0.0, abs=1e-11)
    assert metrics.rpe_se3(estimate, truth, STEP) == pytest.approx(0.0, abs=1e-12)
    assert metrics.rte(estimate.position, truth.position, STEP, 10.0) > 1.0


@pytest.mark.parametrize("seconds", [1.0, 10.0])
def test_rpe_against_a_loop(seconds):
    truth = walk(tilt=0.3)
    estimate = perturbed(truth)
    apart, errors, errors_2d, errors_se3 = round(seconds / STEP), [], [], []
    turns, turns_true = (
        Rotation.from_quat(np.roll(t.orientation, -1, 1)) for t in (estimate, truth)
    )
    for i in range(len(truth.time) - apart):
        between = turns[i] * turns_true[i].inv()
        _, _, z, w = between.as_quat()
        angle = -2 * np.arctan(z / w)  # the twist about z, turned back
        moved, moved_true = (
            estimate.position[i + apart] - estimate.position[i],
            truth.position[i + apart] - truth.position[i],
        )
        error = Rotation.from_euler("z", angle).apply(moved) - moved_true
        errors.append(np.sum(error**2))
        errors_2d.append(np.sum(error[:2] ** 2))
        errors_se3.append(
            np.sum((turns[i].inv().apply(moved) - turns_true[i].inv().apply(moved_true)) ** 2)
        )
    for dims, squares in ((3, errors), (2, errors_2d)):
        found = metrics.rpe(estimate, truth, STEP, seconds, dims)
        assert found == pytest.approx(np.sqrt(np.mean(squares)), rel=1e-9)
    assert metrics.rpe_se3(estimate, truth, STEP, seconds) == pytest.approx(
        np.sqrt(np.mean(errors_se3)), rel=1e-9
    )


def test_path_length_of_a_scaled_circle():
    angle = np.linspace(0, 2 * np.pi, 1201)
    circle = 10 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)  # 62.8 m in 120 s
    assert metrics.path_length(circle, STEP) == pytest.approx(
        120 * 20 * np.sin(np.pi / 120), rel=1e-12
    )
    assert metrics.path_length_ratio(circle * 0.8, circle, STEP) == pytest.approx(0.8)
    assert metrics.path_length_ratio(circle * 0, circle, STEP) == 0.0
    holes = circle.copy()
    holes[300:400] = np.nan
    assert metrics.path_length_ratio(circle * 0.8, holes, STEP) == pytest.approx(0.8)


def test_path_length_is_hardly_inflated_by_noise():
    truth = np.zeros((1201, 3))
    truth[:, 0] = np.arange(1201) * STEP
    noisy = truth + np.random.default_rng(0).normal(0, 0.02, truth.shape)
    assert metrics.path_length(truth[:996], STEP) == pytest.approx(
        99.5
    )  # the odd rows at the end count too
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
    moving = truth[401:700]
    with pytest.raises(Undefined, match="never stands"):
        metrics.stationary_drift(moving, moving, STEP)
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
    with pytest.raises(Undefined, match="10 s"):
        metrics.yaw_drift(truth[:50], truth[:50], STEP)


@pytest.mark.parametrize("pitch", PITCHES)
def test_a_little_tilt_is_no_yaw_error(pitch):
    """0.1° of noise about both horizontal axes on a perfect path, on whose phone the body's x axis
    may be vertical."""
    truth = pitched(pitch)
    noise = np.zeros((900, 3))
    noise[:, :2] = np.random.default_rng(1).normal(0, np.radians(0.1), (900, 2))
    turn = Rotation.from_rotvec(noise) * Rotation.from_quat(np.roll(truth.orientation, -1, 1))
    found = metrics.measure(truth._replace(orientation=quaternions(turn)), truth).values
    assert found["yaw_rmse"] < 0.01 and found["yaw_drift"] < 1.0
    assert found["rpe_1s"] < 1e-4 and found["rpe_10s"] < 1e-3 and found["ate"] < 1e-3


@pytest.mark.parametrize("pitch", PITCHES)
def test_a_wrong_heading_of_a_tilted_phone_is_measured_and_undone(pitch):
    truth = pitched(pitch)
    turn = Rotation.from_euler("z", 40, degrees=True)
    estimate = moved_by(truth, turn, [5.0, -3.0, 1.0])
    assert metrics.measure(estimate, truth, "none").values["yaw_rmse"] == pytest.approx(40.0)
    covariance = np.broadcast_to(np.eye(3), (900, 3, 3))
    found = metrics.measure(estimate, truth, filtered=filtered(covariance)).values
    for name in ("rpe_10s", "ate", "nees"):
        assert found[name] == pytest.approx(0, abs=1e-9)
    assert found["yaw_rmse"] == pytest.approx(0, abs=1e-6)


def test_nees_of_a_consistent_filter():
    random = np.random.default_rng(0)
    root = random.normal(size=(20000, 3, 3))
    covariance = np.einsum("nij,nkj->nik", root, root) + 0.1 * np.eye(3)
    error = np.einsum("nij,nj->ni", np.linalg.cholesky(covariance), random.normal(size=(20000, 3)))
    squared = metrics.normalised_squared(error, covariance)
    assert squared[7] == pytest.approx(error[7] @ np.linalg.inv(covariance[7]) @ error[7])
    assert metrics.mean_normalised(squared, 3) == pytest.approx(1.0, abs=0.03)
    assert metrics.coverage(squared, 3) == pytest.approx(95, abs=0.7)
    assert metrics.mean_normalised(4 * squared, 3) == pytest.approx(4.0, abs=0.1)
    assert metrics.coverage(np.array([1.0, np.nan, 7.8, 7.9]), 3) == pytest.approx(200 / 3)
    assert metrics.coverage(np.array([5.98, 6.0]), 2) == 50  # of 95 % with two degrees of freedom


def test_nees_does_not_depend_on_the_frame():
    truth = walk()
    random = np.random.default_rng(3)
    covariance = np.broadcast_to(np.diag([4.0, 1.0, 0.25]), (900, 3, 3))
    error = random.normal(size=(900, 3)) * [2.0, 1.0, 0.5]
    error[0] = 0
    estimate = truth._replace(position=truth.position + error)
    straight = metrics.measure(estimate, truth, filtered=filtered(covariance)).values
    turned = moved_by(truth, Rotation.from_euler("z", 1.0), [1.0, 2.0, 3.0])
    elsewhere = metrics.measure(estimate, turned, filtered=filtered(covariance)).values
    for name in ("nees", "nees_2d", "nees_coverage", "nees_coverage_2d"):
        assert straight[name] == pytest.approx(elsewhere[name])
    assert straight["nees"] == pytest.approx(np.mean(np.sum((error / [2.0, 1.0, 0.5]) ** 2, 1)) / 3)


def test_a_covariance_that_is_not_finite_is_no_consistent_one():
    truth = walk()
    covariance = np.broadcast_to(np.eye(3), (900, 3, 3)).copy()
    covariance[100:] = np.nan
    measures = metrics.measure(perturbed(truth, scale=0), truth, filtered=filtered(covariance))
    found = measures.values
    assert found["nees"] == np.inf and found["nees_coverage"] == pytest.approx(100 / 9)
    assert np.isfinite(found["ate"]) and not measures.diverged
    reason = "the filter's covariance is not positive definite"
    assert measures.reasons["nees"] == measures.reasons["nees_2d"] == reason


@pytest.mark.parametrize("row", [150, 900])  # lost in the middle, or whole
@pytest.mark.parametrize(
    "bad",
    [
        np.full((3, 3), 1e30),
        np.eye(3) + 1e40 * np.outer([1, 2, 3], [1, 2, 3]),
        np.diag([1.0, -1.0, 1.0]),
        [[1, 2, 0], [2, 1, 0], [0, 0, 1]],
    ],
)
def test_a_singular_or_indefinite_covariance_is_no_consistent_one(bad, row):
    truth = walk()
    covariance = np.broadcast_to(np.eye(3), (900, 3, 3)).copy()
    covariance[150:] = bad
    estimate = lost(perturbed(truth, scale=0), row)
    found = metrics.measure(estimate, truth, filtered=filtered(covariance)).values
    share = pytest.approx(100 / 6) if row == 900 else 0
    for tag in ("", "_2d"):
        assert found[f"nees{tag}"] == np.inf and found[f"nees_coverage{tag}"] == share


def test_normalised_errors_against_the_inverse_whatever_the_units():
    random = np.random.default_rng(4)
    root, error = random.normal(size=(50, 3, 3)), random.normal(size=(50, 3))
    unit = np.array([1e-9, 1.0, 1e9])
    covariance = root @ root.transpose(0, 2, 1) + 0.1 * np.eye(3)
    expected = [e @ np.linalg.inv(p) @ e for e, p in zip(error, covariance, strict=True)]
    found = metrics.normalised_squared(unit * error, unit[:, None] * covariance * unit)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


def test_untrusted_rows_count_nowhere():
    truth = walk()
    estimate = perturbed(truth)
    wrong = estimate._replace(position=estimate.position.copy())
    wrong.position[100:150] += 1e3
    reference = masked(truth, slice(100, 150))
    kept = np.r_[0:100, 150:900]
    assert metrics.ate(wrong.position, reference.position) == pytest.approx(
        metrics.ate(estimate.position[kept], truth.position[kept])
    )
    a, b = metrics.measure(wrong, reference), metrics.measure(estimate, reference)
    assert a == b and not a.reasons


def test_a_reference_without_orientation_is_no_divergence():
    """Its rows count where no attitude is needed; the first that has one aligns the estimate."""
    truth = walk()
    reference = truth._replace(orientation=truth.orientation.copy())
    reference.orientation[:50] = np.nan
    estimate = moved_by(truth, Rotation.from_euler("z", 1.0), [5.0, -3.0, 1.0])
    found = metrics.measure(estimate, reference)
    assert not found.reasons
    for name in ("ate", "rpe_10s", "rpe_se3", "yaw_rmse"):
        assert found.values[name] == pytest.approx(0, abs=1e-6)
    broken = estimate._replace(orientation=estimate.orientation.copy())
    broken.orientation[-50:] = np.nan  # of the estimate it is
    for value in (
        metrics.yaw_rmse(broken.orientation, reference.orientation),
        metrics.rpe(broken, reference, STEP, 1.0),
    ):
        assert np.isnan(value)


def test_measure_names_and_reasons():
    truth = walk()
    own = filtered(np.broadcast_to(np.eye(3), (900, 3, 3)), 3.0)
    own.nis[0], own.accepted[:2] = np.nan, [np.nan, 0.0]
    found = metrics.measure(perturbed(truth), truth, filtered=own)
    assert not found.reasons
    assert {
        "ate",
        "ate_2d",
        "ate_ronin_2d",
        "ate_mean",
        "rte_60s",
        "rte_60s_ronin_2d",
        "rte_1m",
        "rte_10m_2d",
        "rpe_1s",
        "rpe_10s_2d",
        "rpe_se3",
        "drift",
        "yaw_rmse",
        "yaw_drift",
        "path_length_ratio",
        "stationary_drift",
        "nees",
        "nees_coverage_2d",
        "nis",
        "nis_coverage",
        "accepted",
        "duration",
        "path_length",
    } <= found.values.keys()
    with_poses = set(metrics.NAMES) - metrics.OF_WAYPOINTS.keys()
    assert with_poses == found.values.keys() - {"duration", "path_length"}
    assert found.values["nis"] == pytest.approx(1.0) and found.values["duration"] == pytest.approx(
        89.9
    )
    assert found.values["accepted"] == pytest.approx(100 * 898 / 899)
    without = metrics.measure(truth, masked(truth, slice(None)))
    assert without.values["ate"] is None and without.reasons["ate"] == "no trusted reference"
    assert without.values["duration"] == pytest.approx(89.9)
    short = metrics.measure(*(Trajectory(*(field[:5] for field in truth)) for _ in range(2)))
    assert (
        short.values["ate"] == 0.0
        and short.values["rpe_1s"] is None
        and "1 s" in short.reasons["rpe_1s"]
    )
    broken = truth._replace(position=truth.position.copy())
    broken.position[100:] = np.nan
    assert (
        metrics.measure(broken, truth).reasons["rpe_1s"]
        == "the estimate is not finite from 10.0 s on"
    )


def test_a_diverged_estimate_has_infinite_errors():
    truth = walk()
    covariance = np.broadcast_to(np.eye(3), (900, 3, 3))
    arguments = {"filtered": filtered(covariance, 3.0)}
    estimate = perturbed(truth)
    whole = metrics.measure(estimate, truth, **arguments)
    broken = metrics.measure(lost(estimate, 500), truth, **arguments)
    given = {"duration", "path_length"}
    shares = {"nees_coverage", "nees_coverage_2d", "nis_coverage", "accepted"}
    assert broken.values.keys() == whole.values.keys() and not whole.reasons
    infinite = {name for name, value in broken.values.items() if value == np.inf}
    assert infinite == whole.values.keys() - given - shares
    assert all(broken.values[name] == 0 for name in shares)
    assert all(broken.values[name] == whole.values[name] for name in given)
    assert set(broken.reasons.values()) == {"the estimate is not finite from 50.0 s on"}
    assert broken.diverged and not whole.diverged
    far = estimate._replace(position=np.full((900, 3), 1e300))
    far.position[0] = 0
    found = metrics.measure(far, truth)
    assert found.values["ate"] == np.inf and found.reasons["ate"].startswith("the error is too")
    assert found.diverged


def test_what_is_not_defined_has_not_diverged():
    """Without a reference, too short or never standing there is no error that could be infinite."""
    truth = walk()
    blind = metrics.measure(lost(truth, 500), masked(truth, slice(None)))
    assert blind.values["ate"] is None and blind.reasons["ate"] == "no trusted reference"
    pair = (Trajectory(*(part[:5] for part in path)) for path in (lost(truth, 3), truth))
    short = metrics.measure(*pair)
    assert short.values["ate"] == np.inf and short.values["rpe_1s"] is None
    assert blind.diverged and short.diverged and "not finite" not in short.reasons["rpe_1s"]
