"""The likelihood of the filter's innovations, and the options that make it largest."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.optimize import minimize

from gnio_jax.calibration.unknowns import DIGITS, PRIOR_STD
from gnio_jax.config import DataConfig, FilterOptions
from gnio_jax.errors import InputError
from gnio_jax.filtering import initial_state, over_sequences, repeat_odometry
from gnio_jax.filtering.options import FilterSetup, filter_with, switches_and_numbers
from gnio_jax.filtering.unconstrained import natural, unconstrained, with_numbers
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
    imu_valid: Bool[np.ndarray, "w t"] | None = None
    """Which samples are there; None: all."""


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
    walks: Walks, windows: DataConfig, options: FilterOptions, unknowns: tuple[str, ...]
) -> Callable[[Float[Array, "u"]], tuple[Array, Array]]:
    """As a function of the numbers without bounds of some of the options: what is to be made small,
    and the part of it that is −log-likelihood of all innovations over their number. The rest is the
    prior that keeps those in place of which the walks say nothing."""
    switches, numbers = switches_and_numbers(options)
    given = _Given(walks, free_vector(options, unknowns), numbers)
    fixed = {"windows": windows, "switches": switches, "unknowns": unknowns}
    return lambda free: _objective(free, given, **fixed)


class _Given(NamedTuple):
    """What the objective is told beside the numbers that are sought. Arguments of its program: what
    one calibration compiles serves the next."""

    walks: Walks
    start: Float[np.ndarray, "u"]
    numbers: dict[str, float]
    """Of the options (`switches_and_numbers`)."""


def _objective(
    free: Float[Array, "u"],
    given: _Given,
    *,
    windows: DataConfig,
    switches: FilterOptions,
    unknowns: tuple[str, ...],
) -> tuple[Array, Array]:
    """`innovation_objective`."""
    sought = natural(dict(zip(unknowns, free, strict=True)))
    setup = filter_with(windows, switches, {**given.numbers, **sought})
    evidence = _log_likelihood(given.walks, setup)
    prior = 0.5 * jnp.sum(((free - given.start) / PRIOR_STD) ** 2)
    count = jnp.isfinite(given.walks.displacement).all(axis=2).sum()
    return (prior - evidence) / count, -evidence / count


_value_and_gradient = jax.jit(
    jax.value_and_grad(_objective, has_aux=True),
    static_argnames=("windows", "switches", "unknowns"),
)


def free_vector(options: FilterOptions, unknowns: tuple[str, ...]) -> Float[np.ndarray, "u"]:
    """The numbers without bounds of some of the options, in this order."""
    return np.array(list(unconstrained(options, unknowns).values()))


def _log_likelihood(walks: Walks, setup: FilterSetup) -> Array:
    """Of all innovations, with a filter whose noise and start may be traced."""
    config = dataclasses.replace(
        setup.config,
        gate_threshold=NO_GATE,
        history="diagonal",
        checkpoint_every=CHECKPOINT_EVERY,
    )

    def of_walk(given: tuple[Any, Any], walk: Walks) -> Array:
        noise, std = given
        pose = (walk.rotation, walk.velocity, walk.position, walk.gyro_bias)
        state = initial_state(config, *pose, std=std)
        told = walk.displacement, walk.std
        run = state, walk.gyro, walk.accel
        _, history = repeat_odometry(*run, *told, config, noise, walk.imu_valid)
        # What the walk is filled up with comes after its last displacement, and may run away.
        told = jnp.isfinite(walk.displacement).all(axis=1)
        healthy = jnp.all((history.healthy > 0) | ~told)
        return jnp.where(healthy, jnp.nansum(history.log_likelihood), jnp.nan)

    return jnp.sum(over_sequences(of_walk, shared=1)((setup.noise, setup.initial_std), walks))


def fit(
    walks: Walks,
    windows: DataConfig,
    options: FilterOptions,
    unknowns: tuple[str, ...],
    progress: Callable[[int], None],
    most_steps: int = 60,
) -> Fit:
    """The options that make the innovations most likely, by L-BFGS from `options`.

    A step to where the filter fails counts as very unlikely, and the search turns back. Raises
    `InputError` where it fails with `options`.
    """
    switches, numbers = switches_and_numbers(options)
    start = free_vector(options, unknowns)
    given = jax.device_put(_Given(walks, start, numbers))
    fixed = {"windows": windows, "switches": switches, "unknowns": unknowns}
    evidences: list[float] = []
    """Of every call, the first of which is at the start."""

    def evaluate(free: np.ndarray) -> tuple[float, np.ndarray]:
        (value, evidence), gradient = jax.device_get(_value_and_gradient(free, given, **fixed))
        sound = np.isfinite(value) and np.isfinite(gradient).all()
        evidences.append(float(evidence) if sound else FAILED)
        progress(len(evidences))
        if not sound:
            return FAILED, np.zeros_like(free)
        return float(value), np.asarray(gradient, float)

    limits = {"maxiter": most_steps, "ftol": 1e-7}
    found = minimize(evaluate, start, jac=True, method="L-BFGS-B", options=limits)
    if evidences[0] == FAILED:
        raise InputError("the filter", "fails on these recordings with the options of the run")
    fitted = with_numbers(options, dict(zip(unknowns, found.x, strict=True)), DIGITS)
    before = evidences[0]
    evaluate(free_vector(fitted, unknowns))
    return Fit(fitted, before, evidences[-1], int(found.nit))
