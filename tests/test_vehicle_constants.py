"""The measuring program of the vehicles' constants: what is held out has no part in a choice."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks import vehicle_constants
from benchmarks.vehicle_constants import (
    UNITS,
    WINDOWS,
    choose,
    default_settings,
    differentiate,
    evaluate_fold,
    fit,
    leave_one_out,
    make_drive,
    measure_drive,
    relative_errors,
    settings_at,
)
from gnio_jax import config as configuration
from gnio_jax.evaluation.metrics import piece_errors
from gnio_jax.evaluation.prepare import prepare
from gnio_jax.evaluation.trajectory import Trajectory
from gnio_jax.filtering import initial_state, make_filter, run_filter
from gnio_jax.filtering.settings import free_parameters
from gnio_jax.numerics import quaternion_from_matrix, quaternions
from gnio_jax.types import Sequence

DEFAULTS = np.zeros(len(UNITS))


@pytest.fixture(scope="module")
def sequences():
    """Four drives of 6 s on a level road at 25 m/s, with biases."""
    return [simulate(number) for number in range(4)]


@pytest.fixture(scope="module")
def drives(sequences):
    return prepare_drives(sequences)


def prepare_drives(sequences):
    recordings, _ = prepare(sequences, WINDOWS)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(vehicle_constants, "PADDING", 61)  # the drives are short
        return [make_drive(recording) for recording in recordings]


def simulate(number):
    rng = np.random.default_rng(number)
    time = np.arange(601) / 100
    phase = 0.3 * time + rng.uniform(0, 6)
    yaw, rate, speed = 0.8 * np.sin(phase), 0.24 * np.cos(phase), 25.0
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
    drives = prepare_drives(sequences)
    return evaluate_fold(drives[2:], drives[:2], (0.06,))


def test_the_reference_of_a_drive_that_is_held_out_has_no_part_in_the_choice(
    sequences, monkeypatch
):
    monkeypatch.setattr(vehicle_constants, "STEPS", 2)
    result = evaluate_first_fold(sequences)
    assert list(result.errors) == ["drive 0", "drive 1"]
    changed = evaluate_first_fold([*map(stretch_reference, sequences[:2]), *sequences[2:]])
    assert changed.choice[:2] == result.choice[:2]
    np.testing.assert_array_equal(changed.choice.point, result.choice.point)
    for name in result.errors:
        assert changed.errors[name].mean() != result.errors[name].mean()
    trained_otherwise = evaluate_first_fold(
        [*sequences[:2], *map(stretch_reference, sequences[2:])]
    )
    moved = trained_otherwise.choice.point != result.choice.point
    assert moved.all()


def test_zero_of_the_fit_is_the_default_and_one_is_a_unit_of_every_constant():
    default, other = settings_at(0.06, DEFAULTS), settings_at(0.06, np.ones(len(UNITS)))
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


def test_the_errors_of_a_drive_are_those_of_the_metrics(sequences, drives):
    (recording,), _ = prepare(sequences[1:2], WINDOWS)
    ekf = make_filter(WINDOWS, default_settings(0.06))
    start = recording.start.rotation, recording.start.velocity, recording.start.position
    absent = (
        np.full((recording.strides, 3), np.nan),
        np.zeros((recording.strides, 3, 3)) + np.eye(3),
    )
    samples = recording.strides * WINDOWS.stride
    signals = recording.gyro[:samples], recording.accel[:samples]
    _, history = run_filter(ekf, initial_state(ekf, *start), *signals, *absent)
    rotation = np.concatenate([start[0][None], history.rotation])
    position = np.concatenate([start[2][None], history.position])
    path = Trajectory(recording.time, position, quaternion_from_matrix(rotation))
    expected = 100 * piece_errors(path, recording.reference, WINDOWS.stride_seconds)[:, 0]
    assert len(expected) > 1
    np.testing.assert_allclose(measure_drive(drives[1], 0.06, DEFAULTS), expected, rtol=1e-9)


def test_the_derivatives_are_those_of_the_whole_filter(drives):
    point, step = np.linspace(-0.5, 0.5, len(UNITS)), 1e-4
    differences = [
        (
            relative_errors(drives[0], 0.06, point + step * axis)
            - relative_errors(drives[0], 0.06, point - step * axis)
        )
        / (2 * step)
        for axis in np.eye(len(UNITS))
    ]
    derivatives = differentiate(drives[0], 0.06, point)
    np.testing.assert_allclose(derivatives, np.stack(differences, axis=-1), atol=1e-6)
    assert (np.abs(derivatives).max((0, 1)) > 1e-8).all()


def objective(drives, penalty, point):
    """The mean of both errors and the penalty, %."""
    errors = [measure_drive(drive, 0.06, point) for drive in drives]
    of_drives = np.mean([of_drive.mean() for of_drive in errors])
    return 0.5 * (np.concatenate(errors).mean() + of_drives) + penalty * np.sum(point**2)


def test_a_fit_ends_where_no_constant_makes_the_objective_smaller(drives):
    point = fit(drives, 0.06, 0.03, DEFAULTS)
    value = objective(drives, 0.03, point)
    assert value < 0.9 * objective(drives, 0.03, DEFAULTS)
    steps = [s * axis for axis in np.eye(len(UNITS)) for s in (-0.5, 0.5)]
    neighbours = [objective(drives, 0.03, point + step) for step in steps]
    assert value < 1.002 * min(neighbours)


def test_approximate_leave_one_out_is_near_the_fits_without_each_drive(drives):
    point = fit(drives, 0.06, 0.3, DEFAULTS)
    without = [[other for other in drives if other is not drive] for drive in drives]
    errors = [
        measure_drive(drive, 0.06, fit(training, 0.06, 0.3, DEFAULTS))
        for drive, training in zip(drives, without, strict=True)
    ]
    exact = 0.5 * (np.concatenate(errors).mean() + np.mean([x.mean() for x in errors]))
    training_error = objective(drives, 0.0, point)
    approximate = leave_one_out(drives, 0.06, 0.3, point)
    assert training_error < exact
    assert abs(approximate - exact) < 0.3 * (exact - training_error)


def test_the_low_pass_and_the_penalty_are_those_of_the_smallest_error_of_leave_one_out(monkeypatch):
    starts = []

    def fit_by_name(drives, seconds, penalty, start):
        starts.append(start[0])
        return np.full(len(UNITS), seconds + penalty)

    monkeypatch.setattr(vehicle_constants, "fit", fit_by_name)
    monkeypatch.setattr(
        vehicle_constants,
        "leave_one_out",
        lambda drives, seconds, penalty, point: abs(seconds - 0.06) + abs(point[0] - 0.09),
    )
    choice = choose([], (0.03, 0.06, 0.09))
    assert choice[:2] == (0.06, 0.03) and choice.point[0] == pytest.approx(0.09)
    # A fit starts where the one with the penalty before has ended, and a low-pass begins anew.
    assert starts == pytest.approx([0, 0.33, 0.06, 0, 0.36, 0.09, 0, 0.39, 0.12])


def test_a_choice_among_fits_without_finite_errors_is_refused(monkeypatch):
    monkeypatch.setattr(vehicle_constants, "fit", lambda *_: DEFAULTS)
    monkeypatch.setattr(vehicle_constants, "leave_one_out", lambda *_: np.inf)
    with pytest.raises(ValueError, match="no fit has finite errors"):
        choose([], (0.06,))


def test_the_program_prints_the_errors_of_all_drives_and_runs_a_part_of_the_folds(
    sequences, monkeypatch, capsys
):
    monkeypatch.setattr(vehicle_constants, "PENALTIES", (0.03,))
    monkeypatch.setattr(vehicle_constants, "STEPS", 2)
    monkeypatch.setattr(vehicle_constants.data, "load", lambda *_: sequences)
    words = "vehicle_constants --low-pass 0.06".split()
    monkeypatch.setattr(sys, "argv", [*words, "--folds", "2"])
    vehicle_constants.main()
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("4 drives, ")
    for beginning in ("defaults, low-pass chosen: ", "fold 0, ", "fold 1, ", "constants chosen: "):
        assert sum(line.startswith(beginning) for line in lines) == 1

    monkeypatch.setattr(sys, "argv", [*words, "--folds", "2", "--only", "1"])
    vehicle_constants.main()
    part = capsys.readouterr().out.splitlines()
    assert not any("fold 0" in line for line in part)
    of_fold = [[x for x in text if x.startswith("fold 1, ")] for text in (lines, part)]
    assert of_fold[0] == of_fold[1]

    # Without a number of folds each drive is one.
    monkeypatch.setattr(sys, "argv", [*words, "--only", "3"])
    vehicle_constants.main()
    assert "fold 3, drive 3: " in capsys.readouterr().out


def test_the_constants_of_all_drives_are_printed_as_a_file_has_them(sequences, monkeypatch, capsys):
    monkeypatch.setattr(vehicle_constants, "PENALTIES", (0.03,))
    monkeypatch.setattr(vehicle_constants, "STEPS", 2)
    monkeypatch.setattr(vehicle_constants.data, "load", lambda *_: sequences)
    words = "vehicle_constants --low-pass 0.06 --all-drives".split()
    monkeypatch.setattr(sys, "argv", words)
    vehicle_constants.main()
    head, lines = capsys.readouterr().out.split("filter:\n")
    loaded, _ = vehicle_constants.load_drives(None, None)
    _, _, point = choose(loaded, [0.06])
    assert "constants of all drives, on them: all pieces " in head and np.any(point)
    settings = configuration.parse("filter:\n" + lines, "fit").filter
    expected = free_parameters(settings_at(0.06, point), UNITS)
    for name, value in free_parameters(settings, UNITS).items():
        assert float(value) == pytest.approx(float(expected[name]), abs=0.01), name
    assert settings.low_pass_seconds == 0.06
    for words_of_folds in (["--folds", "2"], ["--only", "0"]):
        monkeypatch.setattr(sys, "argv", [*words, *words_of_folds])
        with pytest.raises(SystemExit):
            vehicle_constants.main()
        assert "--all-drives: holds no drive out" in capsys.readouterr().err


def test_a_fold_that_does_not_exist_is_refused(sequences, monkeypatch, capsys):
    monkeypatch.setattr(vehicle_constants.data, "load", lambda *_: sequences)
    monkeypatch.setattr(sys, "argv", "vehicle_constants --folds 2 --only 2".split())
    with pytest.raises(SystemExit):
        vehicle_constants.main()
    assert "--only: there are the folds 0 to 1" in capsys.readouterr().err
