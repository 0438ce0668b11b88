"""The measuring program of the vehicles' constants: what is held out has no part in a choice."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import vehicle_constants
from benchmarks.vehicle_constants import WINDOWS, evaluate_fold, make_fold, minimise, settings_at
from gnio_jax.evaluation.prepare import prepare
from gnio_jax.numerics import quaternions
from gnio_jax.types import Sequence

LOW_PASS = (0.0, 0.06)
FOLDS = {"drive 0": 0, "drive 1": 0, "drive 2": 1, "drive 3": 1}


@pytest.fixture(scope="module")
def drives():
    """Four drives of 13 s on a level road at 10 m/s, with biases."""
    return [make_drive(number) for number in range(4)]


def make_drive(number):
    rng = np.random.default_rng(number)
    time = np.arange(1301) / 100
    phase = 0.3 * time + rng.uniform(0, 6)
    yaw, rate, speed = 0.8 * np.sin(phase), 0.24 * np.cos(phase), 10.0
    velocity = speed * np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1)
    gyro, accel = np.zeros((2, len(time), 3))
    gyro[:, 2], accel[:, 1], accel[:, 2] = rate, speed * rate, 9.81
    return Sequence(
        name=f"drive {number}",
        time=time,
        gyro=gyro + rng.normal(size=3) * 1e-3,
        accel=accel + rng.normal(size=3) * 0.05,
        orientation=quaternions(Rotation.from_euler("z", yaw[:, None])),
        position=np.cumsum(velocity, axis=0) / 100,
        velocity=velocity,
        valid=np.ones(len(time), bool),
    )


def stretch_reference(sequence):
    return sequence._replace(position=1.05 * sequence.position)


def evaluate_first_fold(sequences):
    recordings, _ = prepare(sequences, WINDOWS)
    return evaluate_fold(make_fold(recordings, FOLDS, 0, LOW_PASS), 12, (7, 0))


def test_the_reference_of_a_drive_that_is_held_out_has_no_part_in_the_choice(drives):
    result = evaluate_first_fold(drives)
    assert list(result.errors) == ["drive 0", "drive 1"]
    changed = evaluate_first_fold([*map(stretch_reference, drives[:2]), *drives[2:]])
    assert changed.choice[:2] == result.choice[:2]
    np.testing.assert_array_equal(changed.choice.point, result.choice.point)
    for name in result.errors:
        assert changed.errors[name].mean() != result.errors[name].mean()
    trained_otherwise = evaluate_first_fold([*drives[:2], *map(stretch_reference, drives[2:])])
    assert (trained_otherwise.choice.point != result.choice.point).all()


def test_zero_of_the_search_is_the_default_and_one_is_a_unit_of_every_constant():
    default, other = settings_at(0.06, np.zeros(14)), settings_at(0.06, np.ones(14))
    assert default.low_pass_seconds == 0.06
    before, after = (
        dict((settings.measurements["nonholonomic"] or {}).items()) for settings in (default, other)
    )
    assert before["lateral_std"] == before["vertical_std"] == 1.0
    assert before["yaw"] == before["pitch"] == before["lever_x"] == before["lever_z"] == 0.0
    assert after["lateral_std"] == pytest.approx(np.e)
    assert after["pitch"] == pytest.approx(0.005) and after["lever_z"] == pytest.approx(0.3)
    assert after["roll"] == after["lever_y"] == 0.0
    assert other.noise.gyro_density / default.noise.gyro_density == pytest.approx(np.e)
    assert other.start.tilt / default.start.tilt == pytest.approx(np.exp(0.7))
    assert other.start.yaw == default.start.yaw


def test_the_strategy_comes_to_the_minimum_of_a_turned_ellipsoid():
    rng = np.random.default_rng(1)
    axes = np.linalg.qr(rng.normal(size=(6, 6)))[0]
    minimum, scales = rng.normal(size=6), np.logspace(0, 2, 6)

    def value(points):
        return np.sum(scales * ((points - minimum) @ axes) ** 2, axis=1)

    np.testing.assert_allclose(minimise(value, 6, 3600, rng), minimum, atol=1e-6)


def test_the_program_prints_the_errors_of_all_drives_and_chooses_the_low_pass_once_for_a_fold(
    drives, monkeypatch, capsys
):
    choose_low_pass, choices = vehicle_constants.choose_low_pass, []

    def count_choice(training, seconds):
        choices.append(sorted(drive.name for drive in training))
        return choose_low_pass(training, seconds)

    monkeypatch.setattr(vehicle_constants, "choose_low_pass", count_choice)
    monkeypatch.setattr(vehicle_constants, "PENALTIES", (0.03,))
    monkeypatch.setattr(vehicle_constants.data, "load", lambda *_: drives)
    words = "vehicle_constants --seeds 3 4 --folds 2 --trials 12 --low-pass 0.06"
    monkeypatch.setattr(sys, "argv", words.split())
    vehicle_constants.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("4 drives, ")
    for beginning in ("defaults, low-pass chosen: ", "seed 3: ", "seed 4: ", "mean of 2 seed(s)"):
        assert sum(line.startswith(beginning) for line in lines) == 1
    # Two folds have two choices, whatever the number of seeds.
    assert len(choices) == 2 and set(choices[0]).isdisjoint(choices[1])

    monkeypatch.setattr(sys, "argv", [*words.split(), "--only", "1"])
    vehicle_constants.main()
    part = capsys.readouterr().out.splitlines()
    assert not any("fold 0" in line for line in part)
    of_fold = [[x for x in text if x.startswith("seed 4, fold 1: ")] for text in (lines, part)]
    assert of_fold[0] == of_fold[1] and len(of_fold[0]) == 1


def test_a_fold_that_does_not_exist_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", "vehicle_constants --folds 2 --only 2".split())
    with pytest.raises(SystemExit):
        vehicle_constants.main()
    assert "--only: there are the folds 0 to 1" in capsys.readouterr().err
