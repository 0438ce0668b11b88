"""Weights of RoNIN's ResNet and of EqNIO's networks, and the recognition of whose weights they are.

The layouts are those of the public code: names of arrays, their shapes, the order of the channels.
EqNIO's around TLIO, and its networks without reflections, are assumed to name the frame's arrays as
its network around RoNIN with reflections does, which is the one that was seen.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax import models
from gnio_jax.config import ModelConfig
from gnio_jax.errors import InputError
from gnio_jax.interop.tlio import CHANNELS, PARTS, checked_array, open_weights

REMEDY = "the weights must be those of TLIO, RoNIN or EqNIO (ResNet), as their training saves them"
RONIN_PARTS = PARTS | {
    "displacement": "output_block.",
    "neck_conv": "transition.0.",
    "neck_bn": "transition.1.",
    "fc1": "fc.0.",
    "fc2": "fc.3.",
    "fc3": "fc.6.",
}
FRAME_PARTS = {
    "frame": "vnoutput_layer.vector_linear.",
    "vectors": "vnlinear_layer0.vector_linear.",
    "scalars": "slinear_layer0.",
    "gate": "nonlinearity0.",
    "mean_vectors": "vnlinear_layer1.vector_linear.",
    "mean_scalars": "slinear_layer1.",
    "mean_gate": "nonlinearity1.",
    "last_vectors": "vnlinear_layer2.vector_linear.",
    "last_norm": "vector_ln1.ln.",
    "kernel": "weight",
    "scale": "gamma",
}
BLOCK_PARTS = {
    "vector_filter": "0.conv_layer_vec.",
    "scalar_filter": "0.conv_layer_sca.",
    "gate": "1.",
    "vector_norm": "2.ln.",
    "scalar_norm": "3.",
    "kernel": "weight",
    "scale": "gamma",
}
"""Names of ours, and the keys in their place, as in `tlio.PARTS`."""


class Weights(NamedTuple):
    """A network and its variables."""

    model: ModelConfig
    variables: Any
    features: int
    """⌈N/32⌉ for windows of N samples, all that the weights show of their length."""


def load_state_dict(source: Mapping[str, Any] | str | Path) -> Weights:
    """The network whose weights these are, and its variables.

    Takes what `load_tlio_state_dict` takes: weights of TLIO's ResNet, of RoNIN's ResNet-18, or of
    EqNIO's around one of them. Raises `InputError` naming the file and the key that is missing,
    unexpected, of another shape or not finite.
    """
    where, weights = open_weights(source)
    weights = {key: value for key, value in weights.items() if not key.endswith(".beta")}
    framed = any(key.startswith("vnoutput_layer.") for key in weights)
    inner = "ronin." if any(key.startswith("ronin.") for key in weights) else "tlio."
    prefix = inner if framed else ""
    ronin = f"{prefix}output_block.fc.0.weight" in weights
    first = f"{prefix}output_block{'.fc.0' if ronin else '1.fc1'}.weight"
    if first not in weights or len(np.shape(weights[first])) != 2:
        raise InputError(where, f"'{first}' is missing, or is not a matrix", REMEDY)
    features, left_over = divmod(np.shape(weights[first])[1], 128)
    if left_over or not features:
        problem = f"'{first}' must have 128·⌈N/32⌉ columns for windows of N samples"
        raise InputError(where, f"{problem}, found {np.shape(weights[first])[1]}", REMEDY)
    outputs = np.shape(weights.get(f"{prefix}output_block.fc.6.weight", np.zeros((2, 1))))[0]
    if outputs not in (2, 3):
        raise InputError(where, f"'{prefix}output_block.fc.6.weight' has {outputs} rows", REMEDY)
    config = ModelConfig(
        name="ronin_resnet" if ronin else "tlio",
        output_dim=outputs if ronin else None,  # type: ignore[arg-type]
        equivariance=_frame(weights) if framed else "none",
    )
    template = models.variable_shapes(models.from_config(config), 32 * features)
    key_of = _framed_key(prefix, ronin) if framed else _plain_key("", ronin)
    leaves = jax.tree_util.tree_leaves_with_path(template)
    expected = {
        key_of(names): leaf
        for names, leaf in ((tuple(step.key for step in path), leaf) for path, leaf in leaves)
        if names[-2:] != ("uncertainty", "log_std")
    }
    for problem, keys in (
        ("missing", expected.keys() - weights.keys()),
        ("unexpected", weights.keys() - expected.keys()),
    ):
        if keys:
            more = f" (and {len(keys) - 1} more)" if len(keys) > 1 else ""
            raise InputError(where, f"'{min(keys)}' is {problem}{more}", REMEDY)

    def value(path: tuple, leaf: Any) -> jax.Array:
        names = tuple(step.key for step in path)
        if names[-2:] == ("uncertainty", "log_std"):
            return jnp.zeros(leaf.shape, jnp.float32)
        key = key_of(names)
        array = weights[key]
        if names[-2].endswith("_filter") and np.ndim(array) == 4:  # (out, in, samples, 1)
            array = array[..., 0]
        array = checked_array(where, key, array, leaf.shape)
        if "stem_conv" in names and not framed:  # EqNIO shows them [accel, gyro], as we do
            array = array[:, CHANNELS]
        return jnp.asarray(array, jnp.float32)

    return Weights(config, jax.tree_util.tree_map_with_path(value, template), features)


def _frame(weights: Mapping[str, Any]) -> Any:
    """Which of EqNIO's frames: that of O(2) has three vectors, and those of SO(2) one or two
    blocks."""
    inputs = np.shape(weights.get("vnlinear_layer0.vector_linear.weight", np.zeros((1, 3))))[-1]
    if inputs == 3:
        return "o2_frame"
    return "so2_frame" if "layers.1.3.gamma" in weights else "so2_frame_shallow"


def _plain_key(prefix: str, ronin: bool) -> Callable[[tuple[str, ...]], str]:
    parts = RONIN_PARTS if ronin else PARTS
    return lambda names: prefix + "".join(parts.get(name, f"{name}.") for name in names[1:])


def _framed_key(prefix: str, ronin: bool) -> Callable[[tuple[str, ...]], str]:
    plain = _plain_key(prefix, ronin)

    def key_of(names: tuple[str, ...]) -> str:
        if names[1] != "frame":
            return plain(names)
        head, *steps = names[2:]
        parts = FRAME_PARTS
        key = parts.get(head, "")
        if head.startswith("block"):
            parts, key = BLOCK_PARTS, f"layers.{int(head.removeprefix('block')) - 1}."
        layers = {"linear": "linear.", "norm": "layer_norm."}
        return key + "".join(layers.get(step) or parts[step] for step in steps)

    return key_of
