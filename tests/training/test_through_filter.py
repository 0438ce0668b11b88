"""Training through the filter, with a network of one layer on walks of a few seconds."""

import dataclasses
import shutil
import signal
from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from gnio_jax import config as configuration
from gnio_jax import models, parallel
from gnio_jax.commands.options import Call, read
from gnio_jax.commands.train import experiment, train
from gnio_jax.config import (
    CorrelatedError,
    DataConfig,
    EvaluateConfig,
    FilterSettings,
    InitialStd,
    ModelConfig,
    NoiseModel,
    OptimConfig,
    ThroughFilter,
    TrainConfig,
)
from gnio_jax.errors import InputError
from gnio_jax.evaluation.evaluate import resolve
from gnio_jax.filtering.settings import with_free_parameters
from gnio_jax.networks import read_network, write_network
from gnio_jax.reporting import Silence
from gnio_jax.training import checkpoint, filter_task, loop, optimizer, task
from gnio_jax.training.filter_losses import FilterLosses
from gnio_jax.training.filter_task import FilterTask
from gnio_jax.training.initial import load_initial_network
from gnio_jax.training.recordings import set_up
from gnio_jax.training.task import TrainState
from gnio_jax.training.window_task import WindowTask
from tests.support import tiny_run
from tests.support.filter_settings import changed
from tests.support.tiny_run import rows, same
from tests.support.tlio_files import SPEED, TURN, write_splits

LEARN = ("noise", "measurement", "start", "head")
WINDOW = 0.4
OPTIONS = FilterSettings(
    NoiseModel(0.1, 0.1, 1e-3, 1e-2, measurement_scale=1.5, correlation=CorrelatedError(0.3, 0.5)),
    InitialStd(tilt=0.0, yaw=2e-3, velocity=0.1, gyro_bias=1e-3, position=0.01),
)
THROUGH = ThroughFilter(
    learn=LEARN,
    piece_seconds=2.0,
    filter_learning_rate=0.2,
    displacement_weight=1.0,
    yaw_weight=1.0,
    innovation_weight=1.0,
    state_weight=1.0,
    window_weight=1.0,
)

THROUGH_FILTER = TrainConfig(filter=OPTIONS, through_filter=THROUGH)


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """A TLIO folder of three walks round a circle, and a run to start from."""
    root = write_splits(tmp_path_factory.mktemp("tlio"))
    of_data = DataConfig(rate=50.0, window_seconds=WINDOW)
    tiny_run.save(root / "initial", TrainConfig(data=of_data, model=ModelConfig("tiny")), 0.1)
    return root


def tiny(recording, workdir, **changes):
    config = TrainConfig(
        dataset="tlio",
        data_root=str(recording),
        workdir=str(workdir),
        init_from=str(recording / "initial"),
        data=DataConfig(rate=50.0, window_seconds=WINDOW),
        model=ModelConfig(name="tiny", uncertainty="calibrated"),
        optim=OptimConfig(epochs=2, batch_size=2, learning_rate=1e-3, warmup_epochs=0.5),
        filter=OPTIONS,
        through_filter=THROUGH,
    )
    return dataclasses.replace(config, **changes)


@pytest.fixture(scope="module")
def finished(recording, tmp_path_factory):
    workdir = tmp_path_factory.mktemp("finished") / "run"
    loop.train(tiny(recording, workdir))
    return workdir


def test_a_run_logs_its_losses_and_what_the_filter_knows_of_its_errors(finished):
    log_rows = rows(finished)
    # 12 s have five segments of 2 s, since the sample at the end of each is needed; two walks.
    assert [(row["epoch"], row["step"]) for row in log_rows] == [(0, 5), (1, 10)]
    for row in log_rows:
        parts = ("displacement", "yaw", "innovation", "state", "mse")
        assert row["loss"] == pytest.approx(sum(row[part] for part in parts), rel=1e-6)
        assert row["skipped"] == 0
        assert row["val_rmse"] == pytest.approx(row["val_mse"] ** 0.5)
        assert row["val_nis"] > 0 and row["val_nees"] > 0
        assert "val_waypoint_error" not in row  # these walks have none
        assert (
            row["gradient_norm/head/bias"] > 0
            and row["gradient_norm/filter/noise.gyro_density"] > 0
        )
        val = row["val_mse"] + row["val_innovation"] + row["val_state"]
        val += row["val_displacement_error/1s"] ** 2 + row["val_yaw_error/1s"] ** 2
        assert row["val_loss"] == pytest.approx(val, rel=1e-6)


