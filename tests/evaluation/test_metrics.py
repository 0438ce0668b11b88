"""Metrics against hand-computed values, plain loops, SciPy and (where installed) evo."""

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.metrics import Trajectory, Undefined

STEP = 0.1


def quaternions(rotation):
    return np.roll(rotation.as_quat(), 1, axis=-1)


def walk(seed=0, n=900, tilt=0.0):
    """A wandering path at about 1.2 m/s whose yaw follows it, with a stop in the middle."""
    random = np.random.default_rng(seed)
    heading = np.cumsum(random.normal(0, 0.08, n))
    speed = np.where(
        (np.arange(n) > 400) & (np.arange(n) < 480), 0.0, 1.2 + 0.2 * np.sin(np.arange(n) * 0.3)
    )
    steps = (
        np.stack(
            [speed * np.cos(heading), speed * np.sin(heading), 0.1 * np.sin(np.arange(n) * 0.05)], 1
        )
        * STEP
    )
    angles = np.stack(
        [heading, tilt * np.sin(np.arange(n) * 0.07), tilt * np.cos(np.arange(n) * 0.11)], 1
    )
    return Trajectory(
        np.arange(n) * STEP + 5.0,
        np.cumsum(steps, 0),
        quaternions(Rotation.from_euler("ZYX", angles)),
    )


def perturbed(truth, seed=1, scale=0.05):
    random = np.random.default_rng(seed)
    n = len(truth.time)
    turn = Rotation.from_rotvec(np.cumsum(random.normal(0, 0.004, (n, 3)), 0))
    moved = truth.position + np.cumsum(random.normal(0, scale, (n, 3)), 0)
    return Trajectory(
        truth.time, moved, quaternions(turn * Rotation.from_quat(np.roll(truth.orientation, -1, 1)))
    )


def moved_by(trajectory, rotation, shift):
    return Trajectory(
        trajectory.time,
        rotation.apply(trajectory.position) + shift,
        quaternions(rotation * Rotation.from_quat(np.roll(trajectory.orientation, -1, 1))),
    )


def masked(trajectory, rows):
    position = trajectory.position.copy()
    position[rows] = np.nan
    return trajectory._replace(position=position)


# Absolute errors


def test_constant_offset():
    truth = walk().position
    estimate = truth + np.array([3.0, 4.0, 12.0])
    assert metrics.ate(estimate, truth) == pytest.approx(13.0)
    assert metrics.ate(estimate[:, :2], truth[:, :2]) == pytest.approx(5.0)
    assert metrics.ate_mean(estimate, truth) == pytest.approx(13.0)
    assert metrics.ate_ronin(estimate, truth) == pytest.approx(13.0 / np.sqrt(3))
    assert metrics.ate_ronin(estimate[:, :2], truth[:, :2]) == pytest.approx(5.0 / np.sqrt(2))
    assert metrics.rte(estimate, truth, STEP) == pytest.approx(0.0, abs=1e-12)


def test_ate_is_not_ate_mean():
    truth = np.zeros((2, 3))
    estimate = np.array([[0.0, 0, 0], [2.0, 0, 0]])
    assert metrics.ate(estimate, truth) == pytest.approx(np.sqrt(2))
    assert metrics.ate_mean(estimate, truth) == pytest.approx(1.0)


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
    assert a == b and not a.undefined


def test_drift():
    truth = np.zeros((101, 3))
    truth[:, 0] = np.arange(101) * STEP * 2
    estimate = truth * [1.05, 1, 1]
    assert metrics.drift(estimate, truth, STEP) == pytest.approx(5.0)
    with pytest.raises(Undefined, match="under 1 m"):
        metrics.drift(estimate * 0.01, truth * 0.01, STEP)


# Relative errors


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
    flat = metrics.rte(estimate[:, :2], reference[:, :2], STEP)
    assert metrics.rte_ronin(estimate[:, :2], reference[:, :2], STEP) == pytest.approx(
        flat / np.sqrt(2)
    )


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


# Alignment


def test_origin_undoes_a_yaw_and_a_shift():
    truth = walk(tilt=0.3)
    estimate = moved_by(truth, Rotation.from_euler("z", -2.0), [5.0, -3.0, 1.0])
    aligned = metrics.align(estimate, masked(truth, slice(0, 7)), "origin")
    np.testing.assert_allclose(aligned.position, truth.position, atol=1e-9)
    np.testing.assert_allclose(
        metrics.rotation_matrices(aligned.orientation),
        metrics.rotation_matrices(truth.orientation),
        atol=1e-9,
    )
    assert metrics.align(estimate, truth, "none") is estimate


