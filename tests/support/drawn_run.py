"""A run as `gnio train` leaves it, of a network whose weights NumPy has drawn: compiling its
initialisation would take longer than the tests."""

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax import config as configuration
from gnio_jax.training import checkpoint
from gnio_jax.training.step import TrainState


def save(folder, config, draw):
    """Write settings and best checkpoint into `folder`, and return it.

    draw(random, "params" or "batch_stats", shape) gives the values of an array.
    """
    configuration.save(folder / "config.yaml", config)
    random = np.random.default_rng(0)
    window = jax.ShapeDtypeStruct((1, config.data.window, 6), jnp.float32)
    shapes = jax.eval_shape(checkpoint.create_model(config).init, jax.random.key(0), window)
    drawn = {
        kind: jax.tree.map(
            lambda leaf, kind=kind: jnp.asarray(draw(random, kind, leaf.shape), jnp.float32), tree
        )
        for kind, tree in shapes.items()
    }
    state = TrainState(jnp.int32(0), drawn["params"], drawn["batch_stats"], {})
    with checkpoint.Checkpoints(folder) as checkpoints:
        checkpoints.save("best", state, checkpoint.Position(1, 0, 1.0, (0.0, 0.0, 0.0), 1.0))
    return folder
