"""TLIO's weights for the model `tlio`.

PyTorch is needed for its own files alone (`pip install gnio-jax[torch]`); a mapping of arrays or an
.npz needs nothing.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax import models
from gnio_jax.errors import InputError, require_packages

CHANNELS = np.array([3, 4, 5, 0, 1, 2])
"""Index of each of our channels, [accel, gyro], among TLIO's, [gyro, accel]."""
_STEM = "input_block.0.weight"
_FLATTENED = "output_block1.fc1.weight"
_PREP_CHANNELS = 128
PARTS = {
    "encoder": "",
    "displacement": "output_block1.",
    "log_std": "output_block2.",
    "stem_conv": "input_block.0.",
    "stem_bn": "input_block.1.",
    "shortcut_conv": "downsample.0.",
    "shortcut_bn": "downsample.1.",
    "neck_conv": "prep1.",
    "neck_bn": "bn1.",
    "kernel": "weight",
    "scale": "weight",
    "mean": "running_mean",
    "var": "running_var",
    "bias": "bias",
    **{f"group{g + 1}_block{b + 1}": f"residual_groups.{g}.{b}." for g in range(4) for b in (0, 1)},
}
"""Names of ours, and what TLIO's keys have in their place; those that are not here are the same,
and a dot."""
_REMEDY = "the weights must be those of TLIO's network 'resnet', as its training saves them"


def load_tlio_state_dict(mapping_or_path: Mapping[str, Any] | str | Path) -> Any:
    """Variables of the model `tlio` (width 64) from the weights of TLIO's ResNet.

    Takes the state dict itself (arrays or tensors), an .npz of it, a checkpoint (.pt, .pth), or a
    TorchScript archive. The checkpoint may hold it as `model_state_dict`, and its keys may begin
    with `module.`. The window's length follows from the first linear layer: any of N samples with
    ⌈N/32⌉ the same. The first convolution's channels are permuted: the network takes our windows
    [accel, gyro]. Raises `InputError` naming the file and the key that is missing, unexpected, of
    another shape or not finite.
    """
    where, weights = open_weights(mapping_or_path)
    template = _template(where, weights)
    expected = {
        "".join(PARTS.get(step.key, f"{step.key}.") for step in path[1:]): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(template)
    }
    odd = {
        "missing": expected.keys() - weights.keys(),
        "unexpected": weights.keys() - expected.keys(),
    }
    for problem, keys in odd.items():
        if keys:
            more = f" (and {len(keys) - 1} more)" if len(keys) > 1 else ""
            raise InputError(where, f"'{min(keys)}' is {problem}{more}", _REMEDY)
    arrays = {
        key: checked_array(where, key, weights[key], leaf.shape) for key, leaf in expected.items()
    }
    arrays[_STEM] = arrays[_STEM][:, CHANNELS]
    leaves = [jnp.asarray(arrays[key], jnp.float32) for key in expected]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def _template(where: str, weights: Mapping[str, Any]) -> Any:
    """Shapes of the variables for the window's length that the weights have."""
    if _FLATTENED not in weights:
        raise InputError(where, f"'{_FLATTENED}' is missing", _REMEDY)
    shape = np.shape(weights[_FLATTENED])
    if len(shape) != 2 or shape[1] % _PREP_CHANNELS or not shape[1]:
        expected = f"(512, {_PREP_CHANNELS}·⌈N/32⌉) for windows of N samples"
        raise InputError(
            where, f"'{_FLATTENED}' must have shape {expected}, found {shape}", _REMEDY
        )
    return models.variable_shapes(models.create("tlio"), 32 * (shape[1] // _PREP_CHANNELS))


def checked_array(where: str, key: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """The array with PyTorch's (out, in, size) turned to our `shape`, (size, in, out)."""
    array = np.asarray(value.detach().cpu().float() if hasattr(value, "detach") else value)
    if array.shape != (torch_shape := shape[::-1]):
        raise InputError(
            where, f"'{key}' must have shape {torch_shape}, found {array.shape}", _REMEDY
        )
    if not np.issubdtype(array.dtype, np.floating) or not np.isfinite(array).all():
        problem = f"'{key}' holds values that are not finite numbers"
        raise InputError(where, problem, "the weights are damaged")
    return array.T


def open_weights(source: Mapping[str, Any] | str | Path) -> tuple[str, dict[str, Any]]:
    """The name of the weights in messages, and the state dict, without counts of batches."""
    where, weights = _open(source)
    weights = weights.get("model_state_dict", weights)
    if not isinstance(weights, Mapping):
        raise InputError(where, "its model_state_dict is not a mapping of arrays", _REMEDY)
    weights = {str(key).removeprefix("module."): value for key, value in weights.items()}
    return where, {k: v for k, v in weights.items() if not k.endswith("num_batches_tracked")}


def _open(source: Mapping[str, Any] | str | Path) -> tuple[str, Mapping[str, Any]]:
    """The name of the weights in messages, and their content."""
    if isinstance(source, Mapping):
        return "state dict", source
    path = Path(source)
    if not path.is_file():
        kinds = "a checkpoint of TLIO's training, a TorchScript archive or an .npz"
        raise InputError(path, "no such file", f"give {kinds} of the state dict")
    if path.suffix != ".npz":
        require_packages(path, "torch", "torch")
    try:
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as file:
                content = dict(file)
        else:
            content = _torch(path)
    except Exception as error:  # torch and zipfile raise half a dozen types for damaged files
        problem = f"cannot be read ({str(error).partition(chr(10))[0][:160]})"
        kinds = "an .npz of arrays, or a file of PyTorch that holds tensors and plain values only"
        raise InputError(path, problem, f"it must be {kinds}") from None
    if not isinstance(content, Mapping):
        raise InputError(path, f"holds no mapping of arrays but {type(content).__name__}", _REMEDY)
    return str(path), content


def _torch(path: Path) -> Any:
    import torch  # pyright: ignore[reportMissingImports]

    if zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            script = any(name.endswith("/constants.pkl") for name in archive.namelist())
        if script:
            return torch.jit.load(path, map_location="cpu").state_dict()
    return torch.load(path, map_location="cpu", weights_only=True)
