"""TLIO's network and RoNIN's, which has its encoder and head: their outputs against the recorded
ones, and how the head trains."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn

from gnio_jax import interop, models
from gnio_jax.models.tlio import FullyConnectedHead
from tests.support import tlio_weights
from tests.support.compiling import quick

RECORDED = Path(__file__).parents[1] / "recorded" / "tlio_tracker" / "pipeline.npz"


def test_output_is_the_recorded_one():
    recorded = np.load(RECORDED, allow_pickle=False)
    gyro, accel = np.split(recorded["net_input_gyro_accel"], 2, axis=-1)
    variables = interop.load_tlio_state_dict(tlio_weights.weights())
    apply = jax.jit(models.create("tlio").apply)
    found = apply(variables, np.concatenate([accel, gyro], axis=-1))
    np.testing.assert_allclose(found.displacement, recorded["net_displacement"], atol=1e-5)
    np.testing.assert_allclose(found.log_std, recorded["net_log_std"], atol=1e-5)
    assert found.displacement.dtype == found.log_std.dtype == jnp.float32
    swapped = apply(
        variables, np.concatenate([gyro, accel], axis=-1)
    )  # what the comparison would say of channels in the other order
    assert np.abs(swapped.displacement - recorded["net_displacement"]).max() > 1e-3


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
    found = quick(model.apply)(variables, np.concatenate([accel, gyro], axis=-1))
    wanted = recorded["net_displacement"] * [1, 1, 0]
    np.testing.assert_allclose(found.displacement, wanted, atol=1e-5)
    np.testing.assert_array_equal(found.log_std, np.tile(constant, (len(wanted), 1)))


def test_dropout_keeps_its_share_in_training_alone():
    features = jax.random.normal(jax.random.key(1), (64, 2, 64), jnp.float32)
    heads = {share: FullyConnectedHead(8, 3, share) for share in (0.0, 0.25)}
    shape = jax.eval_shape(lambda: heads[0.0].init(jax.random.key(0), features, False))
    rng = np.random.default_rng(0)
    variables = jax.tree.map(
        lambda leaf: jnp.asarray(
            rng.uniform(0.1, 0.4, leaf.shape) * rng.choice([-1, 1], leaf.shape), jnp.float32
        ),
        shape,
    )
    variables["batch_stats"] = jax.tree.map(jnp.abs, variables["batch_stats"])

    def hidden(share, train, seed=0):
        _, seen = heads[share].apply(
            variables,
            features,
            train,
            rngs={"dropout": jax.random.key(seed)},
            mutable=["intermediates", "batch_stats"],
            capture_intermediates=lambda module, _: isinstance(module, nn.Dropout),
        )
        return [np.asarray(seen["intermediates"][f"Dropout_{i}"]["__call__"][0]) for i in range(2)]

    whole, dropped, other = hidden(0.0, True)[0], hidden(0.25, True)[0], hidden(0.25, True, 1)[0]
    active, kept = whole > 1e-3, dropped != 0
    assert active.sum() > 1000 and abs(kept[active].mean() - 0.75) < 0.05
    np.testing.assert_allclose(dropped[kept], whole[kept] / 0.75, rtol=1e-5)
    assert (kept != (other != 0)).any()
    second = hidden(0.25, True)[1]
    assert 0.15 < (second == 0).mean()
    for one, two in zip(hidden(0.0, False), hidden(0.25, False), strict=True):
        np.testing.assert_array_equal(one, two)


def test_a_new_head_predicts_next_to_nothing_and_learns_every_parameter():
    features = jax.random.normal(jax.random.key(1), (8, 2, 64), jnp.float32)
    head = FullyConnectedHead(8, 3, 0.5)
    variables = jax.jit(lambda key: head.init(key, features, False))(jax.random.key(0))
    assert abs(np.asarray(variables["params"]["fc1"]["kernel"]).std() - 0.01) < 0.001
    assert all(
        (np.asarray(variables["params"][layer]["bias"]) == 0).all()
        for layer in ("fc1", "fc2", "fc3")
    )

    @jax.jit
    def gradient(variables):
        def loss(params):
            output, _ = head.apply(
                {**variables, "params": params},
                features,
                True,
                rngs={"dropout": jax.random.key(2)},
                mutable=["batch_stats"],
            )
            return jnp.sum((output - 1) ** 2), output

        return jax.grad(loss, has_aux=True)(variables["params"])

    found, output = gradient(variables)
    assert float(jnp.abs(output).max()) < 0.1
    assert all(
        np.isfinite(leaf).all() and np.abs(leaf).max() > 0 for leaf in jax.tree.leaves(found)
    )
