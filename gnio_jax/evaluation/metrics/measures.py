"""Every metric of one sequence, from a table of metrics."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.evaluation.metrics.absolute import ate, ate_mean, ate_ronin, drift
from gnio_jax.evaluation.metrics.alignment import NOT_FINITE, AlignmentMethod, align
from gnio_jax.evaluation.metrics.consistency import (
    COVERAGES,
    coverage,
    mean_normalised,
    position_nees,
)
from gnio_jax.evaluation.metrics.heading import yaw_drift, yaw_rmse
from gnio_jax.evaluation.metrics.movement import path_length, path_length_ratio, stationary_drift
from gnio_jax.evaluation.metrics.relative import rpe, rpe_se3, rte, rte_distance, rte_ronin
from gnio_jax.evaluation.metrics.trajectory import (
    Positions,
    Trajectory,
    Undefined,
    finite_poses,
)
from gnio_jax.numerics import finite_rows

TOO_LARGE = "the error is too large for a number"
"""How the reason of a metric begins that no float64 holds."""


class Measures(NamedTuple):
    """The metrics of one sequence."""

    values: dict[str, float | None]
    """Metric -> value; None where it is not defined; errors are infinite where the estimate
    diverged (`diverged`)."""
    undefined: dict[str, str]
    """Metric -> reason, for those without a value and those that are infinite or, of an estimate
    that diverged, a coverage of 0."""


class Comparison(NamedTuple):
    """One sequence as its metrics see it."""

    estimate: Trajectory
    """As the estimator gives it."""
    aligned: Trajectory
    """Under the alignment asked for."""
    start_aligned: Trajectory
    """Under alignment `origin`."""
    reference: Trajectory
    """At the estimate's stamps, NaN where it cannot be trusted."""
    covariance: Float[np.ndarray, "n 3 3"] | None
    """Of the position, m², where there is a filter."""
    nis: Float[np.ndarray, "k"] | None
    """Normalised innovation squared, where there is a filter."""
    step: float
    """Time between rows, s."""
    dims: int = 3
    """3, or 2 for the horizontal metrics."""

    @property
    def position(self) -> Positions:
        """Of the estimate, without alignment."""
        return self.estimate.position[:, : self.dims]

    @property
    def aligned_position(self) -> Positions:
        return self.aligned.position[:, : self.dims]

    @property
    def true_position(self) -> Positions:
        return self.reference.position[:, : self.dims]

    @property
    def nees(self) -> Float[np.ndarray, "n"]:
        """Of the position, in the filter's frame."""
        assert self.covariance is not None
        return position_nees(
            self.start_aligned, self.estimate, self.reference, self.covariance, self.dims
        )


Metric = Callable[[Comparison], float]
"""Raises `Undefined` with the reason where it has no value."""

SPATIAL: dict[str, Metric] = {
    "ate": lambda c: ate(c.aligned_position, c.true_position),
    "ate_ronin": lambda c: ate_ronin(c.aligned_position, c.true_position),
    "ate_mean": lambda c: ate_mean(c.aligned_position, c.true_position),
    "rte_60s": lambda c: rte(c.aligned_position, c.true_position, c.step),
    "rte_60s_ronin": lambda c: rte_ronin(c.aligned_position, c.true_position, c.step),
    "rte_1m": lambda c: rte_distance(c.aligned_position, c.true_position, 1.0),
    "rte_10m": lambda c: rte_distance(c.aligned_position, c.true_position, 10.0),
    "rpe_1s": lambda c: rpe(c.estimate, c.reference, c.step, 1.0, c.dims),
    "rpe_10s": lambda c: rpe(c.estimate, c.reference, c.step, 10.0, c.dims),
    "rpe_se3": lambda c: rpe_se3(c.estimate, c.reference, c.step, 1.0, c.dims),
    "drift": lambda c: drift(c.aligned_position, c.true_position, c.step),
    "path_length_ratio": lambda c: path_length_ratio(c.position, c.true_position, c.step),
    "stationary_drift": lambda c: stationary_drift(c.position, c.true_position, c.step),
}
"""In 3-D and in 2-D."""
POSITION_CONSISTENCY: dict[str, Metric] = {
    "nees": lambda c: mean_normalised(c.nees, c.dims),
    "nees_coverage": lambda c: coverage(c.nees, c.dims),
}
"""In 3-D and in 2-D, of an estimate with a covariance."""
HEADING: dict[str, Metric] = {
    "yaw_rmse": lambda c: yaw_rmse(c.aligned.orientation, c.reference.orientation),
    "yaw_drift": lambda c: yaw_drift(c.estimate.orientation, c.reference.orientation, c.step),
}
OF_REFERENCE: dict[str, Metric] = {"path_length": lambda c: path_length(c.true_position, c.step)}
"""The same whatever the estimate."""
OF_MEASUREMENTS: dict[str, Metric] = {
    "nis": lambda c: mean_normalised(_present_nis(c), 3),
    "nis_coverage": lambda c: coverage(_present_nis(c), 3),
}
"""Need no reference."""
NAMES = (
    *(f"{name}{tag}" for tag in ("", "_2d") for name in (SPATIAL | POSITION_CONSISTENCY)),
    *HEADING,
    *OF_MEASUREMENTS,
)
"""Every metric of an estimate."""