def test_what_is_not_to_learn_stays_to_the_bit(recording, finished):
    before = read_network(recording / "initial")
    after = checkpoint.load_latest(finished)
    for module, parameters in before.variables["params"].items():
        assert same(parameters, after.variables["params"][module]) == (module != "head"), module
    statistics = after.variables["batch_stats"]
    assert same(before.variables["batch_stats"]["norm"], statistics["norm"])
    settings, trained_settings = (
        configuration.flatten(OPTIONS),
        configuration.flatten(after.config.filter),
    )
    moved = {name for name in settings if settings[name] != trained_settings[name]}
    numbers = {name for name in settings if name.startswith(("noise.", "start."))}
    assert moved == numbers - {"start.tilt"}  # which is 0
    assert configuration.load(finished / "config.yaml").filter == OPTIONS
    evaluated = resolve(EvaluateConfig(str(finished)), after.config)
    assert evaluated.filter == after.config.filter


def test_stopped_and_resumed_gives_the_same_bits(recording, finished, tmp_path):
    run, start = tmp_path / "run", shutil.copytree(recording / "initial", tmp_path / "initial")
    config = tiny(recording, run, init_from=str(start))
    with tiny_run.stopped_at(1):
        assert loop.train(config).stopped_by == signal.SIGTERM
    shutil.rmtree(start)  # it is not needed any more
    assert loop.train(config, resume=True).stopped_by is None
    tiny_run.assert_same_runs(run, finished)


def test_a_copy_with_other_options_has_them(finished, tmp_path):
    """As calibration writes it: what had learnt does not come back."""
    run = read_network(finished)
    options = changed(
        run.config.filter,
        noise={"gyro_density": 0.5, "correlation": CorrelatedError(0.9, 0.5)},
    )
    config = dataclasses.replace(run.config, filter=options)
    write_network(tmp_path, run._replace(config=config))
    network = read_network(tmp_path)
    assert network.config.filter == options and same(network.variables, run.variables)
    assert (network.step, network.epoch) == (run.step, run.epoch)


@pytest.fixture(scope="module")
def training(recording):
    with jax.enable_x64(True):
        filter_training, recordings = set_up(FilterTask, tiny(recording, "unused"), Silence())
    return filter_training, recordings.source


@pytest.fixture(scope="module")
def start(recording):
    return read_network(recording / "initial").variables


def oracle(state):
    """The state whose network says the displacement of a walk round the circle, whatever it sees,
    with σ = 5 cm."""
    angle = TURN * WINDOW
    truth = SPEED / TURN * np.array([np.sin(angle), 1 - np.cos(angle), 0.0])
    params = jax.tree.map(lambda leaf: 0.01 * leaf, state.variables["params"])
    params["head"]["bias"] = jnp.float32(truth)
    params["uncertainty"]["log_std"]["bias"] = jnp.full(3, np.log(0.05), jnp.float32)
    return state._replace(variables=state.variables | {"params": params})


KEY = jax.random.key(0)


def begun(training, start):
    return oracle(parallel.copy_to_devices(training.initial_state(KEY, start)))


def take(training, state, source, first, count=1):
    """Steps of an epoch as long as the task's, with the first five segments: compiled once."""
    order = jnp.repeat(source.earliest[:5], 2)
    numbers = jnp.int32(first), jnp.int32(count), jnp.float32(1)
    return training.take_steps(state, source, order, *numbers, KEY)


def test_each_seed_has_the_weights_of_the_run(training, start):
    """The steps take the memory of their state; that of the weights, which the next seed starts
    from, is another."""
    state = parallel.copy_to_devices(training[0].initial_state(KEY, start))
    for leaf in jax.tree.leaves(state):
        leaf.delete()
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves(start))


def test_wild_steps_are_skipped_and_counted(training, start):
    """A sample that is not a number; a reference that jumps, whose gradient is finite and far too
    large."""
    training, source = training
    first = int(source.earliest[0])
    lost = source.accel.at[first + 30].set(np.nan)
    jumps = source.position.at[first + 50 :].add(1e6)
    for spoiled in ({"accel": lost}, {"position": jumps}):
        state = begun(training, start)
        before = jax.tree.map(np.array, (state.variables, state.opt_state))
        state, progress = take(training, state, source._replace(**spoiled), 0)
        assert int(state.step) == 1 and int(progress.failed_step) == -1
        assert same(before, (state.variables, state.opt_state))
        assert progress.sums.pop("skipped") == 1
        assert len(progress.sums) > 6 and all(figure == 0 for figure in progress.sums.values())
    assert loop.mean_figures({"loss": 6.0, "skipped": 2.0}, 5) == {"loss": 2.0, "skipped": 2}


