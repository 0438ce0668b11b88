"""RoNIN's network: its sizes, its head against plain NumPy, and its uncertainty."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import models
from gnio_jax.models.resnet import ResNet18
from tests.support import networks
from tests.support.compiling import quick
from tests.support.networks import count

shapes = functools.partial(networks.shapes, "ronin_resnet")


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
