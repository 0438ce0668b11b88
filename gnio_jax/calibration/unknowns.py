"""The unknowns of a calibration: fields of the filter's options, as numbers without bounds."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax.config import FilterOptions
from gnio_jax.errors import InputError
from gnio_jax.types import Array

PRIOR_STD = 2.0
"""Standard deviation of each unknown about its start, in its own logarithm or logit (ours). The
recordings outweigh it by far in all that they tell; what they do not tell stays where it was."""


LARGEST_SHARE = 0.9999
"""Of a window's standard deviation that lasts, as it is written down."""


class Unknown(NamedTuple):
    """One field of `FilterOptions`."""

    field: str
    to_free: Callable[[float], float]
    """From its value to a number without bounds."""
    from_free: Callable[[Array], Array]
    start: float | None = None
    """Where the fit begins if the option is off; None: always at the option."""


def _logarithmic(field: str, start: float | None = None) -> Unknown:
    return Unknown(field, math.log, jnp.exp, start)


def _share(field: str, start: float) -> Unknown:
    return Unknown(field, lambda x: math.log(x / (1 - x)), jax.nn.sigmoid, start)


UNKNOWNS = {
    "measurement": (_logarithmic("measurement_scale"),),
    "noise": (
        _logarithmic("gyro_density"),
        _logarithmic("accel_density"),
        _logarithmic("gyro_bias_walk"),
        _logarithmic("accel_bias_walk"),
    ),
    "start": (_logarithmic("gyro_bias_std"), _logarithmic("accel_bias_std")),
    "window": (
        _share("window_error_share", 0.8),
        _logarithmic("window_error_seconds"),
    ),
    "walk": (
        _logarithmic("scale_error_std", 0.05),
        _logarithmic("heading_error_std_degrees", 2.0),
        _logarithmic("walk_error_seconds"),
    ),
}
"""By the groups that can be fitted."""


def chosen(groups: tuple[str, ...]) -> tuple[Unknown, ...]:
    """The unknowns of some groups."""
    return tuple(unknown for group in groups for unknown in UNKNOWNS[group])


def check_fittable(options: FilterOptions, unknowns: tuple[Unknown, ...]) -> None:
    """`InputError` for an option that is 0: it has no logarithm, and the fit would not leave it."""
    for unknown in unknowns:
        if unknown.start is None and not getattr(options, unknown.field) > 0:
            remedy = "leave its group out of --fit, or give the run a small value"
            raise InputError(f"filter.{unknown.field}", "is 0 and cannot be fitted", remedy)


def with_starts(options: FilterOptions, unknowns: tuple[Unknown, ...]) -> FilterOptions:
    """The options from which a fit begins: with errors where they were off."""
    starts = {
        u.field: u.start for u in unknowns if u.start is not None and getattr(options, u.field) == 0
    }
    return dataclasses.replace(options, **starts)


def to_free(options: FilterOptions, unknowns: tuple[Unknown, ...]) -> Float[np.ndarray, "u"]:
    """The unknowns as numbers without bounds."""
    return np.array([u.to_free(getattr(options, u.field)) for u in unknowns])


def from_free(free: Float[Array, "u"], unknowns: tuple[Unknown, ...]) -> dict[str, Array]:
    """The values of the fields; also of numbers that are traced."""
    return {unknown.field: unknown.from_free(free[i]) for i, unknown in enumerate(unknowns)}


def written(options: FilterOptions, fields: dict[str, Array]) -> FilterOptions:
    """The options with these values, as four digits, which is how they are written down.

    Rounding leaves a share below 1.
    """
    values = {name: float(f"{float(value):.4g}") for name, value in fields.items()}
    if "window_error_share" in values:
        values["window_error_share"] = min(values["window_error_share"], LARGEST_SHARE)
    return dataclasses.replace(options, **values)
