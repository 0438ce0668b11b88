"""The network against its specification: how its parts start, its ablations, and a plain NumPy
forward pass."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax import models
from gnio_jax.models import heads
from gnio_jax.models.heads import GatedHead
from gnio_jax.models.motion_bank import MotionBank
from tests.support.compiling import quick
from tests.support.networks import drawn, predicted, shapes
from tests.support.numpy_layers import conv_norm as numpy_conv_norm
from tests.support.numpy_layers import float64, linear, motion_bank, relu, resnet, sigmoid
from tests.support.tiny_network import Tiny


def test_the_bank_starts_alive():
    """Windows attend to different prototypes before training; of prototypes near each other, which
    are a saddle, they attend to all alike."""
    features = np.maximum(np.random.default_rng(0).normal(0.4, 1.0, (200, 512)), 0)
    entropy = {}
    for std in (1.0, 512**-0.5):
        fresh = quick(MotionBank(std=std).init_with_output)
        (_, attention), variables = jax.device_get(fresh(jax.random.key(1), jnp.float32(features)))
        np.testing.assert_allclose(np.std(variables["params"]["prototypes"]), std, rtol=0.03)
        entropy[std] = -np.mean(np.sum(attention * np.log(attention), axis=-1)) / np.log(64)
    assert entropy[1.0] < 0.98 and entropy[512**-0.5] > 0.999
    assert models.create("gnio")._bank().std == 1.0
    assert models.create("gnio", bank_std=0.5)._bank().std == 0.5


def test_the_projections_start_as_those_of_pytorch():
    """Xavier-uniform over query, key and value as one (3d, d) matrix, a linear layer's bound for
    the output, biases zero."""
    bank = MotionBank(size=3, heads=2, width=64)
    params = quick(bank.init)(jax.random.key(0), jnp.zeros((1, 64), jnp.float32))["params"]
    xavier = (6 / (64 + 192)) ** 0.5
    bounds = {"query": xavier, "key": xavier, "value": xavier, "output": 64**-0.5}
    for name, bound in bounds.items():
        kernel = np.abs(params[name]["kernel"])
        assert 0.99 * bound < kernel.max() <= bound
        assert abs(kernel.mean() - bound / 2) < 0.02 * bound
        np.testing.assert_array_equal(params[name]["bias"], 0)


def test_a_new_head_predicts_that_it_stands_still():
    h = 3 * jnp.float32(np.random.default_rng(0).standard_normal((16, 64)))
    (displacement, _), _ = GatedHead().init_with_output(jax.random.key(0), h)
    assert 0 < np.abs(displacement).max() < 0.2
    for head in (heads.UncertaintyHead(), heads.CalibratedUncertainty()):
        log_std, _ = head.init_with_output(jax.random.key(0), h, True)
        np.testing.assert_array_equal(log_std, 0)  # σ = 1 m


def test_first_parameters_are_those_of_flax_and_another_seed_compiles_nothing(caplog):
    variables = models.initialise(Tiny(), jax.random.key(0), 64)
    with jax.log_compiles(), caplog.at_level("WARNING"):
        other = models.initialise(Tiny(), jax.random.key(1), 64)
    assert not [line for line in caplog.messages if "Compiling" in line]
    of = lambda variables: variables["params"]["encoder"]["kernel"]  # noqa: E731
    assert not np.array_equal(of(variables), of(other))
    expected = quick(Tiny().init)(jax.random.key(0), jnp.zeros((1, 64, 6), jnp.float32))
    jax.tree.map(functools.partial(np.testing.assert_allclose, atol=1e-6), variables, expected)
    shapes = models.variable_shapes(Tiny(), 64)
    assert jax.tree.structure(shapes) == jax.tree.structure(variables)
    for shape, leaf in zip(*map(jax.tree.leaves, (shapes, variables)), strict=True):
        assert (shape.shape, shape.dtype) == (leaf.shape, leaf.dtype)


def block(x, q, s, stride):
    y = relu(numpy_conv_norm(x, "conv1", q, s, stride, 1))
    y = numpy_conv_norm(y, "conv2", q, s, 1, 1)
    projected = "shortcut_conv" in q
    return relu(y + (numpy_conv_norm(x, "shortcut_conv", q, s, stride) if projected else x))


def numpy_forward(variables, windows):
    (p, s), results = float64(variables), []
    for x in np.asarray(windows, np.float64):
        f = resnet(x, p["encoder"], s["encoder"], block).mean(axis=0)
        context, attention = motion_bank(f, p["bank"])
        h = f + context
        gate = np.tanh(linear(h, p["head"]["gate"]))
        displacement = np.log1p(np.exp(linear(h, p["head"]["scale"]))) * gate
        log_std = linear(h, p["uncertainty"]["log_std"])
        results.append((displacement, log_std, gate, attention))
    return tuple(map(np.array, zip(*results, strict=True)))


def test_forward_against_numpy():
    options = {"width": 8, "bank_size": 5}
    model, variables = models.create("gnio", **options), drawn(shapes("gnio", **options))
    windows = np.random.default_rng(1).standard_normal((2, 100, 6)).astype(np.float32)
    displacement, log_std, gate, attention = numpy_forward(variables, windows)
    # The bank is projected once, when the network is made ready.
    assert models.inference_variables(model, variables).constants.keys() == {"memory"}
    for prediction in predicted(model, variables, windows):
        np.testing.assert_allclose(prediction.displacement, displacement, rtol=2e-4, atol=2e-5)
        np.testing.assert_allclose(prediction.log_std, log_std, rtol=2e-4, atol=2e-5)
        np.testing.assert_allclose(prediction.diagnostics["gate"], gate, rtol=2e-4, atol=2e-5)
        np.testing.assert_allclose(
            prediction.diagnostics["attention"], attention, rtol=2e-4, atol=2e-6
        )


SCALES = {
    "softplus": lambda x: np.log1p(np.exp(x)),
    "pos_elu": lambda x: np.where(x > 0, x + 1, np.exp(np.minimum(x, 0))),
    "abs": np.abs,
    "exp": np.exp,
    "linear": lambda x: x,
}
GATES = {"tanh": np.tanh, "sigmoid": sigmoid}


def test_gates_and_scales():
    assert heads.SCALES.keys() == SCALES.keys() and heads.GATES.keys() == GATES.keys()
    random = np.random.default_rng(0)
    h = jnp.float32(random.standard_normal((4, 16)))
    for gate, scale in [*((name, "abs") for name in GATES), *(("tanh", name) for name in SCALES)]:
        head = GatedHead(gate, scale)
        shape = jax.eval_shape(head.init, jax.random.key(1), h)
        draw = lambda leaf: 0.3 * random.standard_normal(leaf.shape).astype(leaf.dtype)  # noqa: E731
        variables = jax.tree.map(draw, shape)
        displacement, diagnostics = head.apply(variables, h)
        s = SCALES[scale](linear(np.float64(h), variables["params"]["scale"]))
        g = GATES[gate](linear(np.float64(h), variables["params"]["gate"]))
        np.testing.assert_allclose(displacement, s * g, rtol=1e-4, atol=1e-5)
        np.testing.assert_allclose(diagnostics["gate"], g, rtol=1e-4, atol=1e-5)


def test_gradient_is_finite_where_everything_is_zero():
    """Zero features, zero parameters, zero gate, |0| as scale."""
    bank, head = MotionBank(3, 2, 16), GatedHead("tanh", "abs")
    h = jnp.zeros((2, 16), jnp.float32)
    shape = jax.eval_shape(lambda key: (bank.init(key, h), head.init(key, h)), jax.random.key(0))
    zero = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)

    def displacement(variables, h):
        return jnp.sum(head.apply(variables[1], h + bank.apply(variables[0], h)[0])[0])

    for leaf in jax.tree.leaves(quick(jax.grad(displacement, (0, 1)))(zero, h)):
        assert np.isfinite(leaf).all()
