"""What a step of training computes in bfloat16, and a batch that is taken in parts."""

from dataclasses import replace

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import config as configuration
from gnio_jax.config import ModelConfig, OptimConfig, ThroughFilter, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.training import step
from gnio_jax.training.checkpoint import create_trained_model
from gnio_jax.training.losses import stage
from gnio_jax.types import Prediction, Windows
from tests.support.compiling import quick


class Linear(nn.Module):
    """Without batch normalisation, so that parts of a batch know nothing of each other."""

    @nn.compact
    def __call__(self, windows, train=False):
        x = nn.Dense(6, name="out")(windows.reshape(windows.shape[0], -1))
        return Prediction(x[:, :3], x[:, 3:])


def windows(count, length):
    rng = np.random.default_rng(1)
    shapes = ((count, length, 6), (count, 3), (count, length, 3))
    return Windows(*(jnp.asarray(rng.normal(size=shape).astype(np.float32)) for shape in shapes))


def gradient(model, config, variables, length=200):
    state = step.TrainState.of(jnp.int32(0), {"batch_stats": {}, **variables}, ())
    now = stage(config.loss, 0, 1)
    arguments = (state, windows(12, length), jax.random.key(2), now, model, config)
    return step._gradient(*arguments)


def test_the_gradient_of_a_batch_is_the_mean_of_its_parts():
    optim = OptimConfig(batch_size=12)
    configs = [TrainConfig(optim=each) for each in (optim, replace(optim, accumulate=3))]
    variables = quick(Linear().init)(jax.random.key(0), jnp.zeros((1, 4, 6), jnp.float32))
    whole, parts = quick(
        lambda variables: [gradient(Linear(), each, variables, 4) for each in configs]
    )(variables)
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, 2e-5, 1e-5), whole, parts)


def test_parts_have_rows_of_every_device():
    rows = np.arange(12)
    parts = np.asarray(step._in_parts(jnp.asarray(rows), 3))
    assert sorted(parts.ravel()) == list(rows)
    for device in (rows[:6], rows[6:]):
        assert [len(np.intersect1d(part, device)) for part in parts] == [2, 2, 2]


IMU = jnp.zeros((1, 200, 6), jnp.float32)
NETWORKS = {
    "gnio": {"width": 2, "bank_size": 3, "bank_heads": 2},
    "gnio in a canonical frame": {"width": 2, "equivariance": "canonical_frame"},
    "ctin": {},
    "deepils": {"width": 4},
    "imot": {},
    "ronin_resnet": {"width": 2},
    "tlio": {"width": 2},
}


FEWER_LAYERS = {
    "ctin": {"decoder_layers": 1},
    "imot": {"encoder_layers": 1, "decoder_layers": 1},
}
"""The others are no different, and take long to trace."""

FLOAT32_PRODUCTS = {"ctin": 10, "gnio in a canonical frame": 2, "imot": 6}
"""Products of recurrences (ctin), of positions and of sums of vectors: float32 in every step."""


@pytest.mark.parametrize("name", NETWORKS)
def test_bfloat16_is_for_products_alone(name):
    """Parameters, statistics, loss and gradient are float32, and so is what is no product."""
    found, variables = {}, None
    for dtype in ("bfloat16", "float32"):
        options = ModelConfig(name.split()[0], **NETWORKS[name], dtype=dtype)
        config = TrainConfig(model=options, optim=OptimConfig(batch_size=12))
        model = create_trained_model(config).clone(**FEWER_LAYERS.get(name, {}))
        if variables is None:  # the other's are no different
            variables = jax.eval_shape(lambda m=model: m.init(jax.random.key(0), IMU))
            assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(variables))
        found[dtype] = jax.make_jaxpr(lambda v, m=model, c=config: gradient(m, c, v))(variables)
        assert all(leaf.dtype != jnp.bfloat16 for leaf in found[dtype].out_avals)
    assert "bf16" not in str(found["float32"])
    products, others = [], []
    for equation in equations(found["bfloat16"].jaxpr):
        kinds = [getattr(value.aval, "dtype", None) for value in equation.invars]
        if equation.primitive.name == "dot_general":
            products.append(all(kind == jnp.bfloat16 for kind in kinds))
        elif jnp.bfloat16 in kinds:
            others.append(equation.primitive.name)
    assert sum(products) > 10
    assert products.count(False) <= FLOAT32_PRODUCTS.get(name, 0)
    layout = {"transpose", "reshape", "convert_element_type", "squeeze", "broadcast_in_dim"}
    calls = {"pjit", "jit", "custom_vjp_call", "mul"}
    assert set(others) <= layout | calls


def equations(jaxpr):
    for equation in jaxpr.eqns:
        yield equation
        for value in equation.params.values():
            for inner in value if isinstance(value, list | tuple) else [value]:
                inner = getattr(inner, "jaxpr", inner)
                if hasattr(inner, "eqns"):
                    yield from equations(inner)


@pytest.mark.parametrize(
    "changes, expected",
    [
        ({"optim": OptimConfig(batch_size=10, accumulate=3)}, "'optim.accumulate' is 3; it must"),
        ({"optim": OptimConfig(accumulate=0)}, "'optim.accumulate' must be at least 1"),
        (
            {"optim": OptimConfig(accumulate=2), "through_filter": ThroughFilter(("head",))},
            "'optim.accumulate' is for training on windows alone",
        ),
        (
            {"model": ModelConfig(dtype="bfloat16"), "through_filter": ThroughFilter(("head",))},
            "'model.dtype' is for training on windows alone",
        ),
    ],
)
def test_what_does_not_fit_is_told(changes, expected):
    with pytest.raises(InputError, match=expected):
        configuration.validate(replace(TrainConfig(), **changes))
