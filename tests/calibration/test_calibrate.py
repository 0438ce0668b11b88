"""A calibrated run and its messages; the fitted settings against the noises of simulated walks,
consider covariances against the errors of drawn positions, the gradient against differences.

All fits use walks, windows and settings of one shape, and one walk for each device, so each of
their programs is compiled once and without a vmap.
"""

import dataclasses
import functools
import json
import re
import shutil
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import pytest
from scipy.optimize import OptimizeResult
from scipy.spatial.transform import Rotation

from gnio_jax import calibration, data, filtering, models
from gnio_jax.calibration import fit as fitting
from gnio_jax.calibration import predictions
from gnio_jax.calibration import run as calibrating
from gnio_jax.commands import app
from gnio_jax.config import (
    CalibrateConfig,
    CorrelatedError,
    DataConfig,
    FilterSettings,
    ModelConfig,
    TrainConfig,
    to_plain,
)
from gnio_jax.data.simulated import walks as simulated
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Displacements, SequenceEstimate, Trajectory
from gnio_jax.evaluation.estimate import BatchInputs, filter_inputs
from gnio_jax.evaluation.prepare import Start, prepare
from gnio_jax.filtering.settings import free_parameters
from gnio_jax.filtering.state import GYRO_BIAS
from gnio_jax.networks import load
from tests.support import estimators, tiny_run
from tests.support.filter_settings import changed
from tests.support.walks import simulate, with_correlated_errors

DATA = DataConfig(rate=50.0, window_seconds=0.4, stride_seconds=0.1)
WALKS, STRIDES, N, CLONES, SIGMA = 2, 400, 5, 4, 0.05
TRAINED = TrainConfig(
    data=DATA,
    model=ModelConfig(name="tiny", width=4),
    filter=changed(start={"velocity": 0.7}),
)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    with tiny_run.registry_entry():
        yield tiny_run.save(tmp_path_factory.mktemp("trained") / "run", TRAINED)


@pytest.fixture
def splits_read(monkeypatch):
    """Every split has short walks; the splits that were read."""
    seconds = (STRIDES + 1) * DATA.stride_seconds  # the first sample has no pose to start from
    seeds, read = range(1, WALKS + 1), []
    walks = [simulated.pedestrian(seed, seed, "handheld", seconds, 50.0) for seed in seeds]
    monkeypatch.setattr(data, "load", lambda name, root, split, *_: read.append(split) or walks)
    return read


