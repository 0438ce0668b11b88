"""Estimators against plain loops over samples and windows, and against what they must give with
perfect inputs."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import evaluation
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Setup, metrics
from gnio_jax.evaluation.estimators import filtered
from gnio_jax.evaluation.estimators.integrated import mean_over_windows
from gnio_jax.filtering import CorrelatedError
from tests.support.estimators import (
    CONFIG,
    INTEGRATE,
    LOOSE,
    NETWORK,
    OPTIONS,
    RATE,
    network,
    rotations,
    unyaw,
)
from tests.support.filter_settings import changed


def test_imu_only_is_strap_down_integration(walks):
    (prepared, other), _ = evaluation.prepare(walks[::2], CONFIG, Setup("imu_only"))
    (found, _) = evaluation.estimate([prepared, other], None, CONFIG, OPTIONS, Setup("imu_only"))
    rotation, velocity, position = (
        rotations(walks[0].orientation[0]).as_matrix(),
        walks[0].velocity[0],
        walks[0].position[0],
    )
    dt, gravity, path, attitudes = 1 / RATE, np.array([0, 0, -9.81]), [position], [rotation]
    for k in range(len(prepared.sequence.time) - 1):
        step = rotation @ walks[0].accel[k] * dt
        position = position + velocity * dt + 0.5 * step * dt + 0.5 * gravity * dt**2
        velocity = velocity + step + gravity * dt
        rotation = rotation @ Rotation.from_rotvec(walks[0].gyro[k] * dt).as_matrix()
        if (k + 1) % CONFIG.stride == 0:
            path.append(position)
            attitudes.append(rotation)
    np.testing.assert_allclose(found.trajectory.position, path, atol=1e-9)
    np.testing.assert_allclose(
        rotations(found.trajectory.orientation).as_matrix(), attitudes, atol=1e-10
    )
    np.testing.assert_array_equal(
        found.trajectory.time, walks[0].time[:: CONFIG.stride][: len(path)]
    )
    np.testing.assert_array_equal(
        found.reference.position, walks[0].position[:: CONFIG.stride][: len(path)]
    )
    assert np.isnan(found.accepted).all() and found.std.shape == (len(path), 15)


def test_integration_against_a_loop(walks):
    (prepared,), _ = evaluation.prepare(walks[:1], CONFIG, INTEGRATE)
    (found,) = evaluation.estimate([prepared], NETWORK, CONFIG, OPTIONS, INTEGRATE)
    turns = rotations(walks[0].orientation).as_matrix()
    (prediction,) = evaluation.predict_windows(
        NETWORK, [prepared], [turns[: len(prepared.sequence.time)]], CONFIG
    )
    strides = (len(prepared.sequence.time) - 1) // CONFIG.stride
    position, path = walks[0].position[0], [walks[0].position[0]]
    for stride in range(strides):
        covering = [i for i in range(len(prediction.displacement)) if i <= stride < i + 10]
        moves = [
            unyaw(turns[i * CONFIG.stride]).T
            @ prediction.displacement[i]
            * CONFIG.stride
            / CONFIG.window
            for i in covering
        ]
        position = position + np.mean(moves, axis=0)
        path.append(position)
    np.testing.assert_allclose(found.trajectory.position, path, atol=1e-9)
    np.testing.assert_allclose(found.displacement[10:], prediction.displacement)
    assert np.isnan(found.displacement[:10]).all() and found.std is None


def test_a_stride_without_a_window_goes_on_as_before():
    steps = np.array(
        [[1.0, 0, 0], [1.0, 0, 0], [np.nan] * 3, [np.nan] * 3, [np.nan] * 3, [2.0, 0, 0]]
    )
    moved = mean_over_windows(steps, 7, 2)[:, 0]
    np.testing.assert_allclose(moved, [1, 1, 1, 1, 1, 2, 2])


def test_strides_before_the_first_window_take_its_movement():
    steps = np.array([[np.nan] * 3, [np.nan] * 3, [1.0, 0, 0], [3.0, 0, 0]])
    moved = mean_over_windows(steps, 5, 2)[:, 0]
    np.testing.assert_allclose(moved, [1, 1, 1, 2, 3])


@pytest.mark.parametrize(
    "setup, ate",
    [
        (Setup(), 0.03),
        (LOOSE, 0.03),
        (INTEGRATE, 0.1),
        (Setup("integrate", orientation="filter"), 0.1),
        (Setup("imu_only"), 0.03),
        (Setup(init="static"), 0.1),
        (Setup("integrate", orientation="device"), 0.3),
    ],
)
def test_perfect_displacements_leave_little_error(walks, setup, ate):
    prepared, _ = evaluation.prepare(walks[::2], CONFIG, setup._replace(gyro_bias="reference"))
    for found in evaluation.perfect_displacements(prepared, CONFIG, OPTIONS, setup):
        values = metrics.measure(found.trajectory, found.reference).values
        assert values["ate"] < ate and values["path_length_ratio"] == pytest.approx(1, abs=0.04)


def test_true_displacements_lack_nothing_that_was_calibrated(walks):
    prepared, _ = evaluation.prepare(walks[::2], CONFIG, Setup(gyro_bias="reference"))
    calibrated = changed(
        OPTIONS, noise={"std_factor": (3.0, 1.0, 1.0), "correlation": CorrelatedError()}
    )
    both = (
        evaluation.perfect_displacements(prepared, CONFIG, options)
        for options in (OPTIONS, calibrated)
    )
    for plain, found in zip(*both, strict=True):
        np.testing.assert_array_equal(found.trajectory.position, plain.trajectory.position)


SCALE = OPTIONS.noise.measurement_scale


def told_the_same(prepared, config, options):
    """By a network that does not look at its windows."""
    alike = network(0.0, -2.0, log_std_gain=0.0, constant=(0.9, 0.2, 0.02))
    return evaluation.estimate(prepared, alike, config, options)


@pytest.mark.parametrize("run", [evaluation.perfect_displacements, told_the_same])
def test_what_is_considered_widens_the_covariance_and_moves_nothing(walks, run):
    """By ∂p/∂b_g of the filter, here of a run whose gyro is off by a little."""
    prepared, _ = evaluation.prepare(walks[::2], CONFIG, Setup(gyro_bias="reference"))
    options = changed(OPTIONS, considered={"gyro_bias": 1e-3})
    (plain, _), (found, _) = (run(prepared, CONFIG, each) for each in (OPTIONS, options))
    np.testing.assert_array_equal(found.trajectory.position, plain.trajectory.position)
    moved = []
    for axis in 1e-5 * np.eye(3):
        ahead, behind = (
            run(
                [each._replace(gyro_bias=each.gyro_bias + off) for each in prepared],
                CONFIG,
                OPTIONS,
            )
            for off in (axis, -axis)
        )
        moved.append((ahead[0].trajectory.position - behind[0].trajectory.position) / 2e-5)
    added = 1e-6 * sum(m[:, :, None] * m[:, None, :] for m in moved)
    wanted = plain.position_covariance + added
    assert added[-1].max() > 1e-6
    np.testing.assert_allclose(found.position_covariance, wanted, rtol=1e-2, atol=1e-7)
    std = np.sqrt(np.diagonal(wanted, axis1=1, axis2=2))
    np.testing.assert_allclose(found.std[:, 6:9], std, rtol=1e-2)
    at_start = np.hypot(plain.std[0, 9:12], 1e-3)  # a constant bias is there from the start
    np.testing.assert_allclose(found.std[0, 9:12], at_start, rtol=1e-12)


def test_integration_is_neither_ahead_nor_behind(clean):
    (prepared,), _ = evaluation.prepare([clean], CONFIG, INTEGRATE)
    (found,) = evaluation.perfect_displacements([prepared], CONFIG, OPTIONS, INTEGRATE)
    path, truth = found.trajectory.position, found.reference.position
    errors = {
        shift: metrics.ate(path[10:-10], truth[10 + shift : len(truth) - 10 + shift])
        for shift in range(-3, 4)
    }
    assert min(errors, key=errors.get) == 0


def same(a, b, tolerance):
    assert a.name == b.name
    for field, one, other in zip(a._fields, a, b, strict=True):
        if isinstance(one, np.ndarray):
            np.testing.assert_allclose(one, other, atol=tolerance, err_msg=field)


def test_batches_change_nothing(walks):
    prepared, _ = evaluation.prepare(walks[::2], CONFIG)
    together = evaluation.estimate(prepared, NETWORK, CONFIG, OPTIONS)
    for each, in_batch in zip(prepared, together, strict=True):
        (alone,) = evaluation.estimate([each], NETWORK, CONFIG, OPTIONS, batch_size=1)
        same(alone, in_batch, 1e-5)
        np.testing.assert_allclose(
            alone.trajectory.position, in_batch.trajectory.position, atol=1e-6
        )
        np.testing.assert_allclose(
            alone.diagnostics["gate"], in_batch.diagnostics["gate"], atol=1e-6
        )


def test_another_scale_of_the_covariances_is_used_and_compiles_nothing(walks):
    prepared, _ = evaluation.prepare(walks[::2], CONFIG)
    (_, one) = evaluation.estimate(prepared, NETWORK, CONFIG, OPTIONS)
    programs = filtered._run_with_network._cache_size()
    options = changed(OPTIONS, noise={"measurement_scale": SCALE * 9})
    (_, scaled) = evaluation.estimate(prepared, NETWORK, CONFIG, options)
    assert filtered._run_with_network._cache_size() == programs
    first = np.isfinite(one.displacement_std).all(axis=1).argmax()  # a later window is seen turned
    np.testing.assert_allclose(
        scaled.displacement_std[first], 3 * one.displacement_std[first], rtol=1e-12
    )
    np.testing.assert_allclose(one.displacement_std[first], np.exp(-3.0) * SCALE**0.5, rtol=0.5)
    options = changed(OPTIONS, noise={"std_factor": (3.0, 3.0, 3.0)})
    (_, same_filter) = evaluation.estimate(prepared, NETWORK, CONFIG, options)
    same(scaled, same_filter, 1e-9)


@pytest.mark.parametrize(
    "disturbed, factor, row", [(slice(450, 451), 1e5, 91), (slice(None), 1e3, 1)]
)
def test_what_the_filter_calls_void_has_diverged(walks, disturbed, factor, row):
    """One leap of the accelerometer, or a wrong unit: all numbers stay finite."""
    accel = walks[0].accel.copy()
    accel[disturbed] *= factor
    prepared, _ = evaluation.prepare([walks[0]._replace(accel=accel), walks[2]], CONFIG)
    void, whole = evaluation.estimate(prepared, NETWORK, CONFIG, OPTIONS)
    assert np.isfinite(void.velocity).all()
    assert np.argmax(np.linalg.norm(void.velocity, axis=1) > 100) == row
    for field in void.trajectory[1:]:
        assert np.isfinite(field[:row]).all() and np.isnan(field[row:]).all()
    words = f"filter: not healthy from {row / 10:.1f} s on, and all after it is void"
    assert void.notes == (words,) and whole.notes == ()
    scores = evaluation.score([void, whole])
    assert [name for name, own in scores.items() if own.diverged] == [void.name]


def test_many_batches_of_unlike_lengths(walks):
    """The ladder of padded lengths, a batch that is filled up, the order of the answers, the
    progress."""
    prepared, _ = evaluation.prepare(walks, CONFIG)
    together, told = evaluation.perfect_displacements(prepared, CONFIG, OPTIONS), []
    pairs = evaluation.perfect_displacements(
        prepared, CONFIG, OPTIONS, batch_size=2, progress=told.append
    )
    for each, a, b in zip(prepared, together, pairs, strict=True):
        assert a.name == each.sequence.name and len(a.trajectory.time) == len(
            each.sequence.time[:: CONFIG.stride]
        )
        same(a, b, 1e-9)
    assert told == sorted(told) and len(told) == 2 and told[-1] == 1.0


@pytest.mark.parametrize("context, first", [(0.0, 11), (0.2, 12)])
def test_tight_and_loose_see_the_same_windows(clean, context, first):
    """With an exact IMU the filter's attitude is the reference's, as long as no measurement
    disturbs it."""
    config, found = dataclasses.replace(CONFIG, context_seconds=context), []
    for setup in (Setup(), LOOSE):
        prepared, _ = evaluation.prepare([clean], config, setup)
        found += evaluation.estimate(
            prepared, network(0.1, 4.0), config, OPTIONS, setup, batch_size=1
        )
    tight, loose = found
    assert (
        np.isnan(tight.displacement[:first]).all() and np.isfinite(tight.displacement[first:]).all()
    )
    np.testing.assert_array_equal(np.isnan(tight.displacement), np.isnan(loose.displacement))
    np.testing.assert_allclose(tight.displacement[first:], loose.displacement[first:], atol=2e-3)
    np.testing.assert_allclose(
        tight.displacement_std[first:], loose.displacement_std[first:], rtol=2e-2
    )
    np.testing.assert_allclose(
        tight.diagnostics["gate"][first:], loose.diagnostics["gate"][first:], atol=2e-2
    )
    np.testing.assert_allclose(tight.trajectory.position, loose.trajectory.position, atol=2e-2)
    assert (
        np.std(tight.displacement[first:], axis=0).max() > 0.01
    )  # else the agreement would say nothing


def test_loose_measurements_have_the_same_least_std(clean):
    sure = network(0.0, -90.0)
    prepared, _ = evaluation.prepare([clean], CONFIG, LOOSE)
    (found,) = evaluation.estimate(prepared, sure, CONFIG, OPTIONS, LOOSE, batch_size=1)
    np.testing.assert_allclose(found.displacement_std[11:], np.exp(-4) * np.sqrt(10), rtol=1e-6)


def test_no_reference_is_fine_with_a_static_start(walks):
    nowhere = walks[0]._replace(
        valid=np.zeros(len(walks[0].time), bool),
        position=np.full_like(walks[0].position, np.nan),
        orientation=np.full_like(walks[0].orientation, np.nan),
    )
    setup = Setup("integrate", orientation="filter", init="static")
    prepared, _ = evaluation.prepare([nowhere], CONFIG, setup)
    (found,) = evaluation.estimate(prepared, NETWORK, CONFIG, OPTIONS, setup)
    assert np.isfinite(found.trajectory.position).all() and np.isnan(found.reference.position).all()
    for bad, remedy in [
        (Setup(), "--init static"),
        (Setup(init="static", gyro_bias="reference"), "--gyro-bias zero"),
        (Setup("integrate", init="static"), "--orientation filter"),
    ]:
        with pytest.raises(InputError, match=remedy):
            evaluation.prepare([nowhere], CONFIG, bad)


def test_never_moves(walks):
    prepared, _ = evaluation.prepare(walks[:1], CONFIG, INTEGRATE)
    (still,) = evaluation.never_moves(
        evaluation.perfect_displacements(prepared, CONFIG, OPTIONS, INTEGRATE)
    )
    assert (still.trajectory.position == walks[0].position[0]).all() and still.displacement is None
    assert metrics.measure(still.trajectory, still.reference).values["path_length_ratio"] == 0
