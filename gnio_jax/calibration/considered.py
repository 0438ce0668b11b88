"""The errors that the filter is to consider, fitted to those of its positions."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from gnio_jax.calibration.likelihood import Walks, free_vector
from gnio_jax.calibration.unknowns import CONSIDERED, DIGITS, PRIOR_STD
from gnio_jax.config import DataConfig, FilterOptions
from gnio_jax.errors import InputError
from gnio_jax.filtering import (
    ConsideredStd,
    considered_covariance,
    initial_state,
    over_sequences,
    repeat_odometry,
    sensitivity,
)
from gnio_jax.filtering.history import POSITION
from gnio_jax.filtering.options import considered_std, filter_with, switches_and_numbers
from gnio_jax.filtering.unconstrained import natural, with_numbers
from gnio_jax.training.filter_losses import gaussian_nll, normalised_squares
from gnio_jax.types import Array

TOGETHER_SECONDS = 10.0
"""Errors of the position this far apart count as independent beside the prior (ours)."""


class Considered(NamedTuple):
    """The errors to be considered."""

    options: FilterOptions
    before: float
    """Mean over all positions of eᵀ P⁻¹ e / 3 with none."""
    after: float
    """The same with `options`."""


class Positions(NamedTuple):
    """Of all recordings, where there is a reference; axis 0: the rows."""

    error: Float[np.ndarray, "k 3"]
    """Truth − estimate, m."""
    covariance: Float[np.ndarray, "k 3 3"]
    """Of the filter, m²."""
    sensitivity: Float[np.ndarray, "k 3 6"]
    """S of the position."""


def fit_considered(
    positions: Positions, stride_seconds: float, options: FilterOptions
) -> Considered:
    """The standard deviations of the errors that the filter leaves out, which make the errors of
    its positions most likely; there is one every `stride_seconds`.

    The search begins at `CONSIDERED`, whatever the options say. Raises `InputError` where there is
    no position with a reference, or no likelihood.
    """
    if not len(positions.error):
        raise InputError("the filter", "is not healthy where these recordings have a reference")
    start = free_vector(dataclasses.replace(options, **CONSIDERED), tuple(CONSIDERED))
    independent = len(positions.error) * stride_seconds / TOGETHER_SECONDS

    def objective(free: Float[Array, "u"]) -> Array:
        std = considered_std(natural(dict(zip(CONSIDERED, free, strict=True))))
        prior = 0.5 * jnp.sum(((free - start) / PRIOR_STD) ** 2)
        return gaussian_nll(positions.error, with_considered(positions, std)) + prior / independent

    compiled = jax.jit(jax.value_and_grad(objective))
    found = minimize(
        lambda free: jax.device_get(compiled(free)), start, jac=True, method="L-BFGS-B"
    )
    if not np.isfinite(found.fun):
        raise InputError("the filter", "has a covariance on these recordings that is not one")
    fitted = with_numbers(options, dict(zip(CONSIDERED, found.x, strict=True)), DIGITS)
    before, after = (
        float(_nees_per_axis(positions.error, covariance))
        for covariance in (
            positions.covariance,
            with_considered(positions, considered_std(vars(fitted))),
        )
    )
    return Considered(fitted, before, after)


@jax.jit
def _nees_per_axis(
    error: Float[Array, "k 3"], covariance: Float[Array, "k 3 3"]
) -> Float[Array, ""]:
    """Mean over all positions of eᵀ P⁻¹ e / 3."""
    return jnp.mean(normalised_squares(error, covariance)) / 3


@jax.jit
def with_considered(positions: Positions, std: ConsideredStd) -> Float[Array, "k 3 3"]:
    """Covariances of the positions with the errors that are considered, m²."""
    return positions.covariance + considered_covariance(positions.sensitivity, std)


def filtered_positions(
    walks: Walks, truth: Float[np.ndarray, "w k 3"], windows: DataConfig, options: FilterOptions
) -> Positions:
    """The positions of a filter over the walks, where it is healthy.

    `truth` has the true ones after each stride, m; NaN where there is none.
    """
    switches, numbers = switches_and_numbers(options)
    of_all = _filtered(walks, numbers, windows=windows, switches=switches)
    healthy, position, covariance, of_position = jax.device_get(of_all)
    error = truth - position
    known = np.isfinite(error).all(axis=2) & (healthy > 0)
    return Positions(error[known], covariance[known], of_position[known])


@functools.partial(jax.jit, static_argnames=("windows", "switches"))
def _filtered(
    walks: Walks, numbers: dict[str, Any], *, windows: DataConfig, switches: FilterOptions
) -> tuple[Array, Array, Array, Array]:
    """Of every walk: where the filter is healthy, its positions, their covariances and S."""
    setup = filter_with(windows, switches, numbers)

    def of_walk(walk: Walks) -> tuple[Array, Array, Array, Array]:
        pose = (walk.rotation, walk.velocity, walk.position, walk.gyro_bias)
        state = initial_state(setup.config, *pose, std=setup.initial_std)
        run = state, walk.gyro, walk.accel
        fixed = setup.config, setup.noise, walk.imu_valid
        told = walk.displacement, walk.std
        _, history = repeat_odometry(*run, *told, *fixed)
        found = sensitivity(*run, history, *fixed)
        assert history.covariance is not None
        covariance = history.covariance[:, POSITION, POSITION]
        return history.healthy, history.position, covariance, found[:, POSITION]

    return over_sequences(of_walk)(walks)
