"""Losses of a filtered segment: of its path, of the filter's own covariance, and of the network's
displacements.

Each is a pure function of arrays, differentiable, and a mean over the segment. The scale-free
errors have the form of KITTI's benchmark (Geiger et al. 2012) and of AI-IMU's training (Brossard et
al. 2020, §IV-C).
"""

from __future__ import annotations

from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from gnio_jax import geometry
from gnio_jax.config import ThroughFilter
from gnio_jax.filtering import FilterConfig, FilterHistory
from gnio_jax.filtering.history import POSITION, VELOCITY
from gnio_jax.training.segments import MotionPath, Segment
from gnio_jax.types import KITTI_LENGTHS, Array

HORIZON_SECONDS = (1.0, 5.0, 10.0, 30.0, 60.0)
"""Times over which relative errors are taken, s, if the segment is long enough."""
DISTANCE_FLOOR = 1.0
"""Added in quadrature to the distance by which an error is divided, m, so that standing still is no
singular point (ours)."""
TRANSLATION_FLOOR = 1e-3
"""Added in quadrature to a relative error of translation, so that its root has a derivative
everywhere (ours)."""
FAR_OFF = 1.5
"""Distance from a waypoint beyond which it counts less and less, m (ours)."""
VELOCITY_POSITION = slice(VELOCITY.start, POSITION.stop)


class FilterLosses(NamedTuple):
    """Losses of one segment, or means over several."""

    total: Float[Array, ""]
    """The objective of training."""
    displacement: Float[Array, "h"]
    """`relative_displacement` of each horizon."""
    yaw: Float[Array, "h"]
    """`relative_yaw` of each horizon, 1/m²."""
    innovation: Float[Array, ""]
    """`innovation_nll`."""
    state: Float[Array, ""]
    """`gaussian_nll` of the true velocity (m/s) and position (m)."""
    window: Float[Array, ""]
    """`window_error`, m²."""
    translation: Float[Array, ""]
    """`relative_translation`, 0 without a piece."""
    long_enough: Float[Array, ""]
    """1 if the path has a piece of 100 m, else 0. Its mean is the share of the segments that count
    in the mean of `translation`."""
    waypoints: Float[Array, ""]
    """`waypoint_error`; 0 for a segment with fewer than two waypoints."""
    nis: Float[Array, ""]
    """Mean normalised innovation squared over its degrees of freedom; no part of the total."""
    nees: Float[Array, ""]
    """Mean normalised error squared of the position over its degrees of freedom, likewise."""
    healthy: Bool[Array, ""]
    """True if the filter never diverged."""


def filter_losses(
    estimate: MotionPath,
    segment: Segment,
    history: FilterHistory,
    config: FilterConfig,
    weights: ThroughFilter,
) -> FilterLosses:
    """All losses of a segment, and their sum with the weights.

    The reference of a recording with waypoints is interpolated, and the network must not learn from
    it: the error at the waypoints replaces all losses that need poses, with the weight of
    displacements.

    Args:
        estimate: The filter's motion, K + 1 rows that begin with its start.
        segment: The samples and the reference.
        history: The K rows of the run, with the whole core covariance.
        config: The settings of the filter, for the length of an interval.
        weights: The weight of each loss.
    """
    truth = segment.truth
    intervals = len(truth.position) - 1
    chex.assert_shape(history.covariance, (intervals, 15, 15))
    assert history.covariance is not None  # for type checkers
    counts = [round(seconds / config.clone_seconds) for seconds in HORIZON_SECONDS]
    counts = [count for count in counts if 1 <= count <= intervals]
    displacement = jnp.stack([relative_displacement(estimate, truth, count) for count in counts])
    yaw = jnp.stack([relative_yaw(estimate, truth, count) for count in counts])
    innovation = innovation_nll(history.log_likelihood)
    error = jnp.concatenate(
        [truth.velocity - estimate.velocity, truth.position - estimate.position], axis=1
    )
    # Differences of positions have no covariance in the history. The start is as good as certain,
    # so the position's own covariance is that of the displacement from the start (ours).
    covariance = history.covariance[:, VELOCITY_POSITION, VELOCITY_POSITION]
    state = gaussian_nll(error[1:], covariance)
    if config.measures == "velocity":
        seconds = config.window * config.dt
        window = velocity_error(history.displacement, truth, seconds)
    else:
        window = window_error(history.displacement, estimate, truth, config.clones_per_window)
    every = max(1, round(1 / config.clone_seconds))
    translation, pieces = relative_translation(estimate, truth, every)
    waypoints = waypoint_error(estimate.position, segment.waypoint)
    posed = (
        weights.displacement_weight * jnp.mean(displacement)
        + weights.yaw_weight * jnp.mean(yaw)
        + weights.state_weight * state
        + weights.window_weight * window
        + weights.translation_weight * translation
    )
    tapped = weights.displacement_weight * waypoints
    total = weights.innovation_weight * innovation + jnp.where(segment.tapped, tapped, posed)
    of_position = history.covariance[:, POSITION, POSITION]
    squares = normalised_squares(error[1:, 3:], of_position)
    nis, healthy = jnp.nanmean(history.nis) / 3, history.healthy[-1] > 0
    return FilterLosses(
        *(total, displacement, yaw, innovation, state, window, translation),
        *(jnp.where(pieces > 0, 1.0, 0.0), waypoints),
        *(nis, jnp.mean(squares) / 3, healthy),
    )


