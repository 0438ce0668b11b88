"""Gravity tells whether gyro and accelerometer are of one body, one clock and one unit; sensors
that are dead or hang are told too. The motion is known in closed form."""

import itertools

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data import conversion, physics
from gnio_jax.data.physics import ImuSamples
from gnio_jax.errors import InputError
from tests.support import known_walk
from tests.support.csv_writers import write_native

TIME = np.arange(3000) / 100
GYRO, FORCE = known_walk.rate(TIME), known_walk.force(TIME)
WALK = ImuSamples(TIME, GYRO, FORCE)


def test_a_gyro_that_gravity_follows_is_supported_in_spite_of_its_bias():
    for gyro in (GYRO, GYRO + np.array([0.3, -0.2, 0.1]), GYRO * 1.03):
        imu = WALK._replace(gyro=gyro)
        error, contrast = physics.agreement(imu)
        assert error < 0.2 and contrast > 10 and physics.is_supported(error, contrast)
        assert physics.contradiction(imu) is None and physics.check_turning(imu, "walk") == []


def test_every_other_assignment_of_axes_is_found():
    """48 ways, of which one is right. The words of the remedy give the axes back."""
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            imu = WALK._replace(gyro=GYRO[:, order] * signs)
            contradiction = physics.contradiction(imu)
            if order == (0, 1, 2) and signs == (1.0, 1.0, 1.0):
                assert contradiction is None
                continue
            assert contradiction is not None
            factor, _, remedy = contradiction
            assert factor > physics.PROOF
            words = dict(word.split("=") for word in remedy.split("--columns ")[1].split())
            columns = dict(zip("xyz", imu.gyro.T, strict=True))
            repaired = [
                columns[words[f"gyro_{axis}"][-1]] * (-1) ** words[f"gyro_{axis}"].count("-")
                for axis in "xyz"
            ]
            np.testing.assert_array_equal(np.stack(repaired, axis=1), GYRO)


@pytest.mark.parametrize(
    ("scale", "clock", "words"),
    [
        (180 / np.pi, 1.0, "its gyro looks like deg/s"),
        (np.pi / 180, 1.0, "its gyro looks like rad/s"),
        (131.0, 1.0, "its gyro looks like raw counts, 131 in 1 deg/s"),
        (1.0, 10.0, "its samples come 10 times faster than its stamps say"),
        (1.0, 0.1, "its samples come 10 times slower"),
    ],
)
def test_units_and_clocks_are_found(scale, clock, words):
    time = np.arange(12000) / 100
    imu = ImuSamples(time * clock, known_walk.rate(time) * scale, known_walk.force(time))
    with pytest.raises(InputError, match=words):
        physics.check_turning(imu, "walk")


def test_a_short_recording_is_warned_of_and_a_shorter_one_is_not():
    for seconds in (20, 7, 4):
        rows = TIME <= seconds
        imu = ImuSamples(TIME[rows], -GYRO[rows], FORCE[rows])
        if seconds == 20:
            with pytest.raises(InputError, match="gravity turns against the gyro"):
                physics.check_turning(imu, "walk")
            continue
        warnings = physics.check_turning(imu, "walk")
        assert len(warnings) == (1 if seconds == 7 else 0)
        assert all("gravity turns against the gyro" in text for text in warnings)


def test_a_clock_in_doubt_is_supported_if_no_other_one_explains_gravity_better():
    assert physics.is_clock_supported(WALK)
    for pace in (0.2, 0.4, 0.5, 2.0, 2.5, 5.0):
        assert not physics.is_clock_supported(WALK._replace(time=TIME * pace))


def test_what_cannot_be_told_is_no_contradiction():
    noise = np.random.default_rng(1).normal(0, 0.02, (3000, 3))
    still = ImuSamples(TIME, noise, noise + np.array([0, 0, 9.81]))
    short = ImuSamples(*(field[:300] for field in WALK))
    gap = WALK._replace(time=np.where(np.arange(3000) % 100 < 99, TIME, TIME + 50.0).cumsum())
    for imu in (still, still._replace(gyro=-noise), short._replace(gyro=-GYRO[:300]), gap):
        assert physics.contradiction(imu) is None


def test_nothing_is_turned_over_a_hole():
    time = np.arange(12000) / 100
    time = time[time % 7.0 < 4.0]
    imu = ImuSamples(time, known_walk.rate(time), known_walk.force(time))
    assert physics.agreement(imu)[0] < 2 * physics.agreement(WALK)[0]


def test_a_day_of_stamps_takes_no_memory():
    """One stamp may be far from all others."""
    time = TIME.copy()
    time[-1] = 1e9
    assert physics.contradiction(WALK._replace(time=time)) is None


def test_runs_of_equal_rows_are_no_samples_of_a_fine_sensor():
    noise = np.random.default_rng(0).normal(0, 0.01, (3000, 3))
    values = GYRO + noise
    values[100:130] = values[100]
    rows, slower = physics.repeats(TIME, values)
    np.testing.assert_array_equal(np.flatnonzero(rows), np.arange(101, 130))
    assert not slower
    rows, slower = physics.repeats(TIME, (GYRO + noise)[np.arange(3000) // 4 * 4])
    assert slower and rows.sum() == 2250
    # Coarse sensors at rest: one that always reads the same, and one whose axes change one by one.
    for spread in (1.0, 2.5):
        coarse = np.round(np.array([0.0, 0.0, 9.8]) + spread * noise, 1)
        assert not physics.repeats(TIME, coarse)[0].any()


def test_the_check_of_own_recordings_asks_the_same(tmp_path):
    """Without a reference, which would tell otherwise."""

    def reason(spoil):
        write_native(tmp_path / "walk.csv", TIME, reference=False, spoil=spoil)
        (row,), _ = conversion.check(data.get("csv"), tmp_path)
        return row.reason

    def negated(columns):
        for axis in "xyz":
            columns[f"gyro_{axis}"] = -columns[f"gyro_{axis}"]

    def silent(columns):
        columns |= {f"gyro_{axis}": 0 * TIME for axis in "xyz"}

    def stuck(columns):
        for name in columns.keys() - {"time"}:
            columns[name] = np.where(TIME > 20, columns[name][2000], columns[name])

    assert reason(lambda columns: None) == ""
    assert "gravity turns against the gyro" in reason(negated)
    assert "the gyro reads 0 throughout" in reason(silent)
    assert "accel repeats its values in 33% of the samples" in reason(stuck)