def test_a_step_is_skipped_where_the_filter_diverged_or_the_loss_is_infinite(
    training, start, monkeypatch
):
    training, source = training

    def gradient_of(trained, variables, batch, step, task_):
        loss = jnp.where(step == 2, jnp.inf, jnp.float64(1))
        figures = dict.fromkeys(training.figures, jnp.float64(0)) | {"loss": loss}
        gradient = jax.tree.map(jnp.ones_like, trained)
        return gradient, task.BatchLosses(figures, variables["batch_stats"], step != 1)

    monkeypatch.setattr(task, "gradient_of", gradient_of)
    optim = dataclasses.replace(training.config.optim, epochs=100)  # compiled for itself
    other = dataclasses.replace(training, config=dataclasses.replace(training.config, optim=optim))
    for number, skipped in ((0, 0), (1, 1), (2, 1)):
        state = begun(training, start)._replace(step=jnp.int32(number))
        before = jax.tree.map(np.array, (state.variables, state.opt_state))
        state, progress = take(other, state, source, 0)
        assert progress.sums["skipped"] == skipped
        assert same(before, (state.variables, state.opt_state)) == bool(skipped)


def test_a_skipped_step_does_not_shift_the_schedule(training, start):
    """The rate that the log gives for a step is the one that is in force, whatever was skipped
    before: the same step is taken after a skip."""
    training, source = training
    rates = [loop.learning_rate(checkpoint.RunPosition(step=step), training) for step in range(4)]
    assert len(set(rates)) == 4
    state, other = (begun(training, start) for _ in range(2))
    lost = source._replace(accel=source.accel.at[:].set(np.nan))
    skipped, _ = take(training, other, lost, 0)
    state = state._replace(step=jnp.int32(1))
    states = [take(training, origin, source, 1)[0] for origin in (state, skipped)]
    assert same(states[0].variables, states[1].variables)


def test_training_segments_are_turned_by_any_yaw_and_low_passed(training):
    training, source = training
    rows, key = jnp.zeros(64, jnp.int32), jax.random.key(0)

    def changed_task(**changes):
        augment = dataclasses.replace(training.config.augment, **changes)
        config = dataclasses.replace(training.config, augment=augment)
        return dataclasses.replace(training, config=config)

    as_walked, turned = (
        jax.jit(changed_task(yaw=yaw).draw)(key, source, rows) for yaw in (False, True)
    )
    np.testing.assert_array_equal(as_walked[0].gyro, turned[0].gyro)
    np.testing.assert_array_equal(as_walked[1][3], turned[1][3])  # the gyro's first bias
    before, after = (np.asarray(sample[0].truth.velocity[:, 0]) for sample in (as_walked, turned))
    np.testing.assert_allclose(np.linalg.norm(after, axis=1), np.linalg.norm(before, axis=1))
    assert (before == before[0]).all()
    angle = np.arctan2(after[:, 1], after[:, 0])
    assert abs(np.exp(1j * angle).mean()) < 0.4  # all round the circle

    half, untouched = changed_task(low_pass_share=0.5), []
    draws = [jax.jit(variant.draw) for variant in (training, half)]
    for number in (0, 1):
        (plain, starts), (passed, same_starts) = (
            draw(jax.random.key(number), source, rows) for draw in draws
        )
        jax.tree.map(
            np.testing.assert_array_equal, (same_starts, passed.truth), (starts, plain.truth)
        )
        untouched.append((passed.gyro == plain.gyro).all(axis=(1, 2)))
        assert 0.2 < untouched[-1].mean() < 0.8
    assert (untouched[0] != untouched[1]).any()
    # Those of validation never pass it.
    every = changed_task(low_pass_share=1.0)
    cuts = (jax.jit(variant.segments, static_argnums=3) for variant in (training, every))
    jax.tree.map(np.testing.assert_array_equal, *(cut(key, source, rows, False) for cut in cuts))


def test_the_low_pass_of_segments_is_at_the_rate_of_the_data(training, monkeypatch):
    training, source = training
    calls = []

    def noted(key, segments, augment, rate):
        calls.append((augment, rate))
        return segments

    monkeypatch.setattr(filter_task, "low_pass_segments", noted)
    jax.eval_shape(training.draw, jax.random.key(0), source, source.earliest[:1])
    assert calls == [(training.config.augment, 50.0)]


