"""RIO's rotation consistency as a loss, and its adaptation at test time."""

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from gnio_jax.training import adaptation, network_losses
from gnio_jax.types import Prediction, Windows
from tests.support.compiling import quick

RNG = np.random.default_rng(9)
WINDOWS = jnp.asarray(RNG.standard_normal((4, 6, 6)), jnp.float32)


class Uneven(nn.Module):
    """The mean acceleration, scaled by a normalisation's factor for each axis: equivariant only if
    both are the same."""

    @nn.compact
    def __call__(self, windows, train=False):
        other = self.param("weight", nn.initializers.ones, (1,), jnp.float32)
        scale = Factor(name="norm")(windows.shape[0])
        moved = windows[..., :3].mean(axis=1) * scale * other[None]
        return Prediction(moved, jnp.zeros_like(moved))


class Factor(nn.Module):
    @nn.compact
    def __call__(self, count):
        scale = self.param("scale", nn.initializers.ones, (3,), jnp.float32)
        return jnp.tile(scale[None], (count, 1))


def variables(x, y, weight=1.0):
    scale = jnp.array([x, y, 1.0], jnp.float32)
    params = {"weight": jnp.array([weight], jnp.float32), "norm": {"scale": scale}}
    return {"params": params, "batch_stats": {}}


def turned(vectors, angle):
    c, s = np.cos(angle), np.sin(angle)
    return vectors @ np.array([[c, s], [-s, c]])


def test_the_consistency_is_the_cosine_where_there_is_motion():
    angle_key, dropout_key = jax.random.split(jax.random.key(3))
    weights, model = variables(2.0, 0.5), Uneven()
    displacement = np.array([[3.0, 0, 0], [0.1, 0, 9], [0, 2, 0], [-1, 1, 0]])
    windows = Windows(WINDOWS, jnp.asarray(displacement, jnp.float32), jnp.zeros((4, 6, 3)))
    prediction = model.apply(weights, WINDOWS)
    keys = angle_key, dropout_key
    loss = quick(
        lambda w: network_losses.rotation_consistency(model, weights, w, prediction, keys, 1.0)
    )(windows)
    angles = jax.random.uniform(angle_key, (4,), jnp.float32, 0.0, jnp.float32(2 * np.pi))
    factors, total = np.array([2.0, 0.5]), 0.0
    for number in (0, 2, 3):  # the second one stands still in the plane
        mean = np.asarray(WINDOWS[number, :, :2], float).mean(0)
        one = turned(mean * factors, float(angles[number]))
        two = turned(mean, float(angles[number])) * factors
        total += one @ two / np.linalg.norm(one) / np.linalg.norm(two)
    np.testing.assert_allclose(loss, -total / 4, atol=1e-5)


def test_a_certain_network_stays_and_a_collapsed_one_comes_back():
    first = variables(1.0, 1.0)
    model = Uneven()
    # The same at every heading: no variance at all.
    collapsed = adaptation.adapt(model, first, variables(3.0, 3.0), WINDOWS)
    assert collapsed.decision == "restored" and collapsed.variables is first
    weights = variables(1.0, 1.6)
    spread = np.asarray(adaptation.ensemble_variance(model, weights, 1.0 * WINDOWS))
    scale = np.sqrt(0.02 / spread.mean())
    outcome = adaptation.adapt(model, first, weights, scale * WINDOWS)
    if spread.min() * scale**2 > adaptation.LEAST_VARIANCE:
        assert outcome.decision == "kept" and outcome.variables is weights


def test_an_uncertain_network_becomes_more_consistent_by_its_normalisations_alone():
    model, weights = Uneven(), variables(2.0, 0.5)
    before = np.asarray(adaptation.ensemble_variance(model, weights, 9 * WINDOWS))
    assert before.min() > adaptation.LEAST_VARIANCE
    outcome = adaptation.adapt(model, weights, weights, 9 * WINDOWS, learning_rate=0.05)
    assert outcome.decision == "adapted"
    after = outcome.variables["params"]
    np.testing.assert_array_equal(after["weight"], weights["params"]["weight"])
    ratio = after["norm"]["scale"][0] / after["norm"]["scale"][1]
    assert 1 < ratio < 4 - 0.3
