"""The unknowns of a calibration: fields of the filter's options, by the groups of `--fit`."""

from __future__ import annotations

import dataclasses

from gnio_jax.config import FilterOptions
from gnio_jax.errors import InputError

GROUPS = {
    "measurement": ("measurement_scale",),
    "noise": ("gyro_density", "accel_density", "gyro_bias_walk", "accel_bias_walk"),
    "start": ("gyro_bias_std", "accel_bias_std"),
    "window": ("window_error_share", "window_error_seconds"),
    "walk": ("scale_error_std", "heading_error_std_degrees", "walk_error_seconds"),
}
STARTS = {"window_error_share": 0.8, "scale_error_std": 0.05, "heading_error_std_degrees": 2.0}
"""Where the fit begins with errors that the run has switched off (ours)."""
CONSIDERED = {
    "considered_gyro_bias_std": 1e-3,
    "considered_scale_std": 0.05,
    "considered_heading_std_degrees": 5.0,
    "considered_slope_std": 0.02,
}
"""Errors that are fitted last, to those of the trajectory, and where that begins (ours)."""
PRIOR_STD = 2.0
"""Standard deviation of each unknown about its start, in its own logarithm or logit (ours). The
recordings outweigh it by far in all that they tell; what they do not tell stays where it was."""
DIGITS = 4
"""As many are written down."""


def chosen(groups: tuple[str, ...]) -> tuple[str, ...]:
    """The fields of some groups."""
    return tuple(field for group in groups for field in GROUPS[group])


def check_fittable(options: FilterOptions, fields: tuple[str, ...]) -> None:
    """`InputError` for an option that is 0: it has no logarithm, and the fit would not leave it."""
    for name in fields:
        if name not in STARTS and not getattr(options, name) > 0:
            remedy = "leave its group out of --fit, or give the run a small value"
            raise InputError(f"filter.{name}", "is 0 and cannot be fitted", remedy)


def with_starts(options: FilterOptions, fields: tuple[str, ...]) -> FilterOptions:
    """The options from which a fit begins: with errors where they were off."""
    off = [name for name in fields if name in STARTS and getattr(options, name) == 0]
    return dataclasses.replace(options, **{name: STARTS[name] for name in off})