def test_the_errors_of_the_starts_do_not_depend_on_the_yaws(training):
    training, source = training
    rows = jnp.zeros(16, jnp.int32)
    draw = jax.jit(jax.vmap(lambda key: training.draw(key, source, rows)))
    segments, starts = draw(jax.random.split(jax.random.key(3), 200))
    velocity = np.asarray(segments.truth.velocity[:, :, 0])
    angles = np.arctan2(velocity[..., 1], velocity[..., 0])
    errors = np.asarray(starts[3]).reshape(200, -1)
    correlations = stats.spearmanr(angles, errors).statistic[:16, 16:]
    assert correlations.shape == (16, 48) and np.abs(correlations).max() < 0.4


def test_the_error_at_waypoints_is_logged_where_walks_have_them(training, start, monkeypatch):
    training, source = training
    horizons = np.ones(3)
    losses = FilterLosses(1.0, horizons, horizons, 1.0, 1.0, 1.0, 0.0, 0.0, 0.09, 1.0, 1.0, True)
    monkeypatch.setattr(filter_task, "validate", lambda *_, **__: losses)
    for tapped in (False, True):
        walks = source._replace(tapped=np.arange(len(source.tapped)) < 7 * tapped)
        row = training.figures_of(begun(training, start), walks, KEY)
        assert row.get("val_waypoint_error") == (pytest.approx(0.3) if tapped else None)


def test_segments_that_are_too_short_for_kittis_error_do_not_lower_it(training, start, monkeypatch):
    """Of which a quarter has pieces of 100 m: the mean over all, 0.005, is a quarter of theirs."""
    training, source = training
    weights = dataclasses.replace(training.config.through_filter, translation_weight=1.0)
    config = dataclasses.replace(training.config, through_filter=weights)
    training, horizons = dataclasses.replace(training, config=config), np.ones(3)
    for share, expected in ((0.25, pytest.approx(2.0)), (0.0, None)):
        means = 1.0, horizons, horizons, 1.0, 1.0, 1.0, 0.02 * share, share, 0.09, 1.0, 1.0, True
        monkeypatch.setattr(filter_task, "validate", lambda *_, m=means, **__: FilterLosses(*m))
        row = training.figures_of(begun(training, start), source, KEY)
        assert row.get("val_t_rel") == expected


def test_the_filter_in_training_has_a_slope_at_its_gate_is_cut_and_does_not_call_lapack(
    training, start
):
    """Where each core is a device, batched calls of LAPACK in the step deadlock."""
    training, source = training
    ekf = training.training_filter()
    assert (ekf.gate_softness, ekf.checkpoint_every, ekf.truncate_every) == (2.0, 20, 100)
    state, order = training.initial_state(KEY, start), jnp.resize(source.earliest, 10)
    numbers = jnp.int32(0), jnp.int32(1), jnp.float32(1)
    lowered = task.train_steps.trace(state, source, order, *numbers, KEY, task=training)
    assert "cholesky" not in str(lowered.jaxpr) and "triangular_solve" not in str(lowered.jaxpr)


def test_gradient_against_differences(training, start):
    """Of each number of the filter and of a weight of the network, in a step as a run takes it;
    after one step Adam's first moment is a tenth of the gradient."""
    training, source = training
    begin = begun(training, start)

    def shifted_step(name="", by=0.0):
        """The step with one number moved."""

        def moved(path, leaf):
            leaf = np.array(leaf)
            if name_of(path) == name:
                leaf.flat[0] += np.float32(by)
            return jax.device_put(leaf)

        variables = jax.tree_util.tree_map_with_path(moved, begin.variables)
        others = jax.tree.map(parallel.fresh_copy, (begin.step, begin.opt_state))
        state, progress = take(training, TrainState(others[0], variables, others[1]), source, 0)
        assert progress.sums["skipped"] == 0
        return state, float(progress.sums["loss"])

    first = shifted_step()[0]
    before, after, moments = map(firsts, (begin.variables, first.variables, first.opt_state))
    moments = {name.partition("/mu/")[2]: value for name, value in moments.items()}
    names = [f"filter/{name}" for name in begin.variables["filter"]]
    assert len(names) == 15
    for name in [*names, "params/head/bias"]:
        step = 1e-3
        expected = (shifted_step(name, step)[1] - shifted_step(name, -step)[1]) / (2 * step)
        assert expected != 0, name
        np.testing.assert_allclose(10 * moments[name], expected, 1e-3, 1e-6, err_msg=name)
        assert (after[name] - before[name]) * expected < 0, name  # the step goes downhill


