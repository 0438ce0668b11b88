"""Losses by hand, the schedule by its formula, Adam against a plain NumPy loop."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from gnio_jax.config import LossConfig, OptimConfig
from gnio_jax.training import losses, optimizer
from gnio_jax.types import Prediction, Windows


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
    single = lambda rows: jnp.asarray(rows, jnp.float32)  # noqa: E731
    log_std = single([[0, 0, 0], [np.log(2), 0, -1]])
    prediction = Prediction(single([[1, 0, 0], [0, 0, 0]]), log_std)
    walked = target([[0.0, 0, 0], [2, 1, 0]])
    # First window: error 1 on x. Second: errors 2 and 1, standard deviations 2, 1, 1/e.
    mse, mae = (1 + (4 + 1)) / 2, (1 + (2 + 1)) / 2
    nll = (0.5 + (0.5 * 4 / 4 + 0.5 * 1 + np.log(2) - 1)) / 2
    for config, total in (
        (LossConfig(), 100 * mse + 1e-4 * nll),
        (LossConfig(mse_weight=1.0, mae_weight=1.0, nll_weight=0.0), mse + mae),
        (LossConfig(nll_from_epoch=3.0), 100 * mse),
    ):
        figures = found_losses(prediction, walked, config, epoch=2)
        np.testing.assert_allclose(
            [figures.mse, figures.nll, figures.total], [mse, nll, total], rtol=1e-6
        )


def test_uncertainty_learns_from_its_epoch_on():
    walked = target([[0.3, -0.2, 0.1]])
    config = LossConfig(mse_weight=0.0, nll_weight=1.0, log_std_from_epoch=10.0)

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
    """The first whole step after a fraction of an epoch; without a likelihood the uncertainty has
    nothing to learn from, unless the loss has one of its own."""
    config = LossConfig(nll_from_epoch=0.5, log_std_from_epoch=1.25)
    ctins_loss = LossConfig(name="velocity_and_covariance", nll_from_epoch=3.0)
    for loss, steps, switches in (
        (config, 8, (4, 10)),
        (config, 7, (4, 9)),
        (LossConfig(nll_from_epoch=3.0), 7, (21, 21)),
        (ctins_loss, 7, (21, 0)),
        (LossConfig(log_std_from_epoch=1e9), 300, (0, 2**31 - 1)),
    ):
        assert losses.switches(loss, steps) == switches
    stages = [losses.loss_stage(config, step, 8) for step in range(12)]
    assert [float(stage.nll_weight) > 0 for stage in stages] == [step >= 4 for step in range(12)]
    assert [bool(stage.log_std_learns) for stage in stages] == [step >= 10 for step in range(12)]


def test_velocity_and_covariance_by_hand():
    steps, velocity, log_std = np.random.default_rng(0).standard_normal((3, 2, 5, 3))
    steps *= 0.1
    single = lambda x: jnp.asarray(x, jnp.float32)  # noqa: E731
    windows = Windows(jnp.zeros((2, 5, 6), jnp.float32), single(steps.sum(1)), single(steps))
    diagnostics = {"velocity": single(velocity), "velocity_log_std": single(log_std)}
    diagnostics["task_log_std"] = single([[0.3, -0.4]] * 2)
    prediction = Prediction(single(velocity.mean(1)), single(np.zeros((2, 3))), diagnostics)
    speed = covariance = displacement = 0.0
    for b in range(2):
        for t in range(5):
            for axis in range(3):
                error = 5 * steps[b, t, axis] - velocity[b, t, axis]
                speed += error**2 / 10
                squared = error**2 / np.exp(2 * log_std[b, t, axis])
                covariance += (squared / 2 + log_std[b, t, axis]) / 10
        displacement += ((steps[b].sum(0) - velocity[b].mean(0)) ** 2).sum() / 2
    expected = (
        (speed + displacement) / (2 * np.exp(0.6)) + covariance / (2 * np.exp(-0.8)) + 0.3 - 0.4
    )
    config = LossConfig(name="velocity_and_covariance")
    np.testing.assert_allclose(found_losses(prediction, windows, config).total, expected, rtol=1e-5)
    with pytest.raises(ValueError, match="velocity for every sample"):
        found_losses(prediction._replace(diagnostics={}), windows, config)
    fewer = prediction._replace(
        diagnostics=diagnostics | {"velocity": diagnostics["velocity"][:, :1]}
    )
    with pytest.raises(AssertionError, match="shape"):
        found_losses(fewer, windows, config)


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
        figures = [found_losses(prediction, walk, config, axes=2) for walk in (level, climbing)]
        assert figures[0] == figures[1]
        one_more = found_losses(prediction, climbing, config, axes=3)
        assert one_more.total > figures[1].total and one_more.mse > figures[1].mse


def test_a_prediction_of_another_shape_is_refused():
    """(b, 1) would be broadcast in silence."""
    prediction = Prediction(jnp.zeros((2, 3)), jnp.zeros((2, 1)))
    stage = losses.loss_stage(LossConfig(), 0, 1)
    with pytest.raises(AssertionError, match="shape"):
        losses.losses(prediction, target([[0.0, 0, 0]] * 2), LossConfig(), stage)


def by_formula(step, steps_per_epoch, warmup, epochs):
    if step < warmup * steps_per_epoch:
        return 1e-6 + (1e-4 - 1e-6) * step / (warmup * steps_per_epoch)
    share = (step - warmup * steps_per_epoch) / ((epochs - warmup) * steps_per_epoch)
    return 1e-6 + (1e-4 - 1e-6) * 0.5 * (1 + np.cos(np.pi * share))


@pytest.mark.parametrize("epochs, warmup", [(200, 5), (4, 2)])
def test_schedule_of_the_paper(epochs, warmup):
    rate = optimizer.schedule(OptimConfig(epochs=epochs), 7)
    steps = np.arange(7 * epochs + 1)
    expected = [by_formula(step, 7, warmup, epochs) for step in steps]
    np.testing.assert_allclose(jax.jit(jax.vmap(rate))(steps), expected, rtol=1e-4)


@pytest.mark.parametrize("scale", [300.0, 0.01])
def test_the_whole_schedule_of_the_filter_is_scaled(scale):
    """Its start, its peak and the end of its cosine."""
    rate, steps = optimizer.schedule(OptimConfig(epochs=4), 7, scale), np.arange(7 * 4 + 1)
    expected = [scale * by_formula(step, 7, 2, 4) for step in steps]
    np.testing.assert_allclose(jax.jit(jax.vmap(rate))(steps), expected, rtol=1e-4)


def test_plateau_waits_for_its_epochs_and_starts_counting_anew(monkeypatch):
    monkeypatch.setattr(optimizer, "PLATEAU_EPOCHS", 2)
    monkeypatch.setattr(optimizer, "PLATEAU_FACTOR", 0.5)
    config = OptimConfig(schedule="plateau")
    # a fall by less than a ten-thousandth is none
    errors = [np.nan, 1.0, 0.9, 0.9, 0.89999, 0.95, 0.8, 0.8, 0.8, 0.8, 0.8, 0.8, 0.8]
    factors, plateau = [], optimizer.Plateau()
    for error in errors:
        plateau = optimizer.update_plateau(plateau, error, config)
        factors.append(plateau.factor)
    assert factors == [1, 1, 1, 1, 1, 0.5, 0.5, 0.5, 0.5, 0.25, 0.25, 0.25, 0.125]
    assert optimizer.update_plateau(optimizer.Plateau(), 1.0, OptimConfig()) == optimizer.Plateau()


def test_no_decay_after_the_warm_up_and_no_rise_below_the_end_of_the_cosine():
    rate = optimizer.schedule(OptimConfig(schedule="constant", epochs=20, warmup_epochs=2.0), 5)
    rates = [rate(0), rate(5), rate(10), rate(100)]
    np.testing.assert_allclose(rates, [1e-6, (1e-6 + 1e-4) / 2, 1e-4, 1e-4], rtol=1e-4)
    at_once = optimizer.schedule(OptimConfig(schedule="plateau", warmup_epochs=0.0), 5)
    assert float(at_once(0)) == pytest.approx(1e-4)
    low = OptimConfig(epochs=10, learning_rate=5e-7, start_learning_rate=0.0)
    rates = jax.vmap(optimizer.schedule(low, 3))(np.arange(31))
    np.testing.assert_allclose(rates[15:], 5e-7, rtol=1e-6)
    assert (np.diff(rates) > -1e-12).all()


def test_the_gradient_of_a_corrector_is_clipped_by_its_own_norm():
    """Adam's first moment after one step is a tenth of the clipped gradient."""
    gradient = {"encoder": [0.3, 0.4], "head": [0.0, 1.2], "corrector": [30.0, 40.0]}
    tree = {"params": {name: {"w": jnp.float32(g)} for name, g in gradient.items()}}
    for corrector in (True, False):
        config = OptimConfig(clip_norm=1.0, weight_decay=0.0)
        adam = optimizer.adam(config, LossConfig(), 3, corrector)
        learns = jnp.bool_(True)
        _, state = adam.update(tree, adam.init(tree), tree, log_std_learns=learns)
        moments = optax.tree.get(state, "mu")["params"]
        norm = np.hypot(0.5, 1.2)  # 1.3
        whole = np.hypot(norm, 50.0)
        for name, value in gradient.items():
            part_norm = 50.0 if name == "corrector" else norm
            expected = 0.1 * np.array(value) / (part_norm if corrector else whole)
            np.testing.assert_allclose(moments[name]["w"], expected, rtol=1e-5)


