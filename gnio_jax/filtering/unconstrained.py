"""Options of the filter as numbers without bounds, in which they are fitted and learn: logarithms,
and the logit of a share."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax.config import FilterOptions

SHARES = ("window_error_share",)
"""Fields of `FilterOptions` between 0 and 1; the others are positive."""
LARGEST_SHARE = 0.9999
"""Largest share that is written down: rounding must not make it 1."""


def unconstrained(options: FilterOptions, fields: Iterable[str]) -> dict[str, float]:
    """The numbers of some fields. An option that is 0 is switched off, and has none."""
    values = {name: getattr(options, name) for name in fields}
    return {name: _number(name, value) for name, value in values.items() if value > 0}


def _number(name: str, value: float) -> float:
    return math.log(value) - (math.log1p(-value) if name in SHARES else 0.0)


def natural(numbers: Mapping[str, Any]) -> dict[str, Float[jax.Array, ""]]:
    """The values of fields, float64, from their numbers. Differentiable."""
    wide = {name: jnp.asarray(number, jnp.float64) for name, number in numbers.items()}
    return {
        name: jax.nn.sigmoid(number) if name in SHARES else jnp.exp(number)
        for name, number in wide.items()
    }


def with_numbers(options: FilterOptions, numbers: Mapping[str, Any], digits: int) -> FilterOptions:
    """The options with the values of these numbers, rounded as they are written down."""
    values = {name: _rounded(name, float(number), digits) for name, number in numbers.items()}
    return dataclasses.replace(options, **values)


def _rounded(name: str, number: float, digits: int) -> float:
    if name in SHARES:
        return min(float(f"{1 / (1 + math.exp(-number)):.{digits}g}"), LARGEST_SHARE)
    return float(f"{math.exp(number):.{digits}g}")