def name_of(path):
    return jax.tree_util.keystr(path, simple=True, separator="/")


def firsts(tree):
    """The first number of each leaf, by its name."""
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {name_of(path): np.asarray(leaf).flat[0] for path, leaf in leaves}


def test_parts_are_modules_and_options_by_name():
    modules = ("encoder", "norm", "bank", "head", "displacement", "uncertainty", "log_std")
    numbers = optimizer.filter_numbers(THROUGH_FILTER)
    variables = {"params": dict.fromkeys(modules, 0), "filter": numbers}
    for learn, params, some in (
        ("encoder", {"encoder", "norm", "bank"}, ()),
        ("head", {"head", "displacement"}, ()),  # TLIO's name, too
        ("uncertainty", {"uncertainty", "log_std"}, ()),
        ("noise", set(), optimizer.FILTER_PARTS["noise"]),
        ("measurement", set(), ("noise.measurement_scale", "noise.std_factor.0")),
        ("start", set(), ("start.yaw", "start.velocity")),
    ):
        selection = optimizer.select_trained(variables | {"batch_stats": {}}, (learn,))
        assert selection.get("params", {}).keys() == params
        assert set(some) <= selection.get("filter", {}).keys() and all(selection.values())
    assert optimizer.select_trained(variables, ("all", "head")) == variables
    experts = models.variable_shapes(models.create("experts", width=2), 32)
    for learn, part in (("head", "displacement"), ("uncertainty", "log_std")):
        selection = optimizer.select_trained({**experts}, (learn,))["params"]
        assert selection.keys() == {f"expert1_{part}", f"expert2_{part}"}
    without = variables | {"params": {"encoder": 0, "head": 0}}
    assert optimizer.select_trained(without, ("all",)) == without
    with pytest.raises(InputError, match=r"'uncertainty', but no module .* called uncertainty or"):
        optimizer.select_trained(without, ("noise", "uncertainty"))
    assert optimizer.select_trained(variables, ()) == {"params": variables["params"]}


def test_options_survive_their_unconstrained_numbers():
    numbers = optimizer.filter_numbers(THROUGH_FILTER)
    assert "start.tilt" not in numbers and "considered.scale" not in numbers
    assert optimizer.trained_settings(OPTIONS, numbers) == OPTIONS
    leaves = jax.tree.leaves(with_free_parameters(OPTIONS, numbers))
    assert {jnp.asarray(leaf).dtype for leaf in leaves} == {jnp.dtype(jnp.float64)}
    # A share is never rounded to 1, which no setting may be.
    nearly = optimizer.trained_settings(OPTIONS, {"noise.correlation.share": jnp.float32(20)})
    assert nearly.noise.correlation.share == 0.9999


def test_a_later_stage_starts_from_what_the_filter_has_learnt(recording, finished, training):
    """The command makes the filter of that run the default; what it asks for wins."""
    words = ["--init-from", str(finished), "--through-filter.learn", *THROUGH.learn]
    asked_for = tiny(recording, "unused", init_from=str(finished))
    run = load_initial_network(asked_for)
    call = Call("gnio train", words)
    begins = experiment(read(train, call), call).filter
    assert begins == run.config.filter != OPTIONS
    config = tiny(recording, "unused", filter=changed(begins, start={"velocity": 0.3}))
    later = dataclasses.replace(training[0], config=config)
    state = later.initial_state(KEY, run.variables)
    assert same(state.variables["params"], run.variables["params"])
    other = state.variables["filter"].pop("start.velocity")
    np.testing.assert_allclose(other, np.log(0.3), rtol=1e-6)
    expected = optimizer.filter_numbers(dataclasses.replace(config, filter=run.config.filter))
    for name, number in state.variables["filter"].items():
        np.testing.assert_allclose(number, expected[name], atol=1e-4, err_msg=name)


