"""What learns through the filter: modules of the network, and options of the filter.

The filter's options learn as numbers without bounds (`filtering.settings`). They lie beside
the network's variables as the collection "filter", float32 like the network.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Float

from gnio_jax.config import FilterSettings
from gnio_jax.filtering.settings import free_parameters, is_below, with_written_parameters
from gnio_jax.training.optimizer import UNCERTAINTY

FILTER_PARTS = {
    "noise": (
        "noise.gyro_density",
        "noise.accel_density",
        "noise.gyro_bias_walk",
        "noise.accel_bias_walk",
    ),
    "measurement": ("noise.measurement_scale", "noise.std_factor", "noise.correlation"),
    "start": ("start",),
}
"""Numbers of `FilterSettings` that each part of the filter has, by their paths."""
DIGITS = 5
"""That float32 keeps of a value whose logarithm it holds."""

HEADS = ("head", "displacement")
"""Names of the networks' modules from which the displacement comes."""

Learnt = dict[str, dict[str, Any]]
"""Variables that learn, by collection: "params" and "filter"; none of them empty."""


def filter_numbers(settings: FilterSettings) -> dict[str, Float[jax.Array, ""]]:
    """The collection "filter": a number for each setting that is not switched off."""
    paths = [path for of_part in FILTER_PARTS.values() for path in of_part]
    return {name: jnp.float32(each) for name, each in free_parameters(settings, paths).items()}


def learnt_options(settings: FilterSettings, numbers: dict[str, Any]) -> FilterSettings:
    """The filter's settings with the values that have learnt, as five digits."""
    return with_written_parameters(settings, numbers, DIGITS)


def chosen(variables: Any, learn: Iterable[str]) -> Learnt:
    """The variables that learn, out of the network's and the filter's."""
    parts = set(learn)
    if "all" in parts:
        parts = {*FILTER_PARTS, "uncertainty", "head", "encoder"}
    paths = [path for part in parts for path in FILTER_PARTS.get(part, ())]
    found = {
        "params": _those(variables["params"], lambda module: module_part(module) in parts),
        "filter": _those(
            variables["filter"], lambda name: any(is_below(name, path) for path in paths)
        ),
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
