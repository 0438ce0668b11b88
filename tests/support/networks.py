"""Small networks with variables that NumPy has drawn: nothing is compiled to initialise them."""

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax import models
from gnio_jax.models.layers import EPSILON
from tests.support.compiling import quick

SMALL = {
    "ai_imu": {},
    "airio": {"width": 4},
    "ctin": {"width": 12, "encoder_width": 8, "ffn": 10, "heads": 2, "decoder_layers": 2},
    "deepils": {"width": 4},
    "experts": {"width": 4},
    "gnio": {"width": 4, "bank_size": 3},
    "imot": {
        "encoder_layers": 2,
        "decoder_layers": 2,
        "ffn_ratio": 1.5,
        "heads": 4,
        "particles": 5,
    },
    "gru": {"width": 4},
    "ionet": {"width": 4},
    "ionext": {"width": 4},
    "ridi": {"supports": 3},
    "ronin_lstm": {"width": 5},
    "ronin_resnet": {"width": 4},
    "ronin_tcn": {"width": 4},
    "state_space": {"width": 6, "state": 5, "layers": 2},
    "tlio": {"width": 4},
    "trunk": {"width": 4},
}
"""Options of every network with which it compiles soon."""


def count(tree):
    """Numbers in all arrays of a tree."""
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(tree))


def shapes(name, samples=200, **options):
    """Shapes of a network's variables."""
    return models.variable_shapes(models.create(name, **options), samples)


def drawn(tree, seed=3, size=None):
    """Variables far from their neutral start, statistics, scales and biases too, so that nothing
    can be left out unnoticed. Kernels and biases are of `size`, or kernels the smaller the more
    numbers they sum."""
    rng = np.random.default_rng(seed)

    def draw(path, leaf):
        name = path[-1].key
        if name in ("var", "scale") or name.endswith("_length"):
            values = rng.uniform(0.5, 1.5, leaf.shape)
        elif name in ("particles", "positions", "prototypes"):
            values = rng.standard_normal(leaf.shape)
        elif leaf.ndim == 1 or name == "bias":
            values = (size or 0.3) * rng.standard_normal(leaf.shape)
        else:
            values = rng.standard_normal(leaf.shape) * (size or np.prod(leaf.shape[:-1]) ** -0.5)
        return jnp.asarray(values, jnp.float32)

    return jax.tree.map_with_path(draw, tree)


def predicted(model, variables, windows, folds=True):
    """What a network predicts: as it is, and made ready for inference, with its normalisations
    folded, unless it has others. One program, unless it has constants."""
    frozen, program = models.inference_variables(model, variables), quick(models.Inference(model))
    for path, leaf in jax.tree.leaves_with_path(frozen.variables["batch_stats"]):
        if folds and path[-1].key in ("mean", "var"):
            folded = np.float32(0 if path[-1].key == "mean" else 1 - EPSILON)
            np.testing.assert_array_equal(leaf, folded, err_msg=str(path))
    plain = models.InferenceVariables(variables, {})
    variants = [plain, frozen]
    if frozen.constants:  # they are used, not computed again
        variants.append(frozen._replace(constants=jax.tree.map(lambda x: 2 * x, frozen.constants)))
    predictions = [jax.device_get(program(variant, jnp.asarray(windows))) for variant in variants]
    for other in predictions[2:]:
        assert np.abs(other.displacement - predictions[1].displacement).max() > 1e-3
    return predictions[:2]
