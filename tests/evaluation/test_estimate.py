"""Estimators against plain loops over samples and windows, and against what they must give with
perfect inputs.

The filter runs over two recordings of one length at a time: two programs serve nearly all tests.
"""

import dataclasses

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import evaluation
from gnio_jax.config.schema import TLIO_STD
from gnio_jax.evaluation import infer, metrics
from gnio_jax.evaluation.estimate import PERFECT_STD, mean_over_windows, perfect
from gnio_jax.filtering import ConsideredStd, CorrelatedError, make_filter
from tests.support.estimators import (
    CONFIG,
    NETWORK,
    OPTIONS,
    RATE,
    imu_only,
    loose,
    network,
    ready,
    relabel,
    rotations,
    sensed,
    summed,
    tight,
    unyaw,
    with_factors,
    with_truth,
    with_waypoints,
)
from tests.support.filter_settings import changed


def test_imu_only_is_strap_down_integration(walks):
    recordings = ready(walks[:2], gyro_bias="reference")
    (estimate, _), bias = imu_only(recordings), recordings[0].start.gyro_bias
    rotation = rotations(walks[0].orientation[0]).as_matrix()
    velocity, position = walks[0].velocity[0], walks[0].position[0]
    dt, gravity, path = 1 / RATE, np.array([0, 0, -9.81]), [(position, velocity, rotation)]
    for k in range(CONFIG.stride * (len(estimate.trajectory.time) - 1)):
        step = rotation @ walks[0].accel[k] * dt
        position = position + velocity * dt + 0.5 * step * dt + 0.5 * gravity * dt**2
        velocity = velocity + step + gravity * dt
        rotation = rotation @ Rotation.from_rotvec((walks[0].gyro[k] - bias) * dt).as_matrix()
        if (k + 1) % CONFIG.stride == 0:
            path.append((position, velocity, rotation))
    assert len(path) == 150
    positions, velocities, attitudes = map(np.stack, zip(*path, strict=True))
    np.testing.assert_allclose(estimate.trajectory.position, positions, atol=1e-9)
    np.testing.assert_allclose(estimate.states.velocity, velocities, atol=1e-9)
    turned = rotations(estimate.trajectory.orientation).as_matrix()
    np.testing.assert_allclose(turned, attitudes, atol=1e-10)
    rows = slice(0, len(path) * CONFIG.stride, CONFIG.stride)
    np.testing.assert_array_equal(estimate.trajectory.time, walks[0].time[rows])
    np.testing.assert_array_equal(estimate.reference.position, walks[0].position[rows])
    np.testing.assert_allclose(estimate.states.gyro_bias, np.tile(bias, (150, 1)), rtol=1e-12)
    assert not estimate.states.accel_bias.any() and np.isnan(estimate.states.innovation).all()
    variance = np.einsum("nii->ni", estimate.filtered.covariance)
    np.testing.assert_allclose(estimate.states.std[:, 6:9] ** 2, variance, rtol=1e-6)
    assert np.isnan(estimate.filtered.accepted).all() and estimate.states.std.shape == (150, 15)


def test_the_sum_of_displacements_equals_a_loop(walks):
    """The strides in the context of the first window move as that window does."""
    recordings = ready(walks[:1], orientation="reference")
    (estimate,), (predicted,) = summed(recordings), infer(NETWORK, recordings, CONFIG)
    turns = rotations(walks[0].orientation).as_matrix()
    context, last = CONFIG.context // CONFIG.stride, recordings[0].strides - 10
    position, path = walks[0].position[0], [walks[0].position[0]]
    for stride in range(recordings[0].strides):
        at = max(stride, context)
        moves = [
            unyaw(turns[i * CONFIG.stride]).T @ predicted.value[i + 9] / 10
            for i in range(max(at - 9, context), min(at, last) + 1)
        ]
        position = position + np.mean(moves, axis=0)
        path.append(position)
    np.testing.assert_allclose(estimate.trajectory.position, path, atol=1e-9)
    np.testing.assert_array_equal(estimate.displacements.value[1:], predicted.value)
    assert np.isnan(estimate.displacements.value[: 10 + context]).all()
    assert estimate.states is None and estimate.filtered is None
    (still,) = evaluation.never_moves([estimate])
    assert (still.trajectory.position == walks[0].position[0]).all()
    assert metrics.measure(still.trajectory, still.reference).values["path_length_ratio"] == 0


