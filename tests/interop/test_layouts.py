"""Weights of RoNIN and EqNIO in dicts of the public layout, with PyTorch's layers as the oracle."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from gnio_jax import interop, models
from gnio_jax.commands import app
from gnio_jax.errors import InputError
from gnio_jax.models.eqnio import EquivariantFrame
from gnio_jax.networks import read_network
from tests.support import tlio_weights
from tests.support.compiling import quick

RNG = np.random.default_rng(8)


def ronin_weights(outputs=2):
    """TLIO's encoder and first head under RoNIN's names, the last layer with two rows."""
    weights = {}
    for key, value in tlio_weights.weights().items():
        if key.startswith("output_block2."):
            continue
        names = {"prep1.": "transition.0.", "bn1.": "transition.1.", "fc1.": "fc.0."}
        names |= {"fc2.": "fc.3.", "fc3.": "fc.6."}
        if key.startswith("output_block1."):
            inner = key.removeprefix("output_block1.")
            layer = next(name for name in names if inner.startswith(name))
            key = "output_block." + names[layer] + inner.removeprefix(layer)
            value = value[:outputs] if layer == "fc3." else value
        weights[key] = value
    return weights


def frame_weights(width, vectors, scalars, depth, turns):
    """The frame's arrays, as its public code names them."""
    factor = 2 if turns else 1
    shapes = {
        "vnlinear_layer0.vector_linear.weight": (width, factor * vectors),
        "slinear_layer0.weight": (width, scalars),
        "vnlinear_layer1.vector_linear.weight": (width, factor * width),
        "slinear_layer1.weight": (width, width),
        "nonlinearity1.linear.weight": (width, 2 * width),
        "nonlinearity1.layer_norm.gamma": (width,),
        "vnlinear_layer2.vector_linear.weight": (width, factor * width),
        "vector_ln1.ln.gamma": (width,),
        "vnoutput_layer.vector_linear.weight": (2, factor * width),
    }
    gates = ["nonlinearity0", *(f"layers.{block}.1" for block in range(depth))]
    for name in gates:
        shapes[f"{name}.linear.weight"] = (2 * width, 2 * width)
        shapes[f"{name}.layer_norm.gamma"] = (2 * width,)
    for block in range(depth):
        shapes[f"layers.{block}.0.conv_layer_vec.weight"] = (width, factor * width, 32, 1)
        shapes[f"layers.{block}.0.conv_layer_sca.weight"] = (width, width, 32, 1)
        shapes[f"layers.{block}.2.ln.gamma"] = (width,)
        shapes[f"layers.{block}.3.gamma"] = (width,)
    weights = {key: RNG.normal(0, 0.1, shape) for key, shape in shapes.items()}
    betas = {
        key.replace("gamma", "beta"): np.zeros(shape)
        for key, shape in shapes.items()
        if key.endswith("gamma")
    }
    return weights | betas


def test_ronins_weights_are_tlios_under_other_names():
    ronin = interop.load_state_dict(ronin_weights())
    assert (ronin.model.name, ronin.model.output_dim, ronin.features) == ("ronin_resnet", 2, 7)
    tlio = interop.load_state_dict(tlio_weights.weights())
    assert tlio.model.name == "tlio"
    jax.tree.map(
        np.testing.assert_array_equal,
        ronin.variables["params"]["encoder"],
        tlio.variables["params"]["encoder"],
    )
    head, other = (w.variables["params"]["displacement"] for w in (ronin, tlio))
    np.testing.assert_array_equal(head["neck_bn"]["scale"], other["neck_bn"]["scale"])
    np.testing.assert_array_equal(head["fc3"]["kernel"], other["fc3"]["kernel"][:, :2])


@pytest.mark.parametrize(
    "frame, inner",
    [
        ("o2_frame", "ronin"),
        ("o2_frame", "tlio"),
        ("so2_frame", "tlio"),
        ("so2_frame_shallow", "ronin"),
    ],
)
def test_eqnios_weights_are_recognised_and_their_inner_channels_stay(frame, inner):
    weights = ronin_weights() if inner == "ronin" else tlio_weights.weights()
    sizes = (64, 3, 9, 2, False) if frame == "o2_frame" else (128, 2, 5, 2, True)
    sizes = (128, 2, 5, 1, True) if frame == "so2_frame_shallow" else sizes
    outer = frame_weights(*sizes)
    network = interop.load_state_dict(outer | {f"{inner}.{key}": w for key, w in weights.items()})
    name = {"ronin": "ronin_resnet", "tlio": "tlio"}[inner]
    assert (network.model.name, network.model.equivariance) == (name, frame)
    params = network.variables["params"]
    stem = weights["input_block.0.weight"].T
    np.testing.assert_array_equal(params["encoder"]["stem_conv"]["kernel"], np.float32(stem))
    kernel = np.float32(outer["layers.0.0.conv_layer_vec.weight"][..., 0].T)
    np.testing.assert_array_equal(params["frame"]["block1"]["vector_filter"]["kernel"], kernel)
    shapes = models.variable_shapes(models.from_config(network.model))["params"]
    assert jax.tree.map(jnp.shape, params) == jax.tree.map(jnp.shape, shapes)