def test_se3_against_scipy():
    truth = walk(tilt=0.3)
    estimate = moved_by(perturbed(truth), Rotation.from_rotvec([0.4, -0.9, 1.7]), [5.0, -3.0, 1.0])
    a, b = estimate.position - estimate.position.mean(0), truth.position - truth.position.mean(0)
    best, _ = Rotation.align_vectors(b, a)
    np.testing.assert_allclose(
        metrics.align(estimate, truth, "se3").position,
        best.apply(a) + truth.position.mean(0),
        atol=1e-8,
    )


def test_se3_never_mirrors():
    random = np.random.default_rng(4)
    truth = walk()._replace(position=random.normal(size=(900, 3)))
    estimate = truth._replace(position=truth.position * [1, 1, -1])
    a, b = estimate.position - estimate.position.mean(0), truth.position - truth.position.mean(0)
    best, _ = Rotation.align_vectors(b, a)
    np.testing.assert_allclose(
        metrics.align(estimate, truth, "se3").position,
        best.apply(a) + truth.position.mean(0),
        atol=1e-8,
    )


def test_yaw_position_is_the_least_over_yaw():
    truth = walk(tilt=0.3)
    estimate = moved_by(perturbed(truth), Rotation.from_euler("z", 2.5), [5.0, -3.0, 1.0])
    found = metrics.ate(metrics.align(estimate, truth, "yaw_position").position, truth.position)
    centred, target = (
        estimate.position - estimate.position.mean(0),
        truth.position - truth.position.mean(0),
    )
    costs = [
        metrics.ate(Rotation.from_euler("z", angle).apply(centred), target)
        for angle in np.linspace(-np.pi, np.pi, 3001)
    ]
    assert found == pytest.approx(min(costs), rel=1e-3) and found <= min(costs) + 1e-12
    assert metrics.ate(metrics.align(estimate, truth, "se3").position, truth.position) <= found


# Heading


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


def test_a_reference_without_orientation_is_no_divergence():
    """Its rows count where no attitude is needed; the first that has one aligns the estimate."""
    truth = walk()
    reference = truth._replace(orientation=truth.orientation.copy())
    reference.orientation[:50] = np.nan
    estimate = moved_by(truth, Rotation.from_euler("z", 1.0), [5.0, -3.0, 1.0])
    found = metrics.measure(estimate, reference)
    assert not found.undefined
    for name in ("ate", "rpe_10s", "rpe_se3", "yaw_rmse"):
        assert found.values[name] == pytest.approx(0, abs=1e-6)
    broken = estimate._replace(orientation=estimate.orientation.copy())
    broken.orientation[-50:] = np.nan  # of the estimate it is
    for value in (
        metrics.yaw_rmse(broken.orientation, reference.orientation),
        metrics.rpe(broken, reference, STEP, 1.0),
    ):
        assert np.isnan(value)


PITCHES = [0, 45, 84, 90]


def pitched(pitch, n=900):
    """A walk whose phone is held at a constant pitch (°), its body x axis vertical at 90."""
    path = walk(n=n)
    held = Rotation.from_euler("y", pitch, degrees=True)
    heading = Rotation.from_quat(np.roll(path.orientation, -1, 1))
    return path._replace(orientation=quaternions(heading * held))


@pytest.mark.parametrize("pitch", PITCHES)
def test_yaw_of_a_tilted_phone_is_the_turn_about_the_vertical(pitch):
    """Against SciPy's minimum of ‖R̂ − R_z(ψ) R‖, with half a degree of tilt error too."""
    random = np.random.default_rng(pitch)
    headings = random.uniform(-3, 3, 12)
    truth = Rotation.from_euler("ZY", np.column_stack([headings, np.full(12, np.radians(pitch))]))
    yaws = np.concatenate([random.uniform(-3, 3, 10), [0.0, np.pi]])
    tilt = Rotation.from_rotvec(np.column_stack([random.normal(0, 0.01, (12, 2)), np.zeros(12)]))
    estimate = Rotation.from_euler("z", yaws[:, None]) * tilt * truth

    def nearest(r_hat, r):
        def cost(angle):
            return np.linalg.norm(r_hat - Rotation.from_euler("z", angle).as_matrix() @ r) ** 2

        start = min(np.linspace(-np.pi, np.pi, 73), key=cost)
        return minimize_scalar(cost, (start - 0.1, start, start + 0.1), tol=1e-9).x

    pairs = zip(estimate.as_matrix(), truth.as_matrix(), strict=True)
    expected = [nearest(*pair) for pair in pairs]
    found = metrics.relative_yaw(quaternions(estimate), quaternions(truth))
    assert np.abs(found).max() <= np.pi
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * np.array(expected)), atol=1e-6)
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * yaws), atol=1e-12)


