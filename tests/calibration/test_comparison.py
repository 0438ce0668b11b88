"""The errors of trajectories before and after a calibration: against trajectories whose errors have
a closed form, and against runs of the filter, one walk at a time, with errors in plain NumPy."""

import dataclasses
import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import calibration, filtering
from gnio_jax.calibration import comparison
from gnio_jax.calibration.comparison import Change, Effect
from gnio_jax.calibration.fit import ConsiderFit, InnovationFit
from gnio_jax.commands import app
from gnio_jax.config import CorrelatedError, DataConfig, FilterSettings
from gnio_jax.evaluation import Displacements, PreparedRecording, SequenceEstimate, Trajectory
from gnio_jax.evaluation.prepare import Start
from tests.support.filter_settings import changed
from tests.support.walks import simulate

DATA = DataConfig(rate=50.0, window_seconds=0.4, stride_seconds=0.1)
STRIDES, N, CLONES, SIGMA = 200, 5, 4, 0.05


def recording(name, time, position, rotation, gyro, accel, start):
    """A walk whose reference is at all rows of `time`."""
    quaternion = np.roll(Rotation.from_matrix(rotation).as_quat(), 1, axis=1)
    reference = Trajectory(time, position, quaternion)
    nothing = np.full((1, 3), np.nan)
    return PreparedRecording(
        name, name, "", time, gyro, accel, None, start, None, reference, nothing, nothing, ()
    )


def simulated():
    """A walk with a raw gyro and one with a compensated gyro, and their displacements."""
    noise, std = filtering.NoiseModel(2e-3, 2e-2, 1e-6, 1e-4), filtering.InitialStd(gyro_bias=5e-3)
    runs = simulate(7, 2, STRIDES, N, CLONES, 1 / DATA.rate, noise, std, SIGMA)
    time, walks, displacements = DATA.stride_seconds * np.arange(STRIDES + 1), [], []
    for k in range(2):
        pose = runs.rotation0[k], runs.velocity0[k], runs.position0[k]
        start = Start(*pose, np.zeros(3), std, 1.0, k == 0)  # a comparison takes its own settings'
        position = np.concatenate([runs.position0[k, None], runs.position[k]])
        rotation = np.concatenate([runs.rotation0[k, None], runs.rotation[k]])
        signals = runs.gyro[k], runs.accel[k]
        walks.append(recording(f"walk{k}", time, position, rotation, *signals, start))
        covariance = np.broadcast_to(SIGMA**2 * np.eye(3), (STRIDES, 3, 3))
        displacements.append(Displacements(runs.displacement[k], covariance))
    return walks, displacements


def filtered(walk, displacement, settings):
    """Positions and attitudes of the filter, with its first ones."""
    ekf, start = filtering.make_filter(DATA, settings), walk.start
    level = settings.raw_gyro_bias if start.raw_gyro else settings.start.gyro_bias
    pose = start.rotation, start.velocity, start.position, start.gyro_bias, 0
    state = filtering.initial_state(ekf, *pose, level)
    signals = walk.gyro, walk.accel, *displacement[:2]
    history = filtering.run_filter(ekf, state, *signals)[1]
    rotation = np.concatenate([start.rotation[None], history.rotation])
    return np.concatenate([start.position[None], history.position]), Rotation.from_matrix(rotation)


def errors(walk, position, attitude):
    """ATE and RPE over a second, m, and the ratio of the lengths, by loops."""
    truth = walk.reference.position
    true = Rotation.from_quat(np.roll(walk.reference.orientation, -1, axis=1))
    twist = (attitude * true.inv()).as_quat() * [0, 0, 1, 1]  # of the error about z
    second, squares, lengths = round(1 / DATA.stride_seconds), [], np.zeros(2)
    for k in range(len(truth) - second):
        step = Rotation.from_quat(twist[k]).inv().apply(position[k + second] - position[k])
        squares.append(np.sum((step - (truth[k + second] - truth[k])) ** 2))
    for k in range(0, len(truth) - second, second):
        lengths += [np.linalg.norm(path[k + second] - path[k]) for path in (position, truth)]
    ate = np.sqrt(np.mean(np.sum((position - truth) ** 2, axis=1)))
    return ate, np.sqrt(np.mean(squares)), lengths[0] / lengths[1]


def test_both_filters_run_as_their_settings_say():
    """The start has their uncertainty, and no error is correlated before the calibration."""
    walks, displacements = simulated()
    before = changed(noise={"gyro_density": 1e-3, "measurement_scale": 9.0})
    before = dataclasses.replace(before, raw_gyro_bias=0.05)
    correlated = {"measurement_scale": 1.0, "correlation": CorrelatedError(0.7, 0.5)}
    biases = {"gyro_bias": 0.02, "accel_bias": 0.3}
    after = changed(before, noise=correlated, start=biases, considered={"scale": 0.5})
    effect = comparison.compare_filters(walks, displacements, DATA, before, after)
    expected = np.mean(
        [
            [errors(walk, *filtered(walk, rows, settings)) for settings in (before, after)]
            for walk, rows in zip(walks, displacements, strict=True)
        ],
        axis=0,
    )
    assert tuple(effect.errors) == ("ate", "rpe_1s", "path_length_ratio")
    np.testing.assert_allclose(np.transpose([*effect.errors.values()]), expected, rtol=1e-6)
    assert (np.abs(expected[0] / expected[1] - 1) > 0.005).all()  # the settings make a difference
    assert effect.diverged == (0, 0) and effect.recordings == 2