def yaw_errors(
    estimate: Float[Array, "k 3 3"], truth: Float[Array, "k 3 3"]
) -> tuple[Float[jax.Array, "k"], Float[jax.Array, "k"]]:
    """Cosine and sine of the yaw of R̂ Rᵀ, which turns the true attitude into the estimated one.

    Unlike the difference of two yaws it has no singular point near the truth.
    """
    turn = jnp.einsum("kij,klj->kil", estimate, truth)
    return jax.vmap(geometry.yaw_direction)(turn)


def relative_displacement(
    estimate: MotionPath, truth: MotionPath, count: int
) -> Float[jax.Array, ""]:
    """‖Rz(ψ_i)ᵀ (p̂_j − p̂_i) − (p_j − p_i)‖² / (distance² + floor²), j = i + `count`, mean over i.

    ψ_i is the yaw error at i, so errors before i do not count; distance is the distance walked from
    i to j, m.
    """
    cosine, sine = (part[:-count] for part in yaw_errors(estimate.rotation, truth.rotation))
    moved = estimate.position[count:] - estimate.position[:-count]
    x = cosine * moved[:, 0] + sine * moved[:, 1]
    y = cosine * moved[:, 1] - sine * moved[:, 0]
    true_moved = truth.position[count:] - truth.position[:-count]
    error = jnp.stack([x, y, moved[:, 2]], axis=1) - true_moved
    return jnp.mean(jnp.sum(error**2, axis=1) / _squared_distance(truth.position, count))


def relative_yaw(estimate: MotionPath, truth: MotionPath, count: int) -> Float[jax.Array, ""]:
    """4 sin²((ψ_j − ψ_i)/2) / (distance² + floor²), j = i + `count`, mean over i; 1/m².

    ψ is the yaw error; for small changes the numerator is (ψ_j − ψ_i)², rad².
    """
    cosine, sine = yaw_errors(estimate.rotation, truth.rotation)
    change = (cosine[count:] - cosine[:-count]) ** 2 + (sine[count:] - sine[:-count]) ** 2
    return jnp.mean(change / _squared_distance(truth.position, count))


def _squared_distance(position: Float[Array, "k 3"], count: int) -> Float[jax.Array, "i"]:
    """Length of the path over `count` rows from each row on, squared, and the floor; m²."""
    step = jnp.diff(position, axis=0)
    walked = jnp.cumsum(jnp.sqrt(jnp.sum(step**2, axis=1)))
    walked = jnp.concatenate([jnp.zeros_like(walked[:1]), walked])
    return (walked[count:] - walked[:-count]) ** 2 + DISTANCE_FLOOR**2


