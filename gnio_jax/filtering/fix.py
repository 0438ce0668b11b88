"""A fix of position as a measurement (ours): from a satellite receiver, a beacon, or a map on which
somebody taps their position.

The time t of a fix is arbitrary. The fix is measured at the end of a clone interval, where the
velocity times a = t_end − t is subtracted from the position:

    z = p − a v + w + b v,   w ~ N(0, R),   b ~ N(0, σ_t²),

where b is the error of the time of the fix, e.g. of a tap that comes early or late. At the nearest
end |a| is at most half an interval, in which an acceleration changes the position by a few
millimetres.

A fix may lack components, e.g. the height. Those that it has are a measurement of fewer numbers.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erfc, ndtri
from jaxtyping import Bool, Float

from gnio_jax.errors import InputError
from gnio_jax.filtering.readings import interval_ends
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.state import FilterState
from gnio_jax.filtering.update import Correction, Outcome, Step, linearise, measure, whiten
from gnio_jax.types import Array

THRESHOLDS = {2: 9.210, 3: 11.345}
"""99 % of χ² with 2 and with 3 degrees of freedom."""
ASYMMETRY = 1e-6
"""Largest difference of a covariance from its transpose, relative to its largest entry."""


class Fix(NamedTuple):
    """A horizontal (m = 2) or a three-dimensional position (m = 3), or a row for each of K clone
    intervals. It is an entry of `measurements` of `run_filter`, `run_odometry` and `smooth`.

    Fixes without any displacement show a yaw that is uncertain by more than 0.2 rad less well than
    the covariance says (docs/filter.md).

    Outside `jit` these three refuse a fix with impossible numbers, naming the field. Inside `jit`,
    where values are not known, such a fix counts as missing.
    """

    position: Float[Array, "*k m"]
    """World frame, m; NaN where there is none. A component that is NaN is missing, and the others
    are used."""
    covariance: Float[Array, "*k m m"]
    """R, m². Rows and columns of missing components may be anything."""
    before_end: Float[Array, "*k"]
    """a, the time from the fix to the end of its clone interval, s; negative if the fix is after
    the end."""
    time_std: Float[Array, "*k"]
    """σ_t, s."""
    threshold: Float[Array, "*k"]
    """Largest rᵀ S⁻¹ r of all m components that passes; inf: every fix does. A fix that lacks
    components must pass the test of the same probability (`threshold_of`)."""
    name = "fix"

    def update(self, state: FilterState, step: Step) -> tuple[FilterState, Outcome, Correction]:
        """A fix is refused if it fails the χ² test against the filter's prediction. So a fix that
        jumps by a kilometre changes nothing. A good fix changes nothing either if the covariance of
        the filter is much too small.

        A missing component has no residual, no Jacobian and a variance of 1 that is correlated with
        nothing: it adds nothing to the estimate, to rᵀ S⁻¹ r or to det S.
        """
        axes, dtype = self.position.shape[0], state.offset.dtype
        fix = jax.tree.map(lambda part: jnp.asarray(part, dtype), self)
        present = jnp.isfinite(fix.position) & ~improper(fix)
        pairs, eye = present[:, None] & present[None], jnp.eye(axes, dtype=dtype)
        # No NaN may enter the arithmetic, because otherwise the derivatives would be NaN too.
        position = jnp.where(present, fix.position, 0.0)
        before_end = jnp.where(present.any(), fix.before_end, 0.0)
        time_std = jnp.where(present.any(), fix.time_std, 0.0)
        by_position = jnp.where(present[:, None], np.eye(3, dtype=dtype)[:axes], 0.0)

        velocity = state.velocity[:axes]
        expected = state.position[:axes] - before_end * velocity
        time_error = jnp.where(present, time_std * velocity, 0.0)
        residual = jnp.where(present, position - expected, 0.0)
        linear = linearise(
            state,
            jnp.where(present.any(), residual, jnp.nan),
            jnp.where(pairs, fix.covariance, eye) + time_error[:, None] * time_error[None],
            position=by_position,
            velocity=-before_end * by_position,
        )
        threshold = threshold_of(present, fix.threshold)
        return measure(state, linear, step, threshold, frame="world")


def improper(fix: Fix) -> Bool[Array, ""]:
    """Whether one fix has impossible numbers: its covariance is not symmetric and positive
    definite, or another number is NaN or out of bounds."""
    present = jnp.isfinite(fix.position)
    pairs = present[:, None] & present[None]
    covariance = jax.lax.stop_gradient(jnp.where(pairs, fix.covariance, jnp.eye(len(present))))
    skew = jnp.abs(covariance - covariance.T).max()
    _, volume = whiten(covariance, ())  # NaN where it is not positive definite
    return ~(
        (skew <= ASYMMETRY * jnp.abs(covariance).max())
        & jnp.isfinite(volume)
        & jnp.isfinite(fix.before_end)
        & (fix.time_std >= 0)
        & jnp.isfinite(fix.time_std)
        & (fix.threshold > 0)
    )


def threshold_of(present: Bool[Array, "m"], threshold: Float[Array, ""]) -> Float[Array, ""]:
    """The quantile of χ² with as many degrees of freedom as there are components, at the
    probability at which `threshold` is that of χ² with all m = 2 or 3.

    The tails are erfc(√(q/2)) with one degree, e^(−q/2) with two, and with three the first and
    √(2 q/π) times the second.
    """
    count, is_tested = present.sum(), jnp.isfinite(threshold)

    def of_fewer() -> Array:
        half = 0.5 * jnp.where(is_tested, threshold, 1.0)
        tail = jnp.exp(-half)
        if len(present) == 3:
            tail = erfc(jnp.sqrt(half)) + 2 * jnp.sqrt(half / np.pi) * tail
        return jnp.where(count == 1, ndtri(0.5 * tail) ** 2, -2 * jnp.log(tail))

    # A branch, because otherwise XLA computes the tails for every entry of the covariance.
    return jax.lax.cond((count < len(present)) & is_tested, of_fewer, lambda: threshold)


def fixes_on_intervals(
    time: Any,
    position: Any,
    covariance: Any,
    intervals: int,
    config: FilterConfig,
    start: float = 0.0,
    time_std: Any = 0.0,
    threshold: float | None = None,
) -> Fix:
    """Fixes of position, each in the row of the clone interval whose end is nearest.

    A fix without any component is ignored. Several fixes in one row become their mean, component by
    component over those that have it, with the covariance of this mean; their time is their mean
    time. The weights are the inverses of their mean variances.

    Args:
        time: (f,) stamps in any order, s, on the clock of `start`.
        position: (f, m) positions in the world, m, with m = 2 (horizontal) or 3. A component that
            is NaN is missing, with its rows and columns of the covariance.
        covariance: (f, m, m) covariances, m².
        intervals: Number K of clone intervals. A fix during the samples that follow them, which are
            less than another one, is in the last row.
        config: The settings of the filter, for the length of an interval.
        start: Stamp of the first IMU sample, s.
        time_std: Standard deviation of the stamps, s, one number or (f,).
        threshold: Largest χ² of a fix that is used; None: the quantile of 99 %.

    Raises:
        InputError: A shape differs, a covariance is not symmetric and positive definite, a
            `time_std` is below 0, a fix is outside of the recording, or there is no interval.
    """
    time, position, covariance = (np.asarray(x, np.float64) for x in (time, position, covariance))
    count, axes = position.shape if position.ndim == 2 else (-1, 0)
    if axes not in THRESHOLDS or time.shape != (count,) or covariance.shape != (count, axes, axes):
        shapes = f"found {time.shape}, {position.shape} and {covariance.shape}"
        problem = "time, position and covariance must be (f,), (f, m) and (f, m, m), m = 2 or 3"
        raise InputError("fixes", f"{problem}, {shapes}")
    if np.shape(time_std) not in ((), time.shape):
        raise InputError("fixes", f"time_std must be one or (f,), found {np.shape(time_std)}")
    used = np.isfinite(position).any(axis=1)
    time, position, covariance = time[used], position[used], covariance[used]
    time_std = np.broadcast_to(np.asarray(time_std, np.float64), used.shape)[used]
    after, end = time - start, interval_ends("fixes", intervals, config, 0.0)[-1]
    outside = time[~((after >= -1e-6) & (after < end + config.clone_seconds))]
    if len(outside):
        problem = f"{len(outside)} of {count} are outside of the recording, one at {outside[0]:g} s"
        remedy = f"it lasts from {start:g} to {start + end:g} s: are both on one clock?"
        raise InputError("fixes", problem, remedy)
    if not ((time_std >= 0) & (time_std < np.inf)).all():
        raise InputError("fixes", "time_std must be at least 0 and finite")
    if threshold is not None and not threshold > 0:
        raise InputError("fixes", f"threshold must be above 0, found {threshold}")
    present = np.isfinite(position)
    if improper_covariances(present, covariance).any():
        raise InputError("fixes", "a covariance is not finite, symmetric and positive definite")

    row = np.clip(np.rint(after / config.clone_seconds).astype(int) - 1, 0, intervals - 1)
    variance = np.diagonal(covariance, axis1=1, axis2=2)
    weight = present.sum(axis=1) / np.where(present, variance, 0.0).sum(axis=1)

    def normalise(weights: np.ndarray) -> np.ndarray:
        """The weights, each divided by the sum of those of its row."""
        sums = np.bincount(row, weights, intervals)[row]
        return np.divide(weights, sums, out=np.zeros_like(weights), where=weights > 0)

    share = normalise(weight)
    component_share = np.stack([normalise(weight * column) for column in present.T], axis=1)
    fix = Fix(
        position=np.zeros((intervals, axes)),
        covariance=np.zeros((intervals, axes, axes)),
        before_end=np.bincount(row, share * ((row + 1) * config.clone_seconds - after), intervals),
        time_std=np.sqrt(np.bincount(row, (share * time_std) ** 2, intervals)),
        threshold=np.full(intervals, THRESHOLDS[axes] if threshold is None else threshold),
    )
    pairs = present[:, :, None] & present[:, None]
    products = component_share[:, :, None] * component_share[:, None]
    np.add.at(fix.position, row, component_share * np.where(present, position, 0.0))
    np.add.at(fix.covariance, row, products * np.where(pairs, covariance, 0.0))
    filled = np.zeros((intervals, axes), bool)
    np.logical_or.at(filled, row, present)
    fix.position[~filled] = np.nan
    fix.covariance[:] += np.eye(axes) * ~filled[:, :, None]
    return fix


def improper_covariances(
    present: Bool[np.ndarray, "f m"], covariance: Float[np.ndarray, "f m m"]
) -> Bool[np.ndarray, "f"]:
    """Which covariances are not finite, symmetric and positive definite, in the components that are
    present."""
    pairs = present[:, :, None] & present[:, None]
    covariance = np.where(pairs, covariance, np.eye(present.shape[1]))
    finite = np.isfinite(covariance).all(axis=(1, 2))
    usable = np.reshape(finite, (-1, 1, 1))
    covariance = np.where(usable, covariance, np.eye(present.shape[1]))
    size, skew = np.abs(covariance), np.abs(covariance - covariance.transpose(0, 2, 1))
    symmetric = (skew <= ASYMMETRY * size.max(axis=(1, 2), keepdims=True)).all(axis=(1, 2))
    positive = np.linalg.eigvalsh(covariance).min(axis=1) > 0
    return ~(finite & symmetric & positive)