def measure(
    estimate: Trajectory,
    reference: Trajectory,
    alignment: AlignmentMethod = "origin",
    position_covariance: Float[np.ndarray, "n 3 3"] | None = None,
    nis: Float[np.ndarray, "k"] | None = None,
) -> Measures:
    """Every metric of one sequence, in 3-D under its plain name and horizontally as `<name>_2d`.

    `reference` has the estimate's stamps and NaN where it cannot be trusted. The absolute metrics,
    `rte_*` and `yaw_rmse` see the estimate under `alignment`; `se3` is fitted in 3-D for the
    horizontal ones too. `nees` is taken in the frame of the filter, whose covariance is relative to
    its start, so with the start aligned whatever `alignment` is.

    An estimate with a row that is not finite has diverged. Every metric that a finite one would
    have is then infinite (a coverage 0), with the reason in `undefined`; so is one that is too
    large for a number.
    """
    divergence = _divergence(estimate)
    # Which metrics there would be depends on the reference: a finite stand-in finds out.
    path = _at_rest(estimate) if divergence else estimate
    comparison, not_aligned = _compare(path, _trusted(reference), alignment)
    comparison = comparison._replace(covariance=position_covariance, nis=nis)
    values: dict[str, float | None] = {"duration": float(estimate.time[-1] - estimate.time[0])}
    undefined: dict[str, str] = {}
    for name, metric, seen in _metrics(comparison):
        values[name], reason = _value(
            name,
            metric,
            seen,
            missing=not_aligned if name not in OF_MEASUREMENTS else "",
            divergence=divergence if name not in OF_REFERENCE else "",
        )
        if reason:
            undefined[name] = reason
    return Measures(values, undefined)


def is_infinite(reason: str) -> bool:
    """Whether a reason in `Measures.undefined` is that of an infinite value."""
    return reason.startswith((NOT_FINITE, TOO_LARGE))


def diverged(values: Mapping[str, float | None]) -> bool:
    """Whether the estimate of a sequence diverged: its `ate` is infinite or, where there is none
    for want of a reference, anything else is. An infinite NEES alone is a bad covariance."""
    error = values.get("ate")
    return math.inf in values.values() if error is None else math.isinf(error)


def _trusted(reference: Trajectory) -> Trajectory:
    """Both parts of a pose NaN where the position is."""
    good = finite_rows(reference.position)[:, None]
    poses = (np.where(good, part, np.nan) for part in (reference.position, reference.orientation))
    return Trajectory(reference.time, *poses)


def _divergence(estimate: Trajectory) -> str:
    """Why the estimate's errors are infinite; empty where it is finite throughout."""
    finite = finite_poses(estimate)
    if finite.all():
        return ""
    return f"{NOT_FINITE} from {estimate.time[np.argmin(finite)] - estimate.time[0]:.1f} s on"


def _at_rest(estimate: Trajectory) -> Trajectory:
    """Level at the origin throughout."""
    level = np.tile([1.0, 0, 0, 0], (len(estimate.time), 1))
    return Trajectory(estimate.time, np.zeros_like(estimate.position), level)


def _compare(
    estimate: Trajectory, reference: Trajectory, alignment: AlignmentMethod
) -> tuple[Comparison, str]:
    """The estimate beside its reference; with the reason where it cannot be aligned."""
    aligned, start_aligned, reason = estimate, estimate, ""
    try:
        aligned, start_aligned = (align(estimate, reference, how) for how in (alignment, "origin"))
    except Undefined as undefined:
        reason = str(undefined)
    step = float(np.median(np.diff(estimate.time))) if len(estimate.time) > 1 else 1.0
    return Comparison(estimate, aligned, start_aligned, reference, None, None, step), reason


def _metrics(comparison: Comparison) -> Iterator[tuple[str, Metric, Comparison]]:
    """Name, metric and what it is of, in the order of the files."""
    spatial = SPATIAL | (POSITION_CONSISTENCY if comparison.covariance is not None else {})
    for dims, tag in ((3, ""), (2, "_2d")):
        seen = comparison._replace(dims=dims)
        yield from ((name + tag, metric, seen) for name, metric in spatial.items())
    others = HEADING | OF_REFERENCE | (OF_MEASUREMENTS if comparison.nis is not None else {})
    yield from ((name, metric, comparison) for name, metric in others.items())


def _value(
    name: str, metric: Metric, comparison: Comparison, missing: str, divergence: str
) -> tuple[float | None, str]:
    """Value of one metric, and the reason where it has none or is not finite."""
    if missing:
        return None, missing
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # TOO_LARGE says so
            value = metric(comparison)
    except Undefined as undefined:
        return None, str(undefined)
    infinite = divergence or ("" if np.isfinite(value) else TOO_LARGE)
    if infinite:
        return (0.0 if name in COVERAGES else math.inf), infinite
    return value, ""


def _present_nis(comparison: Comparison) -> Float[np.ndarray, "k"]:
    assert comparison.nis is not None
    return comparison.nis
