"""A frozen network does once what depends on its parameters alone."""

import jax.numpy as jnp

from gnio_jax import models
from tests.support.compiling import quick
from tests.support.networks import drawn


def test_keys_and_values_are_not_computed_again():
    model = models.create("gnio", width=4, bank_size=16)
    variables, windows = (
        drawn(models.variable_shapes(model, 64)),
        jnp.zeros((1, 64, 6), jnp.float32),
    )

    def operations(apply, given):
        return quick(apply).lower(given, windows).compile().cost_analysis()["flops"]

    saved = operations(model.apply, variables) - operations(
        models.Inference(model), models.inference_variables(model, variables)
    )
    assert saved >= 2 * 2 * 16 * 32 * 32  # two projections of 16 prototypes of 32 features
