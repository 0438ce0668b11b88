"""The likelihood of the filter's innovations, and the options that make it largest."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import minimize

from gnio_jax.calibration.unknowns import PRIOR_STD, Unknown, from_free, to_free, written
from gnio_jax.config import DataConfig, FilterOptions
from gnio_jax.errors import InputError
from gnio_jax.evaluation import filter_setup
from gnio_jax.filtering import FilterConfig, initial_state, over_sequences, repeat_odometry
from gnio_jax.filtering.options import initial_std, noise_model
from gnio_jax.types import Array

CHECKPOINT_EVERY = 50
"""Clone intervals between the states that the backward pass keeps."""
FAILED = 1e6
"""What the search sees where the filter fails: it turns back."""
NO_GATE = 1e9
"""Threshold of a χ² gate that lets everything through: one that rejects would reward a noise so
small that everything is rejected."""


class Walks(NamedTuple):
    """Recordings with the network's displacements, padded to one length. Axis 0: the recording."""

    rotation: Float[np.ndarray, "w 3 3"]
    """At the start, body → world."""
    velocity: Float[np.ndarray, "w 3"]
    """At the start, m/s."""
    position: Float[np.ndarray, "w 3"]
    """At the start, m."""
    gyro_bias: Float[np.ndarray, "w 3"]
    """First estimate, rad/s."""
    gyro: Float[np.ndarray, "w t 3"]
    """rad/s."""
    accel: Float[np.ndarray, "w t 3"]
    """m/s²."""
    displacement: Float[np.ndarray, "w k 3"]
    """Of the network, m, in the filter's own yaw frame; NaN where there is none."""
    std: Float[np.ndarray, "w k 3"]
    """Of the network, m; 1 where there is none."""


class Fit(NamedTuple):
    """Where the likelihood is largest."""

    options: FilterOptions
    before: float
    """−log-likelihood per innovation at the start of the fit, when the factors of the axes are
    there."""
    after: float
    """The same with `options`."""
    steps: int


def innovation_objective(
    walks: Walks, windows: DataConfig, options: FilterOptions, unknowns: tuple[Unknown, ...]
) -> Callable[[Array], tuple[Array, Array]]:
    """As a function of the unknowns without bounds: what is to be made small, and the part of it
    that is −log-likelihood of all innovations over their number. The rest is the prior that keeps
    those in place of which the walks say nothing."""
    start = to_free(options, unknowns)
    count = np.isfinite(walks.displacement).all(2).sum()
    fixed = dataclasses.replace(options, measurement_scale=1.0)
    config = dataclasses.replace(
        filter_setup(windows, fixed).config,
        gate_threshold=NO_GATE,
        history="diagonal",
        checkpoint_every=CHECKPOINT_EVERY,
    )

    def objective(free: Array) -> tuple[Array, Array]:
        evidence = _log_likelihood(walks, config, vars(options) | from_free(free, unknowns))
        prior = 0.5 * jnp.sum(((free - start) / PRIOR_STD) ** 2)
        return (prior - evidence) / count, -evidence / count

    return objective


def _log_likelihood(walks: Walks, config: FilterConfig, options: Mapping[str, Any]) -> Array:
    """Of all innovations, with options whose values may be traced."""
    noise, std = noise_model(options), initial_std(options)
    factor = jnp.sqrt(jnp.asarray(options["measurement_scale"]))

    def of_walk(given: tuple[Any, Any, Any], walk: Walks) -> Array:
        factor, noise, std = given
        pose = (walk.rotation, walk.velocity, walk.position, walk.gyro_bias)
        state = initial_state(config, *pose, std=std)
        told = walk.displacement, factor * walk.std
        _, history = repeat_odometry(state, walk.gyro, walk.accel, *told, config, noise)
        # What the walk is filled up with comes after its last displacement, and may run away.
        told = jnp.isfinite(walk.displacement).all(axis=1)
        healthy = jnp.all((history.healthy > 0) | ~told)
        return jnp.where(healthy, jnp.nansum(history.log_likelihood), jnp.nan)

    return jnp.sum(over_sequences(of_walk, shared=1)((factor, noise, std), walks))


def fit(
    walks: Walks,
    windows: DataConfig,
    options: FilterOptions,
    unknowns: tuple[Unknown, ...],
    progress: Callable[[int], None],
    most_steps: int = 60,
) -> Fit:
    """The options that make the innovations most likely, by L-BFGS from `options`.

    A step to where the filter fails counts as very unlikely, and the search turns back. Raises
    `InputError` where it fails with `options`.
    """
    objective = innovation_objective(walks, windows, options, unknowns)
    compiled = jax.jit(jax.value_and_grad(objective, has_aux=True))
    calls = 0

    def evaluate(free: np.ndarray) -> tuple[float, float, np.ndarray]:
        nonlocal calls
        calls += 1
        progress(calls)
        (value, evidence), gradient = jax.device_get(compiled(free))
        if not (np.isfinite(value) and np.isfinite(gradient).all()):
            return FAILED, FAILED, np.zeros_like(free)
        return float(value), float(evidence), np.asarray(gradient, float)

    start = to_free(options, unknowns)
    _, before, _ = evaluate(start)
    if before == FAILED:
        raise InputError("the filter", "fails on these recordings with the options of the run")
    found = minimize(
        lambda free: evaluate(free)[::2],
        start,
        jac=True,
        method="L-BFGS-B",
        options={"maxiter": most_steps, "ftol": 1e-7},
    )
    fitted = written(options, from_free(jnp.asarray(found.x), unknowns))
    _, after, _ = evaluate(to_free(fitted, unknowns))
    return Fit(fitted, before, after, int(found.nit))
