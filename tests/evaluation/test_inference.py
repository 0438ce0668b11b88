"""Attitudes and the network's windows against plain loops."""

import numpy as np
import pytest

from gnio_jax import evaluation
from gnio_jax.config import DataConfig
from gnio_jax.evaluation import Setup
from gnio_jax.numerics import yaw
from tests.support.estimators import CONFIG, INTEGRATE, NETWORK, OPTIONS, RATE, rotations, unyaw


@pytest.mark.parametrize(
    "reading, context", [("per_sample", 0.0), ("single", 0.0), ("per_sample", 0.4)]
)
def test_windows_are_cut_with_the_given_attitude(walks, reading, context):
    config = DataConfig(rate=RATE, window_rotation=reading, context_seconds=context)
    prepared, _ = evaluation.prepare(walks[:2], config, INTEGRATE)
    attitudes = [evaluation.attitude(r, config, "reference") for r in prepared]
    predictions = evaluation.predict_windows(NETWORK, prepared, attitudes, config)
    for walk, prediction, each in zip(walks[:2], predictions, prepared, strict=True):
        turns = rotations(walk.orientation).as_matrix()
        starts = range(0, len(each.sequence.time) - config.window, config.stride)
        assert len(prediction.displacement) == len(starts)
        without = config.context // config.stride
        assert np.isnan(prediction.displacement[:without]).all()
        for row, i in list(enumerate(starts))[without::17]:
            rows = range(i - config.context, i + config.window)
            means = [
                np.mean(
                    [
                        unyaw(turns[i]) @ turns[j if reading == "per_sample" else i] @ signal[j]
                        for j in rows
                    ],
                    axis=0,
                )
                for signal in (walk.accel, walk.gyro)
            ]
            np.testing.assert_allclose(prediction.displacement[row], 0.05 * means[0], atol=2e-6)
            np.testing.assert_allclose(prediction.log_std[row], means[1] - 3, atol=1e-5)
        assert set(prediction.diagnostics) == {"gate"}


def test_the_first_gyro_bias_is_taken_off_the_windows_and_the_attitude(clean):
    (prepared,), _ = evaluation.prepare([clean], CONFIG, INTEGRATE)
    bias = np.array([0.1, -0.05, 0.02])
    biased = prepared._replace(
        sequence=prepared.sequence._replace(gyro=prepared.sequence.gyro + bias), gyro_bias=bias
    )
    attitudes = [evaluation.attitude(r, CONFIG, "filter") for r in (prepared, biased)]
    np.testing.assert_allclose(*attitudes, atol=1e-9)
    a, b = evaluation.predict_windows(NETWORK, [prepared, biased], attitudes, CONFIG)
    np.testing.assert_allclose(a.log_std, b.log_std, atol=1e-5)


def test_a_displacement_across_a_gap_of_the_imu_is_none(walks):
    there = np.ones(len(walks[0].time), bool)
    there[203:240] = False
    config = DataConfig(rate=RATE, context_seconds=0.4)
    sequences = [walks[0]._replace(imu_valid=there), walks[0]]
    prepared, _ = evaluation.prepare(sequences, config, INTEGRATE)
    attitudes = [evaluation.attitude(r, config, "reference") for r in prepared]
    holed, whole = evaluation.predict_windows(NETWORK, prepared, attitudes, config)
    for row, (found, expected) in enumerate(
        zip(holed.displacement, whole.displacement, strict=True)
    ):
        begin = row * config.stride - config.context
        if begin >= 0 and there[begin : begin + config.seen].all():
            np.testing.assert_array_equal(found, expected)
        else:
            assert np.isnan(found).all()
    (path, *_) = evaluation.estimate(prepared, NETWORK, config, OPTIONS, INTEGRATE)
    assert np.isfinite(path.trajectory.position).all()


def test_attitudes(walks):
    (prepared,), _ = evaluation.prepare(walks[:1], CONFIG, Setup("integrate", orientation="device"))
    count = len(prepared.sequence.time)
    device = evaluation.attitude(prepared, CONFIG, "device")
    own = rotations(walks[0].device_orientation[:count]).as_matrix()
    turn = device[0] @ own[0].T
    np.testing.assert_allclose(turn[2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(device, turn @ own, atol=1e-12)
    start = rotations(walks[0].orientation[:1]).as_matrix()
    np.testing.assert_allclose(yaw(device[:1]), yaw(start), atol=1e-12)

    gap = walks[0]._replace(orientation=walks[0].orientation.copy(), valid=walks[0].valid.copy())
    gap.orientation[200:260], gap.valid[190:260] = np.nan, False
    (prepared,), _ = evaluation.prepare([gap], CONFIG, INTEGRATE)
    bridged = evaluation.attitude(prepared, CONFIG, "reference")
    truth = rotations(walks[0].orientation[:count]).as_matrix()
    np.testing.assert_allclose(bridged[:190], truth[:190], atol=1e-12)
    np.testing.assert_allclose(bridged[260:], truth[260:], atol=1e-12)
    np.testing.assert_allclose(
        bridged[190:260], truth[190:260], atol=0.03
    )  # 1.4 s of gyro with its bias


def test_an_untrusted_orientation_need_be_no_rotation(walks):
    orientation, valid = walks[0].orientation.copy(), walks[0].valid.copy()
    orientation[200:260], valid[200:260] = 0.0, False
    zeros = walks[0]._replace(orientation=orientation, valid=valid)
    orientation = orientation.copy()
    orientation[200:260] = np.nan
    unknown = zeros._replace(orientation=orientation)
    prepared, _ = evaluation.prepare([zeros, unknown], CONFIG, INTEGRATE)
    bridged = [evaluation.attitude(each, CONFIG, "reference") for each in prepared]
    np.testing.assert_array_equal(*bridged)
