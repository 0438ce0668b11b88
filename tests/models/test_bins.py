"""VeloBins' head and its loss."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from scipy.stats import norm

from gnio_jax import models
from gnio_jax.config import LossConfig
from gnio_jax.models.bins import BinHead, centres_of
from gnio_jax.training.losses import loss_stage, losses
from gnio_jax.types import Prediction, Windows
from tests.support.compiling import quick
from tests.support.networks import SMALL, count, drawn
from tests.support.numpy_layers import linear, softmax

RNG = np.random.default_rng(7)
HIDDEN = RNG.standard_normal((2, 5))
CENTRES = np.array([-1.5, -0.5, 0.5, 1.5])


def test_6848_parameters_whatever_the_number_of_bins():
    for bins in (512, 16):
        shapes = jax.eval_shape(BinHead(bins).init, jax.random.key(0), jnp.zeros((1, 48)))
        assert count(shapes["params"]) == 6_848


def test_mean_and_variance_are_those_of_the_bins():
    head = BinHead(bins=4, reach=2.0)
    variables = drawn(jax.eval_shape(head.init, jax.random.key(0), jnp.asarray(HIDDEN)))
    means, says = quick(head.apply)(variables, jnp.float32(HIDDEN))
    q = jax.tree.map(lambda x: np.asarray(x, float), variables["params"])
    code = []
    for centre in CENTRES:
        angles = [centre / 2 * 0.5 * 64 ** (j / 31) for j in range(32)]
        code.append(np.sin(q["code_scale"] * [*np.sin(angles), *np.cos(angles)]))
    embedding = linear(np.array(code), q["embedding"])
    for h, mean, log_std in zip(HIDDEN, means, says["log_std"], strict=True):
        query = linear(h, q["query"]).reshape(3, 32)
        shares = softmax(query @ embedding.T)
        expected_mean = shares @ CENTRES
        variance = shares @ CENTRES**2 - expected_mean**2 + 1 / 12  # uniform within a bin of 1 m
        np.testing.assert_allclose(mean, expected_mean, atol=1e-5)
        np.testing.assert_allclose(np.exp(2 * log_std), variance, rtol=1e-4)


@pytest.mark.parametrize("name", ["gru", "ronin_tcn"])
def test_networks_with_memory_have_the_head_too(name):
    """With the same prediction for a window as step by step, and the uncertainty of the bins."""
    model = models.create(name, **SMALL[name], head="bins", reach=2.0)
    variables = drawn({"batch_stats": {}, **models.variable_shapes(model, 40)})
    assert "uncertainty" not in variables["params"]
    windows = jnp.asarray(RNG.standard_normal((2, 40, 6)), jnp.float32)
    whole = quick(model.apply)(variables, windows)
    state, parts = model.begin(2), []
    for first in (0, 20):
        state, part = model.apply(
            variables, state, windows[:, first : first + 20], 20, method="advance"
        )
        parts.append(part)
    np.testing.assert_allclose(parts[1].displacement[:, 0], whole.displacement, atol=1e-5)
    shares = softmax(np.asarray(whole.diagnostics["bin_logits"], float))
    centres = np.asarray(centres_of(jnp.float32(2.0), 512), float)
    mean = shares @ centres
    variance = shares @ centres**2 - mean**2 + (4 / 512) ** 2 / 12
    np.testing.assert_allclose(whole.displacement, mean, atol=1e-4)
    np.testing.assert_allclose(whole.log_std, 0.5 * np.log(variance), atol=1e-4)


def label_of(truth, std):
    """A Gaussian in four bins, tilted to the exact mean by a root search."""
    weight = np.diff(norm.cdf([-2, -1, 0, 1, 2], truth, std))

    def tilted(tilt):
        p = weight * np.exp(tilt * CENTRES)
        return p / p.sum()

    return tilted(brentq(lambda tilt: tilted(tilt) @ CENTRES - truth, -40, 40))


def test_the_loss_is_hubers_and_the_divergence_from_a_label_with_the_true_mean():
    logits = RNG.standard_normal((1, 3, 4))
    mean = softmax(logits) @ CENTRES
    truth = mean + np.array([[0.05, -0.6, 0.3]])
    prediction = Prediction(
        jnp.asarray(mean),
        jnp.zeros((1, 3)),
        {"bin_logits": jnp.asarray(logits), "bin_reach": jnp.full(1, 2.0)},
    )
    config, expected = LossConfig(name="bins"), 0.0
    for axis in (0, 1):
        error = abs(truth[0, axis] - mean[0, axis])
        label = label_of(truth[0, axis], max(error, 0.1))
        p = softmax(logits[0, axis])
        expected += 0.1 * (error - 0.05) if error > 0.1 else error**2 / 2
        expected += np.sum(label * np.log(np.maximum(label, 1e-300) / p))
    windows = Windows(jnp.zeros((1, 5, 6)), jnp.asarray(truth), jnp.zeros((1, 5, 3)))
    loss = losses(prediction, windows, config, loss_stage(config, 0, 1), 2).total
    np.testing.assert_allclose(loss, expected, rtol=1e-3)


@pytest.mark.parametrize(
    "frame, degrees, reflected",
    [
        ("four_headings", 90, False),
        ("four_headings", 180, False),
        ("four_headings", 270, False),
        ("canonical_frame", 37, False),
        ("so2_frame", 37, False),
        ("o2_frame", 37, False),
        ("o2_frame", 37, True),
    ],
)
def test_distribution_and_target_are_along_the_same_axes(frame, degrees, reflected):
    """A window that is turned or reflected with its truth has the same loss, and the mean of the
    distribution is the displacement."""
    model = models.create("trunk", width=3, head="bins", reach=2.0, equivariance=frame)
    variables = drawn(models.variable_shapes(model, 40))
    rng = np.random.default_rng(4)
    windows = rng.normal([0.3, 0.0, 9.8, 0, 0, 0], 2.0, (3, 40, 6))
    truths = rng.uniform(-1.0, 1.0, (3, 3))
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    mirror = np.diag([1.0, -1.0, 1.0]) if reflected else np.eye(3)
    motion = turn @ mirror
    of_rate = np.linalg.det(motion) * motion  # an angular rate is an axial vector
    moved = np.concatenate([windows[..., :3] @ motion.T, windows[..., 3:] @ of_rate.T], axis=-1)
    config, apply, totals = LossConfig(name="bins"), quick(model.apply), []
    for imu, truth in ((windows, truths), (moved, truths @ motion.T)):
        imu, truth = np.float32(imu), np.float32(truth)
        prediction = apply(variables, imu)
        shares = softmax(np.float64(prediction.diagnostics["bin_logits"]))
        mean = shares @ np.linspace(-2 + 2 / 512, 2 - 2 / 512, 512)
        displacement = np.asarray(prediction.along_axes(prediction.displacement))
        np.testing.assert_allclose(mean, displacement, atol=1e-4)
        assert np.abs(displacement[:, :2]).min() > 1e-3
        target = Windows(jnp.asarray(imu), jnp.asarray(truth), jnp.zeros((3, 40, 3)))
        totals.append(losses(prediction, target, config, loss_stage(config, 0, 1)).total)
    np.testing.assert_allclose(totals[1], totals[0], rtol=1e-3)


def test_a_network_with_bins_has_their_uncertainty():
    model = models.create("trunk", width=3, head="bins", reach=2.0)
    shapes = models.variable_shapes(model, 40)
    assert "uncertainty" not in shapes["params"] and "head" in shapes["params"]
    assert "uncertainty" not in models.variable_shapes(models.create("gnio", head="bins"))["params"]
