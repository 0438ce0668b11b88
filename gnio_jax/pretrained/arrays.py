"""A network's variables in the safetensors format; the only importer of that library.

A file of tensors by name, a header of JSON, and nothing that is executed. The name of an array is
its path, e.g. `params/head/kernel`.
"""

from __future__ import annotations

from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from gnio_jax.errors import InputError
from gnio_jax.types import Array

Storage = Literal["float32", "float16"]
WINDOWS = 64
"""Drawn windows by which the loss of a storage is measured."""


class StorageLoss(NamedTuple):
    """The largest change of what the network says, over drawn windows of a walker's strength."""

    displacement: float
    """m."""
    std: float
    """Of the standard deviation, as a fraction."""


def to_bytes(variables: Any, storage: Storage = "float32") -> bytes:
    """The variables as a file. With `float16` the parameters are rounded; the statistics of batch
    normalisations, which are few, stay float32.

    Raises `InputError` where a parameter is too large for float16.
    """
    tensors = {}
    for name, leaf in _named(variables).items():
        array = np.asarray(leaf, np.float32)
        if storage == "float16" and name.startswith("params/"):
            with np.errstate(over="ignore"):
                array = array.astype(np.float16)
            if not np.isfinite(array).all():
                raise InputError(f"'{name}'", "is too large for float16", "store float32")
        tensors[name] = np.ascontiguousarray(array)
    return save(tensors)


def from_bytes(content: bytes, template: Any, where: object) -> Any:
    """The variables of a file as float32, in the structure of `template` (arrays or shapes).

    Raises `InputError` where a name or shape is not the template's.
    """
    try:
        tensors = load(content)
    except (SafetensorError, ValueError, KeyError) as error:
        problem = f"cannot be read ({str(error)[:120]})"
        raise InputError(where, problem, "it must be a safetensors file") from None
    wanted = _named(template)
    for name in sorted(wanted.keys() | tensors.keys()):
        shapes = [tree[name].shape if name in tree else None for tree in (tensors, wanted)]
        if shapes[0] != shapes[1]:
            problem = f"'{name}' has shape {shapes[0]}; the configured network has {shapes[1]}"
            raise InputError(where, problem, "weights and config.yaml must be of one run")
        if not np.isfinite(tensors[name]).all():
            raise InputError(where, f"'{name}' holds values that are not finite")
    leaves = [jnp.asarray(tensors[name], jnp.float32) for name in wanted]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def storage_loss(model: Any, variables: Any, stored: Any, window: int) -> StorageLoss:
    """What the network loses by being stored: `stored` are the variables as they are read back."""
    windows = _drawn_windows(window)
    apply = jax.jit(model.apply)
    before, after = (apply(each, windows) for each in (variables, stored))
    moved = jnp.linalg.norm(after.displacement - before.displacement, axis=-1)
    spread = jnp.expm1(jnp.abs(after.log_std - before.log_std))
    return StorageLoss(float(moved.max()), float(spread.max()))


def _drawn_windows(window: int) -> Array:
    """(b, N, 6) [accel m/s², gyro rad/s]: gravity on z, and noise as strong as steps."""
    random = np.random.default_rng(0)
    strength = np.array([2.0, 2.0, 3.0, 1.0, 1.0, 1.0])
    windows = random.normal(0.0, 1.0, (WINDOWS, window, 6)) * strength
    windows[:, :, 2] += 9.81
    return jnp.asarray(windows, jnp.float32)


def _named(tree: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}
