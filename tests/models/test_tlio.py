"""RoNIN's network, which has TLIO's encoder and head: its output against the recorded one of TLIO,
and how the head trains."""

import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from gnio_jax import interop, models
from gnio_jax.models.tlio import FullyConnectedHead
from tests.support import tlio_weights
from tests.support.compiling import quick
from tests.support.networks import drawn, predicted

RECORDED = Path(__file__).parents[1] / "recorded" / "tlio_tracker" / "pipeline.npz"


def test_ronins_displacement_is_that_of_tlio_with_the_same_weights():
    """Of two axes; the vertical is 0, and the uncertainty a constant."""
    recorded = np.load(RECORDED, allow_pickle=False)
    gyro, accel = np.split(recorded["net_input_gyro_accel"], 2, axis=-1)
    tlio = interop.load_tlio_state_dict(tlio_weights.weights())
    variables = {
        kind: {name: part for name, part in tree.items() if name != "log_std"}
        for kind, tree in tlio.items()
    }
    head = variables["params"]["displacement"]
    fc3 = {name: array[..., :2] for name, array in head["fc3"].items()}
    variables["params"]["displacement"] = head | {"fc3": fc3}
    constant = np.array([-1.0, -2.0, -3.0], np.float32)
    variables["batch_stats"]["uncertainty"] = {"log_std": constant}
    model = models.create("ronin_resnet", output_dim=2)
    wanted = recorded["net_displacement"] * [1, 1, 0]
    for found in predicted(model, variables, np.concatenate([accel, gyro], axis=-1)):
        np.testing.assert_allclose(found.displacement, wanted, atol=1e-5)
        np.testing.assert_array_equal(found.log_std, np.tile(constant, (len(wanted), 1)))


def test_dropout_keeps_its_share_in_training_alone():
    features = jnp.float32(np.random.default_rng(1).standard_normal((64, 2, 64)))
    head = FullyConnectedHead(8, 3, 0.25)
    variables = drawn(
        jax.eval_shape(lambda key: head.init(key, features, False), jax.random.key(0))
    )
    options = {"mutable": ["intermediates", "batch_stats"]}
    options["capture_intermediates"] = lambda module, _: isinstance(module, nn.Dropout | nn.Dense)

    @functools.partial(quick, static_argnums=0)
    def hidden(train, key):
        """What the two dropouts are given, and what they leave of it."""
        _, seen = head.apply(variables, features, train, rngs={"dropout": key}, **options)
        layers = (("fc1", "Dropout_0"), ("fc2", "Dropout_1"))
        found = [[seen["intermediates"][name]["__call__"][0] for name in pair] for pair in layers]
        return [(nn.relu(given), left) for given, left in found]

    first, second = (jax.device_get(hidden(True, jax.random.key(seed))) for seed in (0, 1))
    for (given, left), (_, other) in zip(first, second, strict=True):
        active, kept = given > 1e-3, left != 0
        assert active.sum() > 1000 and abs(kept[active].mean() - 0.75) < 0.05
        np.testing.assert_allclose(left[kept], given[kept] / 0.75, rtol=1e-5)
        assert (kept != (other != 0)).any()
    for given, left in jax.device_get(hidden(False, jax.random.key(0))):
        np.testing.assert_array_equal(left, given)


def test_a_new_head_predicts_next_to_nothing():
    features = jnp.float32(np.random.default_rng(1).standard_normal((8, 2, 64)))
    head = FullyConnectedHead(8, 3, 0.5)
    output, variables = quick(lambda key: head.init_with_output(key, features, False))(
        jax.random.key(0)
    )
    assert np.abs(output).max() < 0.1
    params = jax.device_get(variables["params"])
    assert abs(params["fc1"]["kernel"].std() - 0.01) < 0.001
    assert not any(params[layer]["bias"].any() for layer in ("fc1", "fc2", "fc3"))