def test_a_stride_without_a_window_repeats_the_movement_before():
    nan = np.nan
    steps = np.array([nan, nan, 1, 1, nan, nan, nan, 2])[:, None] * np.ones(3)
    np.testing.assert_allclose(mean_over_windows(steps, 2)[:, 0], [1, 1, 1, 1, 1, 1, 1, 2, 2])


@pytest.mark.parametrize(
    "how, filtered, ate",
    [
        ({}, True, 0.03),
        ({"init": "static"}, True, 0.1),
        ({"orientation": "reference"}, False, 0.1),
        ({"orientation": "filter"}, False, 0.1),
        ({"orientation": "device"}, False, 0.3),
    ],
)
def test_perfect_displacements_leave_little_error(walks, how, filtered, ate):
    """An error of half a window in time would be 0.6 m."""
    for estimate in with_truth(ready(walks[:2], gyro_bias="reference", **how), filtered=filtered):
        values = metrics.measure(estimate.trajectory, estimate.reference).values
        assert values["ate"] < ate and values["path_length_ratio"] == pytest.approx(1, abs=0.06)


def test_the_filter_of_true_displacements_ignores_the_calibration(walks):
    recordings = ready(walks[:2], gyro_bias="reference")
    noise = {"std_factor": (3.0, 1.0, 1.0), "measurement_scale": 40.0}
    calibrated = changed(OPTIONS, noise={**noise, "correlation": CorrelatedError()})
    estimates = (with_truth(recordings, options=options) for options in (OPTIONS, calibrated))
    for plain, calibrated_estimate in zip(*estimates, strict=True):
        np.testing.assert_array_equal(
            calibrated_estimate.trajectory.position, plain.trajectory.position
        )
        std = calibrated_estimate.displacements.std[-1]
        np.testing.assert_allclose(std, PERFECT_STD, rtol=1e-12)
    of_gyro = {"gyro_bias": 1e-3, "raw_gyro_bias": 0.02}
    considered = changed(
        calibrated, considered={**of_gyro, "scale": 0.1, "heading": 0.1, "slope": 0.1}
    )
    assert perfect(make_filter(CONFIG, considered)).considered == ConsideredStd(**of_gyro)


