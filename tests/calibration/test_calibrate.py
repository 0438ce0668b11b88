"""A calibrated run: what is written, what is refused, and what is fitted to what: settings against
the noises that simulated walks were made with, consider covariances against the errors that
positions were drawn with, the gradient against differences.

Fits and calibrations here are of walks, windows and settings of one shape, and of one walk for each
device: each of their programs is compiled once, and without a vmap.
"""

import dataclasses
import functools
import json
import re
import shutil

import jax
import numpy as np
import pytest
from scipy.optimize import OptimizeResult
from scipy.spatial.transform import Rotation

from gnio_jax import calibration, data, filtering, models
from gnio_jax.calibration import evidence
from gnio_jax.calibration import fit as fitting
from gnio_jax.calibration import run as calibrating
from gnio_jax.commands import app
from gnio_jax.config import (
    CalibrateConfig,
    CorrelatedError,
    DataConfig,
    FilterSettings,
    ModelConfig,
    TrainConfig,
    plain,
)
from gnio_jax.data.simulated import walks as simulated
from gnio_jax.errors import InputError
from gnio_jax.evaluation import Displacements, Estimate, Trajectory
from gnio_jax.evaluation.estimate import Inputs
from gnio_jax.evaluation.prepare import Start, prepare
from gnio_jax.filtering.settings import free_parameters
from gnio_jax.filtering.state import GYRO_BIAS
from gnio_jax.training import checkpoint
from tests.support import tiny_run
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
    with tiny_run.known():
        yield tiny_run.save(tmp_path_factory.mktemp("trained") / "run", TRAINED)


@pytest.fixture
def splits_read(monkeypatch):
    """Every split has short walks; the splits that were read."""
    seconds = (STRIDES + 1) * DATA.stride_seconds  # the first sample has no pose to start from
    seeds, read = range(1, WALKS + 1), []
    walks = [simulated.pedestrian(seed, seed, "handheld", seconds, 50.0) for seed in seeds]
    monkeypatch.setattr(data, "load", lambda name, root, split, *_: read.append(split) or walks)
    return read


