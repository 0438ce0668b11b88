"""The state at the start of training, with parameters that NumPy has drawn: compiling the programs
that initialise a network takes longer than what many tests do with it."""

import functools

import jax
import numpy as np

from gnio_jax.training.window_task import WindowTask


def fresh_state(model, config, steps_per_epoch, key):
    """As a task on windows begins."""
    return WindowTask(model, config, steps_per_epoch).initial_state(key, None)


def drawn_state(model, config, steps_per_epoch):
    """As `fresh_state` in shapes and types. Kernels are normal, the smaller the more numbers they
    sum, and those of the heads next to nothing; the optimizer has seen nothing."""
    create = functools.partial(fresh_state, model, config, steps_per_epoch)
    shapes = jax.eval_shape(create, jax.random.key(0))
    random = np.random.default_rng(0)

    def parameter(path, leaf):
        if path[-1].key == "scale":
            return np.ones(leaf.shape, leaf.dtype)
        spread = np.prod(leaf.shape[:-1]) ** -0.5 if leaf.ndim > 1 else 0.1
        spread *= 0.01 if path[0].key in ("head", "uncertainty") else 1.0
        return random.normal(0, spread, leaf.shape).astype(leaf.dtype)

    def statistic(path, leaf):
        return np.full(leaf.shape, path[-1].key == "var", leaf.dtype)

    variables = {
        "params": jax.tree_util.tree_map_with_path(parameter, shapes.variables["params"]),
        "batch_stats": jax.tree_util.tree_map_with_path(statistic, shapes.variables["batch_stats"]),
    }
    opt_state = jax.tree.map(lambda leaf: np.zeros(leaf.shape, leaf.dtype), shapes.opt_state)
    return jax.device_put(
        shapes._replace(step=np.int32(0), variables=variables, opt_state=opt_state)
    )
