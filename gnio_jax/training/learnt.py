"""What learns through the filter: modules of the network, and options of the filter.

The filter's options learn as numbers without bounds (`filtering.unconstrained`). They lie beside
the network's variables as the collection "filter", float32 like the network.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax.config import FilterOptions
from gnio_jax.filtering.unconstrained import unconstrained, with_numbers
from gnio_jax.training.optimizer import UNCERTAINTY

FILTER_PARTS = {
    "noise": ("gyro_density", "accel_density", "gyro_bias_walk", "accel_bias_walk"),
    "measurement": (
        "measurement_scale",
        "std_factor_x",
        "std_factor_y",
        "std_factor_z",
        "window_error_share",
        "window_error_seconds",
        "scale_error_std",
        "heading_error_std_degrees",
        "walk_error_seconds",
    ),
    "start": (
        "tilt_std_degrees",
        "yaw_std_degrees",
        "velocity_std",
        "position_std",
        "gyro_bias_std",
        "accel_bias_std",
    ),
}
"""Fields of `FilterOptions` that each part of the filter has."""
DIGITS = 5
"""That float32 keeps of a value whose logarithm it holds."""

HEADS = ("head", "displacement")
"""Names of the networks' modules from which the displacement comes."""

Learnt = dict[str, dict[str, Any]]
"""Variables that learn, by collection: "params" and "filter"; none of them empty."""


def filter_numbers(options: FilterOptions) -> dict[str, Float[jax.Array, ""]]:
    """The collection "filter": a number for each option that is not switched off."""
    fields = [name for names in FILTER_PARTS.values() for name in names]
    return {name: jnp.float32(each) for name, each in unconstrained(options, fields).items()}


def learnt_options(options: FilterOptions, numbers: dict[str, Any]) -> FilterOptions:
    """The filter's options with the values that have learnt, as five digits."""
    return with_numbers(options, numbers, DIGITS)


def chosen(variables: Any, learn: Iterable[str]) -> Learnt:
    """The variables that learn, out of the network's and the filter's."""
    parts = set(learn)
    if "all" in parts:
        parts = {*FILTER_PARTS, "uncertainty", "head", "encoder"}
    names = {name for part in parts for name in FILTER_PARTS.get(part, ())}
    found = {
        "params": _those(variables["params"], lambda module: module_part(module) in parts),
        "filter": _those(variables["filter"], lambda name: name in names),
    }
    return {collection: tree for collection, tree in found.items() if tree}


def _those(tree: dict[str, Any], wanted: Any) -> dict[str, Any]:
    return {name: leaf for name, leaf in tree.items() if wanted(name)}


def module_part(module: str) -> str:
    """The part of the network that one of its modules belongs to."""
    if module in UNCERTAINTY:
        return "uncertainty"
    return "head" if module in HEADS else "encoder"


def merged(variables: Any, learnt: Learnt) -> Any:
    """All variables, with those that learn in their places."""
    return {
        collection: {**tree, **learnt.get(collection, {})} for collection, tree in variables.items()
    }
