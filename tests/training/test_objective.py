"""Losses by hand, the schedule by its formula, Adam against a plain NumPy loop."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gnio_jax.config import LossConfig, ModelConfig, OptimConfig, TrainConfig
from gnio_jax.data.windows import WindowSource
from gnio_jax.models.heads import CalibratedUncertainty
from gnio_jax.training import losses, optimizer, window_task
from gnio_jax.training.losses import Losses
from gnio_jax.training.task import TrainState
from gnio_jax.training.window_task import Validation, calibrated, isotropic
from gnio_jax.types import Prediction, Windows
from tests.support.tiny_network import Tiny


def target(displacement, steps=4):
    """Windows of which only the target matters, walked at constant velocity."""
    displacement = jnp.asarray(displacement, jnp.float32)
    count = len(displacement)
    return Windows(
        jnp.zeros((count, steps, 6), jnp.float32),
        displacement,
        jnp.broadcast_to(displacement[:, None] / steps, (count, steps, 3)),
    )


STEPS_PER_EPOCH = 7


@functools.partial(jax.jit, static_argnames=("config", "epoch", "axes"))
def found_losses(prediction, windows, config, epoch=0, axes=3):
    stage = losses.loss_stage(config, epoch * STEPS_PER_EPOCH, STEPS_PER_EPOCH)
    return losses.losses(prediction, windows, config, stage, axes)


def test_losses_by_hand():
    prediction = Prediction(
        jnp.array([[1.0, 0, 0], [0, 0, 0]], jnp.float32),
        jnp.array([[0, 0, 0], [np.log(2), 0, -1]], jnp.float32),
    )
    walked = target([[0.0, 0, 0], [2, 1, 0]])
    # First window: error 1 on x. Second: errors 2 and 1, standard deviations 2, 1, 1/e.
    mse = (1 + (4 + 1)) / 2
    nll = ((0.5) + (0.5 * 4 / 4 + 0.5 * 1 + np.log(2) - 1)) / 2
    found = found_losses(prediction, walked, LossConfig())
    np.testing.assert_allclose(
        [found.mse, found.nll, found.total], [mse, nll, 100 * mse + 1e-4 * nll], rtol=1e-6
    )
    found = found_losses(
        prediction, walked, LossConfig(mse_weight=1.0, mae_weight=1.0, nll_weight=0.0)
    )
    np.testing.assert_allclose(found.total, mse + (1 + (2 + 1)) / 2, rtol=1e-6)
    found = found_losses(prediction, walked, LossConfig(nll_from_epoch=3.0), epoch=2)
    np.testing.assert_allclose([found.nll, found.total], [nll, 100 * mse], rtol=1e-6)


def test_uncertainty_learns_from_its_epoch_on():
    walked, config = (
        target([[0.3, -0.2, 0.1]]),
        LossConfig(mse_weight=0.0, nll_weight=1.0, log_std_from_epoch=10.0),
    )

    def slopes(epoch):
        value = lambda d, u: found_losses(Prediction(d, u), walked, config, epoch).total  # noqa: E731
        return jax.jit(jax.value_and_grad(value, (0, 1)))(
            jnp.zeros((1, 3), jnp.float32), jnp.full((1, 3), -1.0, jnp.float32)
        )

    (before, (d_before, u_before)), (after, (d_after, u_after)) = slopes(9), slopes(10)
    assert before == after
    np.testing.assert_array_equal(u_before, 0)
    np.testing.assert_allclose(u_after, 1 - np.square([[0.3, -0.2, 0.1]]) * np.exp(2), rtol=1e-5)
    np.testing.assert_array_equal(d_before, d_after)
    assert (d_before != 0).all()


def test_switches_are_steps():
    config = LossConfig(nll_from_epoch=0.5, log_std_from_epoch=1.25)
    assert losses.switches(config, 8) == (4, 10)
    assert losses.switches(config, 7) == (4, 9)  # the first whole step after the fraction
    assert losses.switches(LossConfig(nll_from_epoch=3.0), 7) == (
        21,
        21,
    )  # without a likelihood it has nothing to learn from
    assert losses.switches(LossConfig(name="velocity_and_covariance", nll_from_epoch=3.0), 7) == (
        21,
        0,
    )
    assert losses.switches(LossConfig(log_std_from_epoch=1e9), 300) == (0, 2**31 - 1)
    seen = [losses.loss_stage(config, step, 8) for step in range(12)]
    assert [float(stage.nll_weight) > 0 for stage in seen] == [step >= 4 for step in range(12)]
    assert [bool(stage.log_std_learns) for stage in seen] == [step >= 10 for step in range(12)]


def test_velocity_and_covariance_by_hand():
    rng = np.random.default_rng(0)
    steps, velocity, log_std = (
        0.1 * rng.standard_normal((2, 5, 3)),
        rng.standard_normal((2, 5, 3)),
        rng.standard_normal((2, 5, 3)),
    )
    windows = Windows(
        jnp.zeros((2, 5, 6), jnp.float32),
        jnp.asarray(steps.sum(1), jnp.float32),
        jnp.asarray(steps, jnp.float32),
    )
    single = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    said = {
        "velocity": single(velocity),
        "velocity_log_std": single(log_std),
        "task_log_std": single([[0.3, -0.4]] * 2),
    }
    prediction = Prediction(single(velocity.mean(1)), single(np.zeros((2, 3))), said)
    speed = covariance = place = 0.0
    for b in range(2):
        for t in range(5):
            for axis in range(3):
                error = 5 * steps[b, t, axis] - velocity[b, t, axis]
                speed += error**2 / 10
                squared = error**2 / np.exp(2 * log_std[b, t, axis])
                covariance += (squared / 2 + log_std[b, t, axis]) / 10
        place += ((steps[b].sum(0) - velocity[b].mean(0)) ** 2).sum() / 2
    expected = (speed + place) / (2 * np.exp(0.6)) + covariance / (2 * np.exp(-0.8)) + 0.3 - 0.4
    config = LossConfig(name="velocity_and_covariance")
    np.testing.assert_allclose(found_losses(prediction, windows, config).total, expected, rtol=1e-5)
    with pytest.raises(ValueError, match="velocity for every sample"):
        found_losses(prediction._replace(diagnostics={}), windows, config)


def ctins(task_log_std, log_std, error=0.1):
    """A window of five samples whose predicted velocities are wrong by `error` along each axis."""
    shape = (1, 5, 3)
    diagnostics = {
        "velocity": jnp.full(shape, error, jnp.float32),
        "velocity_log_std": jnp.full(shape, log_std, jnp.float32),
        "task_log_std": jnp.array([task_log_std], jnp.float32),
    }
    nothing = jnp.zeros((1, 3), jnp.float32)
    return Prediction(jnp.full((1, 3), error, jnp.float32), nothing, diagnostics)


def test_the_weights_of_ctins_loss_are_bounded():
    """σ = 0.3 m per window: the likelihood of the velocities is negative, and the lower δ_c, the
    lower the loss would be without a bound. No gradient draws δ_c there, nor is one infinite."""
    config, walked = LossConfig(name="velocity_and_covariance"), target([[0.0, 0, 0]], steps=5)

    @jax.jit
    def value_and_slope(log_c):
        value = lambda c: found_losses(ctins([0.0, c], np.log(0.3)), walked, config).total  # noqa: E731
        return jax.value_and_grad(value)(log_c)

    floor = losses.TASK_LOG_STD_FLOOR
    lowest, _ = value_and_slope(jnp.float32(floor))
    for log_c in (floor - 1, -10.0, -60.0):
        value, slope = value_and_slope(jnp.float32(log_c))
        assert value == lowest and slope == 0
    assert value_and_slope(jnp.float32(floor + 0.5))[0] > lowest


def test_ctin_with_two_axes_is_not_blamed_for_the_vertical():
    """Its velocity along z is always 0: how the walker climbs changes nothing."""
    level, climbing = target([[0.3, -0.2, 0.0]], steps=5), target([[0.3, -0.2, 0.7]], steps=5)
    prediction = ctins([0.1, 0.2], -1.0)
    for name in ("velocity_and_covariance", "weighted_sum"):
        config = LossConfig(name=name, mae_weight=1.0)
        both = [found_losses(prediction, each, config, axes=2) for each in (level, climbing)]
        assert both[0] == both[1]
        one_more = found_losses(prediction, climbing, config, axes=3)
        assert one_more.total > both[1].total and one_more.mse > both[1].mse


def test_a_prediction_of_another_shape_is_refused():
    """(b, 1) would be broadcast in silence."""
    for shape in ((2, 1), (1, 3)):
        prediction = Prediction(jnp.zeros((2, 3)), jnp.zeros(shape))
        stage = losses.loss_stage(LossConfig(), 0, 1)
        with pytest.raises(AssertionError, match="shape"):
            losses.losses(prediction, target([[0.0, 0, 0]] * 2), LossConfig(), stage)


def test_nan_on_validation_is_never_the_best_of_the_plateau():
    config, plateau = OptimConfig(schedule="plateau"), optimizer.Plateau()
    for error in (float("nan"), 1.0, float("nan"), 0.5):
        plateau = optimizer.watch(plateau, error, config)
    assert plateau == optimizer.Plateau(1.0, 0.5, 0)


def test_floor_limits_what_the_likelihood_sees():
    prediction = Prediction(jnp.zeros((1, 3), jnp.float32), jnp.full((1, 3), -20.0, jnp.float32))
    floor = float(np.log(1e-3))
    found = found_losses(prediction, target([[0.005, 0, 0]]), LossConfig(log_std_floor=floor))
    np.testing.assert_allclose(found.nll, 0.5 * 0.005**2 / 1e-6 + 3 * floor, rtol=1e-5)


def by_formula(step, steps_per_epoch, warmup, epochs):
    if step < warmup * steps_per_epoch:
        return 1e-6 + (1e-4 - 1e-6) * step / (warmup * steps_per_epoch)
    share = (step - warmup * steps_per_epoch) / ((epochs - warmup) * steps_per_epoch)
    return 1e-6 + (1e-4 - 1e-6) * 0.5 * (1 + np.cos(np.pi * share))


@pytest.mark.parametrize("epochs, warmup", [(200, 5), (4, 2)])
def test_schedule_of_the_paper(epochs, warmup):
    """Short runs (4 epochs for a warm-up of 5) warm up for their first half."""
    rate = optimizer.schedule(OptimConfig(epochs=epochs), 7)
    steps = np.arange(7 * epochs + 1)
    expected = [by_formula(step, 7, warmup, epochs) for step in steps]
    np.testing.assert_allclose(jax.jit(jax.vmap(rate))(steps), expected, rtol=1e-4)


def test_no_decay_after_the_warm_up():
    rate = optimizer.schedule(OptimConfig(schedule="constant", epochs=20, warmup_epochs=2.0), 5)
    np.testing.assert_allclose(
        [rate(0), rate(5), rate(10), rate(100)], [1e-6, (1e-6 + 1e-4) / 2, 1e-4, 1e-4], rtol=1e-4
    )
    assert float(
        optimizer.schedule(OptimConfig(schedule="plateau", warmup_epochs=0.0), 5)(0)
    ) == pytest.approx(1e-4)


def test_plateau_waits_for_its_epochs_and_starts_counting_anew(monkeypatch):
    monkeypatch.setattr(optimizer, "PLATEAU_EPOCHS", 2)
    monkeypatch.setattr(optimizer, "PLATEAU_FACTOR", 0.5)
    config = OptimConfig(schedule="plateau")
    # a fall by less than a ten-thousandth is none
    errors = [1.0, 0.9, 0.9, 0.89999, 0.95, 0.8, 0.8, 0.8, 0.8, 0.8, 0.8, 0.8]
    factors, plateau = [], optimizer.Plateau()
    for error in errors:
        plateau = optimizer.watch(plateau, error, config)
        factors.append(plateau.factor)
    assert factors == [1, 1, 1, 1, 0.5, 0.5, 0.5, 0.5, 0.25, 0.25, 0.25, 0.125]
    assert optimizer.watch(optimizer.Plateau(), 1.0, OptimConfig()) == optimizer.Plateau()


def test_plateau_is_that_of_pytorch():
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(1)
    errors = np.cumprod(1 + 0.05 * rng.standard_normal(120) - 0.002)
    theirs = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=1.0)
    scheduler = torch.optim.lr_scheduler.ReduceLROnPlateau(theirs, "min", factor=0.1, patience=10)
    plateau = optimizer.Plateau()
    for error in errors:
        scheduler.step(error)
        plateau = optimizer.watch(plateau, float(error), OptimConfig(schedule="plateau"))
        assert plateau.factor == pytest.approx(theirs.param_groups[0]["lr"])
    assert plateau.factor < 0.1


def test_a_constant_uncertainty_takes_the_errors_of_the_validation():
    constant, other = jnp.zeros(3, jnp.float32), jnp.ones(3, jnp.float32)
    state = TrainState(
        jnp.int32(0), {}, {"uncertainty": {"log_std": constant}, "bn": {"mean": other}}, ()
    )
    nothing = Losses(*[jnp.float32(0)] * 3)
    found = calibrated(
        state,
        Validation(nothing, jnp.array([0.04, 1.0, 4.0], jnp.float32), jnp.ones(3, jnp.float32)),
    ).batch_stats
    np.testing.assert_allclose(np.exp(found["uncertainty"]["log_std"]), [0.2, 1, 2], rtol=1e-6)
    assert found["bn"]["mean"] is other


@pytest.mark.parametrize("equivariance", ["none", "four_headings", "canonical_frame"])
def test_constants_of_an_equivariant_network_are_the_same_along_both_axes(
    monkeypatch, equivariance
):
    """Their squares are the mean square errors of the plane."""
    stats = {"uncertainty": {"log_std": jnp.zeros(3, jnp.float32)}}
    state = TrainState(jnp.int32(7), {}, stats, ())
    errors = jnp.array([1.0, 4.0, 9.0], jnp.float32)
    found = Validation(Losses(*[jnp.float32(0)] * 3), errors, errors)
    monkeypatch.setattr(window_task, "validate", lambda *_, **__: found)
    config = TrainConfig(model=ModelConfig(equivariance=equivariance))
    task = window_task.WindowTask(Tiny(), config, 7)
    held_out = WindowSource(*[jnp.zeros(0)] * len(WindowSource._fields))
    kept, _ = task.validate(state, {"some": held_out}, jax.random.key(0))
    constants = kept.batch_stats["uncertainty"]["log_std"]
    wanted = [1.0, 4.0, 9.0] if equivariance == "none" else [2.5, 2.5, 9.0]
    np.testing.assert_allclose(np.exp(2 * constants), wanted, rtol=1e-6)
    np.testing.assert_allclose(isotropic(found).axis_normalised, [2.5, 2.5, 9.0], rtol=1e-6)


def test_a_calibrated_head_announces_the_errors_of_the_validation():
    """Errors twice and half as large as announced: the factors follow, from whatever they were; and
    training does not see them."""
    head, rng = CalibratedUncertainty(), np.random.default_rng(0)
    h = jnp.asarray(rng.standard_normal((4, 5)), jnp.float32)
    variables = head.init(jax.random.key(0), h, False)
    stats = {"uncertainty": {"log_factor": jnp.log(jnp.array([3.0, 1.0, 1.0], jnp.float32))}}
    nothing = Losses(*[jnp.float32(0)] * 3)
    seen = Validation(nothing, jnp.ones(3, jnp.float32), jnp.array([4.0, 0.25, 1.0], jnp.float32))
    lost = calibrated(
        TrainState(jnp.int32(0), {}, stats, ()),
        seen._replace(axis_normalised=jnp.array([jnp.inf, 0, 1], jnp.float32)),
    )
    assert np.isfinite(lost.batch_stats["uncertainty"]["log_factor"]).all()
    found = calibrated(TrainState(jnp.int32(0), {}, stats, ()), seen).batch_stats["uncertainty"]
    np.testing.assert_allclose(np.exp(found["log_factor"]), [6.0, 0.5, 1.0], rtol=1e-6)
    variables = {"params": variables["params"], "batch_stats": found}
    np.testing.assert_allclose(
        head.apply(variables, h, False), np.log([[6.0, 0.5, 1.0]] * 4), rtol=1e-6, atol=1e-7
    )
    np.testing.assert_array_equal(head.apply(variables, h, True), 0.0)


@pytest.mark.parametrize(
    "held_loss", [LossConfig(log_std_from_epoch=2.0), LossConfig(nll_from_epoch=2.0)]
)
def test_a_held_uncertainty_is_not_counted(held_loss):
    """PyTorch's Adam does not count steps in which a parameter has no gradient: at the release the
    moments are those of a first step."""
    config = OptimConfig(epochs=10)
    tx, rate = optimizer.adam(config, held_loss, 3), optimizer.schedule(config, 3)
    params = {
        part: {"w": jnp.array([1.0, -2.0, 3.0], jnp.float32)} for part in ("encoder", "log_std")
    }
    state, update = tx.init({"params": params}), jax.jit(tx.update)
    expected = {part: [np.array([1.0, -2.0, 3.0]), np.zeros(3), np.zeros(3), 0] for part in params}
    rng = np.random.default_rng(0)
    for step in range(12):
        held = not bool(losses.loss_stage(held_loss, step, 3).log_std_learns)
        assert held == (step < 6)
        gradient = {
            part: np.zeros(3) if held and part == "log_std" else rng.standard_normal(3)
            for part in params
        }
        change, state = update(
            {"params": {name: {"w": jnp.float32(g)} for name, g in gradient.items()}},
            state,
            {"params": params},
            log_std_learns=jnp.bool_(not held),
        )
        params = optax.apply_updates(params, optax.tree.scale(-rate(step), change["params"]))
        for part, (w, m, v, count) in expected.items():
            if held and part == "log_std":
                continue
            m, v = 0.9 * m + 0.1 * gradient[part], 0.999 * v + 0.001 * gradient[part] ** 2
            count += 1
            w = w - by_formula(step, 3, 5, 10) * (m / (1 - 0.9**count)) / (
                np.sqrt(v / (1 - 0.999**count)) + 1e-8
            )
            expected[part] = [w, m, v, count]
        for part in params:
            np.testing.assert_allclose(params[part]["w"], expected[part][0], rtol=1e-6, atol=2e-7)


def test_a_rate_below_the_end_of_the_cosine_does_not_rise():
    config = OptimConfig(epochs=10, learning_rate=5e-7, start_learning_rate=0.0)
    rates = np.array([optimizer.schedule(config, 3)(step) for step in range(31)])
    np.testing.assert_allclose(rates[15:], 5e-7, rtol=1e-6)
    assert (np.diff(rates) > -1e-12).all() and rates.max() <= 5.0001e-7


@pytest.mark.parametrize("clip, decay", [(None, 0.0), (0.5, 0.0), (0.5, 0.03)])
def test_adam_against_numpy(clip, decay):
    config = OptimConfig(epochs=10, clip_norm=clip, weight_decay=decay)
    tx, schedule = optimizer.adam(config, LossConfig(), 3), optimizer.schedule(config, 3)
    params = {"w": jnp.array([1.0, -2.0, 3.0], jnp.float32)}
    state, learn = tx.init(params), jax.jit(tx.update)
    w, m, v = np.array([1.0, -2.0, 3.0]), np.zeros(3), np.zeros(3)
    rng = np.random.default_rng(0)
    for step in range(20):
        gradient = rng.standard_normal(3)
        update, state = learn({"w": jnp.asarray(gradient, jnp.float32)}, state, params)
        params = optax.apply_updates(params, optax.tree.scale(-schedule(step), update))
        if clip:
            gradient = gradient * min(1, clip / np.linalg.norm(gradient))
        gradient = gradient + decay * w
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
        rate = by_formula(step, 3, 5, 10)
        w = w - rate * (m / (1 - 0.9 ** (step + 1))) / (
            np.sqrt(v / (1 - 0.999 ** (step + 1))) + 1e-8
        )
    np.testing.assert_allclose(params["w"], w, atol=1e-6)


@functools.partial(jax.jit, static_argnames="config")
def value_and_slopes(log_std, error, config):
    """The likelihood of one window, and its derivatives."""

    def likelihood(log_std, error):
        prediction = Prediction(jnp.zeros((1, 3)), jnp.array([[log_std, 0, 0]]), {})
        return found_losses(prediction, target([[error, 0, 0]]), config).nll

    return jax.value_and_grad(likelihood, (0, 1))(log_std, error)


@pytest.mark.parametrize("error", [0.0, 0.5, 0.999, 1.0, 1.001, 30.0])
def test_the_likelihood_is_the_papers_without_bound(error):
    """σ = 0.1 m: ½ e²/σ² + log σ, and its slopes 1 − e²/σ² and e/σ², also at 300 σ."""
    value, (slope, by_error) = value_and_slopes(np.log(0.1), error, LossConfig())
    np.testing.assert_allclose(value, 50 * error**2 + np.log(0.1), rtol=1e-5)
    np.testing.assert_allclose(slope, 1 - 100 * error**2, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(by_error, 100 * error, rtol=1e-5)


@pytest.mark.parametrize("error", [0.0, 0.5, 0.999, 1.0, 1.001, 30.0])
def test_an_outlier_pulls_at_the_uncertainty_no_more_than_ten_standard_deviations(error):
    """σ = 0.1 m: the likelihood is the normal one up to 1 m; value and slope are steady there."""
    log_std = np.log(0.1)
    squared = (error / 0.1) ** 2
    config = LossConfig(outlier_sigmas=10.0)
    value, (slope, by_error) = value_and_slopes(log_std, error, config)
    counted = squared if squared <= 100 else 100 * (1 + np.log(squared / 100))
    np.testing.assert_allclose(value, 0.5 * counted + log_std, rtol=1e-5)
    np.testing.assert_allclose(slope, 1 - min(squared, 100.0), rtol=1e-4, atol=1e-4)
    assert np.isfinite(by_error)