def test_yaw_of_level_phones_is_the_difference_of_their_yaws():
    angles = np.random.default_rng(0).uniform(-np.pi, np.pi, (2, 50))
    level = (quaternions(Rotation.from_euler("z", of_one[:, None])) for of_one in angles)
    found = metrics.relative_yaw(*level)
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * (angles[0] - angles[1])), atol=1e-12)


def test_yaw_is_finite_where_it_has_no_value():
    """Half a turn about a horizontal axis: no yaw is nearer than another. NaN stays NaN."""
    level, over = np.array([[1.0, 0, 0, 0]]), np.array([[0.0, np.sqrt(0.5), np.sqrt(0.5), 0]])
    np.testing.assert_array_equal(metrics.relative_yaw(over, level), 0.0)
    assert np.isnan(metrics.relative_yaw(level, level * np.nan)).all()


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
    found = metrics.measure(estimate, truth, position_covariance=covariance).values
    for name in ("rpe_10s", "ate", "nees"):
        assert found[name] == pytest.approx(0, abs=1e-9)
    assert found["yaw_rmse"] == pytest.approx(0, abs=1e-6)


# Movement


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
    brief = np.zeros((40, 3))
    brief[:, 0] = np.r_[np.arange(12), np.full(15, 11), np.arange(11, 24)] * STEP  # still for 1.5 s
    assert not metrics.standing(brief, STEP).any()


# Consistency


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


def test_nees_does_not_depend_on_the_frame():
    truth = walk()
    random = np.random.default_rng(3)
    covariance = np.broadcast_to(np.diag([4.0, 1.0, 0.25]), (900, 3, 3))
    error = random.normal(size=(900, 3)) * [2.0, 1.0, 0.5]
    error[0] = 0
    estimate = truth._replace(position=truth.position + error)
    straight = metrics.measure(estimate, truth, position_covariance=covariance).values
    turned = moved_by(truth, Rotation.from_euler("z", 1.0), [1.0, 2.0, 3.0])
    elsewhere = metrics.measure(estimate, turned, position_covariance=covariance).values
    for name in ("nees", "nees_2d", "nees_coverage", "nees_coverage_2d"):
        assert straight[name] == pytest.approx(elsewhere[name])
    assert straight["nees"] == pytest.approx(np.mean(np.sum((error / [2.0, 1.0, 0.5]) ** 2, 1)) / 3)


# All of them


def test_measure_names_and_reasons():
    truth = walk()
    found = metrics.measure(perturbed(truth), truth, nis=np.array([np.nan, 3.0, 3.0]))
    assert not found.undefined
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
        "nis",
        "nis_coverage",
        "duration",
        "path_length",
    } <= found.values.keys()
    assert found.values["nis"] == pytest.approx(1.0) and found.values["duration"] == pytest.approx(
        89.9
    )
    without = metrics.measure(truth, masked(truth, slice(None)))
    assert without.values["ate"] is None and without.undefined["ate"] == "no trusted reference"
    assert without.values["duration"] == pytest.approx(89.9)
    short = metrics.measure(*(Trajectory(*(field[:5] for field in truth)) for _ in range(2)))
    assert (
        short.values["ate"] == 0.0
        and short.values["rpe_1s"] is None
        and "1 s" in short.undefined["rpe_1s"]
    )
    broken = truth._replace(position=truth.position.copy())
    broken.position[100:] = np.nan
    assert (
        metrics.measure(broken, truth).undefined["rpe_1s"]
        == "the estimate is not finite from 10.0 s on"
    )


def lost(trajectory, row):
    """The trajectory, not finite from a row on."""
    there = np.arange(len(trajectory.time))[:, None] < row
    return Trajectory(trajectory.time, *(np.where(there, part, np.nan) for part in trajectory[1:]))


