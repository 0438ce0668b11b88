"""The filter that an experiment's settings describe, and its numbers as free parameters."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import keystr, tree_leaves_with_path, tree_map_with_path

from gnio_jax.config import (
    ConsideredStd,
    CorrelatedError,
    DataConfig,
    FilterSettings,
    InitialStd,
    NoiseModel,
)
from gnio_jax.config.files import bounds, named
from gnio_jax.config.schema import SHARE
from gnio_jax.filtering.config import FilterConfig

jax.tree_util.register_dataclass(
    FilterSettings,
    data_fields=["noise", "start", "considered"],
    meta_fields=["mahalanobis_fail_scale", "window_rotation"],
)

LARGEST_SHARE = 0.9999
"""Largest share that is written down: rounding must not make it 1."""


class FilterSetup(NamedTuple):
    """A filter as the settings ask for it."""

    config: FilterConfig
    noise: NoiseModel
    initial_std: InitialStd
    considered: ConsideredStd | None = None
    """Of errors that the filter does not estimate; None: there are none."""


def filter_setup(windows: DataConfig, settings: FilterSettings) -> FilterSetup:
    """The filter for the windows and strides that a network was trained with."""
    considered = settings.considered if any(settings.considered) else None
    config = filter_config(windows, settings)
    return FilterSetup(config, settings.noise, settings.start, considered)


def filter_config(windows: DataConfig, settings: FilterSettings) -> FilterConfig:
    """What is fixed when the filter is compiled. The numbers of the settings may be traced."""
    return FilterConfig(
        dt=1.0 / windows.rate,
        samples_per_clone=windows.stride,
        clones_per_window=windows.window // windows.stride,
        context_samples=windows.context,
        mahalanobis_fail_scale=settings.mahalanobis_fail_scale,
        history="core",
        window_rotation=settings.window_rotation or windows.window_rotation,
    )


def free_parameters(settings: FilterSettings, paths: Iterable[str]) -> dict[str, float]:
    """The numbers of some settings without bounds, in which they are fitted and trained: a share's
    logit, the logarithm of all else.

    Each of the `paths` names a number ("noise.gyro_density") or a section of them ("noise"). A
    number that is 0 is switched off, and has none.
    """
    wanted = tuple(paths)
    values = {_name(path): value for path, value in tree_leaves_with_path(settings)}
    return {
        name: math.log(value) - (math.log1p(-value) if name in _SHARES else 0.0)
        for name, value in values.items()
        if value > 0 and any(is_below(name, path) for path in wanted)
    }


def is_below(name: str, path: str) -> bool:
    """Whether the number `name` is the one of this path, or in the section of this path."""
    return f"{name}.".startswith(f"{path}.")


def with_free_parameters(settings: FilterSettings, free: Mapping[str, Any]) -> FilterSettings:
    """The settings with the values, float64, of these free parameters. Differentiable."""

    def value(path: Any, old: Any) -> Any:
        name = _name(path)
        if name not in free:
            return old
        number = jnp.asarray(free[name], jnp.float64)
        return jax.nn.sigmoid(number) if name in _SHARES else jnp.exp(number)

    return tree_map_with_path(value, settings)


def with_written_parameters(
    settings: FilterSettings, free: Mapping[str, Any], digits: int
) -> FilterSettings:
    """The settings with the values of these free parameters as they are written down, as floats of
    so many digits."""

    def value(path: Any, old: Any) -> Any:
        name = _name(path)
        if name not in free:
            return old
        number = float(free[name])
        natural = 1 / (1 + math.exp(-number)) if name in _SHARES else math.exp(number)
        written = float(f"{natural:.{digits}g}")
        return min(written, LARGEST_SHARE) if name in _SHARES else written

    return tree_map_with_path(value, settings)


def _name(path: Any) -> str:
    return keystr(path, simple=True, separator=".")


_SHARES = {
    name
    for name, hint, _ in named(FilterSettings(NoiseModel(correlation=CorrelatedError())))
    if SHARE in bounds(hint)
}
"""Numbers that lie between 0 and 1, as their bounds say; the others are positive."""
