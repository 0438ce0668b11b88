"""A batch that is taken in parts."""

from dataclasses import replace

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import config as configuration
from gnio_jax.config import OptimConfig, ThroughFilter, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.training import step
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


@pytest.mark.parametrize(
    "changes, expected",
    [
        ({"optim": OptimConfig(batch_size=10, accumulate=3)}, "'optim.accumulate' is 3; it must"),
        ({"optim": OptimConfig(accumulate=0)}, "'optim.accumulate' must be at least 1"),
        (
            {"optim": OptimConfig(accumulate=2), "through_filter": ThroughFilter(("head",))},
            "'optim.accumulate' is for training on windows alone",
        ),
    ],
)
def test_what_does_not_fit_is_told(changes, expected):
    with pytest.raises(InputError, match=expected):
        configuration.validate(replace(TrainConfig(), **changes))