def along_x(speeds, diverged=()):
    """Estimates of walks along x at the speeds, m/s, whose truth walks at 1 m/s for 20 s."""
    time, level = np.arange(201) / 10, np.tile([1.0, 0.0, 0.0, 0.0], (201, 1))
    for number, speed in enumerate(speeds):
        position = time[:, None] * [1.0, 0.0, 0.0]
        path = np.where((time[:, None] > 5) & (number in diverged), np.nan, speed * position)
        yield SequenceEstimate(
            "walk", *(Trajectory(time, points, level) for points in (path, position))
        )


def test_a_mean_is_over_the_walks_on_which_neither_filter_diverges(monkeypatch):
    results = iter([along_x((1.1, 1.2, 1.7), [2]), along_x((0.9, 1.0, 1.0))])

    def estimate(recordings, *_):
        return [
            result._replace(name=walk.name)
            for walk, result in zip(recordings, next(results), strict=True)
        ]

    monkeypatch.setattr(comparison, "estimate", estimate)
    (walk, _), _ = simulated()
    arguments = [walk] * 3, [], DATA, FilterSettings(), FilterSettings()  # three of one name
    effect = comparison.compare_filters(*arguments)
    rms = np.sqrt(np.mean((np.arange(201) / 10) ** 2))
    assert effect.errors["ate"] == pytest.approx((0.15 * rms, 0.05 * rms))
    assert effect.errors["rpe_1s"] == pytest.approx((0.15, 0.05))
    assert effect.errors["path_length_ratio"] == pytest.approx((1.15, 0.95))
    assert effect.diverged == (1, 0) and effect.recordings == 3
    assert effect.warnings == ()

    results = iter([along_x((1.1, 1.1, 1.1)), along_x((1.0, 1.0, 1.0), [0, 1, 2])])
    effect = comparison.compare_filters(*arguments)
    assert set(effect.errors.values()) == {Change(None, None)}
    (line,) = effect.warnings
    assert line.startswith(
        "the calibrated filter diverges on 3 of 3 recordings, and the filter of "
    )
    assert "of the run on 0; use the run as it was" in line


@pytest.mark.parametrize(
    ("metric", "before", "after", "figures"),
    [
        ("ate", 3.05, 11.25, "ATE 3.05 -> 11.25 m"),
        ("ate", 3.05, 3.049, None),
        ("ate", 3.051, 3.054, None),  # the same in the table
        ("rpe_1s", 0.482, 0.483, "RPE 1 s 0.482 -> 0.483 m"),
        ("path_length_ratio", 0.65, 1.91, "path ratio 0.65 -> 1.91"),
        ("path_length_ratio", 0.65, 1.34, None),
        ("path_length_ratio", 1.02, 0.97, "path ratio 1.02 -> 0.97"),
    ],
)
def test_an_error_that_grows_is_a_warning(metric, before, after, figures):
    errors = {"ate": Change(None, None), metric: Change(before, after)}
    warnings = Effect(errors, Change(0, 0), 9).warnings
    lines = [line.split("; ")[0] for line in warnings]
    expected = f"these recordings have larger errors with the calibrated filter: {figures}"
    assert lines == ([expected] if figures else [])


@pytest.mark.parametrize(
    ("raw", "others", "few"),
    [
        (0, 5, []),
        (5, 5, []),
        (0, 4, ["only 4 recordings without a raw gyro"]),
        (1, 9, ["only 1 recording with a raw gyro"]),
        (4, 1, ["only 4 recordings with a raw gyro", "only 1 recording without a raw gyro"]),
    ],
)
def test_a_group_of_fewer_than_five_recordings_is_a_warning(raw, others, few):
    fit, worse = (
        InnovationFit(FilterSettings(), 0.0, 0.0, 3, ("the fit stopped",)),
        Change(1.0, 2.0),
    )
    result = calibration.Calibration(
        FilterSettings(),
        fit,
        None,
        Effect({"ate": worse}, Change(0, 0), 9),
        raw + others,
        raw,
        None,
    )
    stopped, larger, *lines = result.warnings
    assert stopped == "the fit stopped" and "ATE 1.00 -> 2.00 m" in larger
    assert [line.split(":")[0] for line in lines] == few


def test_the_command_shows_divergences_and_recordings(monkeypatch, tmp_path, capsys):
    errors = {"ate": Change(3.05, 11.25), "path_length_ratio": Change(0.65, None)}
    fit = InnovationFit(FilterSettings(), 0.0, 0.0, 3)
    result = calibration.Calibration(
        FilterSettings(),
        fit,
        ConsiderFit(FilterSettings(), 1.0, 1.0),
        Effect(errors, Change(2, 1), 12),
        12,
        3,
        tmp_path,
    )
    monkeypatch.setattr(calibration, "calibrate", lambda *_: result)
    app.main(["calibrate"])
    output = capsys.readouterr()
    rows = [re.split(r"\s{2,}", line.strip()) for line in output.out.splitlines()]
    assert [row for row in rows if row[0] in ("ATE (m)", "path ratio (best 1)", "diverged")] == [
        ["ATE (m)", "3.05", "11.25"],
        ["path ratio (best 1)", "0.65", "–"],
        ["diverged", "2 of 12", "1 of 12"],
    ]
    assert "recordings: 3 with a raw gyro, 9 without\n" in output.out
    assert output.err.splitlines() == [f"warning: {line}" for line in result.warnings]
    assert len(result.warnings) == 3
