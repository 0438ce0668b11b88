"""A run as `gnio train` leaves it, of a network whose weights NumPy has drawn: compiling its
initialisation would take longer than the tests."""

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax import config as configuration
from gnio_jax import models
from gnio_jax.training import checkpoint
from gnio_jax.training.checkpoint import RunPosition
from gnio_jax.training.task import TrainState


def save(folder, config, draw):
    """Write settings and best checkpoint into `folder`, and return it.

    draw(random, "params" or "batch_stats", shape) gives the values of an array.
    """
    configuration.save(folder / "config.yaml", config)
    random = np.random.default_rng(0)
    shapes = models.variable_shapes(models.from_config(config.model), config.data.window)
    drawn = {
        kind: jax.tree.map(
            lambda leaf, kind=kind: jnp.asarray(np.float32(draw(random, kind, leaf.shape))), tree
        )
        for kind, tree in shapes.items()
    }
    state = TrainState(jnp.int32(0), drawn, opt_state={})
    checkpoint.save(folder, "best", state, RunPosition(epoch=1, best=1.0))
    return folder
