"""The network's windows against plain loops."""

import numpy as np
import pytest

from gnio_jax.config import DataConfig
from gnio_jax.evaluation import infer
from tests.support.estimators import CONFIG, NETWORK, RATE, ready, rotations, summed, unyaw


@pytest.mark.parametrize("reading, context", [("single", 0.0), ("per_sample", 0.4)])
def test_windows_are_cut_with_the_attitude_of_the_recording(walks, reading, context):
    config = DataConfig(rate=RATE, window_rotation=reading, context_seconds=context)
    recordings = ready(walks[:2], config, orientation="reference")
    predicted = infer(NETWORK, recordings, config)
    for walk, displacements, recording in zip(walks[:2], predicted, recordings, strict=True):
        turns = rotations(walk.orientation).as_matrix()
        assert displacements.value.shape == displacements.std.shape == (recording.strides, 3)
        first = (
            config.input_samples // config.stride - 1
        )  # the stride in which the first window ends
        assert (
            np.isnan(displacements.value[:first]).all()
            and np.isfinite(displacements.value[first:]).all()
        )
        for row in range(first, recording.strides, 17):
            end = (row + 1) * config.stride
            start, rows = end - config.window, range(end - config.input_samples, end)
            at = [j if reading == "per_sample" else start for j in rows]
            means = [
                unyaw(turns[start]) @ np.einsum("tij,tj->ti", turns[at], signal[rows]).mean(0)
                for signal in (walk.accel, walk.gyro)
            ]
            np.testing.assert_allclose(displacements.value[row], 0.05 * means[0], atol=2e-6)
            np.testing.assert_allclose(np.log(displacements.std[row]), means[1] - 3, atol=1e-5)
        assert set(displacements.diagnostics) == {"gate"}


def test_the_first_gyro_bias_is_subtracted_from_windows_and_attitude(clean):
    bias = np.array([0.1, -0.05, 0.02])
    biased = clean._replace(gyro=clean.gyro + bias)
    (plain,), (shifted,) = (
        ready([walk], gyro_bias="reference", orientation="filter") for walk in (clean, biased)
    )
    np.testing.assert_allclose(shifted.start.gyro_bias - plain.start.gyro_bias, bias, atol=1e-12)
    np.testing.assert_allclose(shifted.attitude, plain.attitude, atol=1e-9)
    a, b = infer(NETWORK, [plain, shifted], CONFIG)
    np.testing.assert_allclose(a.std, b.std, rtol=1e-5)


def test_no_standard_deviation_is_below_the_smallest_one(walks):
    recordings = ready(walks[:1], orientation="reference")
    (plain,), (bounded,) = (infer(NETWORK, recordings, CONFIG, least_std=x) for x in (0.0, 0.05))
    np.testing.assert_allclose(bounded.std, np.maximum(plain.std, 0.05), rtol=1e-12)
    assert np.nanmin(plain.std) < 0.05 < np.nanmax(plain.std)


def test_a_window_across_a_gap_of_the_imu_has_no_displacement(walks):
    measured = np.ones(len(walks[0].time), bool)
    measured[203:240] = False
    config = DataConfig(rate=RATE, context_seconds=0.4)
    sequences = [walks[0]._replace(imu_valid=measured), walks[0]]
    recordings = ready(sequences, config, orientation="reference")
    holed, whole = infer(NETWORK, recordings, config)
    for row, (value, expected) in enumerate(zip(holed.value, whole.value, strict=True)):
        end = (row + 1) * config.stride
        if end >= config.input_samples and measured[end - config.input_samples : end].all():
            np.testing.assert_array_equal(value, expected)
        else:
            assert np.isnan(value).all()
    (path, *_) = summed(recordings, config=config)
    assert np.isfinite(path.trajectory.position).all()