@pytest.mark.parametrize("apply, tolerance", [(sensed, 1e-6), (with_factors, 1e-5)])
def test_consider_covariance_widens_the_covariance_and_moves_nothing(walks, apply, tolerance):
    """The derivative of positions by the gyro bias is that of runs whose gyro differs a little and
    whose network ignores its windows. It turns with its yaw frame, because the x axis is level. The
    bias of a raw gyro is larger along the vertical at the start. Factors of the network hold in the
    derivative, too."""
    recordings = [with_level_axis(one) for one in ready(walks[:2], gyro_bias="reference")]
    raw = recordings[1].start._replace(raw_gyro=True)
    recordings = [recordings[0], recordings[1]._replace(start=raw)]
    alike = network(0.0, -2.0, log_std_gain=0.0, constant=(0.9, 0.2, 0.02))._replace(apply=apply)
    numbers = {"nonholonomic": {"lateral_std": 2.0, "vertical_std": 2.0}}
    measurements = numbers if apply is with_factors else {}
    without = dataclasses.replace(OPTIONS, measurements=measurements)

    def run(recordings, options):
        return tight(recordings, alike, options=options)

    options = changed(without, considered={"gyro_bias": 1e-3, "raw_gyro_bias": 5e-3})
    estimates = run(recordings, without), run(recordings, options)
    ahead, behind = (
        [run([with_gyro_bias(recording, off) for recording in recordings], without) for off in axes]
        for axes in (1e-5 * np.eye(3), -1e-5 * np.eye(3))
    )
    for row, (plain, considered) in enumerate(zip(*estimates, strict=True)):
        np.testing.assert_array_equal(considered.trajectory.position, plain.trajectory.position)
        moved = np.stack(
            [
                (a[row].trajectory.position - b[row].trajectory.position) / 2e-5
                for a, b in zip(ahead, behind, strict=True)
            ],
            axis=2,
        )
        variance = 1e-6 * np.eye(3)
        if row == 1:
            up = raw.rotation[2]
            variance = variance + 25e-6 * np.outer(up, up)
        added = moved @ variance @ moved.swapaxes(1, 2)
        expected = plain.filtered.covariance + added
        assert added[-1].max() > 1e-6
        covariance = considered.filtered.covariance
        np.testing.assert_allclose(covariance, expected, rtol=1e-2, atol=tolerance)
        std = np.sqrt(np.diagonal(expected, axis1=1, axis2=2))
        np.testing.assert_allclose(considered.states.std[:, 6:9], std, rtol=1e-2)
        # A constant bias exists from the start.
        at_start = np.sqrt(plain.states.std[0, 9:12] ** 2 + np.diag(variance))
        np.testing.assert_allclose(considered.states.std[0, 9:12], at_start, rtol=1e-12)


def test_the_consider_covariance_does_not_depend_on_which_axis_of_the_phone_is_vertical(walks):
    """Window, displacement and covariance turn with the frame of the x axis."""
    recordings = ready(walks[:1], gyro_bias="reference")
    other, _ = relabel(recordings[0])
    assert abs(other.start.rotation[2, 0]) > 0.8
    turning = network(0.05, -2.0, log_std_gain=0.0)
    considered = {"gyro_bias": 0.01, "scale": 0.1, "heading": 0.1}
    options = changed(OPTIONS, considered=considered)
    (estimate,), (relabelled,) = (
        tight([one], turning, options=options) for one in (recordings[0], other)
    )
    plain = tight(recordings, turning)[0].filtered.covariance
    position = estimate.trajectory.position
    np.testing.assert_allclose(relabelled.trajectory.position, position, atol=1e-3)
    expected = estimate.filtered.covariance
    added = np.abs(expected - plain).max()
    np.testing.assert_allclose(relabelled.filtered.covariance, expected, atol=2e-3 * added)


def test_the_covariance_has_the_arc_of_a_considered_yaw(walks):
    """The linear part is proportional to the variance of the bias. What twice the standard
    deviation has beyond four times as much is 9 l lᵀ, where l is the covariance of the position
    with the yaw, turned by a quarter: ¾ ((c + 4 l)² − c² − 4 (c + l)² + 4 c²), for any c of the
    filter itself."""
    recordings = ready(walks[:1], gyro_bias="reference")
    alike = network(0.0, -2.0, log_std_gain=0.0, constant=(0.9, 0.2, 0.02))

    def run(recordings, options=OPTIONS):
        return tight(recordings, alike, options=options)[0]

    size = 0.02
    plain, one, two = (
        run(recordings, changed(OPTIONS, considered={"gyro_bias": bias})).filtered.covariance
        for bias in (0.0, size, 2 * size)
    )
    with_yaw = 0.0
    for axis in np.eye(3):
        ahead, behind = (
            run([with_gyro_bias(recordings[0], off)]).trajectory
            for off in (1e-5 * axis, -1e-5 * axis)
        )
        moved = (ahead.position - behind.position) / 2e-5
        first, second = (
            Rotation.from_quat(path.orientation, scalar_first=True) for path in (ahead, behind)
        )
        turned = (first * second.inv()).as_rotvec()[:, 2] / 2e-5
        with_yaw = with_yaw + size**2 * turned[:, None] * moved
    lever = np.stack([with_yaw[:, 1], -with_yaw[:, 0], 0 * with_yaw[:, 0]], axis=1)
    expected = 9 * lever[:, :, None] * lever[:, None]
    assert expected[-1].max() > 1e-3
    excess = two - plain - 4 * (one - plain)
    np.testing.assert_allclose(excess, expected, rtol=2e-2, atol=1e-3 * expected.max())


