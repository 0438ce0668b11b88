"""The filter that an experiment's settings describe, and its numbers as free parameters."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.tree_util import keystr, tree_leaves_with_path

from gnio_jax.config import ConsideredStd, DataConfig, FilterSettings, InitialStd, NoiseModel
from gnio_jax.filtering.config import FilterConfig

jax.tree_util.register_dataclass(
    FilterSettings,
    data_fields=["noise", "start", "considered"],
    meta_fields=["raw_gyro_bias", "mahalanobis_fail_scale", "window_rotation"],
)

SHARE = "noise.correlation.share"
"""The number that lies between 0 and 1; the others are positive."""
LARGEST_SHARE = 0.9999
"""Largest share that is written down: rounding must not make it 1."""


class FilterSetup(NamedTuple):
    """A filter as the settings ask for it."""

    config: FilterConfig
    noise: NoiseModel
    initial_std: InitialStd
    considered: ConsideredStd | None = None
    """Of errors that the filter does not estimate; None: there are none."""
    raw_gyro_bias: float | None = None
    """Standard deviation of the first bias of a gyro whose phone takes none off, rad/s."""


def filter_setup(windows: DataConfig, settings: FilterSettings) -> FilterSetup:
    """The filter for the windows and strides that a network was trained with."""
    considered = settings.considered if any(settings.considered) else None
    config = filter_config(windows, settings)
    return FilterSetup(config, settings.noise, settings.start, considered, settings.raw_gyro_bias)


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
    return {
        name: math.log(value) - (math.log1p(-value) if name == SHARE else 0.0)
        for name, value in _numbers(settings).items()
        if value > 0 and any(is_below(name, path) for path in wanted)
    }


def is_below(name: str, path: str) -> bool:
    """Whether the number `name` is the one of this path, or in the section of this path."""
    return f"{name}.".startswith(f"{path}.")


def with_free_parameters(settings: FilterSettings, free: Mapping[str, Any]) -> FilterSettings:
    """The settings with the values, float64, of these free parameters. Differentiable."""
    names, structure = _numbers(settings), jax.tree.structure(settings)
    for name in names.keys() & free.keys():
        number = jnp.asarray(free[name], jnp.float64)
        names[name] = jax.nn.sigmoid(number) if name == SHARE else jnp.exp(number)
    return jax.tree.unflatten(structure, names.values())


def with_written_parameters(
    settings: FilterSettings, free: Mapping[str, Any], digits: int
) -> FilterSettings:
    """The settings with the values of these free parameters as they are written down, as floats of
    so many digits."""
    names = _numbers(with_free_parameters(settings, free))
    for name in names.keys() & free.keys():
        written = float(f"{float(names[name]):.{digits}g}")
        names[name] = min(written, LARGEST_SHARE) if name == SHARE else written
    return jax.tree.unflatten(jax.tree.structure(settings), names.values())


def _numbers(settings: FilterSettings) -> dict[str, Any]:
    """The numbers of the settings by their paths."""
    leaves = tree_leaves_with_path(settings)
    return {keystr(path, simple=True, separator="."): value for path, value in leaves}
