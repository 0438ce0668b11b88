"""The step on windows, statistics of batch normalisation, constants of the uncertainty."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import models, parallel
from gnio_jax.config import AugmentConfig, DataConfig, LossConfig, ModelConfig, TrainConfig
from gnio_jax.models.heads import CalibratedUncertainty
from gnio_jax.reporting import Silence
from gnio_jax.training import task, window_task, windows
from gnio_jax.training.losses import Losses, loss_stage
from gnio_jax.training.recordings import set_up
from gnio_jax.training.task import TrainState
from gnio_jax.training.window_task import Validation, WindowTask, calibrate_uncertainty
from tests.support.drawn_state import drawn_state, fresh_state
from tests.support.tiny_network import Tiny
from tests.support.tiny_run import config, same

KEY = jax.random.key(0)


@pytest.fixture(scope="module")
def training(recording):
    with jax.enable_x64(False):
        experiment = config(recording, "")
        window_training, recordings = set_up(WindowTask, experiment, Silence())
        return (
            window_training,
            recordings,
            drawn_state(window_training.model, experiment, window_training.steps_per_epoch),
        )


@pytest.mark.parametrize(
    "change, warned",
    [
        ({}, True),
        ({"tilt_degrees": 0.0}, False),
        ({"rocking_share": 0.1, "tilt_degrees": 0.0}, True),
    ],
)
@pytest.mark.parametrize("corrector", ["airimu", "none"])
def test_changes_that_are_no_motion_are_not_for_a_corrector(change, warned, corrector):
    """Tilted by default."""
    model = ModelConfig(name="ionet", width=3, corrector=corrector)
    experiment = TrainConfig(model=model, augment=AugmentConfig(**change))
    state = TrainState(jnp.int32(0), {"params": {"head": np.zeros(3)}}, None)
    lines = list(WindowTask(Tiny(), experiment, 7).description(state, Path("run")))
    says = any("from which a corrector learns" in line for line in lines)
    assert says == (warned and corrector == "airimu")


def test_steps_and_validation_are_compiled_once(training):
    """Another order, other windows, more steps, another learning rate, another stage. And the first
    window that is not finite is named, where more steps follow it in the same dispatch."""
    training, (source, held_out, _), state = training
    jitted, programs = (task.train_steps, window_task.validate), []
    state = parallel.copy_to_devices(state)
    with jax.enable_x64(False):
        for epoch, (first, count, factor) in enumerate([(0, 1, 1.0), (1, 2, 0.5), (3, 4, 0.5)]):
            order = training.order(jax.random.key(1), epoch, source)
            if epoch == 2:
                wild = np.array(source.displacement)
                wild[order[4 * 16 + 3]] = np.inf
                source = source._replace(displacement=jax.device_put(wild))
            numbers = jnp.int32(first), jnp.int32(count), jnp.float32(factor)
            state, progress = training.take_steps(state, source, order, *numbers, KEY)
            stage = loss_stage(training.config.loss, epoch, 9)
            outcome = window_task.validate(state, held_out["tlio"], stage, task=training)
            programs.append([function._cache_size() for function in jitted])
            if epoch < 2:
                finite = jax.tree.leaves((progress.sums, outcome.losses))
                assert np.isfinite(finite).all() and progress.failed_step == -1
    assert programs[0] == programs[1] == programs[2]
    assert int(state.step) == 7 and progress.failed_step == 4


def test_the_loss_of_a_corrector_is_in_the_log(training, recording):
    """It is the whole objective here, and its preintegration alone; no other network has one."""
    changes = {"model": ModelConfig("ionet", width=3, corrector="airimu")}
    changes["loss"] = LossConfig(mse_weight=0.0, nll_weight=0.0, preintegration_weight=2.0)
    changes["data"] = DataConfig(rate=50.0, window_rotation="body_axes")
    experiment = config(recording, "", **changes)
    with jax.enable_x64(False):
        other, (source, held_out, _) = set_up(WindowTask, experiment, Silence())
        state = drawn_state(other.model, experiment, other.steps_per_epoch)
        batch = jax.jit(other.draw)(KEY, source, jnp.arange(4, dtype=jnp.int32))
        figures = jax.jit(other.losses)(state.variables, batch, jnp.int32(0)).figures
        row = other.figures_of(state, held_out["tlio"], KEY)
    assert figures.keys() == set(other.figures)
    assert 2 * float(figures["preintegration"]) == pytest.approx(float(figures["loss"]), rel=1e-6)
    assert set(other.figures) - set(training[0].figures) == {"preintegration"}
    assert 2 * row["val_preintegration"] == pytest.approx(row["val_loss"], rel=1e-6)
    assert row["val_preintegration"] != 0
    remark = other.remark(row | dict.fromkeys(other.figures, 0.25))
    assert f"preintegration 0.25  val mse {row['val_mse']:.4g}" in remark
    assert f" preintegration {row['val_preintegration']:.4g}  " in remark


def test_validation_leaves_the_balance_of_experts_out(training, recording):
    """A router that is sure of each window, and takes all experts alike, is not out of balance."""
    rows = []
    for weight in (0.0, 50.0):
        changes = {"model": ModelConfig("experts", width=2), "loss": LossConfig(nll_weight=0.0)}
        changes["loss"] = dataclasses.replace(changes["loss"], balance_weight=weight)
        experiment = config(recording, "", **changes)
        experts = WindowTask(models.from_experiment(experiment), experiment, 1)
        state = drawn_state(experts.model, experiment, 1)
        rows.append(experts.figures_of(state, training[1].held_out["tlio"], KEY))
    assert rows[0]["val_loss"] == rows[1]["val_loss"] > 0
    assert rows[1]["val_loss"] == pytest.approx(100 * rows[1]["val_mse"], rel=1e-5)


class Flat(Tiny):
    """Its displacements have no vertical."""

    output_dim: int = 2


def test_the_vertical_counts_only_where_it_is_predicted(training, monkeypatch):
    training, (source, held_out, _), state = training
    axes = []

    def losses(prediction, windows, config, stage, count, dt):
        axes.append(count)
        return Losses(*jnp.zeros((3, *prediction.displacement.shape[:0])))

    monkeypatch.setattr(window_task, "losses", losses)
    stage = loss_stage(training.config.loss, 0, 9)
    with jax.enable_x64(False):
        for model in (Tiny(), Flat()):
            other = dataclasses.replace(training, model=model)
            batch = jax.eval_shape(other.draw, KEY, source, jnp.zeros(4, jnp.int32))
            jax.eval_shape(other.losses, state.variables, batch, jnp.int32(0))
            jax.eval_shape(
                functools.partial(window_task.validate, task=other), state, held_out["tlio"], stage
            )
    assert axes == [3, 3, 2, 2]


def test_no_type_of_a_fresh_state_is_weak(recording):
    create = functools.partial(fresh_state, Tiny(), config(recording, ""), 3)
    with jax.enable_x64(False):
        fresh = jax.eval_shape(create, jax.random.key(0))
    assert not [leaf for leaf in jax.tree.leaves(fresh) if leaf.weak_type]


def estimated(training, state, source, key=7):
    with jax.enable_x64(False):
        key = jax.random.key(key)
        order = window_task.statistics_order(key, source, training)
        return window_task.estimate_statistics(state, source, order, key, task=training)


def with_statistics(training, windows):
    optim = dataclasses.replace(training.config.optim, statistics_windows=windows)
    return dataclasses.replace(training, config=dataclasses.replace(training.config, optim=optim))


def statistics(state):
    return state.variables["batch_stats"]


def test_statistics_are_means_over_batches_and_all_else_is_left_alone(training):
    """Against NumPy, whatever they were before. A factor of the uncertainty is no statistic."""
    training, (source, *_), state = training
    training = with_statistics(training, 48)
    factor = {"log_factor": jnp.array([0.5, -1.0, 2.0], jnp.float32)}
    other = statistics(state) | {"uncertainty": factor}
    state = state._replace(variables=state.variables | {"batch_stats": other})
    estimate = estimated(training, state, source)
    kernel = np.asarray(state.variables["params"]["encoder"]["kernel"], np.float64)
    order_key, draw_key = jax.random.split(jax.random.key(7))
    order = np.asarray(jax.random.permutation(order_key, source.visited))[:48].reshape(3, 16)
    means, variances, draw = [], [], jax.jit(training.draw)
    for number, which in enumerate(order):
        with jax.enable_x64(False):
            key = jax.random.fold_in(draw_key, number)
            imu = draw(key, source, jnp.asarray(which))[0].imu
        hidden = np.asarray(imu, np.float64).mean(axis=1) @ kernel
        means.append(hidden.mean(axis=0))
        variances.append(hidden.var(axis=0))
    norm = statistics(estimate)["norm"]
    np.testing.assert_allclose(norm["mean"], np.mean(means, 0), rtol=1e-3, atol=1e-5)
    np.testing.assert_allclose(norm["var"], np.mean(variances, 0), rtol=1e-3)
    np.testing.assert_array_equal(
        statistics(estimate)["uncertainty"]["log_factor"], [0.5, -1.0, 2.0]
    )

    moved = jax.tree.map(lambda x: x + 3, statistics(state))
    again = state._replace(variables=state.variables | {"batch_stats": moved}, step=jnp.int32(5))
    assert same(norm, statistics(estimated(training, again, source))["norm"])
    assert not same(norm, statistics(estimated(training, state, source, key=1))["norm"])
    order = window_task.statistics_order(KEY, source, with_statistics(training, 10**9))
    assert len(order) == 220 // 16 * 16
    assert window_task.has_statistics(state, "mean")
    assert not window_task.has_statistics(TrainState(jnp.int32(0), {"batch_stats": {}}, ()), "mean")


def with_uncertainty(**constants):
    """A state of which only constants of the uncertainty matter."""
    leaves = {name: jnp.asarray(value, jnp.float32) for name, value in constants.items()}
    return TrainState(jnp.int32(7), {"batch_stats": {"uncertainty": leaves}}, ())


def validation(mse, normalised):
    figures = (jnp.asarray(axes, jnp.float32) for axes in (mse, normalised))
    return Validation(Losses(*[jnp.float32(0)] * 3), *figures)


def of_uncertainty(state, name):
    return np.exp(statistics(state)["uncertainty"][name])


def test_the_uncertainty_takes_the_errors_of_the_validation():
    """A constant those of the axes. A head's factor follows errors twice and half as large as it
    announced, from whatever it was, and nothing becomes infinite; training does not see it."""
    state = calibrate_uncertainty(
        with_uncertainty(log_std=np.zeros(3)), validation([0.04, 1.0, 4.0], [1] * 3)
    )
    np.testing.assert_allclose(of_uncertainty(state, "log_std"), [0.2, 1, 2], rtol=1e-6)
    start = with_uncertainty(log_factor=np.log([3.0, 1.0, 1.0]))
    state = calibrate_uncertainty(start, validation([1] * 3, [4.0, 0.25, 1.0]))
    np.testing.assert_allclose(of_uncertainty(state, "log_factor"), [6.0, 0.5, 1.0], rtol=1e-6)
    lost = calibrate_uncertainty(start, validation([1] * 3, [np.inf, 0, 1]))
    assert np.isfinite(of_uncertainty(lost, "log_factor")).all()
    head, h = CalibratedUncertainty(), jnp.ones((4, 5), jnp.float32)
    variables = head.init(jax.random.key(0), h, False)
    variables |= {"batch_stats": statistics(state)["uncertainty"]}
    std = np.exp(head.apply(variables, h, False))
    np.testing.assert_allclose(std, [[6.0, 0.5, 1.0]] * 4, rtol=1e-6)
    np.testing.assert_array_equal(head.apply(variables, h, True), 0.0)


@pytest.mark.parametrize(
    "name, equivariance, averaged",
    [
        ("gnio", "none", False),
        ("gnio", "four_headings", True),
        ("gnio", "canonical_frame", False),
        ("gnio", "device_heading", False),
        ("gru", "device_heading", True),
    ],
)
def test_constants_are_those_of_all_datasets_and_of_both_axes_in_a_mean_over_headings(
    monkeypatch, name, equivariance, averaged
):
    """Their squares are the mean square errors over the datasets, and there over the plane."""

    def validate(state, source, *_, **__):
        errors = source.imu[0] * np.float32([1.0, 4.0, 9.0])
        return validation(errors, errors)

    monkeypatch.setattr(window_task, "validate", validate)
    model = models.create(name, equivariance=equivariance)
    training = WindowTask(model, TrainConfig(), 7)
    fields = len(windows.WindowSource._fields)
    held_out = {str(k): windows.WindowSource(*[jnp.full(1, k)] * fields) for k in (0.5, 1.5)}
    calibrated_state, row = training.validate(
        with_uncertainty(log_std=np.zeros(3)), held_out, jax.random.key(0)
    )
    expected = [2.5, 2.5, 9.0] if averaged else [1.0, 4.0, 9.0]
    np.testing.assert_allclose(
        of_uncertainty(calibrated_state, "log_std") ** 2, expected, rtol=1e-6
    )
    assert row["val_normalised/z"] == 9.0