def test_the_frame_of_read_weights_is_that_of_pytorchs_layers():
    torch = pytest.importorskip("torch")
    outer = frame_weights(64, 3, 9, 2, False)
    state = {key: torch.from_numpy(value) for key, value in outer.items()}
    windows = RNG.normal([0, 0, 9.8, 0, 0, 0], 1.0, (2, 40, 6))
    functional = torch.nn.functional
    a, w = (torch.from_numpy(part) for part in np.split(windows, 2, axis=2))
    size = w.norm(dim=2, keepdim=True)
    across = torch.stack([-w[..., 1], w[..., 0], 0 * w[..., 0]], dim=2)
    first = size * functional.normalize(torch.linalg.cross(w, across), dim=2)
    second = size * functional.normalize(torch.linalg.cross(w, first), dim=2)
    whole = torch.stack([a, first, second], dim=3)
    v = whole[:, :, :2]
    pairs = [(v[..., i] * v[..., j]).sum(2) for i, j in ((0, 1), (1, 2), (0, 2))]
    s = torch.cat([whole[:, :, 2], v.norm(dim=2), torch.stack(pairs, dim=2)], dim=2)

    def dense(x, name):
        return functional.linear(x, state[f"{name}.weight"])

    def norm(x, name):
        return functional.layer_norm(x, x.shape[-1:], state[f"{name}.gamma"])

    def unit(v):
        return v / v.norm(dim=-2, keepdim=True)

    def gate(v, s, name):
        y = torch.relu(dense(torch.cat([v.norm(dim=-2), s], dim=-1), f"{name}.linear"))
        y = norm(y, f"{name}.layer_norm")
        return unit(v) * y[..., None, :64], y[..., 64:]

    def filtered(x, name):  # (b, time, rows, channels)
        x = functional.pad(x.permute(0, 3, 1, 2), (0, 0, 15, 16), mode="replicate")
        return functional.conv2d(x, state[f"{name}.weight"]).permute(0, 2, 3, 1)

    def vector_norm(v, name):
        return unit(v) * norm(v.norm(dim=-2), f"{name}.ln")[..., None, :]

    v, s = gate(
        dense(v, "vnlinear_layer0.vector_linear"), dense(s, "slinear_layer0"), "nonlinearity0"
    )
    for block in range(2):
        name = f"layers.{block}"
        v = filtered(v, f"{name}.0.conv_layer_vec")
        s = filtered(s[:, :, None], f"{name}.0.conv_layer_sca")[:, :, 0]
        v, s = gate(v, s, f"{name}.1")
        v, s = vector_norm(v, f"{name}.2"), norm(s, f"{name}.3")
    v, s = v.mean(1), s.mean(1)
    v, s = dense(v, "vnlinear_layer1.vector_linear"), dense(s, "slinear_layer1")
    v, _ = gate(v, s, "nonlinearity1")
    v = vector_norm(dense(v, "vnlinear_layer2.vector_linear"), "vector_ln1")
    x = unit(dense(v, "vnoutput_layer.vector_linear"))[..., 0]
    weights = {f"tlio.{key}": w for key, w in tlio_weights.weights().items()}
    params = interop.load_state_dict(outer | weights).variables["params"]["frame"]
    frame = EquivariantFrame(64, 2, True)
    output = quick(frame.apply)({"params": params}, jnp.asarray(windows))
    np.testing.assert_allclose(output.heading, x.numpy(), atol=1e-5)


def test_a_run_of_ronins_weights_and_mistakes(tmp_path):
    np.savez(tmp_path / "ronin.npz", **ronin_weights())
    app.main(["interop", str(tmp_path / "ronin.npz"), str(tmp_path / "run"), "--dataset", "ronin"])
    network = read_network(tmp_path / "run")
    assert network.config.model.name == "ronin_resnet"
    assert network.config.filter.window_rotation is None
    weights = ronin_weights()
    for change, problem in (
        ({"output_block.fc.0.weight": None}, "'output_block1.fc1.weight' is missing"),
        ({"output_block.fc.3.bias": None}, "'output_block.fc.3.bias' is missing"),
        ({"extra": np.zeros(1)}, "'extra' is unexpected"),
        ({"output_block.fc.3.bias": np.full(512, np.nan)}, "not finite"),
        ({"output_block.fc.3.bias": np.zeros(3)}, "must have shape"),
    ):
        broken = {k: v for k, v in (weights | change).items() if v is not None}
        with pytest.raises(InputError, match=problem):
            interop.load_state_dict(broken)