def test_a_diverged_estimate_has_infinite_errors():
    truth = walk()
    covariance = np.broadcast_to(np.eye(3), (900, 3, 3))
    arguments = {"position_covariance": covariance, "nis": np.full(900, 3.0)}
    estimate = perturbed(truth)
    whole = metrics.measure(estimate, truth, **arguments)
    broken = metrics.measure(lost(estimate, 500), truth, **arguments)
    given = {"duration", "path_length"}
    coverages = {"nees_coverage", "nees_coverage_2d", "nis_coverage"}
    assert broken.values.keys() == whole.values.keys() and not whole.undefined
    infinite = {name for name, value in broken.values.items() if value == np.inf}
    assert infinite == whole.values.keys() - given - coverages
    assert all(broken.values[name] == 0 for name in coverages)
    assert all(broken.values[name] == whole.values[name] for name in given)
    assert set(broken.undefined.values()) == {"the estimate is not finite from 50.0 s on"}
    assert metrics.is_infinite(broken.undefined["ate"])
    far = estimate._replace(position=np.full((900, 3), 1e300))
    far.position[0] = 0
    found = metrics.measure(far, truth)
    assert found.values["ate"] == np.inf and metrics.is_infinite(found.undefined["ate"])


def test_what_is_not_defined_has_not_diverged():
    """Without a reference, too short or never standing there is no error that could be infinite."""
    truth = walk()
    blind = metrics.measure(lost(truth, 500), masked(truth, slice(None)))
    assert blind.values["ate"] is None and blind.undefined["ate"] == "no trusted reference"
    pair = (Trajectory(*(part[:5] for part in path)) for path in (lost(truth, 3), truth))
    short = metrics.measure(*pair)
    assert short.values["ate"] == np.inf and short.values["rpe_1s"] is None
    assert not metrics.is_infinite(short.undefined["rpe_1s"])


def test_a_covariance_that_is_not_finite_is_no_consistent_one():
    truth = walk()
    covariance = np.broadcast_to(np.eye(3), (900, 3, 3)).copy()
    covariance[100:] = np.nan
    found = metrics.measure(perturbed(truth, scale=0), truth, position_covariance=covariance).values
    assert found["nees"] == np.inf and found["nees_coverage"] == pytest.approx(100 / 9)
    assert np.isfinite(found["ate"])


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
    found = metrics.measure(estimate, truth, position_covariance=covariance).values
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


@pytest.mark.parametrize("how", ["origin", "yaw_position", "se3"])
def test_alignment_sees_finite_rows_alone(how):
    truth = walk(tilt=0.3)
    estimate = moved_by(truth, Rotation.from_euler("z", 1.2), [5.0, -3.0, 1.0])
    found = metrics.align(lost(estimate, 500), truth, how)
    np.testing.assert_allclose(found.position[:500], truth.position[:500], atol=1e-9)
    assert np.isnan(found.position[500:]).all()
    with pytest.raises(Undefined, match="not finite in any trusted row"):
        metrics.align(lost(estimate, 500), masked(truth, slice(0, 500)), how)


def test_divergence_never_improves_a_summary():
    """The worst of six errors diverge: the mean is of the others and counts them, the median gets
    no smaller, and is infinite with half."""
    errors = [1.0, 2.0, 3.0, 4.0, 5.0, 60.0]
    names = [f"{group}{k}" for group in "ab" for k in range(3)]
    summaries = []
    for bad in (0, 1, 3, 6):
        values = errors[: 6 - bad] + [np.inf] * bad
        measures = {
            name: {"ate": value, "rte": None} for name, value in zip(names, values, strict=True)
        }
        summaries.append(metrics.summarise(measures, {name: name[0] for name in names}))
    assert [s.diverged for s in summaries] == [{"ate": n, "rte": 0} for n in (0, 1, 3, 6)]
    assert [s.count["ate"] for s in summaries] == [6, 5, 3, 0]
    assert [s.median["ate"] for s in summaries] == [3.5, 3.5, np.inf, np.inf]
    assert [s.mean["ate"] for s in summaries] == [12.5, 3.0, 2.0, None]
    assert summaries[1].interval["ate"] == pytest.approx((2.0, 4.5))
    assert [s.interval["ate"] for s in summaries[2:]] == [None, None]  # one group is left, or none


