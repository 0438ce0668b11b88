"""Names of networks to Flax modules; every one maps windows (b, n, 6) to a `Prediction`."""

from __future__ import annotations

import dataclasses
import difflib
import functools
from typing import Any, get_args

import jax
import jax.numpy as jnp
from flax import linen as nn
from jaxtyping import PRNGKeyArray

from gnio_jax.errors import InputError
from gnio_jax.models.ctin import CTIN
from gnio_jax.models.deepils import DeepILS
from gnio_jax.models.equivariance import CanonicalFrame, FourHeadings
from gnio_jax.models.gnio import GNIO
from gnio_jax.models.imot import IMoT, IMoTText
from gnio_jax.models.precision import Dtype
from gnio_jax.models.ronin import RoNINResNet
from gnio_jax.models.tlio import TLIO

_MODELS: dict[str, type[nn.Module]] = {
    "ctin": CTIN,
    "deepils": DeepILS,
    "gnio": GNIO,
    "imot": IMoT,
    "imot_text": IMoTText,
    "ronin_resnet": RoNINResNet,
    "tlio": TLIO,
}

_EQUIVARIANT: dict[str, type[nn.Module]] = {
    "four_headings": FourHeadings,
    "canonical_frame": CanonicalFrame,
}


def names() -> list[str]:
    """The networks `create` knows."""
    return sorted(_MODELS)


def create(
    name: str, equivariance: str = "none", dtype: str = "float32", **options: object
) -> nn.Module:
    """The network `name` with its options set; its `apply(variables, windows)` returns a
    `Prediction`.

    `equivariance` is "none", "four_headings" or "canonical_frame" (`models.equivariance`), `dtype`
    the type of the factors of its products (`models.precision`). Raises `InputError` for an unknown
    name or option, naming the known ones, or options that do not fit together.
    """
    if name not in _MODELS:
        raise InputError(f"model '{name}'", "unknown", f"known models: {', '.join(names())}")
    known = [
        field.name
        for field in dataclasses.fields(_MODELS[name])
        if field.name not in ("parent", "name")
    ] + ["equivariance"]
    for option in options:
        if option not in known:
            close = difflib.get_close_matches(option, known, n=1)
            raise InputError(
                f"model '{name}'",
                f"unknown option '{option}'",
                (f"did you mean '{close[0]}'? " if close else "")
                + f"known options: {', '.join(known)}",
            )
    if equivariance != "none" and equivariance not in _EQUIVARIANT:
        known = ", ".join(["none", *_EQUIVARIANT])
        problem = f"unknown equivariance '{equivariance}'"
        raise InputError(f"model '{name}'", problem, f"known ones: {known}")
    if dtype not in get_args(Dtype):
        known = ", ".join(get_args(Dtype))
        raise InputError(f"model '{name}'", f"unknown dtype '{dtype}'", f"known ones: {known}")
    try:
        network = _MODELS[name](dtype=dtype, **options)
    except ValueError as error:
        raise InputError(f"model '{name}'", str(error)) from None
    return network if equivariance == "none" else _EQUIVARIANT[equivariance](network, dtype)


def initialise(model: nn.Module, key: PRNGKeyArray, window: int = 200) -> Any:
    """Fresh variables of `model` for windows of `window` samples.

    `model.init` gives the same to rounding. Here the network itself is never run, and one small
    program draws all parameters of one shape: compiling `model.init` takes many times as long.
    """
    return model.lazy_init(key, _windows(window))


def variable_shapes(model: nn.Module, window: int = 200) -> Any:
    """The shapes and types of what `initialise` gives; nothing is computed."""
    return _initialised.eval_shape(model, jax.random.key(0), _windows(window))


@functools.partial(jax.jit, static_argnums=0)
def _initialised(model: nn.Module, key: PRNGKeyArray, windows: Any) -> Any:
    """`model.init`, whose traces JAX keeps: a run is loaded many times in one process."""
    return model.init(key, windows)


def _windows(window: int) -> jax.ShapeDtypeStruct:
    return jax.ShapeDtypeStruct((1, window, 6), jnp.float32)