def test_the_run_differs_in_the_filter_and_its_average_alone(
    run, splits_read, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(calibrating, "MOST_STEPS", 2)  # what the search finds is told below
    run, out = shutil.copytree(run, tmp_path / "run"), tmp_path / "calibrated"
    for name in ("splits.yaml", "metrics.jsonl"):
        (run / name).write_text(f"{name} of the run")
    words = ["calibrate", "--workdir", str(run), "--out", str(out), "--average-headings"]
    app.main([*words, "--fit", "measurement", "noise", "window"])
    told, warned = capsys.readouterr()
    assert "warning: the fit stopped after 2 steps" in warned
    assert f"warning: only {WALKS} recordings without a raw gyro: fewer than 5" in warned
    assert f"recordings: 0 with a raw gyro, {WALKS} without" in told
    assert "noise.std_factor" in told and f"gnio evaluate --workdir {out}" in told
    assert splits_read == ["val"]
    before, after = (checkpoint.load_run(folder) for folder in (run, out))
    assert after.config.model.equivariance == "four_headings"
    same = {name: getattr(before.config, name) for name in ("workdir", "filter", "model")}
    assert dataclasses.replace(after.config, **same) == before.config
    jax.tree.map(np.testing.assert_array_equal, after.variables, before.variables)
    for name in ("splits.yaml", "metrics.jsonl"):
        assert (out / name).read_text() == f"{name} of the run"
    found = after.config.filter
    assert found.start == TRAINED.filter.start
    assert found.noise.correlation.share > 0 and found.noise.std_factor[0] != 1
    about = json.loads((out / "calibration.json").read_text())
    likelihood = about["negative_log_likelihood_per_innovation"]
    assert likelihood["after"] < likelihood["before"]
    assert found.considered.gyro_bias > 0
    nees = about["position_nees_per_axis"]
    assert abs(np.log(nees["after"])) < abs(np.log(nees["before"]))
    assert about["split"] == "val" and about["filter"] == plain(found)
    assert about["recordings"] == WALKS and about["recordings_with_raw_gyro"] == 0
    assert [f"warning: {line}" for line in about["warnings"]] == warned.splitlines()
    change = about["trajectories"]["ate"]
    assert f"ATE (m) │ {change['before']:.2f} │ {change['after']:.2f}" in re.sub(" +", " ", told)
    assert change["before"] != change["after"] and "diverged" not in told


def test_a_network_is_averaged_over_four_headings_or_told_that_it_cannot_be(run):
    loaded = checkpoint.load_run(run)
    averaged = checkpoint.averaged_over_headings(loaded, "the run")
    assert averaged.config.model.equivariance == "four_headings"
    assert averaged.model == models.from_config(averaged.config.model) != loaded.model
    model = dataclasses.replace(loaded.config.model, equivariance="canonical_frame")
    augment = dataclasses.replace(loaded.config.augment, yaw=False)
    for change, problem in (
        ({"model": model}, "has a canonical frame"),
        ({"augment": augment}, "four_headings without augment.yaw"),
    ):
        config = dataclasses.replace(loaded.config, **change)
        with pytest.raises(InputError, match=f"the run.*{problem}"):
            checkpoint.averaged_over_headings(loaded._replace(config=config), "the run")


def test_what_is_refused(run, splits_read, tmp_path):
    shutil.copytree(run, tmp_path / "run")
    (tmp_path / "run" / "calibration.json").write_text("{}")
    for options, problem in (
        ({"split": "test"}, "neither the validation nor the training split"),
        ({"out": "."}, "is there already"),
        ({"fit": ()}, "--fit: names nothing; name some of measurement, noise"),
        ({"workdir": str(tmp_path / "run")}, "is a calibrated run; calibrate the run that it was"),
    ):
        with pytest.raises(InputError, match=problem):
            calibration.calibrate(CalibrateConfig(**{"workdir": str(run)} | options))
    assert splits_read == []


def estimate(error, std):
    rows = len(error) + 2
    path = Trajectory(np.arange(rows), np.zeros((rows, 3)), np.zeros((rows, 4)))
    before = np.full((2, 3), np.nan)
    value, std = (np.concatenate([before, each]) for each in (1.0 + error, std))
    return Estimate("walk", path, path, Displacements(value, uncorrelated(std)))


def uncorrelated(std):
    return std[..., None] ** 2 * np.eye(3)


def test_the_factors_are_those_of_the_errors():
    rng = np.random.default_rng(0)
    std = rng.uniform(0.05, 0.2, (400, 3))
    error = std * np.array([1.5, 0.5, 3.0]) * rng.choice([-1.0, 1.0], (400, 3))
    truth = np.ones((400, 3))
    truth[:50, 1] = np.nan
    found = fitting.std_factors([estimate(error, std)], [truth])
    np.testing.assert_allclose(found, [1.5, 0.5, 3.0], rtol=1e-12)
    with pytest.raises(ValueError, match="10 windows have a reference"):
        truth[:390] = np.nan
        fitting.std_factors([estimate(error, std)], [truth])


@pytest.fixture(scope="module")
def fold_runs(run, tmp_path_factory):
    """Copies of the run as the folds of one experiment, whose networks differ by a factor."""
    folders, loaded, parent = [], checkpoint.load_run(run), tmp_path_factory.mktemp("folds")
    for fold in (0, 1):
        windows = dataclasses.replace(loaded.config.data, train_split=f"train-{fold}of2")
        config = dataclasses.replace(loaded.config, data=windows, workdir=None)
        folders.append(str(tiny_run.save(parent / f"fold{fold}", config, size=0.2 + fold)))
    return folders


def test_each_session_is_judged_by_the_network_that_left_it_out(
    run, splits_read, fold_runs, monkeypatch
):
    def asked_about(prepared, network, *_, **__):
        return [(each.name, network.variables) for each in prepared]

    monkeypatch.setattr(evidence, "estimate", asked_about)
    loaded = checkpoint.load_run(run)
    config = CalibrateConfig(workdir=str(run), out_of_fold=tuple(fold_runs))
    split, asked = evidence.sources(loaded, config)
    found = evidence.gather(split, asked, config, loaded.config.filter, lambda *_: None, 1)
    assert splits_read == ["train"] and len(found.estimates) == WALKS
    fold_of = data.folds(data.load("synthetic", None, "train"), 2)
    assert sorted(set(fold_of.values())) == [0, 1]
    for recording, (name, variables) in zip(*found, strict=True):
        of_fold = checkpoint.load_run(fold_runs[fold_of[recording.group]])
        network = models.Network.of(of_fold.model, of_fold.variables)
        assert recording.name == name and tiny_run.same(variables, network.variables)


def test_the_network_of_every_fold_is_averaged_over_headings(run, fold_runs):
    config = CalibrateConfig(str(run), out_of_fold=tuple(fold_runs), average_headings=True)
    _, networks = evidence.sources(evidence.load_run(run, config), config)
    for source in networks:
        assert source.run.config.model.equivariance == "four_headings"


def test_walks_without_a_reference_are_left_out_and_raw_gyros_start_wide(run, monkeypatch):
    """A raw one is not sure of its level biases, as in an evaluation."""
    walks = [simulated.pedestrian(seed, seed, "handheld", 5.0, 50.0) for seed in (1, 2, 3)]
    walks[0] = walks[0]._replace(valid=np.zeros(len(walks[0].time), bool))
    raw = {**walks[1].attributes, "imu_compensated": "no"}
    walks[1] = walks[1]._replace(attributes=raw)
    monkeypatch.setattr(data, "load", lambda *_: walks)
    monkeypatch.setattr(evidence, "estimate", lambda prepared, *_, **__: prepared)
    loaded, config = checkpoint.load_run(run), CalibrateConfig(str(run))
    settings = dataclasses.replace(loaded.config.filter, raw_gyro_bias=0.05)
    split, networks = evidence.sources(loaded, config)
    recordings, _ = evidence.gather(split, networks, config, settings, lambda *_: None, 1)
    assert [recording.name for recording in recordings] == [walk.name for walk in walks[1:]]
    stds = [recording.start.level_gyro_bias for recording in recordings]
    assert stds == [0.05, settings.start.gyro_bias]


def test_displacements_and_truth_are_those_of_their_times(run, splits_read, tmp_path, monkeypatch):
    """Of true displacements with errors of a centimetre: each is in the interval at whose end its
    window ends. The filter then errs by a few centimetres, and a walk moves by 0.13 m in a stride.
    """
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
        estimates.append(Estimate(recording.name, path, path, rows))

    def unfitted(walks, windows, settings, *_):
        inputs.append(walks)
        return fitting.Fit(settings, 0.0, 0.0, 1)

    def filtered_positions(*arguments):
        positions.append(fitting.filtered_positions(*arguments))
        return positions[0]

    pairs = evidence.Evidence(recordings, estimates)
    monkeypatch.setattr(calibrating, "gather", lambda *_: pairs)
    monkeypatch.setattr(calibrating, "fit_innovations", unfitted)
    monkeypatch.setattr(calibrating, "filtered_positions", filtered_positions)
    calibration.calibrate(CalibrateConfig(str(run), out=str(tmp_path / "calibrated")))
    for value, walk in zip(inputs[0].given.value, estimates, strict=True):
        for interval in (CLONES, 100, STRIDES - 1):
            assert (value[interval] == walk.displacements.value[interval + 1]).all()
    assert len(positions[0].error) == WALKS * STRIDES
    assert np.sqrt(np.mean(positions[0].error ** 2, axis=0)).max() < 0.07


def test_folds_that_do_not_make_a_whole_are_refused(run, splits_read, fold_runs):
    config = CalibrateConfig(workdir=str(run), out_of_fold=tuple(fold_runs))
    first, _ = fold_runs
    for changes, problem in (
        ({"out_of_fold": (first,)}, "were trained on the splits train-0of2; train one run for ea"),
        ({"out_of_fold": (first, first)}, "were trained on the splits train-0of2, train-0of2"),
        ({"split": "train"}, "--split train: is of no use with --out-of-fold"),
    ):
        with pytest.raises(InputError, match=problem):
            calibration.calibrate(dataclasses.replace(config, **changes))
    assert splits_read == []
    loaded = checkpoint.load_run(run)
    other = dataclasses.replace(loaded.config.model, width=5)
    changed = loaded._replace(config=dataclasses.replace(loaded.config, model=other))
    with pytest.raises(InputError, match="fold0: differs from the calibrated run in 'model'"):
        evidence.sources(changed, config)


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
    """Their displacements err by `SIGMA`, while the network says a third of it, and the true
    positions after each stride."""
    noise, std = filtering.NoiseModel(2e-3, 2e-2, 1e-6, 1e-4), filtering.InitialStd(gyro_bias=1e-3)
    runs = simulate(5, WALKS, STRIDES, N, CLONES, 1 / DATA.rate, noise, std, SIGMA)
    runs = with_correlated_errors(runs, CLONES, SIGMA, ERRORS, DATA.stride_seconds)
    std = filtering.InitialStd(*np.ones((6, WALKS)))  # a fit takes that of the settings
    raw = np.zeros(WALKS, bool)
    start = Start(*runs[:3], np.zeros((WALKS, 3)), std, std.gyro_bias, raw)
    given = Displacements(
        runs.displacement, uncorrelated(np.full_like(runs.displacement, SIGMA / 3))
    )
    return Inputs(start, runs.gyro, runs.accel, None, given), runs.position


def fit(walks, settings, **options):
    return fitting.fit_innovations(walks, DATA, settings, PATHS, lambda calls: None, **options)


def test_the_noises_and_errors_of_simulated_walks_are_found():
    wrong = {"gyro_density": 8e-4, "accel_density": 6e-2, "correlation": CorrelatedError(0.6, 0.8)}
    found = fit(walks_and_truth()[0], changed(TRUE, noise=wrong))
    noise = found.settings.noise
    assert found.after < found.before - 0.1
    assert noise.measurement_scale == pytest.approx(9.0, rel=0.15)
    assert noise.gyro_density == pytest.approx(2e-3, rel=0.4)
    assert noise.accel_density == pytest.approx(2e-2, rel=0.4)
    assert noise.correlation.share == pytest.approx(0.8, abs=0.1)
    assert noise.correlation.seconds == pytest.approx(0.5, rel=0.4)
    assert found.warnings == () and found.steps < 60


def test_the_gradient_is_that_of_the_likelihood():
    free = free_parameters(TRUE, PATHS)
    fixed = {"names": tuple(free), "config": fitting.innovation_config(DATA, TRUE)}
    free, rng = np.array(list(free.values())), np.random.default_rng(0)

    def at(vector):
        given = vector, walks_and_truth()[0], free, TRUE
        return jax.device_get(fitting._value_and_gradient(*given, **fixed))

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
    config = fitting.innovation_config(DATA, settings)
    starts = fitting._wide_start(walk, settings), fitting.evaluated_start(walk.start, settings)
    states = (start.state(config) for start in starts)
    spreads = (
        np.sqrt(np.linalg.eigvalsh(state.core_covariance[GYRO_BIAS, GYRO_BIAS])) for state in states
    )
    np.testing.assert_allclose(next(spreads), [expected] * 3, rtol=1e-9)
    np.testing.assert_allclose(next(spreads), [1e-3, expected, expected], rtol=1e-9)


def test_a_second_calibration_compiles_nothing_and_a_fit_that_ends_early_is_told(monkeypatch):
    given, _ = walks_and_truth()
    monkeypatch.setitem(fitting.PHYSICAL, "noise.measurement_scale", (1e8, 1e9))
    warning, outside = fit(given, TRUE, most_steps=1).warnings
    assert outside.startswith("filter.noise.measurement_scale came out as ")
    assert warning.startswith("the fit stopped after 1 steps, ") and "--fit" in warning
    options = {f"--{field.name.replace('_', '-')}" for field in dataclasses.fields(CalibrateConfig)}
    assert set(re.findall(r"--[a-z-]+", warning)) <= options  # no remedy that there is not
    programs = fitting._value_and_gradient._cache_size()
    others = given._replace(given=given.given._replace(value=1.01 * given.given.value))
    settings = changed(TRUE, noise={"std_factor": (0.7, 1.0, 1.0)}, start={"velocity": 0.2})
    fit(others, settings, most_steps=1)
    assert programs > 0 and fitting._value_and_gradient._cache_size() == programs


def test_a_search_begins_anew_until_that_gains_nothing(monkeypatch):
    begun = []

    def minimize(function, at, options, **_):
        function(at)
        begun.append((float(at[0]), options["maxiter"]))
        return OptimizeResult(x=at + 0.1, fun=-min(len(begun), 3.0), nit=5, success=True)

    monkeypatch.setattr(fitting, "minimize", minimize)
    found = fit(walks_and_truth()[0], TRUE, most_steps=40)
    start = next(iter(free_parameters(TRUE, PATHS).values()))
    assert begun == [(pytest.approx(start + 0.1 * k), 40 - 5 * k) for k in range(4)]
    assert found.steps == 20 and found.warnings == ()
    reached = next(iter(free_parameters(found.settings, PATHS).values()))
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
def test_searches_that_ended_too_early_are_told_of(monkeypatch, searches, problem):
    """Of each: the value that it reaches, its steps, and whether it has converged."""
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


def test_values_outside_what_is_physical_are_named():
    noise = {"accel_bias_walk": 2.656, "correlation": CorrelatedError(0.9999, 5.9e4)}
    names = ("noise.gyro_density", "noise.accel_bias_walk", "noise.correlation.share")
    told = fitting.unphysical(changed(TRUE, noise=noise), (*names, "noise.correlation.seconds"))
    assert [line.split(" came out as ")[0] for line in told] == [
        "filter.noise.accel_bias_walk",
        "filter.noise.correlation.share",
        "filter.noise.correlation.seconds",
    ]
    assert "5.9e+04, outside 0.05 to 60: these recordings do not determine it" in told[2]


def test_what_is_switched_off_and_has_no_start_cannot_be_fitted():
    off = changed(TRUE, start={"gyro_bias": 0.0})
    begun = fitting.start_of_fit(off, (*fitting.GROUPS["noise"], *fitting.GROUPS["window"]))
    assert begun.noise.correlation == CorrelatedError(0.8, 0.5)
    own = changed(TRUE, noise={"correlation": CorrelatedError(0.3, 0.7)})
    assert fitting.start_of_fit(own, fitting.GROUPS["window"]) == own
    with pytest.raises(InputError, match=r"filter.start.gyro_bias: is 0 .*leave its group out"):
        fitting.start_of_fit(off, fitting.GROUPS["start"])


def test_a_walk_may_be_filled_up_and_a_filter_that_fails_is_named():
    given, known = walks_and_truth()[0], STRIDES - 40
    after = np.arange(N * STRIDES)[:, None] >= N * known
    nothing = np.arange(STRIDES)[:, None] >= known
    rows = Displacements(
        np.where(nothing, np.nan, given.given.value),
        np.where(nothing[..., None], np.eye(3), given.given.covariance),
    )
    still, falling = [0.0, 0.0, 9.81], [90.0, 0.0, 9.81]  # to 360 m/s, beyond the filter's bound
    evidences = [
        fit(
            given._replace(
                gyro=np.where(after, 0.0, given.gyro),
                accel=np.where(after, force, given.accel),
                given=rows,
            ),
            TRUE,
            most_steps=1,
        ).before
        for force in (still, falling)
    ]
    np.testing.assert_allclose(*evidences, rtol=1e-9)
    # It is the mean over the rows that are there: of the last tenth too it is hardly another.
    np.testing.assert_allclose(evidences[0], fit(given, TRUE, most_steps=1).before, rtol=0.03)
    knock = np.arange(STRIDES * N)[:, None] == 900
    broken = given._replace(accel=np.where(knock, 1e6, given.accel))
    with pytest.raises(InputError, match="the filter: fails on these recordings"):
        fit(broken, TRUE)


def test_what_the_errors_were_drawn_with_is_found():
    rng = np.random.default_rng(0)
    rows = 4000
    root = 0.1 * rng.standard_normal((rows, 3, 3)) + 0.3 * np.eye(3)
    covariance = root @ root.transpose(0, 2, 1)
    # Metres for a unit of each: bias rad/s, log scale, heading rad, slope.
    sensitivity = rng.standard_normal((rows, 3, 6)) * [200.0, 200.0, 5.0, 5.0, 5.0, 40.0]
    wanted = np.array([2e-3, 2e-3, 2e-3, 0.1, np.deg2rad(8.0), 0.01])
    drawn = np.einsum("kij,kj->ki", root, rng.standard_normal((rows, 3)))
    error = drawn + np.einsum("kic,kc->ki", sensitivity, wanted * rng.standard_normal((rows, 6)))
    positions = fitting.Positions(error, covariance, sensitivity, np.zeros((rows, 3)))
    options = changed(considered={"scale": 0.7, "raw_gyro_bias": 0.3})  # of an earlier calibration
    found = fitting.fit_considered(positions, 0.1, options)
    assert found.before > 2 and found.after == pytest.approx(1, abs=0.05)
    np.testing.assert_allclose(
        found.settings.considered, [2e-3, 0.1, np.deg2rad(8.0), 0.01, 0.0], rtol=0.1
    )

    axis = rng.standard_normal((rows, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    bias = 0.02 * axis * rng.standard_normal((rows, 1))
    with_bias = error + np.einsum("kib,kb->ki", sensitivity[:, :, :3], bias)
    # The errors of scale are larger in the raw ones, which must not change the others.
    with_bias += 0.15 * sensitivity[:, :, 3] * rng.standard_normal((rows, 1))
    both = fitting.Positions(
        np.concatenate([error, with_bias]),
        *(np.concatenate([each, each]) for each in (covariance, sensitivity)),
        np.concatenate([0 * axis, axis]),
    )
    fit = fitting.fit_considered(both, 0.1, FilterSettings())
    mixed = fit.settings.considered
    assert mixed[:4] == found.settings.considered[:4]
    assert mixed.raw_gyro_bias == pytest.approx(0.02, rel=0.1)
    assert fit.before > 4 and fit.after == pytest.approx(1.2, abs=0.15)
    alone = positions._replace(error=with_bias, raw_axis=axis)
    every = fitting.fit_considered(alone, 0.1, FilterSettings()).settings.considered
    assert every.raw_gyro_bias == 0.0 and every.gyro_bias > 5e-3 and every.scale > 0.15


def test_the_prior_counts_as_many_independent_errors_as_there_are():
    """Of positions that say nothing of an error: its std stays where the search begins. Of few that
    do, it lies between that and what they say, as far as Bayes' rule has it."""
    rows, stride = 4000, 0.01  # 40 s: four independent errors
    error = np.zeros((rows, 3))
    error[:, 0] = 0.3 * np.where(np.arange(rows) % 2, 1.0, -1.0)
    covariance, sensitivity = np.tile(1e-4 * np.eye(3), (rows, 1, 1)), np.zeros((rows, 3, 6))
    sensitivity[:, 0, 5] = 1.0  # the slope alone, in metres for a unit
    found = fitting.fit_considered(
        fitting.Positions(error, covariance, sensitivity, np.zeros((rows, 3))),
        stride,
        FilterSettings(),
    )
    for name in ("gyro_bias", "scale", "heading"):
        assert getattr(found.settings.considered, name) == pytest.approx(
            getattr(fitting.CONSIDERED, name), rel=1e-3
        )

    def negative_log_posterior(log_std):
        variance = 1e-4 + np.exp(2 * log_std)
        likelihood = 4 * 0.5 * (0.3**2 / variance + np.log(variance))
        return likelihood + 0.5 * ((log_std - np.log(fitting.CONSIDERED.slope)) / 2.0) ** 2

    grid = np.linspace(np.log(0.05), np.log(0.5), 20001)
    wanted = np.exp(grid[np.argmin(negative_log_posterior(grid))])
    assert wanted < 0.28  # what the positions alone would say is 0.3
    assert found.settings.considered.slope == pytest.approx(wanted, rel=2e-3)


def nees(found):
    inverse = np.linalg.inv(found.covariance)
    return np.einsum("ki,kij,kj->k", found.error, inverse, found.error).mean() / 3


def test_positions_are_compared_with_the_truth_of_their_time():
    """Of simulated walks that are as the filter has them: their errors are those it reports, but
    against the truth of a stride later they are not. A filter that fails is left out, and a raw
    gyro has the axis of its walk's start."""
    walks, truth = walks_and_truth()
    truth = truth.copy()
    options = changed(TRUE, noise={"measurement_scale": 9.0})  # σ is three times what is said
    truth[0, 300:] = np.nan
    found = fitting.filtered_positions(walks, truth, DATA, options)
    assert len(found.error) == np.isfinite(truth).all(2).sum()
    assert nees(found) == pytest.approx(1, abs=0.5)
    off = fitting.filtered_positions(walks, np.roll(truth, -1, axis=1), DATA, options)
    assert nees(off) > 3 * nees(found)

    accel, raw = walks.accel.copy(), np.arange(WALKS) == 0
    accel[1, 100:] += 1e4
    marked = walks._replace(start=walks.start._replace(raw_gyro=raw), accel=accel)
    some = fitting.filtered_positions(marked, truth, DATA, options)
    assert np.isfinite(truth[0]).all(1).sum() < len(some.error) < len(found.error) - 100
    assert np.abs(some.error).max() < 50
    axes = np.where(raw[:, None], walks.start.rotation[:, 2], 0.0)
    known = np.isfinite(truth).all(2)
    np.testing.assert_allclose(
        some.raw_axis[: known[0].sum()], np.tile(axes[0], (known[0].sum(), 1))
    )
    assert not some.raw_axis[known[0].sum() :].any() and not found.raw_axis.any()


def test_no_positions_and_no_likelihood_are_named():
    none = fitting.Positions(*(np.zeros((0, 3, *more)) for more in ((), (3,), (6,), ())))
    with pytest.raises(InputError, match="not healthy where these recordings have a reference"):
        fitting.fit_considered(none, 0.1, FilterSettings())
    ones = np.ones((9, 3))
    lost = fitting.Positions(ones, np.full((9, 3, 3), np.nan), np.ones((9, 3, 6)), ones)
    with pytest.raises(InputError, match="no positive definite covariance"):
        fitting.fit_considered(lost, 0.1, FilterSettings())