def test_divergence_is_of_the_sequence_and_leaves_every_mean():
    """Of four: whole, lost, whole with a bad covariance, without a reference and lost."""
    fields = ("ate", "nees", "nees_coverage", "accepted", "path_length")
    rows = {
        "a": (1.0, 2.0, 90.0, 80.0, 10.0),
        "b": (np.inf, np.inf, 0.0, 5.0, 500.0),
        "c": (3.0, np.inf, 0.0, 70.0, 20.0),
    }
    measures = {name: dict(zip(fields, row, strict=True)) for name, row in rows.items()}
    measures["d"] = {"ate": None, "nis": np.inf, "accepted": 3.0}
    assert [name for name, values in measures.items() if metrics.diverged(values)] == ["b", "d"]
    summary = metrics.summarise(measures, {name: name for name in measures})
    means = {
        "ate": 2.0,
        "nees": np.inf,
        "nees_coverage": 45.0,
        "accepted": 75.0,
        "path_length": 15.0,
    }
    assert summary.mean == means | {"nis": None}
    assert summary.count == dict.fromkeys(fields, 2) | {"nis": 0}
    assert summary.diverged == dict.fromkeys(fields, 1) | {"nis": 1, "accepted": 2}
    assert summary.interval["nees"] is None and summary.interval["accepted"] == (70, 80)
    assert summary.median["ate"] == 3.0 and summary.median["nees"] == np.inf


def test_bootstrap_draws_groups_whatever_their_order():
    values = np.array([1.0, 5.0, 1.2, 5.2])
    assert metrics.bootstrap(values, ["x", "y", "x", "y"]) == pytest.approx((1.1, 5.1))
    assert metrics.bootstrap(values, ["x"] * 4) is None
    assert metrics.bootstrap(values[:0], []) is None


def test_summary_draws_whole_groups():
    measures = {
        f"{group}{k}": {"ate": value + 0.001 * k, "rte": None}
        for group, value in [("a", 1.0), ("b", 3.0)]
        for k in range(5)
    }
    groups = {name: name[0] for name in measures}
    summary = metrics.summarise(measures, groups)
    assert summary.mean["ate"] == pytest.approx(2.002) and summary.median["ate"] == pytest.approx(
        2.002
    )
    assert summary.interval["ate"] == pytest.approx(
        (1.002, 3.002)
    )  # with two groups a draw is all a, all b or one of each
    assert (
        summary.count == {"ate": 10, "rte": 0}
        and summary.mean["rte"] is None
        and summary.interval["rte"] is None
    )
    assert metrics.summarise(measures, dict.fromkeys(measures, "one")).interval["ate"] is None
    assert metrics.summarise(measures, groups) == summary


def test_summary_interval_covers_the_mean():
    random = np.random.default_rng(0)
    hits = 0
    for trial in range(60):
        values = random.normal(5.0, 1.0, 25)
        measures, groups = (
            {str(k): {"ate": v} for k, v in enumerate(values)},
            {str(k): k for k in range(25)},
        )
        low, high = metrics.summarise(measures, groups, trial, 400).interval["ate"]
        hits += low <= 5.0 <= high
    assert hits >= 50


# evo


def test_agreement_with_evo():
    pytest.importorskip("evo.core.metrics")
    from evo.core import metrics as evo
    from evo.core.trajectory import PoseTrajectory3D

    truth = walk(tilt=0.3)
    estimate = moved_by(perturbed(truth), Rotation.from_rotvec([0.1, -0.2, 0.7]), [5.0, -3.0, 1.0])
    paths = [
        PoseTrajectory3D(t.position.copy(), t.orientation.copy(), t.time) for t in (truth, estimate)
    ]

    def ape(reference, other):
        metric = evo.APE(evo.PoseRelation.translation_part)
        metric.process_data((reference, other))
        return metric.get_statistic(evo.StatisticsType.rmse)

    assert metrics.ate(estimate.position, truth.position) == pytest.approx(ape(*paths), rel=1e-9)
    for seconds in (1.0, 10.0):
        metric = evo.RPE(
            evo.PoseRelation.translation_part,
            delta=round(seconds / STEP),
            delta_unit=evo.Unit.frames,
            all_pairs=True,
        )
        metric.process_data(tuple(paths))
        assert metrics.rpe_se3(estimate, truth, STEP, seconds) == pytest.approx(
            metric.get_statistic(evo.StatisticsType.rmse), rel=1e-9
        )
    yaw_only = moved_by(
        perturbed(truth)._replace(orientation=truth.orientation),
        Rotation.from_euler("z", 1.0),
        [1.0, 2.0, 3.0],
    )
    metric.process_data(
        (
            paths[0],
            PoseTrajectory3D(yaw_only.position.copy(), yaw_only.orientation.copy(), yaw_only.time),
        )
    )
    ours = metrics.rpe(yaw_only, truth, STEP, 10.0)
    assert ours == pytest.approx(metric.get_statistic(evo.StatisticsType.rmse), rel=1e-9)
    paths[1].align(paths[0])
    assert metrics.ate(
        metrics.align(estimate, truth, "se3").position, truth.position
    ) == pytest.approx(ape(*paths), rel=1e-9)