def test_the_calibrated_run_differs_only_in_its_filter_and_average(
    run, splits_read, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(calibrating, "MOST_STEPS", 2)  # the search is tested below
    run, out = shutil.copytree(run, tmp_path / "run"), tmp_path / "calibrated"
    for name in ("splits.yaml", "metrics.jsonl"):
        (run / name).write_text(f"{name} of the run")
    words = ["calibrate", "--network", str(run), "--out", str(out), "--average-headings"]
    app.main([*words, "--fit", "measurement", "noise", "window"])
    output, warned = capsys.readouterr()
    assert "warning: the fit stopped after 2 steps" in warned
    assert f"warning: only {WALKS} recordings without a raw gyro: fewer than 5" in warned
    assert f"recordings: 0 with a raw gyro, {WALKS} without" in output
    assert "noise.std_factor" in output and f"gnio evaluate --network {out}" in output
    assert splits_read == ["val"]
    before, after = (load(folder) for folder in (run, out))
    assert after.config.model.equivariance == "four_headings"
    same = {name: getattr(before.config, name) for name in ("workdir", "filter", "model")}
    assert dataclasses.replace(after.config, **same) == before.config
    jax.tree.map(np.testing.assert_array_equal, after.variables, before.variables)
    for name in ("splits.yaml", "metrics.jsonl"):
        assert (out / name).read_text() == f"{name} of the run"
    settings = after.config.filter
    assert settings.start == TRAINED.filter.start
    assert settings.noise.correlation.share > 0 and settings.noise.std_factor[0] != 1
    record = json.loads((out / "calibration.json").read_text())
    likelihood = record["negative_log_likelihood_per_innovation"]
    assert likelihood["after"] < likelihood["before"]
    assert settings.considered.gyro_bias > 0
    nees = record["position_nees_per_axis"]
    assert abs(np.log(nees["after"])) < abs(np.log(nees["before"]))
    assert record["split"] == "val" and record["filter"] == to_plain(settings)
    assert record["recordings"] == WALKS and record["recordings_with_raw_gyro"] == 0
    assert [f"warning: {line}" for line in record["warnings"]] == warned.splitlines()
    change = record["trajectories"]["ate"]
    assert f"ATE (m) {change['before']:.2f} {change['after']:.2f}" in re.sub(" +", " ", output)
    assert change["before"] != change["after"] and "diverged" not in output


def test_the_displacements_of_a_fit_have_the_networks_own_uncertainty(monkeypatch, tmp_path):
    """Whatever an earlier fit has written to the run."""
    noise = {"std_factor": (2.0, 3.0, 4.0), "measurement_scale": 5.0, "gyro_density": 2e-4}
    fitted = dataclasses.replace(
        TRAINED, filter=changed(noise=noise, considered={"scale": 0.1, "heading": 0.2})
    )

    class Finished(Exception):
        pass

    def predict(split, networks, config, settings, *_):
        raise Finished(settings)

    monkeypatch.setattr(calibrating, "predict", predict)
    with tiny_run.registry_entry(), pytest.raises(Finished) as caught:
        folder = tiny_run.save(tmp_path / "run", fitted)
        calibration.calibrate(CalibrateConfig(str(folder), out=str(tmp_path / "out")))
    (settings,) = caught.value.args
    assert settings.noise.std_factor == (1.0, 1.0, 1.0)
    assert settings.noise.measurement_scale == 1.0 and settings.noise.gyro_density == 2e-4
    assert settings.considered == filtering.ConsideredStd()


def test_a_network_is_averaged_over_four_headings(run):
    loaded = load(run)
    averaged = predictions.average_over_headings(loaded, "the run")
    assert averaged.config.model.equivariance == "four_headings"
    assert averaged.model == models.from_config(averaged.config.model) != loaded.model


def estimate(error, std):
    rows = len(error) + 2
    path = Trajectory(np.arange(rows), np.zeros((rows, 3)), np.zeros((rows, 4)))
    before = np.full((2, 3), np.nan)
    value, std = (np.concatenate([before, values]) for values in (1.0 + error, std))
    return SequenceEstimate("walk", path, path, Displacements(value, uncorrelated(std)))


def uncorrelated(std):
    return std[..., None] ** 2 * np.eye(3)


def test_the_factors_are_those_of_the_errors():
    rng = np.random.default_rng(0)
    std = rng.uniform(0.05, 0.2, (400, 3))
    error = std * np.array([1.5, 0.5, 3.0]) * rng.choice([-1.0, 1.0], (400, 3))
    truth = np.ones((400, 3))
    truth[:50, 1] = np.nan
    factors = fitting.fit_std_factors([estimate(error, std)], [truth])
    np.testing.assert_allclose(factors, [1.5, 0.5, 3.0], rtol=1e-12)
    with pytest.raises(ValueError, match="10 windows have a reference"):
        truth[:390] = np.nan
        fitting.fit_std_factors([estimate(error, std)], [truth])


@pytest.mark.parametrize("pitch", [0.0, 80.0])
def test_a_tilt_of_the_filter_is_no_error_of_the_network(
    pitch, run, splits_read, tmp_path, monkeypatch
):
    """Displacements with errors of their standard deviation have factors of 1, whether the x axis
    of the phone is level or steep. The filter's attitude errs by a tilt of a degree and a yaw of
    40°, and the network answers in its yaw frame."""
    held = Rotation.from_euler("y", pitch, degrees=True)
    level, walks = Rotation.identity(), data.load("synthetic", None, "val")
    if pitch:
        level = Rotation.from_quat(np.roll(walks[0].orientation[1], -1)).inv() * held
    recordings, _ = prepare(walks, DATA)
    random, estimates, spun = np.random.default_rng(0), [], Rotation.from_euler("z", 0.7)
    tilt = Rotation.from_rotvec([0.6 * np.radians(1.0), 0.8 * np.radians(1.0), 0.0])
    for recording in recordings:
        path = recording.reference
        attitude = Rotation.from_quat(np.roll(path.orientation, -1, axis=1)) * level
        filter_attitude = tilt * spun * attitude
        value = np.full(path.position.shape, np.nan)
        for row in range(CLONES + 1, len(value)):
            x_axis = filter_attitude[row - CLONES].as_matrix()[:, 0]
            moved = spun.apply(path.position[row] - path.position[row - CLONES])
            value[row] = Rotation.from_euler("z", -np.arctan2(x_axis[1], x_axis[0])).apply(moved)
        value += 0.01 * random.standard_normal(value.shape)
        rows = Displacements(value, np.tile(1e-4 * np.eye(3), (len(value), 1, 1)))
        reference, estimated = (
            path._replace(orientation=np.roll(turns.as_quat(), 1, axis=1))
            for turns in (attitude, filter_attitude)
        )
        moved = spun.apply(path.position)
        estimates.append(
            SequenceEstimate(recording.name, estimated._replace(position=moved), reference, rows)
        )
    pairs = predictions.Predictions(recordings, estimates)
    monkeypatch.setattr(calibrating, "predict", lambda *_: pairs)

    class Fitted(Exception):
        pass

    def fit_innovations(walks, windows, settings, *_):
        raise Fitted(settings)

    monkeypatch.setattr(calibrating, "fit_innovations", fit_innovations)
    with pytest.raises(Fitted) as caught:
        calibration.calibrate(CalibrateConfig(str(run), out=str(tmp_path / "calibrated")))
    (settings,) = caught.value.args
    np.testing.assert_allclose(settings.noise.std_factor, 1.0, rtol=0.1)


@pytest.fixture(scope="module")
def fold_runs(run, tmp_path_factory):
    """Copies of the run as the folds of one experiment, whose networks differ by a factor."""
    folders, loaded, parent = [], load(run), tmp_path_factory.mktemp("folds")
    for fold in (0, 1):
        windows = dataclasses.replace(loaded.config.data, train_split=f"train-{fold}of2")
        config = dataclasses.replace(loaded.config, data=windows, workdir=None)
        folders.append(str(tiny_run.save(parent / f"fold{fold}", config, size=0.2 + fold)))
    return folders


def test_each_session_has_the_predictions_of_the_network_that_left_it_out(
    run, splits_read, fold_runs, monkeypatch
):
    def asked_about(prepared, network, *_, **__):
        return [(recording.name, network.variables) for recording in prepared]

    monkeypatch.setattr(predictions, "estimate", asked_about)
    loaded = load(run)
    config = CalibrateConfig(network=str(run), out_of_fold=tuple(fold_runs))
    split, networks = predictions.choose_networks(loaded, config)
    result = predictions.predict(split, networks, config, loaded.config.filter, lambda *_: None, 1)
    assert splits_read == ["train"] and len(result.estimates) == WALKS
    fold_of = data.folds(data.load("synthetic", None, "train"), 2)
    assert sorted(set(fold_of.values())) == [0, 1]
    for recording, (name, variables) in zip(*result, strict=True):
        of_fold = load(fold_runs[fold_of[recording.group]])
        network = models.Network.of(of_fold.model, of_fold.variables)
        assert recording.name == name and tiny_run.same(variables, network.variables)


def test_the_network_of_every_fold_is_averaged_over_headings(run, fold_runs):
    config = CalibrateConfig(str(run), out_of_fold=tuple(fold_runs), average_headings=True)
    _, networks = predictions.choose_networks(predictions.load_network(run, config), config)
    for source in networks:
        assert source.run.config.model.equivariance == "four_headings"


def test_walks_without_a_reference_are_left_out_and_raw_gyros_have_a_wide_start(run, monkeypatch):
    """A raw gyro has uncertain level biases, as in an evaluation."""
    walks = [simulated.pedestrian(seed, seed, "handheld", 5.0, 50.0) for seed in (1, 2, 3)]
    walks[0] = walks[0]._replace(valid=np.zeros(len(walks[0].time), bool))
    raw = {**walks[1].attributes, "imu_compensated": "no"}
    walks[1] = walks[1]._replace(attributes=raw)
    monkeypatch.setattr(data, "load", lambda *_: walks)
    monkeypatch.setattr(predictions, "estimate", lambda prepared, *_, **__: prepared)
    loaded, config = load(run), CalibrateConfig(str(run))
    settings = dataclasses.replace(loaded.config.filter, raw_gyro_bias=0.05)
    split, networks = predictions.choose_networks(loaded, config)
    recordings, _ = predictions.predict(split, networks, config, settings, lambda *_: None, 1)
    assert [recording.name for recording in recordings] == [walk.name for walk in walks[1:]]
    stds = [recording.start.level_gyro_bias for recording in recordings]
    assert stds == [0.05, settings.start.gyro_bias]


def test_displacements_and_true_positions_have_their_times(run, splits_read, tmp_path, monkeypatch):
    """Each true displacement, with an error of a centimetre, is in the interval at whose end its
    window ends. The filter then has errors of a few centimetres, and a walk moves by 0.13 m in a
    stride."""
    recordings, _ = prepare(data.load("synthetic", None, "val"), DATA)
    random, estimates, inputs, positions = np.random.default_rng(0), [], [], []
    for recording in recordings:
        path = recording.reference
        attitude = Rotation.from_quat(np.roll(path.orientation, -1, axis=1)).as_matrix()
        value = np.full(path.position.shape, np.nan)
        for row in range(CLONES + 1, len(value)):  # row k is at the end of stride k
            oldest = row - CLONES
            yaw = np.arctan2(attitude[oldest, 1, 0], attitude[oldest, 0, 0])
            step = path.position[row] - path.position[oldest]
            value[row] = Rotation.from_euler("z", -yaw).apply(step)
        value += 0.01 * random.standard_normal(value.shape)
        rows = Displacements(value, np.tile(1e-4 * np.eye(3), (len(value), 1, 1)))
        estimates.append(SequenceEstimate(recording.name, path, path, rows))

    def unfitted(walks, windows, settings, *_):
        inputs.append(walks)
        return fitting.InnovationFit(settings, 0.0, 0.0, 1)

    def compare_positions(*arguments):
        positions.append(fitting.compare_positions(*arguments))
        return positions[0]

    pairs = predictions.Predictions(recordings, estimates)
    monkeypatch.setattr(calibrating, "predict", lambda *_: pairs)
    monkeypatch.setattr(calibrating, "fit_innovations", unfitted)
    monkeypatch.setattr(calibrating, "compare_positions", compare_positions)
    calibration.calibrate(CalibrateConfig(str(run), out=str(tmp_path / "calibrated")))
    for value, walk in zip(inputs[0].displacements.value, estimates, strict=True):
        for interval in (CLONES, 100, STRIDES - 1):
            assert (value[interval] == walk.displacements.value[interval + 1]).all()
    assert len(positions[0].error) == WALKS * STRIDES
    assert np.sqrt(np.mean(positions[0].error ** 2, axis=0)).max() < 0.07


PATHS = (*fitting.GROUPS["measurement"], *fitting.GROUPS["noise"], *fitting.GROUPS["window"])
ERRORS = CorrelatedError(0.8, 0.5)
TRUE = changed(
    noise={
        "gyro_density": 2e-3,
        "accel_density": 2e-2,
        "measurement_scale": 1.0,
        "correlation": ERRORS,
    },
    start={"gyro_bias": 1e-3},
)


@functools.cache
def walks_and_truth():
    """Walks with the true positions after each stride. The displacements have errors of `SIGMA`,
    and the network reports a third of it."""
    noise, std = filtering.NoiseModel(2e-3, 2e-2, 1e-6, 1e-4), filtering.InitialStd(gyro_bias=1e-3)
    runs = simulate(5, WALKS, STRIDES, N, CLONES, 1 / DATA.rate, noise, std, SIGMA)
    runs = with_correlated_errors(runs, CLONES, SIGMA, ERRORS, DATA.stride_seconds)
    std = filtering.InitialStd(*np.ones((6, WALKS)))  # a fit takes that of the settings
    raw = np.zeros(WALKS, bool)
    start = Start(*runs[:3], np.zeros((WALKS, 3)), std, std.gyro_bias, raw)
    displacements = Displacements(
        runs.displacement, uncorrelated(np.full_like(runs.displacement, SIGMA / 3))
    )
    return BatchInputs(start, runs.gyro, runs.accel, None, displacements), runs.position


def fit(walks, settings, **options):
    return fitting.fit_innovations(walks, DATA, settings, PATHS, lambda calls: None, **options)


def test_the_noises_and_errors_of_simulated_walks_are_found():
    wrong = {"gyro_density": 8e-4, "accel_density": 6e-2, "correlation": CorrelatedError(0.6, 0.8)}
    result = fit(walks_and_truth()[0], changed(TRUE, noise=wrong))
    noise = result.settings.noise
    assert result.after < result.before - 0.1
    assert noise.measurement_scale == pytest.approx(9.0, rel=0.15)
    assert noise.gyro_density == pytest.approx(2e-3, rel=0.4)
    assert noise.accel_density == pytest.approx(2e-2, rel=0.4)
    assert noise.correlation.share == pytest.approx(0.8, abs=0.1)
    assert noise.correlation.seconds == pytest.approx(0.5, rel=0.4)
    assert result.warnings == () and result.steps < 60


def test_the_gradient_equals_differences_of_the_likelihood():
    free = free_parameters(TRUE, PATHS)
    fixed = {"names": tuple(free), "windows": DATA}
    free, rng = np.array(list(free.values())), np.random.default_rng(0)

    def at(vector):
        arguments = vector, walks_and_truth()[0], free, TRUE
        return jax.device_get(fitting._value_and_gradient(*arguments, **fixed))

    gradient = np.asarray(at(free)[1])
    assert (gradient != 0).all()
    for _ in range(2):
        step = 1e-4 * rng.uniform(0.5, 1.5, len(free)) * rng.choice([-1.0, 1.0], len(free))
        ahead, behind = (float(at(free + off)[0][0]) for off in (step, -step))
        np.testing.assert_allclose(2 * gradient @ step, ahead - behind, rtol=1e-3, atol=1e-11)


@pytest.mark.parametrize(("raw", "expected"), [(True, 0.05), (False, 1e-3)])
def test_noises_are_fitted_with_the_whole_bias_of_a_raw_gyro_uncertain(raw, expected):
    settings = dataclasses.replace(TRUE, raw_gyro_bias=0.05)
    walk = jax.tree.map(lambda leaf: leaf[0], walks_and_truth()[0])
    walk = walk._replace(start=walk.start._replace(raw_gyro=np.bool_(raw)))
    ekf = fitting.innovation_filter(DATA, settings)
    starts = fitting._wide_start(walk, settings), fitting.apply_start_settings(walk.start, settings)
    states = (start.state(ekf) for start in starts)
    spreads = (
        np.sqrt(np.linalg.eigvalsh(state.core_covariance[GYRO_BIAS, GYRO_BIAS])) for state in states
    )
    np.testing.assert_allclose(next(spreads), [expected] * 3, rtol=1e-9)
    np.testing.assert_allclose(next(spreads), [1e-3, expected, expected], rtol=1e-9)


def test_a_second_calibration_compiles_nothing_and_an_early_end_is_a_warning(monkeypatch):
    walks, _ = walks_and_truth()
    monkeypatch.setitem(fitting.PHYSICAL, "noise.measurement_scale", (1e8, 1e9))
    warning, outside = fit(walks, TRUE, most_steps=1).warnings
    assert outside.startswith("filter.noise.measurement_scale came out as ")
    assert warning.startswith("the fit stopped after 1 steps, ") and "--fit" in warning
    options = {f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(CalibrateConfig)}
    assert set(re.findall(r"--[a-z-]+", warning)) <= options  # the remedy exists
    programs = fitting._value_and_gradient._cache_size()
    others = walks._replace(
        displacements=walks.displacements._replace(value=1.01 * walks.displacements.value)
    )
    settings = changed(TRUE, noise={"std_factor": (0.7, 1.0, 1.0)}, start={"velocity": 0.2})
    fit(others, settings, most_steps=1)
    assert programs > 0 and fitting._value_and_gradient._cache_size() == programs


def test_a_new_search_begins_until_it_gains_nothing(monkeypatch):
    begun = []

    def minimize(function, at, options, **_):
        function(at)
        begun.append((float(at[0]), options["maxiter"]))
        return OptimizeResult(x=at + 0.1, fun=-min(len(begun), 3.0), nit=5, success=True)

    monkeypatch.setattr(fitting, "minimize", minimize)
    result = fit(walks_and_truth()[0], TRUE, most_steps=40)
    start = next(iter(free_parameters(TRUE, PATHS).values()))
    assert begun == [(pytest.approx(start + 0.1 * k), 40 - 5 * k) for k in range(4)]
    assert result.steps == 20 and result.warnings == ()
    reached = next(iter(free_parameters(result.settings, PATHS).values()))
    assert reached == pytest.approx(start + 0.4, abs=1e-3)


@pytest.mark.parametrize(
    ("searches", "problem"),
    [
        ([(-1.0, 39, True), (-1.00001, 1, True)], None),  # the last one gains nothing
        ([(-1.0, 20, True), (-2.0, 20, True)], "the fit stopped after 40 steps, before it"),
        ([(-1.0, 5, True), (-1.0, 0, False)], None),  # no step from where another has converged
        ([(-1.0, 5, True), (-2.0, 5, False), (-2.0, 0, False)], "10 steps, because no step along"),
    ],
)
def test_a_search_that_ends_too_early_is_a_warning(monkeypatch, searches, problem):
    """A search has the value that it reaches, its steps, and whether it has converged."""
    ends = iter(searches)

    def minimize(function, at, **_):
        function(at)
        value, steps, success = next(ends)
        return OptimizeResult(x=at, fun=value, nit=steps, success=success)

    value = lambda free, *_, **__: ((free @ free, free @ free), 2 * free)  # noqa: E731
    monkeypatch.setattr(fitting, "_value_and_gradient", value)
    monkeypatch.setattr(fitting, "minimize", minimize)
    warnings = fit(walks_and_truth()[0], TRUE, most_steps=40).warnings
    assert next(ends, None) is None
    assert [problem in warning for warning in warnings] == ([True] if problem else [])


def test_implausible_values_are_warnings():
    noise = {"accel_bias_walk": 2.656, "correlation": CorrelatedError(0.9999, 5.9e4)}
    names = ("noise.gyro_density", "noise.accel_bias_walk", "noise.correlation.share")
    warnings = fitting.find_implausible(
        changed(TRUE, noise=noise), (*names, "noise.correlation.seconds")
    )
    assert [line.split(" came out as ")[0] for line in warnings] == [
        "filter.noise.accel_bias_walk",
        "filter.noise.correlation.share",
        "filter.noise.correlation.seconds",
    ]
    assert "5.9e+04, outside 0.05 to 60: these recordings do not determine it" in warnings[2]


def test_a_correlation_that_is_off_gets_a_start():
    off = changed(TRUE, start={"gyro_bias": 0.0})
    begun = fitting.start_of_fit(off, (*fitting.GROUPS["noise"], *fitting.GROUPS["window"]))
    assert begun.noise.correlation == CorrelatedError(0.8, 0.5)
    with_correlation = changed(TRUE, noise={"correlation": CorrelatedError(0.3, 0.7)})
    assert fitting.start_of_fit(with_correlation, fitting.GROUPS["window"]) == with_correlation


def test_the_padding_of_a_walk_has_no_effect():
    walks, strides = walks_and_truth()[0], STRIDES - 40
    after = np.arange(N * STRIDES)[:, None] >= N * strides
    nothing = np.arange(STRIDES)[:, None] >= strides
    rows = Displacements(
        np.where(nothing, np.nan, walks.displacements.value),
        np.where(nothing[..., None], np.eye(3), walks.displacements.covariance),
    )
    still, falling = [0.0, 0.0, 9.81], [90.0, 0.0, 9.81]  # to 360 m/s, beyond the filter's bound
    evidences = [
        fit(
            walks._replace(
                gyro=np.where(after, 0.0, walks.gyro),
                accel=np.where(after, force, walks.accel),
                displacements=rows,
            ),
            TRUE,
            most_steps=1,
        ).before
        for force in (still, falling)
    ]
    np.testing.assert_allclose(*evidences, rtol=1e-9)
    # The mean is over the existing rows; with the last tenth it is almost the same.
    np.testing.assert_allclose(evidences[0], fit(walks, TRUE, most_steps=1).before, rtol=0.03)


def test_the_consider_fit_finds_the_errors_of_drawn_positions():
    rng = np.random.default_rng(0)
    rows = 4000
    root = 0.1 * rng.standard_normal((rows, 3, 3)) + 0.3 * np.eye(3)
    covariance = root @ root.transpose(0, 2, 1)
    # Metres for a unit of each: bias rad/s, log scale, heading rad, slope.
    sensitivity = rng.standard_normal((rows, 3, 6)) * [200.0, 200.0, 5.0, 5.0, 5.0, 40.0]
    expected = np.array([2e-3, 2e-3, 2e-3, 0.1, np.deg2rad(8.0), 0.01])
    drawn = np.einsum("kij,kj->ki", root, rng.standard_normal((rows, 3)))
    error = drawn + np.einsum("kic,kc->ki", sensitivity, expected * rng.standard_normal((rows, 6)))
    no_yaw, number = (np.zeros((rows, 3)), np.zeros((rows, 6))), np.arange(rows)
    axis = np.zeros((rows, 3))
    positions = fitting.PositionErrors(error, covariance, sensitivity, *no_yaw, axis, number)
    options = changed(considered={"scale": 0.7, "raw_gyro_bias": 0.3})  # of an earlier calibration
    result = fitting.fit_considered(positions, options)
    assert result.before > 2 and result.after == pytest.approx(1, abs=0.05)
    np.testing.assert_allclose(
        result.settings.considered, [2e-3, 0.1, np.deg2rad(8.0), 0.01, 0.0], rtol=0.1
    )

    axis = rng.standard_normal((rows, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    bias = 0.02 * axis * rng.standard_normal((rows, 1))
    with_bias = error + np.einsum("kib,kb->ki", sensitivity[:, :, :3], bias)
    # Raw gyros have larger errors of scale, which must not change the other settings.
    with_bias[:, :2] += 0.15 * sensitivity[:, :2, 3] * rng.standard_normal((rows, 1))
    mixed_errors = fitting.PositionErrors(
        np.concatenate([error, with_bias]),
        *(np.concatenate([part, part]) for part in (covariance, sensitivity, *no_yaw)),
        np.concatenate([0 * axis, axis]),
        np.arange(2 * rows),
    )
    fit = fitting.fit_considered(mixed_errors, FilterSettings())
    mixed = fit.settings.considered
    assert mixed[:3] == result.settings.considered[:3]
    assert mixed.slope == pytest.approx(0.01, rel=0.1)
    assert mixed.raw_gyro_bias == pytest.approx(0.02, rel=0.1)
    assert fit.before > 4 and fit.after == pytest.approx(1.2, abs=0.15)
    alone = positions._replace(error=with_bias, raw_axis=axis)
    every = fitting.fit_considered(alone, FilterSettings()).settings.considered
    assert every.raw_gyro_bias == 0.0 and every.gyro_bias > 5e-3 and every.scale > 0.15


def test_the_consider_fit_has_the_arc_of_the_whole_yaw():
    """Positions far from the start, whose yaw is uncertain by 0.3 rad of which the filter knows a
    third: without the arc the radial errors of ½ ψ² l would be taken for other errors."""
    rng, rows, lever = np.random.default_rng(2), 4000, 40.0
    known_std, unknown = 0.1, 0.28
    psi = known_std * rng.standard_normal(rows) + unknown * rng.standard_normal(rows)
    error = np.stack([lever * (np.cos(psi) - 1), lever * np.sin(psi), 0 * psi], axis=1)
    error += 0.1 * rng.standard_normal((rows, 3))
    along = np.array([0.0, lever, 0.0])
    arc = np.diag([0.75 * known_std**4 * lever**2, 0.0, 0.0])
    covariance = 0.01 * np.eye(3) + known_std**2 * np.outer(along, along) + arc
    yaw_sensitivity = np.zeros((rows, 6))
    yaw_sensitivity[:, 4] = 1.0  # the heading
    sensitivity = yaw_sensitivity[:, None] * along[None, :, None]
    positions = fitting.PositionErrors(
        error,
        np.tile(covariance, (rows, 1, 1)),
        sensitivity,
        np.tile(known_std**2 * along, (rows, 1)),
        yaw_sensitivity,
        np.zeros((rows, 3)),
        np.arange(rows),
    )
    result = fitting.fit_considered(positions, FilterSettings())
    assert result.settings.considered.heading == pytest.approx(unknown, rel=0.1)
    assert result.before > 20 and 0.4 < result.after < 1.2
    additive = positions._replace(
        with_yaw=0 * positions.with_yaw, yaw_sensitivity=0 * sensitivity[:, 1]
    )
    assert fitting.fit_considered(additive, FilterSettings()).after > 2


def test_the_considered_covariance_of_positions_is_that_of_the_whole_state():
    rng = np.random.default_rng(6)
    root, rows = rng.standard_normal((5, 15, 15)), rng.standard_normal((5, 15, 6))
    covariance, axis = root @ root.transpose(0, 2, 1), rng.standard_normal((5, 3))
    std = filtering.ConsideredStd(0.3, 0.2, 0.5, 0.1, 0.4)
    added = filtering.considered_covariance(rows, std, axis)
    config = filtering.FilterConfig(0.02, 5, 10)
    whole = filtering.with_considered(covariance, added, config)[:, 6:9, 6:9]
    positions = fitting.PositionErrors(
        np.zeros((5, 3)),
        covariance[:, 6:9, 6:9],
        rows[:, 6:9],
        covariance[:, 6:9, 2],
        rows[:, 2],
        axis,
        np.arange(5),
    )
    np.testing.assert_allclose(fitting._add_considered(positions, std), whole, rtol=1e-12)


def test_the_sensitivity_of_positions_does_not_depend_on_which_axis_of_the_phone_is_vertical():
    """Displacements of a network that turn with the frame of the x axis; a bias turns with the axes
    of the phone."""
    walk = simulated.pedestrian(1, 1, "handheld", 12.0, estimators.RATE)
    (recording,) = estimators.ready([walk], gyro_bias="reference")
    other, labels = estimators.relabel(recording)
    assert abs(other.start.rotation[2, 0]) > 0.8
    network = estimators.network(0.05, -2.0, log_std_gain=0.0)
    positions = []
    for one in (recording, other):
        ekf = filtering.make_filter(estimators.CONFIG, estimators.OPTIONS)
        (estimate,) = estimators.tight([one], network)
        rows = [Displacements(*(part[1:] for part in estimate.displacements[:2]))]
        inputs = filter_inputs([one], rows, one.strides, ekf.config)
        truth = one.reference.position[None, 1:]
        settings = estimators.CONFIG, estimators.OPTIONS
        positions.append(fitting.compare_positions(inputs, truth, *settings).sensitivity)
    expected, actual = positions
    of_bias = np.einsum("kid,cd->kic", expected[..., :3], labels)
    scale = np.abs(of_bias).max()
    np.testing.assert_allclose(actual[..., :3], of_bias, atol=1e-4 * scale)
    scale = np.abs(expected[..., 3:]).max()
    np.testing.assert_allclose(actual[..., 3:], expected[..., 3:], atol=1e-4 * scale)


def test_positions_of_a_filter_that_amplifies_an_error_are_left_out(monkeypatch):
    """A covariance of 1e40 m² has no likelihood beside one of a metre."""
    covariance = np.tile(np.eye(3), (2, 4, 1, 1))
    sensitivity = np.ones((2, 4, 3, 6))
    sensitivity[1, 2, 0, 3], sensitivity[1, 3, 2, 1] = 1e20, np.nan
    rows, of_yaw = np.zeros((2, 4, 3)), np.zeros((2, 4, 6))
    parts = np.ones((2, 4)), rows, covariance, sensitivity, rows, of_yaw, rows
    monkeypatch.setattr(fitting, "_run_walks", lambda *_, **__: parts)
    walks = BatchInputs._make([None] * len(BatchInputs._fields))
    positions = fitting.compare_positions(walks, rows + 0.5, DataConfig(), FilterSettings())
    assert positions.recording.tolist() == [0, 0, 0, 0, 1, 1]
    assert fitting.fit_considered(positions, FilterSettings()).after < 1


def test_a_recording_counts_once_beside_the_prior():
    """An error without effect on the positions keeps the start of the search. If few recordings
    show the error, the result lies between the start and their value, by Bayes' rule."""
    rows = 4000
    error = np.zeros((rows, 3))
    error[:, 0] = 0.3 * np.where(np.arange(rows) % 2, 1.0, -1.0)
    covariance, sensitivity = np.tile(1e-4 * np.eye(3), (rows, 1, 1)), np.zeros((rows, 3, 6))
    sensitivity[:, 0, 3] = 1.0  # the scale alone, in metres for a unit
    result = fitting.fit_considered(
        fitting.PositionErrors(
            error,
            covariance,
            sensitivity,
            error * 0.0,
            np.zeros((rows, 6)),
            np.zeros((rows, 3)),
            np.arange(rows) // 1000,  # four recordings
        ),
        FilterSettings(),
    )
    for name in ("gyro_bias", "heading", "slope"):
        assert getattr(result.settings.considered, name) == pytest.approx(
            getattr(fitting.CONSIDERED, name), rel=1e-3
        )

    def negative_log_posterior(log_std):
        variance = 1e-4 + np.exp(2 * log_std)
        likelihood = 4 * 0.5 * (0.3**2 / variance + np.log(variance))
        return likelihood + 0.5 * ((log_std - np.log(fitting.CONSIDERED.scale)) / 2.0) ** 2

    grid = np.linspace(np.log(0.05), np.log(0.5), 20001)
    expected = np.exp(grid[np.argmin(negative_log_posterior(grid))])
    assert expected < 0.29  # the positions alone would give 0.3
    assert result.settings.considered.scale == pytest.approx(expected, rel=2e-3)


def walks_on_a_slope(rng, slopes, rows=200):
    """The positions of level walks of 50 m whose heights are off by these slopes; the filter itself
    says 0.1 m."""
    way = np.tile(np.linspace(0.0, 50.0, rows), len(slopes))
    error = 0.1 * rng.standard_normal((len(way), 3))
    error[:, 2] += way * np.repeat(slopes, rows)
    covariance, sensitivity = (
        np.tile(0.01 * np.eye(3), (len(way), 1, 1)),
        np.zeros((len(way), 3, 6)),
    )
    sensitivity[:, 2, 5] = way
    of_yaw = np.zeros((len(way), 3)), np.zeros((len(way), 6))
    number = np.repeat(np.arange(len(slopes)), rows)
    return fitting.PositionErrors(
        error, covariance, sensitivity, *of_yaw, np.zeros((len(way), 3)), number
    )


def test_the_slope_is_that_of_all_recordings_but_not_of_a_lost_one():
    """Heights of normally distributed slopes give the slopes' own standard deviation. Raw gyros
    count, because heights do not depend on the yaw. One walk in a hundred on which the height falls
    by 30 m hardly changes the result, where it is the largest part of the mean square."""
    rng = np.random.default_rng(5)
    slopes = 0.012 * rng.standard_normal(100)
    level = walks_on_a_slope(rng, slopes)
    expected = np.sqrt(np.mean(slopes**2))
    fit = fitting.fit_considered(level, FilterSettings()).settings.considered
    assert fit.slope == pytest.approx(expected, rel=0.1)

    raw = (level.recording >= 40)[:, None] * np.array([0.0, 0.0, 1.0])
    mixed = fitting.fit_considered(level._replace(raw_axis=raw), FilterSettings())
    assert mixed.settings.considered.slope == pytest.approx(fit.slope, rel=1e-3)

    slopes[50] = 0.6
    lost = walks_on_a_slope(rng, slopes)
    with_lost = fitting.fit_considered(lost, FilterSettings()).settings.considered.slope
    assert np.sqrt(np.mean(slopes**2)) > 4 * expected
    assert with_lost == pytest.approx(fit.slope, rel=0.2)


def nees(positions):
    inverse = np.linalg.inv(positions.covariance)
    return np.einsum("ki,kij,kj->k", positions.error, inverse, positions.error).mean() / 3


def test_positions_are_compared_with_the_truth_of_their_time():
    """The errors of simulated walks are those that the filter reports; against the true positions
    one stride later they are larger. A filter that fails is left out, and a raw gyro has the axis
    of its walk's start."""
    walks, truth = walks_and_truth()
    truth = truth.copy()
    options = changed(TRUE, noise={"measurement_scale": 9.0})  # σ is three times the reported one
    truth[0, 300:] = np.nan
    positions = fitting.compare_positions(walks, truth, DATA, options)
    assert len(positions.error) == np.isfinite(truth).all(2).sum()
    assert nees(positions) == pytest.approx(1, abs=0.5)
    assert positions.yaw_sensitivity.any() and positions.with_yaw.any()
    additive = dataclasses.replace(options, error="additive")  # whose covariances have no arc
    plain = fitting.compare_positions(walks, truth, DATA, additive)
    assert not plain.yaw_sensitivity.any() and not plain.with_yaw.any()
    # Variances of the samples, as of a corrector, take the place of the densities.
    noise = options.noise
    sizes = np.repeat([noise.accel_density, noise.gyro_density], 3)
    variance = np.broadcast_to(sizes**2 * DATA.rate, (*walks.gyro.shape[:2], 6))
    corrected = walks._replace(variance=variance)
    silent = changed(options, noise={"gyro_density": 1e-9, "accel_density": 1e-9})
    by_variance = fitting.compare_positions(corrected, truth, DATA, silent)
    np.testing.assert_allclose(by_variance.covariance, positions.covariance, rtol=1e-6)
    off = fitting.compare_positions(walks, np.roll(truth, -1, axis=1), DATA, options)
    assert nees(off) > 3 * nees(positions)

    accel, raw = walks.accel.copy(), np.arange(WALKS) == 0
    accel[1, 100:] += 1e4
    marked = walks._replace(start=walks.start._replace(raw_gyro=raw), accel=accel)
    some = fitting.compare_positions(marked, truth, DATA, options)
    assert np.isfinite(truth[0]).all(1).sum() < len(some.error) < len(positions.error) - 100
    assert np.abs(some.error).max() < 50
    axes = np.where(raw[:, None], walks.start.rotation[:, 2], 0.0)
    trusted = np.isfinite(truth).all(2)
    np.testing.assert_allclose(
        some.raw_axis[: trusted[0].sum()], np.tile(axes[0], (trusted[0].sum(), 1))
    )
    assert not some.raw_axis[trusted[0].sum() :].any() and not positions.raw_axis.any()


class Runs(NamedTuple):
    """What the calls below take."""

    run: Path
    folds: tuple[str, ...]
    folder: Path


@pytest.fixture
def runs(run, fold_runs, splits_read, tmp_path):
    yield Runs(run, tuple(fold_runs), tmp_path)
    assert splits_read == []  # no call reads recordings


def calibrate(runs, **options):
    return calibration.calibrate(CalibrateConfig(**{"network": str(runs.run)} | options))


def calibrate_again(runs):
    folder = shutil.copytree(runs.run, runs.folder / "run")
    (folder / "calibration.json").write_text("{}")
    return calibrate(runs, network=str(folder))


def average(runs, model=None, augment=None):
    loaded = load(runs.run)
    model = dataclasses.replace(loaded.config.model, **(model or {}))
    augment = dataclasses.replace(loaded.config.augment, **(augment or {}))
    config = dataclasses.replace(loaded.config, model=model, augment=augment)
    network = loaded._replace(config=config, model=models.from_config(model))
    return predictions.average_over_headings(network, "the run")


def compare_with_another_model(runs):
    loaded = load(runs.run)
    model = dataclasses.replace(loaded.config.model, width=5)
    run = loaded._replace(config=dataclasses.replace(loaded.config, model=model))
    return predictions.choose_networks(run, CalibrateConfig(str(runs.run), out_of_fold=runs.folds))


def fit_a_walk_with_a_knock(_):
    walks = walks_and_truth()[0]
    knock = np.arange(STRIDES * N)[:, None] == 900
    return fit(walks._replace(accel=np.where(knock, 1e6, walks.accel)), TRUE)


def fit_no_positions(_):
    shapes = (3,), (3, 3), (3, 6), (3,), (6,), (3,), ()
    none = fitting.PositionErrors(*(np.zeros((0, *shape)) for shape in shapes))
    return fitting.fit_considered(none, FilterSettings())


def fit_positions_without_covariance(_):
    ones = np.ones((9, 3))
    of_position = np.full((9, 3, 3), np.nan), np.ones((9, 3, 6))
    lost = fitting.PositionErrors(ones, *of_position, ones, np.ones((9, 6)), ones, np.zeros(9))
    return fitting.fit_considered(lost, FilterSettings())


EXACT_START = changed(TRUE, start={"gyro_bias": 0.0})
REFUSED = [
    (lambda x: calibrate(x, split="test"), "neither the validation nor the training split"),
    (lambda x: calibrate(x, out="."), "exists already; remove it, or give another --out"),
    (lambda x: calibrate(x, fit=()), "--fit: names nothing; name some of measurement, noise"),
    (calibrate_again, "is a calibrated run; calibrate the run that it was made from"),
    (
        lambda x: calibrate(x, out_of_fold=x.folds[:1]),
        "were trained on the splits train-0of2; train one run for each of",
    ),
    (
        lambda x: calibrate(x, out_of_fold=x.folds[:1] * 2),
        "were trained on the splits train-0of2, train-0of2; train one run for each of",
    ),
    (
        lambda x: calibrate(x, out_of_fold=x.folds, split="train"),
        "--split train: has no effect with --out-of-fold",
    ),
    (compare_with_another_model, "fold0: differs from the calibrated run in 'model'"),
    (
        lambda x: average(x, model={"equivariance": "canonical_frame"}),
        "^the run: its network has model.equivariance: canonical_frame, a frame of its own",
    ),
    (
        lambda x: average(x, model={"name": "gru", "equivariance": "device_heading"}),
        "^the run: its network has model.equivariance: device_heading, which averages over four "
        "headings; leave --average-headings out",
    ),
    (lambda x: average(x, augment={"yaw": False}), "^the run.*four_headings without augment.yaw"),
    (
        lambda _: fitting.start_of_fit(EXACT_START, fitting.GROUPS["start"]),
        "filter.start.gyro_bias: is 0 .*leave its group out",
    ),
    (fit_a_walk_with_a_knock, "the filter: fails on these recordings"),
    (fit_no_positions, "the filter: is not healthy where these recordings have a reference"),
    (fit_positions_without_covariance, "the filter: has no positive definite covariance"),
]


@pytest.mark.parametrize("call, message", REFUSED)
def test_a_mistake_is_named_before_recordings_are_read(runs, call, message):
    with pytest.raises(InputError, match=message):
        call(runs)