def test_training_on_windows_starts_from_a_runs_weights(recording):
    config = tiny(recording, "unused", through_filter=ThroughFilter())
    for equivariance, fits in (("four_headings", True), ("canonical_frame", False)):
        model = dataclasses.replace(config.model, equivariance=equivariance)
        other = dataclasses.replace(config, model=model)
        with nullcontext() if fits else pytest.raises(InputError, match="canonical_frame"):
            assert load_initial_network(other) is not None
    with jax.enable_x64(False):
        start = load_initial_network(config)
        training, _ = set_up(WindowTask, config, Silence())
        state = training.initial_state(KEY, start.variables)
    theirs = read_network(recording / "initial").variables
    assert same(state.variables["params"], theirs["params"])
    statistics = state.variables["batch_stats"]
    assert same(statistics["norm"], theirs["batch_stats"]["norm"])
    assert state.variables.keys() == {"params", "batch_stats"}
    assert (np.asarray(statistics["uncertainty"]["log_factor"]) == 0).all()


def test_a_network_without_displacements_is_trained_from_random_weights(recording, tmp_path):
    """Its factors of the constraint learn, with the constants, the mounting and the lever."""
    numbers = {"lateral_std": 0.3, "vertical_std": 0.3, "yaw": 0.0, "lever_x": 0.0}
    run = tmp_path / "run"
    config = tiny(
        recording,
        run,
        init_from=None,
        data=DataConfig(rate=50.0, window_seconds=WINDOW, window_rotation="body_axes"),
        model=ModelConfig(name="ai_imu"),
        filter=dataclasses.replace(OPTIONS, measurements={"nonholonomic": numbers}),
        through_filter=dataclasses.replace(THROUGH, learn=("all",), start_spread=0.0),
    )
    loop.train(config)
    first, last = rows(run)
    assert last["skipped"] == 0 and last["gradient_norm/log_std"] > 0
    assert last["gradient_norm/filter/measurements.nonholonomic.yaw"] > 0
    assert last["gradient_norm/filter1"] > 0 and first["gradient_norm/filter2"] > 0
    assert not {"val_rmse", "val_nis"} & last.keys() and np.isfinite(last["val_loss"])
    trained = checkpoint.load_latest(run)
    assert np.abs(trained.variables["params"]["log_std"]["kernel"]).max() > 0
    trained_numbers = trained.config.filter.measurements["nonholonomic"]
    assert all(trained_numbers[name] != number for name, number in numbers.items())
    with pytest.raises(InputError, match=r"'ai_imu' is trained in the filter's loop alone; name"):
        elsewhere = str(tmp_path / "elsewhere")
        loop.train(dataclasses.replace(config, workdir=elsewhere, through_filter=ThroughFilter()))
    for name, choice, usual in (
        ("best_by", "squared_error", "loss"),
        ("schedule", "plateau", "cosine"),
    ):
        optim = dataclasses.replace(config.optim, **{name: choice})
        expected = f"optim.{name}: is {choice}, and 'ai_imu' predicts no displacement, .* {usual}$"
        with pytest.raises(InputError, match=expected):
            loop.refuse_untrainable(dataclasses.replace(config, optim=optim))
        loop.refuse_untrainable(tiny(recording, run, optim=optim))  # others have such an error


def test_mistakes(recording, tmp_path):
    longer = {"data": DataConfig(rate=50.0, window_seconds=1.0)}
    for changes, expected in (
        ({"init_from": None}, r"'through_filter.learn' needs the weights .*--init-from"),
        (
            {"data": DataConfig(rate=100.0, window_seconds=WINDOW)},
            "initial: its data.rate is 50.0, and here it is 100.0; describe the same network",
        ),
        (
            {"through_filter": dataclasses.replace(THROUGH, piece_seconds=1.25)},
            r"'through_filter.piece_seconds' is not a whole number of strides of 0.1 s",
        ),
        (
            longer | {"through_filter": ThroughFilter(LEARN, 1.0)},
            r"'through_filter.piece_seconds' must be longer than the 1 s that the network sees",
        ),
        (
            {"through_filter": ThroughFilter(LEARN, 60.0)},
            r"no segment of 3000 samples .*lower through_filter.piece_seconds",
        ),
        (
            {"filter": dataclasses.replace(OPTIONS, mahalanobis_fail_scale=10.0)},
            r"'filter.mahalanobis_fail_scale' makes no sense beside the soft gate",
        ),
        (
            {"model": ModelConfig(name="ionet", width=3, corrector="airimu")},
            r"'model.corrector' learns from its preintegration, and not through the filter",
        ),
        ({"optim": OptimConfig(batch_size=64)}, "is 64, but there are only 10 segments"),
    ):
        with pytest.raises(InputError, match=expected):
            loop.train(tiny(recording, tmp_path / "run", **changes))
        assert not (tmp_path / "run").exists()
