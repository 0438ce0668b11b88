"""EqNIO's frames: equivariance in float64, a negative test, plain NumPy, and the covariance."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from gnio_jax import models
from gnio_jax.errors import InputError
from gnio_jax.models.eqnio import EqNIO, EquivariantFrame
from gnio_jax.types import Prediction
from tests.support.compiling import quick
from tests.support.networks import drawn

SAMPLES = 37
WINDOWS = np.random.default_rng(0).normal([0, 0, 9.8, 0, 0, 0], 2.0, (3, SAMPLES, 6))
ANGLE = 0.7
TURN = np.array([[np.cos(ANGLE), -np.sin(ANGLE), 0], [np.sin(ANGLE), np.cos(ANGLE), 0], [0, 0, 1]])
MIRROR = TURN @ np.diag([1.0, -1.0, 1.0])


class Stub(nn.Module):
    """A network in the type of its window, with no symmetry at all."""

    @nn.compact
    def __call__(self, windows, train=False):
        dense = functools.partial(nn.Dense, param_dtype=jnp.float32)
        h = jnp.tanh(0.3 * dense(8, name="first")(windows)).mean(axis=1)
        h = jnp.concatenate([h, jnp.tanh(windows[:, 3])], axis=-1)
        return Prediction(dense(3, name="displacement")(h), dense(3, name="log_std")(h))


def changed(windows, matrix, pseudo=True):
    """The windows under a turn or reflection; the rate is a pseudovector, or not."""
    accel = windows[..., :3] @ matrix.T
    sign = np.linalg.det(matrix) if pseudo else 1.0
    return np.concatenate([accel, sign * windows[..., 3:] @ matrix.T], axis=-1)


@functools.cache
def network(reflections, depth=2):
    model = EqNIO(Stub(), reflections, depth)
    shapes = jax.eval_shape(model.init, jax.random.key(0), jnp.float32(WINDOWS[:1]))
    return drawn(shapes), quick(model.apply)


def predicted(reflections, windows):
    variables, apply = network(reflections)
    prediction = apply(variables, jnp.asarray(windows))
    assert prediction.displacement.dtype == np.float64
    return prediction.displacement, prediction.covariance(-30.0, float)


def residual(reflections, matrix, pseudo=True):
    """Largest violation of d(M w) = M d(w) and Σ(M w) = M Σ(w) Mᵀ, relative to their size."""
    (d, cov), (other, its) = (
        predicted(reflections, w) for w in (WINDOWS, changed(WINDOWS, matrix, pseudo))
    )
    d, cov, other, its = map(np.asarray, (d, cov, other, its))
    assert np.abs(cov[:, 0, 1]).min() > 1e-3 * np.abs(cov).max(axis=(1, 2)).min()  # full in xy
    expected_covariance = matrix @ cov @ matrix.T
    return max(
        np.abs(other - d @ matrix.T).max() / np.abs(d).max(),
        np.abs(its - expected_covariance).max() / np.abs(expected_covariance).max(),
    )


def test_a_turn_turns_displacement_and_covariance_in_float64():
    for reflections in (True, False):
        assert residual(reflections, TURN) < 1e-9


def test_a_reflection_reflects_them_if_the_rate_is_a_pseudovector():
    assert residual(True, MIRROR) < 1e-9


def test_the_frame_without_reflections_and_a_rate_that_is_reflected_as_a_vector_fail():
    assert residual(False, MIRROR) > 1e-2
    assert residual(True, MIRROR, pseudo=False) > 1e-2


def dense(x, q):
    return x @ np.asarray(q["kernel"], float)


def normed(x, q):
    spread = np.sqrt(x.var(-1, keepdims=True) + 1e-5)
    return (x - x.mean(-1, keepdims=True)) / spread * np.asarray(q["scale"], float)


def gate(v, s, q):
    sizes = np.hypot(v[:, 0], v[:, 1])
    y = normed(np.maximum(dense(np.hstack([sizes, s]), q["linear"]), 0), q["norm"])
    width = v.shape[2]
    return v / sizes[:, None] * y[:, None, :width], y[:, width:]


def numpy_frame(window, q, reflections, depth):
    """Sample by sample and channel by channel."""

    def twice(v):
        turned = np.stack([-v[:, 1], v[:, 0]], axis=1)
        return v if reflections else np.concatenate([v, turned], axis=2)

    def filtered(x, kernel):
        at = lambda t: x[min(max(t, 0), len(x) - 1)]  # noqa: E731
        return np.array([sum(at(t + k - 15) @ kernel[k] for k in range(32)) for t in range(len(x))])

    def vector_norm(v, q):
        sizes = np.hypot(v[:, 0], v[:, 1])
        return v / sizes[:, None] * normed(sizes, q)[:, None]

    a, w = window[:, :3], window[:, 3:]
    if reflections:
        size = np.linalg.norm(w, axis=1, keepdims=True)
        unit = lambda x: x / np.linalg.norm(x, axis=1, keepdims=True)  # noqa: E731
        across = np.stack([-w[:, 1], w[:, 0], 0 * w[:, 0]], axis=1)
        first = size * unit(np.cross(w, across))
        second = size * unit(np.cross(w, first))
        v = np.stack([a, first, second], axis=2)
        flat = v[:, :2]
        pairs = [(flat[:, :, i] * flat[:, :, j]).sum(1) for i, j in ((0, 1), (1, 2), (0, 2))]
    else:
        v = np.stack([a, w], axis=2)
        flat = v[:, :2]
        pairs = [(flat[:, :, 0] * flat[:, :, 1]).sum(1)]
    s = np.hstack([v[:, 2], np.hypot(flat[:, 0], flat[:, 1]), np.stack(pairs, axis=1)])
    v, s = gate(dense(twice(flat), q["vectors"]), dense(s, q["scalars"]), q["gate"])
    for number in range(depth):
        b = q[f"block{number + 1}"]
        wide = twice(v)
        planes = [
            filtered(wide[:, i], np.asarray(b["vector_filter"]["kernel"], float)) for i in (0, 1)
        ]
        s = filtered(s, np.asarray(b["scalar_filter"]["kernel"], float))
        v, s = gate(np.stack(planes, axis=1), s, b["gate"])
        v, s = vector_norm(v, b["vector_norm"]), normed(s, b["scalar_norm"])
    v, s = v.mean(0, keepdims=True), s.mean(0, keepdims=True)
    v, _ = gate(dense(twice(v), q["mean_vectors"]), dense(s, q["mean_scalars"]), q["mean_gate"])
    v = vector_norm(dense(twice(v), q["last_vectors"]), q["last_norm"])
    one, two = dense(twice(v), q["frame"])[0].T
    x = one / np.linalg.norm(one)
    y = two - (two @ x) * x
    return x, y / np.linalg.norm(y)


@pytest.mark.parametrize("reflections, depth", [(True, 2), (False, 1)])
def test_the_frame_against_numpy_by_gram_and_schmidt(reflections, depth):
    frame = EquivariantFrame(6, depth, reflections)
    shapes = jax.eval_shape(frame.init, jax.random.key(0), jnp.asarray(WINDOWS))
    variables = drawn(shapes)
    heading, sign = quick(frame.apply)(variables, jnp.asarray(WINDOWS))
    in_training = quick(frame.apply, static_argnums=2)(variables, jnp.asarray(WINDOWS), True)
    np.testing.assert_allclose(in_training.heading, heading, atol=1e-5)
    for window, x, s in zip(WINDOWS, np.asarray(heading), np.asarray(sign), strict=True):
        axes = numpy_frame(window, variables["params"], reflections, depth)
        np.testing.assert_allclose(x, axes[0], atol=1e-5)
        np.testing.assert_allclose(s * np.array([-x[1], x[0]]), axes[1], atol=1e-5)


def test_a_phone_at_rest_has_a_frame_and_finite_derivatives():
    still = np.zeros((1, SAMPLES, 6), np.float32)
    still[..., 2] = 9.81
    for reflections in (True, False):
        variables, _ = network(reflections)
        model = EqNIO(Stub(), reflections)

        def loss(variables, windows, model=model):
            prediction = model.apply(variables, windows)
            likelihood, log_std = prediction.normalise(prediction.displacement - 1, None)
            return jnp.sum(likelihood + log_std)

        slopes = quick(jax.grad(loss, argnums=(0, 1)))(variables, jnp.asarray(still))
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(slopes))


def test_the_likelihood_has_the_full_covariance():
    axes = np.array([[np.cos(0.4), np.sin(0.4)]])
    log_std, error = np.array([[0.3, -1.0, 0.1]]), np.array([[0.5, -0.7, 0.2]])
    prediction = Prediction(jnp.zeros((1, 3)), jnp.asarray(log_std), {}, jnp.asarray(axes))
    for d in (2, 3):
        covariance = np.asarray(prediction.covariance(-9.0, float))[0, :d, :d]
        squared, logs = prediction.normalise(jnp.asarray(error[:, :d]), None)
        likelihood = float(jnp.sum(0.5 * squared + logs))
        e = error[0, :d]
        expected = 0.5 * e @ np.linalg.solve(covariance, e)
        expected += 0.5 * np.log(np.linalg.det(covariance))
        np.testing.assert_allclose(likelihood, expected, rtol=1e-9)


def test_the_frames_width_is_an_option_of_networks_with_a_frame():
    narrow = models.create("tlio", width=8, equivariance="so2_frame", frame_width=4)
    frame = models.variable_shapes(narrow, 40)["params"]["frame"]
    assert frame["frame"]["kernel"].shape == (8, 2)
    for equivariance in ("none", "four_headings", "device_heading"):
        with pytest.raises(InputError, match="unknown option 'frame_width'"):
            models.create("tlio", equivariance=equivariance, frame_width=4)
    with pytest.raises(InputError, match="'frame_width' must be at least 1"):
        models.create("tlio", equivariance="o2_frame", frame_width=0)


def test_a_network_that_sees_the_body_has_no_frame():
    with pytest.raises(InputError, match="sees the body"):
        models.create("airio", equivariance="o2_frame")