@pytest.mark.parametrize(
    "clip, decay, loss",
    [
        (0.5, 0.03, LossConfig()),
        (None, 0.0, LossConfig(log_std_from_epoch=2.0)),
        (0.5, 0.03, LossConfig(nll_from_epoch=2.0)),
    ],
)
def test_adam_against_numpy(clip, decay, loss):
    """PyTorch's Adam does not count steps in which a parameter has no gradient: where the
    uncertainty is held at first, the moments at its release are those of a first step."""
    config = OptimConfig(epochs=10, clip_norm=clip, weight_decay=decay)
    adam, rate = optimizer.adam(config, loss, 3), optimizer.schedule(config, 3)
    expected = {part: [np.array([1.0, -2.0, 3.0]), 0.0, 0.0, 0] for part in ("encoder", "log_std")}
    params = {"params": {part: {"w": jnp.float32(w)} for part, (w, *_) in expected.items()}}
    state, update, rng = adam.init(params), jax.jit(adam.update), np.random.default_rng(0)
    for step in range(12):
        learns = bool(losses.loss_stage(loss, step, 3).log_std_learns)
        assert learns == (step >= 6 or loss == LossConfig())
        moving = ("encoder", "log_std") if learns else ("encoder",)
        gradient = {part: rng.standard_normal(3) * (part in moving) for part in expected}
        gradients = {"params": {part: {"w": jnp.float32(g)} for part, g in gradient.items()}}
        change, state = update(gradients, state, params, log_std_learns=jnp.bool_(learns))
        params = optax.apply_updates(params, optax.tree.scale(-rate(step), change))
        norm = np.linalg.norm(np.concatenate(list(gradient.values())))
        for part in moving:
            w, m, v, count = expected[part]
            g = gradient[part] * (min(1, clip / norm) if clip else 1) + decay * w
            m, v, count = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g**2, count + 1
            unbiased = m / (1 - 0.9**count), np.sqrt(v / (1 - 0.999**count)) + 1e-8
            w = w - by_formula(step, 3, 5, 10) * unbiased[0] / unbiased[1]
            expected[part] = [w, m, v, count]
        for part, (w, *_) in expected.items():
            np.testing.assert_allclose(params["params"][part]["w"], w, rtol=1e-6, atol=1e-6)


