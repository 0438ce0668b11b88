"""The layers that drop units in training and their rates, against the published ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from gnio_jax import models
from gnio_jax.models.airimu import AirIMU
from tests.support.networks import SMALL, drawn

LAYERS = {
    "airimu": [0.1] * 2,  # behind each convolution
    "airio": [0.5],  # of the features of both encoders
    "ctin": [0.05] * 8 + [0.5],  # decoder, encoder
    "imot": [0.1] * 12,
    "ionet": [0.25] * 4,
    "ronin_resnet": [0.5] * 2,
    "ronin_tcn": [0.2] * 13,  # two in each block, one behind the last
    "tlio": [0.5] * 4,
}
"""The published rate of each layer of the small networks (`tests.support.networks`), in rising
order."""
KEYS = {"params": jax.random.key(0), "dropout": jax.random.key(1)}


def create(name):
    """The network with its own dropout, and windows for it."""
    model = AirIMU() if name == "airimu" else models.create(name, **SMALL[name])
    channels = 6 if name == "airimu" else models.channels(model)
    windows = np.random.default_rng(2).standard_normal((64, 40, channels))
    return model, jnp.asarray(windows, jnp.float32)


def watch(calls):
    """A context in which the dropout layers append themselves, their input and their output."""

    def note(method, arguments, options, context):
        output = method(*arguments, **options)
        if isinstance(context.module, nn.Dropout):
            calls.append((context.module, arguments[0], output))
        return output

    return nn.intercept_methods(note)


@pytest.mark.parametrize("name", LAYERS)
def test_layers_have_the_published_rates_in_training_alone(name):
    model, windows = create(name)
    for train in (True, False):
        calls = []

        def initialise(windows, train=train):
            return model.init(KEYS, windows, train=train)

        with watch(calls):
            jax.eval_shape(initialise, windows)
        rates = [0.0 if layer.deterministic else layer.rate for layer, *_ in calls]
        assert sorted(rates) == (LAYERS[name] if train else [0.0] * len(LAYERS[name]))


def test_airimu_drops_a_tenth_of_its_units():
    model, windows = create("airimu")
    shapes, calls = jax.eval_shape(lambda: model.init(KEYS, windows)), []
    variables = drawn({"batch_stats": {}, **shapes})
    options = {"mutable": ["batch_stats"], "rngs": {"dropout": jax.random.key(1)}}
    with watch(calls):
        model.apply(variables, windows, train=True, **options)
    assert len(calls) == 2
    for _, units, output in calls:
        present = np.asarray(units) != 0
        dropped = np.asarray(output)[present] == 0
        assert np.mean(dropped) == pytest.approx(0.1, abs=0.01)
        scaled = np.asarray(units)[present][~dropped] / 0.9
        np.testing.assert_allclose(np.asarray(output)[present][~dropped], scaled, rtol=1e-5)
