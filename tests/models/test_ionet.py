"""IONet against plain NumPy, its recurrent layers against PyTorch, and its integrator."""

import contextlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import models
from gnio_jax.config import DataConfig, LossConfig, ModelConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.models.bidirectional import Bidirectional
from gnio_jax.models.ionet import chain
from gnio_jax.training.losses import loss_stage, losses
from gnio_jax.types import Prediction, Windows
from tests.support.compiling import quick
from tests.support.networks import drawn, predicted, shapes
from tests.support.numpy_layers import both_ways, float64, linear

WINDOWS = np.random.default_rng(1).standard_normal((2, 9, 6)).astype(np.float32)


def test_forward_against_numpy():
    options = {"width": 4, "angle": "turn"}
    variables = drawn(shapes("ionet", 9, **options))
    (q, _), displacements = float64(variables), []
    for x in WINDOWS.astype(float):
        x, last = both_ways(x, q["lstm1"], "lstm")
        x, last = both_ways(x, q["lstm2"], "lstm")
        length, angle = linear(last, q["displacement"])
        displacements.append([length * np.cos(angle), length * np.sin(angle), 0])
    for prediction in predicted(models.create("ionet", **options), variables, WINDOWS):
        np.testing.assert_allclose(prediction.displacement, displacements, atol=1e-5)
        assert set(prediction.diagnostics) == {"polar_turn"}


@pytest.mark.parametrize("cell", ["lstm", "gru"])
def test_recurrent_layers_are_pytorchs(cell):
    torch = pytest.importorskip("torch")
    theirs = {"lstm": torch.nn.LSTM, "gru": torch.nn.GRU}[cell](
        6, 5, bidirectional=True, batch_first=True
    )
    params = {
        direction: {
            "input": {
                "kernel": getattr(theirs, f"weight_ih_l0{suffix}").detach().numpy().T,
                "bias": getattr(theirs, f"bias_ih_l0{suffix}").detach().numpy(),
            },
            "recurrent_kernel": getattr(theirs, f"weight_hh_l0{suffix}").detach().numpy().T,
            "recurrent_bias": getattr(theirs, f"bias_hh_l0{suffix}").detach().numpy(),
        }
        for direction, suffix in (("forward", ""), ("backward", "_reverse"))
    }
    apply = quick(Bidirectional(5, cell).apply)
    outputs, last = apply({"params": params}, WINDOWS)
    with torch.no_grad():
        expected, state = theirs(torch.from_numpy(WINDOWS))
    final = state[0] if cell == "lstm" else state  # (direction, batch, units)
    np.testing.assert_allclose(outputs, expected.numpy(), atol=1e-5)
    np.testing.assert_allclose(last, np.concatenate(final.numpy(), axis=-1), atol=1e-5)


def test_chained_turns_walk_a_circle_and_windows_may_overlap():
    turn, length = np.radians(20.0), 2.0
    for windows_per_step in (1, 4):
        steps = 18 * windows_per_step
        path = chain(np.tile([length, turn], (steps, 1)), windows_per_step, heading=0.3)
        assert path.shape == (steps + 1, 2)
        np.testing.assert_allclose(path[-1], path[0], atol=1e-9)
        sides = np.linalg.norm(np.diff(path, axis=0), axis=1)
        np.testing.assert_allclose(sides, length / windows_per_step)


def polar_loss(polar, displacement, steps=None, turn=False):
    zeros = jnp.zeros((len(polar), 3))
    name = "polar_turn" if turn else "polar"
    prediction = Prediction(zeros, zeros, {name: jnp.asarray(polar)})
    steps = jnp.zeros((len(polar), 10, 3)) if steps is None else steps
    config = LossConfig(name="polar", angle_weight=2.0)
    displacement, steps = jnp.asarray(displacement), jnp.asarray(steps)
    windows = Windows(jnp.zeros((len(polar), 10, 6)), displacement, steps)
    return losses(prediction, windows, config, loss_stage(config, 0, 1), 2).total


def test_the_loss_is_that_of_length_and_wrapped_angle_where_there_is_motion():
    angle = np.radians([179.0, 30.0])
    truth = np.array([[2 * np.cos(angle[0]), 2 * np.sin(angle[0]), 5.0], [0.05, 0.0, 0.0]])
    polar = np.array([[2.5, np.radians(-179.0)], [0.15, 3.0]])
    expected = np.mean([0.5**2 + 2 * np.radians(2.0) ** 2, 0.1**2])
    np.testing.assert_allclose(polar_loss(polar, truth), expected, rtol=1e-4)
    # A turn is the angle from the first to the last tenth of the window.
    steps = np.zeros((1, 10, 3))
    steps[0, 0], steps[0, -1] = [0.1, 0, 0], [0, 0.1, 0]
    loss = polar_loss(np.array([[0.0, 1.0]]), np.zeros((1, 3)), steps, turn=True)
    np.testing.assert_allclose(loss, 2 * (1 - np.pi / 2) ** 2, rtol=1e-4)


def test_at_rest_the_gradient_is_finite():
    variables = drawn(shapes("ionet", 9, width=4))
    still = np.zeros((1, 9, 6), np.float32)
    still[..., 2] = 9.81

    def loss(params):
        prediction = models.create("ionet", width=4).apply(
            {**variables, "params": params}, jnp.asarray(still)
        )
        return polar_loss(prediction.diagnostics["polar"], jnp.zeros((1, 3)))

    gradient = quick(jax.grad(loss))(variables["params"])
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gradient))


def test_a_turn_has_no_context_before_it():
    """The loss compares the first with the last steps of what the network sees."""
    for angle, accepted in (("direction", True), ("turn", False)):
        model = ModelConfig("ionet", options={"angle": angle, "width": 4})
        config = TrainConfig(model=model, data=DataConfig(context_seconds=1.0))
        refused = contextlib.nullcontext()
        if not accepted:
            refused = pytest.raises(InputError, match=r"context_seconds.*is not for ionet")
        with refused:
            models.from_experiment(config)