def test_the_uncertainties_of_experts_do_not_count_the_steps_in_which_they_are_held():
    config, loss = OptimConfig(epochs=10), LossConfig(log_std_from_epoch=2.0)
    adam = optimizer.adam(config, loss, 5)
    params = {"params": {name: jnp.ones(2) for name in ("expert1", "expert1_log_std")}}
    state, update = adam.init(params), jax.jit(adam.update)
    for step in range(11):
        learns = step == 10
        gradient = {"expert1": jnp.ones(2), "expert1_log_std": 0.3 * learns * jnp.ones(2)}
        tree = {"params": gradient}
        change, state = update(tree, state, params, log_std_learns=jnp.bool_(learns))
    np.testing.assert_allclose(change["params"]["expert1_log_std"], 1.0, rtol=1e-5)


@functools.partial(jax.jit, static_argnames="config")
def value_and_slopes(log_std, error, config):
    def likelihood(log_std, error):
        prediction = Prediction(jnp.zeros((1, 3)), jnp.array([[log_std, 0, 0]]), {})
        return found_losses(prediction, target([[error, 0, 0]]), config).nll

    return jax.value_and_grad(likelihood, (0, 1))(log_std, error)


@pytest.mark.parametrize("sigmas", [None, 10.0])
def test_the_likelihood_and_its_bound_for_outliers(sigmas):
    """σ = 0.1 m: ½ e²/σ² + log σ, and its slopes 1 − e²/σ² and e/σ²; without a bound as the paper
    has it, also at 300 σ, with one up to 1 m, where value and slope are steady."""
    log_std, config = np.log(0.1), LossConfig(outlier_sigmas=sigmas)
    for error in (0.0, 0.5, 0.999, 1.0, 1.001, 30.0):
        squared = (error / 0.1) ** 2
        value, (slope, by_error) = value_and_slopes(log_std, error, config)
        outlier = bool(sigmas) and squared > 100
        counted = 100 * (1 + np.log(squared / 100)) if outlier else squared
        np.testing.assert_allclose(value, 0.5 * counted + log_std, rtol=1e-5)
        np.testing.assert_allclose(slope, 1 - (100 if outlier else squared), 1e-4, 1e-4)
        assert np.isfinite(by_error)
        if not outlier:
            np.testing.assert_allclose(by_error, 100 * error, rtol=1e-5)
    floor = float(np.log(0.2))
    raised, _ = value_and_slopes(log_std, 0.1, LossConfig(log_std_floor=floor))
    np.testing.assert_allclose(raised, 0.5 * 0.25 + floor, rtol=1e-5)