@pytest.mark.parametrize("run", [tight, loose])
def test_variances_of_a_corrector_take_the_place_of_the_densities(walks, run):
    """A density of white noise is a variance of the samples times their interval. The recordings of
    a batch have different lengths, and the consider covariance repeats the run."""
    gyro, accel = 0.01, 0.2
    considered = changed(OPTIONS, considered={"gyro_bias": 0.01})
    denser = changed(considered, noise={"gyro_density": gyro, "accel_density": accel})
    recordings = ready([walks[0], walks[2]], orientation="reference")
    variance = RATE * np.repeat([accel**2, gyro**2], 3)
    corrected = [
        recording._replace(variance=np.tile(variance, (len(recording.gyro), 1)))
        for recording in recordings
    ]
    estimates, expected, plain = (
        run(*arguments, batch_size=2)
        for arguments in (
            (corrected, NETWORK, CONFIG, considered),
            (recordings, NETWORK, CONFIG, denser),
            (recordings, NETWORK, CONFIG, considered),
        )
    )
    for estimate, other, without in zip(estimates, expected, plain, strict=True):
        same(estimate, other, 1e-5)
        assert np.nanmax(np.abs(estimate.states.std - without.states.std)) > 0.01


def with_level_axis(recording):
    """The recording with the IMU of a phone that moves along (0.9, 0.2, 0.02) m/s in its yaw frame
    and does not roll."""
    time = np.arange(len(recording.gyro) + 1) / RATE
    yaw = 0.2 * np.sin(0.5 * time)
    turns = Rotation.from_euler("ZX", np.stack([yaw, 0.5 + 0 * time], axis=1))
    velocity = Rotation.from_euler("z", yaw[:, None]).apply([0.9, 0.2, 0.02])
    force = np.diff(velocity, axis=0) * RATE + [0.0, 0.0, 9.81]
    gyro = (turns[:-1].inv() * turns[1:]).as_rotvec() * RATE + recording.start.gyro_bias
    start = recording.start._replace(rotation=turns[0].as_matrix(), velocity=velocity[0])
    return recording._replace(gyro=gyro, accel=turns[:-1].inv().apply(force), start=start)


def with_gyro_bias(recording, off):
    start = recording.start
    return recording._replace(start=start._replace(gyro_bias=start.gyro_bias + off))


def same(a, b, tolerance):
    assert a.name == b.name
    jax.tree.map(
        lambda one, other: np.testing.assert_allclose(one, other, atol=tolerance), a[1:-1], b[1:-1]
    )


def test_batches_change_nothing(walks):
    recordings, progress = ready(walks), []
    for way, tolerance in ((tight, 1e-5), (with_truth, 1e-9)):
        pairs = way(recordings, batch_size=2, progress=progress.append)
        others = [*way(recordings[::-2]), *way(recordings[1:])]  # the third with the first, ...
        assert (
            progress == sorted(progress)
            and len(progress) == 2
            and progress.pop(1) == 1.0
            and progress.pop()
        )
        for recording, estimate in zip(recordings, pairs, strict=True):
            assert len(estimate.trajectory.time) == len(recording.time)
            for other in (other for other in others if other.name == recording.name):
                same(estimate, other, tolerance)
                np.testing.assert_allclose(
                    estimate.trajectory.position, other.trajectory.position, atol=1e-6
                )


