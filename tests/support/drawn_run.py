"""A run as `gnio train` leaves it, of a network whose weights NumPy has drawn: compiling its
initialisation would take longer than the tests."""

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax import models
from gnio_jax.networks import TrainedNetwork, write_network


def save(folder, config, draw):
    """Write settings and weights into `folder`, and return it.

    draw(random, "params" or "batch_stats", shape) gives the values of an array.
    """
    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(0)
    model = models.from_config(config.model)
    shapes = models.variable_shapes(model, config.data.window)
    drawn = {
        kind: jax.tree.map(
            lambda leaf, kind=kind: jnp.asarray(np.float32(draw(random, kind, leaf.shape))), tree
        )
        for kind, tree in shapes.items()
    }
    write_network(folder, TrainedNetwork(config, model, drawn, epoch=1, step=0))
    return folder
