"""RoNIN's network: its sizes, its head against plain NumPy, and its uncertainty."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import models
from gnio_jax.errors import InputError
from gnio_jax.models.resnet import ResNet18
from tests.support.compiling import quick


def count(tree):
    return sum(int(np.prod(leaf.shape)) for leaf in jax.tree.leaves(tree))


def shapes(samples=200, **options):
    return models.variable_shapes(models.create("ronin_resnet", **options), samples)


@pytest.mark.parametrize("options, total", [({"output_dim": 2}, 4_634_882), ({}, 4_635_395)])
def test_parameters_of_the_published_network_block_by_block(options, total):
    params = shapes(**options)["params"]
    outputs = options.get("output_dim", 3)
    assert count(params) == total
    assert params.keys() == {"encoder", "displacement"}
    assert count(params["encoder"]) == 3_846_144
    assert {name: count(part) for name, part in params["displacement"].items()} == {
        "neck_conv": 512 * 128,
        "neck_bn": 2 * 128,
        "fc1": 896 * 512 + 512,
        "fc2": 512 * 512 + 512,
        "fc3": 513 * outputs,
    }


def prepared(output_dim):
    """A small network with nothing at its neutral start, and windows."""
    rng = np.random.default_rng(output_dim)
    variables = jax.tree_util.tree_map_with_path(
        lambda path, leaf: jnp.asarray(
            rng.uniform(0.5, 1.5, leaf.shape)
            if path[-1].key in ("scale", "var")
            else rng.normal(0, 0.2, leaf.shape),
            jnp.float32,
        ),
        shapes(70, width=4, output_dim=output_dim),
    )
    return (
        models.create("ronin_resnet", width=4, output_dim=output_dim),
        variables,
        rng.normal(size=(2, 70, 6)).astype(np.float32),
    )


@pytest.mark.parametrize("output_dim", [2, 3])
def test_output_against_numpy(output_dim):
    model, variables, windows = prepared(output_dim)
    found = quick(model.apply)(variables, windows)
    encoder = {kind: variables[kind]["encoder"] for kind in variables}
    features = np.asarray(quick(ResNet18(4).apply)(encoder, windows), np.float64)
    assert features.shape == (2, 3, 32)
    head, seen = (
        variables["params"]["displacement"],
        variables["batch_stats"]["displacement"]["neck_bn"],
    )
    wanted = np.zeros((2, 3))
    for b in range(2):
        flat = []
        for channel in range(8):  # channel by channel, time within: PyTorch's order
            for row in features[b]:
                value = row @ np.asarray(head["neck_conv"]["kernel"])[0, :, channel]
                value = (value - seen["mean"][channel]) / np.sqrt(seen["var"][channel] + 1e-5)
                flat.append(
                    value * head["neck_bn"]["scale"][channel] + head["neck_bn"]["bias"][channel]
                )
        x = np.array(flat)
        for layer in ("fc1", "fc2"):
            x = np.maximum(x @ np.asarray(head[layer]["kernel"]) + head[layer]["bias"], 0)
        wanted[b, :output_dim] = x @ np.asarray(head["fc3"]["kernel"]) + head["fc3"]["bias"]
    np.testing.assert_allclose(found.displacement, wanted, rtol=1e-4, atol=1e-5)
    assert (np.asarray(found.displacement)[:, :output_dim] != 0).all()
    np.testing.assert_array_equal(
        found.log_std, np.tile(variables["batch_stats"]["uncertainty"]["log_std"], (2, 1))
    )
    assert found.displacement.dtype == found.log_std.dtype == jnp.float32


def test_a_frozen_network_gives_the_same_numbers():
    model, variables, windows = prepared(3)
    frozen = models.inference_variables(model, variables)
    apply = quick(models.Inference(model).__call__)
    wanted, found = apply(models.InferenceVariables(variables, {}), windows), apply(frozen, windows)
    np.testing.assert_allclose(found.displacement, wanted.displacement, rtol=2e-4, atol=2e-5)
    np.testing.assert_array_equal(found.log_std, wanted.log_std)
    assert (np.asarray(frozen.variables["params"]["displacement"]["neck_bn"]["scale"]) == 1).all()


def test_training_leaves_the_uncertainty_alone():
    model, variables, windows = prepared(3)
    _, changed = quick(
        lambda v, w: model.apply(
            v, w, train=True, rngs={"dropout": jax.random.key(0)}, mutable=["batch_stats"]
        )
    )(variables, windows)
    assert jax.tree.structure(changed["batch_stats"]) == jax.tree.structure(
        variables["batch_stats"]
    )
    np.testing.assert_array_equal(
        changed["batch_stats"]["uncertainty"]["log_std"],
        variables["batch_stats"]["uncertainty"]["log_std"],
    )
    bn = [tree["batch_stats"]["displacement"]["neck_bn"]["mean"] for tree in (changed, variables)]
    assert (np.asarray(bn[0]) != np.asarray(bn[1])).all()


def test_other_numbers_of_outputs_are_refused():
    with pytest.raises(
        InputError, match="model 'ronin_resnet': output_dim must be 2 or 3, found 4"
    ):
        models.create("ronin_resnet", output_dim=4)