def relative_translation(
    estimate: MotionPath, truth: MotionPath, every: int
) -> tuple[Float[Array, ""], Int[Array, ""]]:
    """‖R̂_iᵀ (p̂_j − p̂_i) − R_iᵀ (p_j − p_i)‖ / ℓ, mean over the pieces of ℓ = 100, 200, … 800 m of
    the true path that begin at every `every`-th row i, and the number of these pieces. The mean is
    0 if there is none.

    It is the metric `t_rel` over 100. Row j is the first one by which the truth has moved further
    than ℓ. AI-IMU's loss is the sum of the squares. It is the root here, as in the metric, with
    `TRANSLATION_FLOOR` added in quadrature (ours).
    """
    step = jnp.diff(truth.position, axis=0)
    walked = jnp.cumsum(jnp.sqrt(jnp.sum(step**2, axis=1)))
    walked = jnp.concatenate([jnp.zeros_like(walked[:1]), walked])
    first = np.arange(0, len(step), every)
    length = np.array(KITTI_LENGTHS, float)
    last = jnp.searchsorted(walked, walked[first][:, None] + length[None], side="right")
    whole = last < len(walked)
    last = jnp.minimum(last, len(walked) - 1)

    def relative_motion(path: MotionPath) -> Float[Array, "i l 3"]:
        change = path.position[last] - path.position[first][:, None]
        return jnp.einsum("iab,ila->ilb", path.rotation[first], change)

    squared = (
        jnp.sum((relative_motion(estimate) - relative_motion(truth)) ** 2, axis=2)
        / length[None] ** 2
    )
    error = jnp.sqrt(jnp.where(whole, squared, 0.0) + TRANSLATION_FLOOR**2)
    pieces = jnp.sum(whole)
    return jnp.sum(jnp.where(whole, error, 0.0)) / jnp.maximum(pieces, 1), pieces


def waypoint_error(
    position: Float[Array, "k 3"], waypoint: Float[Array, "s 2"]
) -> Float[jax.Array, ""]:
    """Squared distances of a path from the waypoints, over the squares of the waypoints' distances
    from their mean and the floor, both summed: 0 for a path of the right shape.

    `position` is that at both ends of the k − 1 clone intervals, between which it is interpolated;
    `waypoint` has a row for each sample, NaN where there is none. The path is compared after the
    horizontal rotation and shift that bring it nearest, because the filter's position and yaw on
    the map are not known. A squared distance d² counts as c² ln(1 + d²/c²), c = `FAR_OFF`, because
    a tap may be too early, too late or in the wrong place. So the error of a path that never moves
    is below 1, and it decreases with the length of the walk. The error is 0 if there are fewer than
    two waypoints.
    """
    samples = len(waypoint) // (len(position) - 1)
    share = (jnp.arange(samples) / samples)[None, :, None]
    before, after = position[:-1, None, :2], position[1:, None, :2]
    path = (before + share * (after - before)).reshape(-1, 2)
    present = jnp.all(jnp.isfinite(waypoint), axis=1)
    target = jnp.where(present[:, None], waypoint, 0.0)
    weight = jnp.where(present.any(), present, True).astype(path.dtype)
    rotation, shift = geometry.planar_alignment(path, target, weight)
    squared = jnp.sum((geometry.matmul(path, rotation.T) + shift[None] - target) ** 2, axis=1)
    counted = FAR_OFF**2 * jnp.log1p(squared / FAR_OFF**2)
    middle = jnp.average(target, axis=0, weights=weight)
    spread = jnp.sum((target - middle[None]) ** 2, axis=1)
    error = jnp.sum(weight * counted) / (jnp.sum(weight * (spread + DISTANCE_FLOOR**2)))
    return jnp.where(present.any(), error, 0.0)


def innovation_nll(log_likelihood: Float[Array, "k"]) -> Float[jax.Array, ""]:
    """Mean of −ln N(r; 0, S) over the measurements. Rows of NaN are no measurements; 0 if there are
    none."""
    present = jnp.isfinite(log_likelihood)
    total = jnp.sum(jnp.where(present, log_likelihood, 0.0))
    return -total / jnp.maximum(jnp.sum(present), 1)


