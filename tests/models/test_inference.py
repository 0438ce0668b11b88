"""A frozen network gives the same numbers, and does once what depends on its parameters alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import models
from tests.support.compiling import quick


def trained_like(model, seed=0):
    """Variables with statistics and affine parameters that are not the initial ones."""
    rng = np.random.default_rng(seed)

    def drawn(path, leaf):
        name = path[-1].key
        if name in ("var", "scale"):
            return jnp.asarray(rng.uniform(0.4, 1.6, leaf.shape), jnp.float32)
        if name in ("mean", "bias"):
            return jnp.asarray(0.3 * rng.standard_normal(leaf.shape), jnp.float32)
        size = 1.0 if name == "prototypes" else np.prod(leaf.shape[:-1]) ** -0.5
        return jnp.asarray(size * rng.standard_normal(leaf.shape), jnp.float32)

    return jax.tree.map_with_path(drawn, models.variable_shapes(model, 64))


@pytest.mark.parametrize(
    "options", [{"bank_size": 8, "bank_heads": 2}, {"bank_size": 0, "head": "linear"}]
)
def test_a_frozen_network_gives_the_same_numbers(options):
    model = models.create("gnio", width=4, **options)
    variables = trained_like(model)
    windows = jax.random.normal(jax.random.key(1), (3, 64, 6), jnp.float32)
    frozen, apply = models.inference_variables(model, variables), models.Inference(model)
    wanted, found = quick(model.apply)(variables, windows), quick(apply)(frozen, windows)
    assert float(jnp.abs(wanted.displacement).max()) > 1e-3
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-5), found, wanted)
    for block in jax.tree.leaves(frozen.variables["batch_stats"], is_leaf=lambda x: "mean" in x):
        assert (block["mean"] == 0).all() and (block["var"] == np.float32(1 - 1e-5)).all()
    assert hash(apply) == hash(models.Inference(models.create("gnio", width=4, **options)))


def test_keys_and_values_are_not_computed_again():
    model = models.create("gnio", width=4, bank_size=16, bank_heads=2)
    variables, windows = trained_like(model), jnp.zeros((1, 64, 6), jnp.float32)

    def operations(apply, given):
        return quick(apply).lower(given, windows).compile().cost_analysis()["flops"]

    saved = operations(model.apply, variables) - operations(
        models.Inference(model), models.inference_variables(model, variables)
    )
    assert saved >= 2 * 2 * 16 * 32 * 32  # two projections of 16 prototypes of 32 features
