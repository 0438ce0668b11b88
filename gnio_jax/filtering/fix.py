"""A fix of position as a measurement (ours): from a satellite receiver, a beacon, or a map on which
somebody taps their position.

The time t of a fix is arbitrary. The fix is measured at the end of a clone interval, where the
velocity times a = t_end − t is subtracted from the position:

    z = p − a v + w + b v,   w ~ N(0, R),   b ~ N(0, σ_t²),

where b is the error of the time of the fix, e.g. of a tap that comes early or late. At the nearest
end |a| is at most half an interval, in which an acceleration changes the position by a few
millimetres.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from gnio_jax.errors import InputError
from gnio_jax.filtering.settings import FilterConfig
from gnio_jax.filtering.state import FilterState
from gnio_jax.filtering.update import Correction, Outcome, Step, linearise, measure
from gnio_jax.types import Array

THRESHOLDS = {2: 9.210, 3: 11.345}
"""99 % of χ² with 2 and with 3 degrees of freedom."""


class Fix(NamedTuple):
    """A horizontal (m = 2) or a three-dimensional position (m = 3), or a row for each of K clone
    intervals. It is an entry of `measurements` of `run_filter`, `run_odometry` and `smooth`."""

    position: Float[Array, "*k m"]
    """World frame, m; NaN where there is none."""
    covariance: Float[Array, "*k m m"]
    """R, m²."""
    before_end: Float[Array, "*k"]
    """a, the time from the fix to the end of its clone interval, s; negative if the fix is after
    the end. Finite even where there is no fix."""
    time_std: Float[Array, "*k"]
    """σ_t, s. Finite even where there is no fix."""
    threshold: Float[Array, "*k"]
    """Largest rᵀ S⁻¹ r that passes; inf: every fix does."""

    def update(self, state: FilterState, step: Step) -> tuple[FilterState, Outcome, Correction]:
        """A fix is refused if it fails the χ² test against the filter's prediction. So a fix that
        jumps by a kilometre changes nothing. A good fix changes nothing either if the covariance of
        the filter is much too small."""
        axes = self.position.shape[0]
        by_position = np.eye(3)[:axes]
        velocity = state.velocity[:axes]
        expected = state.position[:axes] - self.before_end * velocity
        late = self.time_std * velocity
        linear = linearise(
            state,
            self.position - expected,
            self.covariance + late[:, None] * late[None],
            position=by_position,
            velocity=-self.before_end * by_position,
        )
        return measure(state, linear, step, self.threshold, frame="world")


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
    """f fixes in any order, each in the row of the clone interval whose end is nearest.

    time (f,) s, on the clock on which `start` is the stamp of the first IMU sample; position (f, m)
    m in the world frame, m = 2 or 3; covariance (f, m, m) m²; intervals K; time_std s, one or (f,);
    threshold of the χ² test, by default 99 %. A fix whose position has a NaN is ignored. Several
    fixes in one row become their mean, weighted by the inverse traces of their covariances, with
    the covariance of this mean. Raises `InputError` for another shape, for a covariance that is not
    symmetric and positive definite, for a time_std below 0, and for a fix outside of the recording.
    """
    time, position, covariance = (np.asarray(x, np.float64) for x in (time, position, covariance))
    count, axes = position.shape if position.ndim == 2 else (-1, 0)
    if axes not in THRESHOLDS or time.shape != (count,) or covariance.shape != (count, axes, axes):
        found = f"found {time.shape}, {position.shape} and {covariance.shape}"
        problem = "time, position and covariance must be (f,), (f, m) and (f, m, m), m = 2 or 3"
        raise InputError("fixes", f"{problem}, {found}")
    there = np.isfinite(position).all(1)
    if np.shape(time_std) not in ((), time.shape):
        raise InputError("fixes", f"time_std must be one or (f,), found {np.shape(time_std)}")
    late = np.broadcast_to(time_std, time.shape)[there]
    time, position, covariance = time[there], position[there], covariance[there]
    end = intervals * config.clone_seconds
    after = time - start
    if len(outside := time[~((after >= -1e-6) & (after <= end + 1e-6))]):
        problem = f"{len(outside)} of {count} are outside of the recording, one at {outside[0]:g} s"
        remedy = f"it lasts from {start:g} to {start + end:g} s: are both on one clock?"
        raise InputError("fixes", problem, remedy)
    if not ((late >= 0) & (late < np.inf)).all():
        raise InputError("fixes", "time_std must be at least 0 and finite")
    if threshold is not None and not threshold > 0:
        raise InputError("fixes", f"threshold must be above 0, found {threshold}")
    symmetric = np.isclose(covariance, covariance.transpose(0, 2, 1), rtol=1e-6, atol=0).all((1, 2))
    finite = np.isfinite(covariance).all()
    if not finite or not symmetric.all() or (np.linalg.eigvalsh(covariance) <= 0).any():
        raise InputError("fixes", "a covariance is not finite, symmetric and positive definite")

    row = np.clip(np.rint(after / config.clone_seconds).astype(int) - 1, 0, intervals - 1)
    weight = 1 / np.trace(covariance, axis1=1, axis2=2)
    weight = weight / np.bincount(row, weight, intervals)[row]
    before_end = (row + 1) * config.clone_seconds - after
    laid = Fix(
        position=np.zeros((intervals, axes)),
        covariance=np.zeros((intervals, axes, axes)),
        before_end=np.bincount(row, weight * before_end, intervals),
        time_std=np.sqrt(np.bincount(row, (weight * late) ** 2, intervals)),
        threshold=np.full(intervals, THRESHOLDS[axes] if threshold is None else threshold),
    )
    np.add.at(laid.position, row, weight[:, None] * position)
    np.add.at(laid.covariance, row, (weight**2)[:, None, None] * covariance)
    empty = np.bincount(row, minlength=intervals) == 0
    laid.position[empty], laid.covariance[empty] = np.nan, np.eye(axes)
    return laid