def gaussian_nll(
    error: Float[Array, "k d"], covariance: Float[Array, "k d d"]
) -> Float[jax.Array, ""]:
    """Mean over k of −ln N(e_k; 0, P_k), without its constant."""
    variances, remainders = _eliminate(error, covariance)
    return 0.5 * jnp.mean(jnp.sum(remainders**2 / variances + jnp.log(variances), axis=1))


def normalised_squares(
    error: Float[Array, "k d"], covariance: Float[Array, "k d d"]
) -> Float[jax.Array, "k"]:
    """eᵀ P⁻¹ e."""
    variances, remainders = _eliminate(error, covariance)
    return jnp.sum(remainders**2 / variances, axis=1)


def _eliminate(
    error: Float[Array, "k d"], covariance: Float[Array, "k d d"]
) -> tuple[Float[jax.Array, "k d"], Float[jax.Array, "k d"]]:
    """Variance of each entry given the entries before it (D of P = L D Lᵀ), NaN where P is not
    positive definite, and the remainder of each entry (L⁻¹ e).

    This is Gaussian elimination, written out. LAPACK's batched calls wait for workers of XLA's
    thread pool while they hold one: if each core is a device, they deadlock.
    """
    variances, remainders = [], []
    for _ in range(error.shape[1]):
        variance = jnp.where(covariance[:, 0, 0] > 0, covariance[:, 0, 0], jnp.nan)
        column = covariance[:, 1:, 0] / variance[:, None]
        variances.append(variance)
        remainders.append(error[:, 0])
        error = error[:, 1:] - column * error[:, :1]
        covariance = covariance[:, 1:, 1:] - column[:, :, None] * covariance[:, :1, 1:]
    return jnp.stack(variances, axis=1), jnp.stack(remainders, axis=1)


def velocity_error(
    velocity: Float[Array, "k 3"], truth: MotionPath, seconds: float
) -> Float[jax.Array, ""]:
    """Squared error of the measured velocities in the body, in metres per window of this length,
    summed over the axes, mean over the windows; rows of NaN are no measurements.

    The true velocity is expressed in the true body, which has no yaw error.
    """
    true_velocity = jnp.einsum("kji,kj->ki", truth.rotation[1:], truth.velocity[1:])
    present = jnp.all(jnp.isfinite(velocity), axis=1)
    error = jnp.where(present[:, None], velocity - seconds * true_velocity, 0.0)
    return jnp.sum(error**2) / jnp.maximum(jnp.sum(present), 1)


def window_error(
    displacement: Float[Array, "k 3"],
    estimate: MotionPath,
    truth: MotionPath,
    clones_per_window: int,
) -> Float[jax.Array, ""]:
    """Squared error of the measured displacements, summed over the axes, mean over the windows, m².

    Row k spans from the (k − W)-th clone to the k-th; rows of NaN are no measurements. The
    network's displacement is expressed in the yaw frame of the filter's own attitude, and the
    network cannot see the yaw error of this attitude. So the true displacement is turned by this
    error before it is expressed in the same frame.
    """
    first, last = slice(1, -clones_per_window), slice(1 + clones_per_window, None)
    moved = truth.position[last] - truth.position[first]
    attitude = jax.lax.stop_gradient(estimate.rotation[first])
    attitude_cosine, attitude_sine = jax.vmap(geometry.yaw_direction)(attitude)
    cosine, sine = yaw_errors(attitude, truth.rotation[first])
    # The rotation by the yaw error, then into the filter's own yaw frame, is one rotation about z.
    c, s = (
        attitude_cosine * cosine + attitude_sine * sine,
        attitude_cosine * sine - attitude_sine * cosine,
    )
    x, y = c * moved[:, 0] - s * moved[:, 1], s * moved[:, 0] + c * moved[:, 1]
    measured = displacement[clones_per_window:]
    error = measured - jnp.stack([x, y, moved[:, 2]], axis=1)
    present = jnp.all(jnp.isfinite(measured), axis=1)
    squared = jnp.sum(jnp.where(present[:, None], error, 0.0) ** 2, axis=1)
    return jnp.sum(squared) / jnp.maximum(jnp.sum(present), 1)
