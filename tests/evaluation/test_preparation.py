"""Starts, biases and cuts of recordings against what is known of them."""

import numpy as np
import pytest

from gnio_jax import evaluation
from gnio_jax.data.simulated import walks as simulated
from gnio_jax.evaluation import Setup
from tests.support.estimators import CONFIG, OPTIONS, RATE, rotations


def test_start_is_the_first_trusted_sample(walks):
    hidden = walks[0]._replace(valid=np.arange(len(walks[0].time)) >= 137)
    (prepared,), _ = evaluation.prepare([hidden], CONFIG)
    assert prepared.sequence.time[0] == walks[0].time[137]
    np.testing.assert_array_equal(prepared.start.position, walks[0].position[137])
    np.testing.assert_allclose(
        prepared.start.rotation, rotations(walks[0].orientation[137]).as_matrix(), atol=1e-12
    )
    assert (len(prepared.sequence.time) - 1) % CONFIG.stride == 0


@pytest.fixture(scope="module")
def swaying(clean):
    """The walk with a phone in a hand that is never as quiet as a table."""
    sway = 0.03 * np.sin(2 * np.pi * 1.5 * clean.time)
    return clean._replace(gyro=clean.gyro + sway[:, None])


def test_static_start_is_level(clean):
    (prepared,), _ = evaluation.prepare([clean], CONFIG, Setup(init="static"))
    truth = rotations(clean.orientation[0]).as_matrix()
    assert np.degrees(np.arccos(prepared.start.rotation[2] @ truth[2])) < 3.0  # it sways
    assert abs(np.arctan2(prepared.start.rotation[1, 0], prepared.start.rotation[0, 0])) < 1e-12
    assert (
        not prepared.start.velocity.any()
        and not prepared.start.position.any()
        and not prepared.notes
    )
    moving = clean._replace(valid=np.arange(len(clean.time)) > 600)
    (prepared,), _ = evaluation.prepare([moving], CONFIG, Setup(init="static"))
    assert "not standing still" in prepared.notes[0]


def test_gyro_bias_from_reference_and_from_rest(walks, swaying):
    true = np.array([walks[0].attributes[f"gyro_bias_{axis}"] for axis in "xyz"])
    biased = walks[0]._replace(gyro=walks[0].gyro + np.array([0.004, -0.02, 0.01]))
    (prepared,), _ = evaluation.prepare([biased], CONFIG, Setup(gyro_bias="reference"))
    np.testing.assert_allclose(prepared.gyro_bias, true + np.array([0.004, -0.02, 0.01]), atol=1e-4)
    assert "10 s against the reference" in prepared.notes[0]

    (prepared,), _ = evaluation.prepare([swaying], CONFIG, Setup(gyro_bias="rest"))
    assert not prepared.gyro_bias.any() and "no rest" in prepared.notes[0]
    random, bias = np.random.default_rng(0), np.array([0.01, -0.02, 0.005])
    resting = swaying._replace(gyro=swaying.gyro.copy(), accel=swaying.accel.copy())
    resting.gyro[:120] = bias + random.normal(0, 1e-3, (120, 3))
    resting.accel[:120] = swaying.accel[:120].mean(0) + random.normal(0, 0.01, (120, 3))
    (prepared,), _ = evaluation.prepare([resting], CONFIG, Setup(gyro_bias="rest"))
    np.testing.assert_allclose(prepared.gyro_bias, bias, atol=5e-4)
    assert "2 s of rest" in prepared.notes[0]
    (found,) = evaluation.perfect_displacements([prepared], CONFIG, OPTIONS, batch_size=1)
    np.testing.assert_allclose(found.gyro_bias[0], prepared.gyro_bias)


def test_short_sequences_are_left_out_by_name(walks):
    short = walks[0]._replace(
        name="short", valid=np.arange(len(walks[0].time)) > len(walks[0].time) - 52
    )
    prepared, left_out = evaluation.prepare([short, walks[1]], CONFIG)
    assert [r.sequence.name for r in prepared] == [walks[1].name]
    assert left_out == {
        "short": "1.02 s from its first trusted sample on, too short for a window and a stride"
    }


def test_other_rates_are_resampled():
    walk = simulated.pedestrian(1, 1, "handheld", 6.0, 200.0)
    (prepared,), _ = evaluation.prepare([walk], CONFIG)
    assert np.median(np.diff(prepared.sequence.time)) == pytest.approx(1 / RATE)


def with_hole(sequence, rows):
    """The IMU follows lines over the rows, and says so."""
    there = np.ones(len(sequence.time), bool)
    there[rows] = False
    before = np.flatnonzero(there)
    lines = (
        np.column_stack([np.interp(np.arange(len(there)), before, c[there]) for c in each.T])
        for each in (sequence.gyro, sequence.accel)
    )
    gyro, accel = lines
    return sequence._replace(gyro=gyro, accel=accel, imu_valid=there)


def test_a_line_across_a_gap_is_no_rest(clean):
    """A walker whose log lacks its first second rests no more than any other."""
    shake = 3 * np.sin(np.arange(len(clean.time)))[:, None] * [0.0, 1.0, 1.0]
    shaken = clean._replace(accel=clean.accel + shake, gyro=clean.gyro + shake / 3)
    holed = with_hole(shaken, slice(1, round(RATE)))
    setup = Setup(init="static", gyro_bias="rest")
    (prepared,), _ = evaluation.prepare([holed], CONFIG, setup)
    assert not prepared.gyro_bias.any() and "no rest" in prepared.notes[0]
    assert prepared.start.velocity_std == 1.0 and (prepared.start.tilt_std or 0.0) > 0.01


def test_a_rest_that_lacks_some_samples_is_a_rest(swaying):
    """What was measured of it counts, and the line does not."""
    rest, second = np.array([0.01, -0.02, 0.005]), round(RATE)
    resting = swaying._replace(gyro=swaying.gyro.copy(), accel=swaying.accel.copy())
    resting.gyro[:second], resting.accel[:second] = rest, swaying.accel[:second].mean(0)
    holed = with_hole(resting, slice(5, 5 + second // 3))
    holed.gyro[10:15] += 1.0
    setup = Setup(init="static", gyro_bias="rest")
    (prepared,), _ = evaluation.prepare([holed], CONFIG, setup)
    np.testing.assert_allclose(prepared.gyro_bias, rest, atol=1e-12)
    assert "mean of 1 s of rest" in prepared.notes[0] and (prepared.start.velocity_std or 1.0) < 0.1


def test_a_gap_says_nothing_of_the_bias(walks):
    """The reference is there, the gyro is not."""
    true = np.array([walks[0].attributes[f"gyro_bias_{axis}"] for axis in "xyz"])
    holed = with_hole(walks[0], slice(100, 150))
    holed.gyro[100:150] += 3.0
    (prepared,), _ = evaluation.prepare([holed], CONFIG, Setup(gyro_bias="reference"))
    np.testing.assert_allclose(prepared.gyro_bias, true, atol=1e-4)


def test_what_was_hardly_measured_is_left_out(walks):
    lost = with_hole(walks[0], slice(30, None))
    prepared, left_out = evaluation.prepare([lost], CONFIG)
    assert not prepared and "of it measured, too short" in left_out[lost.name]