def test_an_unhealthy_filter_has_diverged(walks):
    accel, row = walks[0].accel.copy(), 91
    accel[450] *= 1e5
    void, whole = tight(ready([walks[0]._replace(accel=accel), walks[1]]))
    assert np.isfinite(void.states.velocity).all()
    assert np.argmax(np.linalg.norm(void.states.velocity, axis=1) > 100) == row
    for field in void.trajectory[1:]:
        assert np.isfinite(field[:row]).all() and np.isnan(field[row:]).all()
    speed = np.linalg.norm(void.states.velocity[row])
    cause = f"a speed of {speed:.0f} m/s, above the limit of 100 m/s"
    words = f"filter: diverged at {row / 10:.1f} s ({cause}); the poses from then on are invalid"
    assert void.notes == (words,) and whole.notes == ()
    scores = evaluation.score([void, whole])
    assert [name for name, measures in scores.items() if measures.diverged] == [void.name]


def test_tight_and_loose_coupling_cut_the_same_windows(clean, walks):
    """With an exact IMU the filter has the attitude of the reference, as long as no measurement
    disturbs it."""
    recordings = ready([clean, walks[1]], orientation="reference")
    (inside, _), (before, _) = (way(recordings, network(0.1, 4.0)) for way in (tight, loose))
    one, other, first = inside.displacements, before.displacements, 12
    assert np.isnan(one.value[:first]).all() and np.isfinite(one.value[first:]).all()
    np.testing.assert_array_equal(np.isnan(one.value), np.isnan(other.value))
    np.testing.assert_allclose(one.value[first:], other.value[first:], atol=2e-3)
    np.testing.assert_allclose(one.std[first:], other.std[first:], rtol=2e-2)
    gates = (displacements.diagnostics["gate"][first:] for displacements in (one, other))
    np.testing.assert_allclose(*gates, atol=2e-2)
    np.testing.assert_allclose(inside.trajectory.position, before.trajectory.position, atol=2e-2)
    # The displacements vary; if they did not, the agreement would say nothing.
    assert np.std(one.value[first:], axis=0).max() > 0.01


@pytest.mark.parametrize("way", [tight, loose, summed])
def test_every_estimator_keeps_the_waypoints(walks, way):
    recordings = ready([walks[0], with_waypoints(walks[1])], orientation="filter")
    (first, second), (with_poses, _) = way(recordings), way(ready(walks[:2], orientation="filter"))
    np.testing.assert_allclose(first.trajectory.position, with_poses.trajectory.position, atol=1e-6)
    assert first.waypoints is None and second.waypoints is recordings[1].waypoints
    score = evaluation.score([second])[second.name].values
    assert np.isfinite(score["waypoint_rms"])


@pytest.mark.parametrize("how", [{}, {"init": "static"}])
def test_the_filter_starts_with_the_uncertainty_of_its_options(walks, how):
    """A start from the reference has all of it, a static start what it does not measure."""
    std = TLIO_STD._replace(yaw=0.3, gyro_bias=0.02, accel_bias=0.2)
    ekf = make_filter(CONFIG, dataclasses.replace(OPTIONS, start=std))
    recordings = ready(walks[:2], ekf=ekf, **how)
    (estimate, _), start_std = imu_only(recordings), recordings[0].start.std
    assert (start_std.yaw, start_std.gyro_bias) == (0.3, 0.02)
    expected = np.repeat(np.array(start_std), [2, 1, 3, 3, 3, 3])
    np.testing.assert_allclose(estimate.states.std[0], expected, rtol=1e-12)
    raw = recordings[0].start._replace(level_gyro_bias=0.05)
    (estimate, _) = imu_only([recordings[0]._replace(start=raw), recordings[1]])
    up = raw.rotation[2]
    expected[9:12] = np.sqrt(0.05**2 * (1 - up**2) + 0.02**2 * up**2)
    np.testing.assert_allclose(estimate.states.std[0], expected, rtol=1e-9)
