"""Errors of a trajectory, each with a name that identifies its definition in the field.

Positions are (n, d) arrays in metres whose rows are `step` seconds apart, with d = 3, or 2 for the
horizontal metrics. A row of the reference that cannot be trusted is NaN and is ignored, and so is a
displacement that starts or ends there. A metric without a value raises `Undefined` with the reason.
`measure` computes all of them. Everything is NumPy in float64.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import gammaincinv

from gnio_jax.data.reference import JUMP_MARGIN
from gnio_jax.evaluation.trajectory import (
    Alignment,
    Quaternions,
    Trajectory,
    Undefined,
    align,
    positions_at,
    relative_yaw,
)
from gnio_jax.numerics import finite_rows, matrix_from_quaternion, rotation_z, spans, stretches
from gnio_jax.types import KITTI_LENGTHS, Waypoints

Positions = Float[np.ndarray, "n d"]

STANDING_SPEED = 0.05
"""Mean speed over one second below which the reference stands still, m/s."""
STANDING_SECONDS = 2.0
"""Shortest stretch that counts as standing still, s."""
LEAST_PATH = 1.0
"""Length of the reference below which `drift` and `path_length_ratio` are undefined, m."""
LEAST_LEG = 1.0
"""Length of a leg below which the ratio of lengths is not meaningful, m."""
APART = 0.25
"""Largest relative error of the time between two rows that are compared (ours)."""
LONGEST_HOLE = 2 * JUMP_MARGIN
"""Longest time between two trusted rows that a straight line joins where the distance along the
reference is summed, s (ours). Readers that find a jump of the reference trust no row in a longer
time around it, so that it counts as no distance."""
LATEST_ALIGNED = 1.0
"""Time after the start of the filter up to which the reference may begin for the NEES, s (ours):
the covariance hardly grows before."""
LEAST_SECONDS = 10.0
"""Time below which `yaw_drift` is undefined, s."""


# --- errors of positions


def ate(estimate: Positions, reference: Positions) -> float:
    """Absolute trajectory error sqrt(mean ‖p̂ − p‖²), m (TUM/evo's APE, RNIN, TLIO's filter)."""
    return _rms(_trusted_errors(estimate, reference))


def drift(estimate: Positions, reference: Positions, step: float) -> float:
    """Error at the last trusted row over the length of the reference's path, % (position drift
    error, PDE). The error has grown over the whole path, so holes of the reference are bridged by
    straight lines."""
    error, rows = _trusted_errors(estimate, reference)[-1], np.arange(len(reference))
    trusted = finite_rows(reference)
    bridged = [np.interp(rows, rows[trusted], axis[trusted]) for axis in reference.T]
    return float(100 * np.linalg.norm(error) / _path_of_reference(np.stack(bridged, 1), step))


def rte(estimate: Positions, reference: Positions, step: float, seconds: float = 60.0) -> float:
    """Relative trajectory error: RMS of the error of displacements over `seconds`, from every row,
    m (RoNIN's T-RTE, RNIN).

    Displacements are compared in the world, without aligning their starts. Where the trusted rows
    span less than `seconds`, it is the error at their end relative to their start, scaled to
    `seconds` (RoNIN's rule).
    """
    error, lag = estimate - reference, _rows_apart(seconds, step)
    rows = np.flatnonzero(finite_rows(reference))
    if len(rows) < 2:
        raise Undefined("a single trusted row" if len(rows) else "no trusted reference")
    span = int(rows[-1] - rows[0])
    if span < lag:
        return float(np.linalg.norm(error[rows[-1]] - error[rows[0]]) * lag / span)
    return _rms_of_pairs(error[lag:] - error[:-lag], finite_rows(reference), lag, seconds)


def rte_distance(estimate: Positions, reference: Positions, step: float, metres: float) -> float:
    """RMS of the error of displacements over `metres` walked, from every row, m (D-RTE of CTIN and
    iMoT).

    A displacement ends at the first row by which the reference has walked `metres`, summed from row
    to row (`_walked_distances`). It counts if both of its ends are trusted.
    """
    trusted, error = finite_rows(reference), estimate - reference
    errors = [np.zeros((0, estimate.shape[1]))]
    for first, walked in _walked_distances(reference, step):
        end = np.searchsorted(walked, walked + metres - 1e-9)
        begin = np.flatnonzero(end < len(walked))
        i, j = first + begin, first + end[begin]
        errors.append((error[j] - error[i])[trusted[i] & trusted[j]])
    return _rms(np.concatenate(errors), f"no unbroken reference of {metres:g} m")


def rpe(
    estimate: Trajectory,
    reference: Trajectory,
    step: float,
    seconds: float,
    dims: int = 3,
    full: bool = False,
) -> float:
    """Relative pose error, m: RMS of R_z(−ψ_i)(p̂_j − p̂_i) − (p_j − p_i) over pairs of rows i, j,
    from every row i (TLIO).

    ψ is the yaw error at the start (`relative_yaw`), so a wrong heading of the whole trajectory
    adds no error.

    Args:
        estimate: The estimated poses.
        reference: The true poses at the same stamps.
        step: Time between two rows, s.
        seconds: Time between the rows of a pair, s.
        dims: 3, or 2 for the horizontal part of the error.
        full: Whether the whole attitude at the start is aligned, by R_i R̂_iᵀ in the place of R_z
            (the translation part of TUM and evo).

    Raises:
        Undefined: No pair is known.
    """
    if full:
        ours, true = (matrix_from_quaternion(path.orientation) for path in (estimate, reference))
        turn = true @ np.swapaxes(ours, 1, 2)
    else:
        turn = rotation_z(-relative_yaw(estimate.orientation, reference.orientation))
    lag = _rows_apart(seconds, step)
    if lag >= len(estimate.time):
        raise Undefined(f"no two trusted rows {seconds:g} s apart")
    displacement, true = (
        path.position[lag:] - path.position[:-lag] for path in (estimate, reference)
    )
    error = (np.einsum("nij,nj->ni", turn[:-lag], displacement) - true)[:, :dims]
    oriented = finite_rows(reference.orientation[:-lag])
    return _rms_of_pairs(error, finite_rows(reference.position), lag, seconds, oriented)


def _rows_apart(seconds: float, step: float) -> int:
    """Number of rows, `step` s apart, in `seconds`. Raises `Undefined` if no whole number of rows
    is that long, to `APART`."""
    rows = round(seconds / step)
    if abs(rows * step - seconds) > APART * seconds * (1 + 1e-9):
        raise Undefined(f"no two rows are {seconds:g} s apart, because each takes {step:g} s")
    return rows


def _rms_of_pairs(
    error: Float[np.ndarray, "m d"],
    trusted: Bool[np.ndarray, "n"],
    lag: int,
    seconds: float,
    counted: Bool[np.ndarray, "m"] | bool = True,
) -> float:
    pairs = trusted[lag:] & trusted[:-lag] & counted
    return _rms(error[pairs], f"no two trusted rows {seconds:g} s apart")


def _rms(errors: Float[np.ndarray, "m d"], reason: str = "") -> float:
    """Root mean square norm. Raises `Undefined(reason)` if there is no row."""
    if not len(errors):
        raise Undefined(reason)
    return float(np.sqrt(np.mean(np.sum(errors**2, 1))))


def _trusted_errors(estimate: Positions, reference: Positions) -> Float[np.ndarray, "m d"]:
    trusted = finite_rows(reference)
    if not trusted.any():
        raise Undefined("no trusted reference")
    return (estimate - reference)[trusted]


# --- paths


def path_length(position: Positions, step: float, seconds: float = 1.0) -> float:
    """Length of the polygon through the first trusted row of each stretch of `seconds` and the last
    one, m. Sides that are longer than two such stretches, across untrusted rows, are left out.

    If the length were summed from row to row, the noise of positions would count as walking: 5 mm
    at 10 Hz make 3 m per minute.
    """
    if len(position) < 2:
        raise Undefined("a single row")
    stretch, trusted = max(1, round(seconds / step)), np.flatnonzero(finite_rows(position))
    _, first = np.unique(trusted // stretch, return_index=True)
    corners = np.unique(np.append(trusted[first], trusted[-1:]))
    sides = np.linalg.norm(np.diff(position[corners], axis=0), axis=1)
    return float(sides[np.diff(corners) <= 2 * stretch].sum())


def _walked_distances(
    reference: Positions, step: float
) -> Iterator[tuple[int, Float[np.ndarray, "m"]]]:
    """The unbroken stretches of the reference: the first row of each, and the distance walked from
    there to each of its rows, m.

    The distance is summed from row to row. Trusted rows that are at most `LONGEST_HOLE` apart are
    joined by a straight line, on which the distance of the rows between them is interpolated.
    """
    trusted = np.flatnonzero(finite_rows(reference))
    if not len(trusted):
        return
    most = max(1.0, LONGEST_HOLE / step * (1 + 1e-6))
    for part in stretches(np.diff(trusted) > most):
        rows = trusted[part]
        sides = np.linalg.norm(np.diff(reference[rows], axis=0), axis=1)
        distance = np.concatenate([[0.0], np.cumsum(sides)])
        yield int(rows[0]), np.interp(np.arange(rows[0], rows[-1] + 1), rows, distance)


def path_length_ratio(estimate: Positions, reference: Positions, step: float) -> float:
    """Estimated over true `path_length` where the reference is trusted: 1 is correct, 0 is an
    estimate that never moved."""
    length = _path_of_reference(reference, step)
    trusted = np.where(finite_rows(reference)[:, None], estimate, np.nan)
    return path_length(trusted, step) / length


def _path_of_reference(reference: Positions, step: float) -> float:
    length = path_length(reference, step)
    if length < LEAST_PATH:
        raise Undefined(f"the reference path is {length:.2f} m long, under {LEAST_PATH:g} m")
    return length


def standing(reference: Positions, step: float) -> Bool[np.ndarray, "n"]:
    """Rows of stretches of at least 2 s in which every displacement over 1 s is below 0.05 m. The
    interval of one second tolerates the noise of the reference and the swaying of a person who
    stands (ours)."""
    lag, still = max(1, round(1.0 / step)), np.zeros(len(reference), bool)
    if len(reference) <= lag:
        return still
    with np.errstate(invalid="ignore"):
        distance = np.linalg.norm(reference[lag:] - reference[:-lag], axis=1)
        slow = distance < STANDING_SPEED * lag * step
    for start, stop in spans(slow):
        if (stop - 1 - start + lag) * step >= STANDING_SECONDS - 1e-9:
            still[start : stop + lag] = True
    return still & finite_rows(reference)


def stationary_drift(estimate: Positions, reference: Positions, step: float) -> float:
    """Metres that the estimate walks (`path_length`) per minute in which the reference stands still
    (`standing`). A gate on the displacement should reduce this drift (GNIO)."""
    rests = [(start, stop) for start, stop in spans(standing(reference, step)) if stop - start > 1]
    if not rests:
        raise Undefined(f"the reference never stands still for {STANDING_SECONDS:g} s")
    walked = sum(path_length(estimate[start:stop], step) for start, stop in rests)
    seconds = sum((stop - 1 - start) * step for start, stop in rests)
    return float(walked / (seconds / 60))


# --- legs: the straight lines from a waypoint to the next


def leg_ratio(estimate: Positions, waypoints: Positions) -> float:
    """Median over the legs of estimated over true length (ours): 1 is correct. The estimate's leg
    is the straight line between its positions at the two times. A late tap makes one leg longer and
    the next one shorter, which hardly changes a median. Legs under 1 m are left out."""
    ours, true = (np.linalg.norm(np.diff(x, axis=0), axis=1) for x in (estimate, waypoints))
    counted = true >= LEAST_LEG
    if not counted.any():
        raise Undefined(f"no leg of {LEAST_LEG:g} m")
    return float(np.median(ours[counted] / true[counted]))


def leg_path_ratio(estimate: Positions, waypoints: Positions) -> float:
    """Length of the estimate's polygon at the times of the waypoints over the length of the polygon
    through the waypoints: the path ratio of a walk that is straight between them."""
    if (length := _length(waypoints)) < LEAST_PATH:
        raise Undefined(f"the legs are {length:.2f} m long together, under {LEAST_PATH:g} m")
    return _length(estimate) / length


def leg_error(estimate: Positions, waypoints: Positions) -> float:
    """RMS error of the legs as vectors, m. An error of one leg does not affect later legs."""
    return _rms(np.diff(estimate - waypoints, axis=0))


def _length(corners: Positions) -> float:
    """Length of a polygon, m."""
    return float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())


# --- yaw


def yaw_rmse(estimate: Quaternions, reference: Quaternions) -> float:
    """Root mean square of the yaw error (`relative_yaw`), degrees (TLIO)."""
    error = relative_yaw(estimate, reference)[_rows_with_attitude(reference)]
    return float(np.degrees(np.sqrt(np.mean(error**2))))


def yaw_drift(estimate: Quaternions, reference: Quaternions, step: float) -> float:
    """Absolute change of the unwrapped yaw error (`relative_yaw`) from the first to the last
    trusted row, degrees per hour (TLIO)."""
    rows = _rows_with_attitude(reference)
    error = np.unwrap(relative_yaw(estimate, reference)[rows])
    hours = (rows[-1] - rows[0]) * step / 3600
    if hours < LEAST_SECONDS / 3600:
        raise Undefined(f"trusted for less than {LEAST_SECONDS:g} s")
    return float(abs(np.degrees(error[-1] - error[0])) / hours)


def _rows_with_attitude(reference: Quaternions) -> Int[np.ndarray, "m"]:
    rows = np.flatnonzero(finite_rows(reference))
    if not len(rows):
        raise Undefined("no trusted reference")
    return rows


# --- KITTI's errors of pieces of a path


def t_rel(estimate: Trajectory, reference: Trajectory, step: float) -> float:
    """Relative error of translation, % of the length: the mean over the pieces of 100, 200, … 800 m
    of the reference that begin at its rows one second apart (KITTI's odometry benchmark, Geiger et
    al. 2012). The whole attitude is aligned at the start of a piece (`piece_errors`)."""
    return float(100 * np.mean(piece_errors(estimate, reference, step)[:, 0]))


def r_rel(estimate: Trajectory, reference: Trajectory, step: float) -> float:
    """Relative error of rotation over the pieces of `t_rel`, degrees per metre."""
    return float(np.degrees(np.mean(piece_errors(estimate, reference, step)[:, 1])))


def piece_errors(
    estimate: Trajectory, reference: Trajectory, step: float
) -> Float[np.ndarray, "m 2"]:
    """Errors of translation (m) and rotation (rad) over pieces, divided by their length.

    A piece of ℓ metres begins at row i and ends at the first row j by which the reference has moved
    further than ℓ, summed from row to row (`_walked_distances`). It counts if the pose of the
    reference is trusted at i and at j. Its error is the motion (T_i⁻¹ T_j of the estimate)⁻¹
    (T_i⁻¹ T_j of the reference). Raises `Undefined` where no unbroken stretch is longer than 100 m.
    """
    i, j, length = pieces(reference, step)
    if not len(i):
        raise Undefined(f"no unbroken reference of {KITTI_LENGTHS[0]} m")
    turns, moves = [], []
    for path in (estimate, reference):
        back = np.swapaxes(matrix_from_quaternion(path.orientation[i]), 1, 2)
        turns.append(back @ matrix_from_quaternion(path.orientation[j]))
        moves.append(np.einsum("nij,nj->ni", back, path.position[j] - path.position[i]))
    cosine = 0.5 * (np.einsum("nij,nij->n", *turns) - 1)
    turned = np.arccos(np.clip(cosine, -1.0, 1.0))
    return np.stack([np.linalg.norm(moves[1] - moves[0], axis=1), turned], axis=1) / length[:, None]


def pieces(reference: Trajectory, step: float) -> Int[np.ndarray, "3 m"]:
    """First row, last row and nominal length (m) of the pieces of `piece_errors`."""
    every, parts = max(1, round(1.0 / step)), [np.zeros((3, 0), int)]
    posed = reference.known
    for first, distance in _walked_distances(reference.position, step):
        begins = np.arange(0, len(distance), every)
        for length in KITTI_LENGTHS:
            end = np.searchsorted(distance, distance[begins] + length, side="right")
            within = end < len(distance)
            i, j = first + begins[within], first + end[within]
            rows = np.stack([i, j, np.full(len(i), length)])
            parts.append(rows[:, posed[i] & posed[j]])
    return np.concatenate(parts, axis=1)


# --- consistency of the filter


def normalised_squared(
    error: Float[np.ndarray, "n d"], covariance: Float[np.ndarray, "n d d"]
) -> Float[np.ndarray, "n"]:
    """eᵀ P⁻¹ e of each row, infinite where P is not finite and positive definite.

    Such a P has no uncertainty in some direction, which contradicts every error. P is tested to the
    rounding of float64 after scaling to unit variances, so that units do not matter (ours).
    """
    variance = np.einsum("nii->ni", covariance)
    sound = np.isfinite(covariance).all((1, 2)) & (variance > 0).all(1)
    std = np.sqrt(variance[sound])
    value, vector = np.linalg.eigh(covariance[sound] / (std[:, :, None] * std[:, None, :]))
    definite = value[:, 0] > value.shape[1] * np.finfo(float).eps * value[:, -1]
    projected = np.einsum("nji,nj->ni", vector, error[sound] / std)
    squared = np.full(len(error), np.inf)
    value = np.where(definite[:, None], value, 1.0)
    squared[sound] = np.where(definite, (projected**2 / value).sum(1), np.inf)
    return squared


def mean_normalised(squared: Float[np.ndarray, "n"], dims: int) -> float:
    """Mean of normalised squared errors over their expectation: 1 is consistent, above 1 the filter
    is overconfident (Bar-Shalom). It is NEES for errors of the position, NIS for innovations."""
    return float(np.mean(_present(squared)) / dims)


def coverage(squared: Float[np.ndarray, "n"], dims: int, level: float = 0.95) -> float:
    """Share of rows inside the χ² region of probability `level`, %: 95 is consistent."""
    quantile = 2 * gammaincinv(dims / 2, level)  # `scipy.stats` takes half a second to import
    return float(100 * np.mean(_present(squared) <= quantile))


def _present(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "m"]:
    present = values[~np.isnan(values)]
    if not len(present):
        raise Undefined("no measurement or no trusted reference")
    return present


# --- all metrics of a sequence


class Filtered(NamedTuple):
    """A filter's results besides its trajectory, one row for each row of the trajectory."""

    covariance: Float[np.ndarray, "n 3 3"]
    """Covariance of the position, in the filter's own world, m²."""
    nis: Float[np.ndarray, "n"]
    """Normalised innovation squared; NaN where there was no measurement."""
    accepted: Float[np.ndarray, "n"]
    """1 if the measurement was used, 0 if it was rejected, NaN if there was none."""


class MetricInputs(NamedTuple):
    """An estimate and its reference, in the form that the metrics need."""

    raw: Trajectory
    """The estimate without alignment."""
    aligned: Trajectory
    """The estimate with the requested alignment."""
    started: Trajectory
    """The estimate with alignment `origin`."""
    reference: Trajectory
    step: float
    """Time between rows, s."""
    filtered: Filtered | None
    waypoints: Waypoints | None = None
    dims: int = 3

    @property
    def paths(self) -> tuple[Positions, Positions]:
        """Positions of the aligned estimate and of the reference. Lengths use the estimate without
        alignment, because an alignment of all axes would turn part of the height into the plane."""
        return self.aligned.position[:, : self.dims], self.reference.position[:, : self.dims]

    @property
    def errors(self) -> Float[np.ndarray, "m"]:
        """‖p̂ − p‖ of the aligned estimate in the trusted rows, m."""
        return np.linalg.norm(_trusted_errors(*self.paths), axis=1)

    def at_waypoints(self) -> tuple[Positions, Positions]:
        """The aligned estimate's positions, and the waypoints that are within it."""
        assert self.waypoints is not None
        position = positions_at(self.aligned, self.waypoints.time)
        rows = finite_rows(position)
        return position[rows], self.waypoints.position[rows]

    def filter_results(self) -> Filtered:
        assert self.filtered is not None
        return self.filtered

    def nees(self) -> Float[np.ndarray, "n"]:
        """eᵀ P⁻¹ e of the position: the error of the start-aligned estimate, turned back into the
        filter's world. NaN without a reference, and where P is zero, as at a start that was given
        as exact.

        Raises `Undefined` if the estimate is aligned more than `LATEST_ALIGNED` after its first
        row. The covariance of an error since row m is P_kk + P_mm − P_km − P_mk, without the effect
        of the yaw at m. The filter does not keep the covariance between two rows, and P_kk alone is
        too large.
        """
        aligned_row = int(np.argmax(self.raw.known & self.reference.known))
        seconds = self.raw.time[aligned_row] - self.raw.time[0]
        if seconds > LATEST_ALIGNED:
            raise Undefined(f"the reference begins {seconds:.1f} s after the filter's start")
        yaw = relative_yaw(self.raw.orientation[:1], self.started.orientation[:1])[0]
        error = (self.started.position - self.reference.position) @ rotation_z(yaw).T
        covariance, dims = self.filter_results().covariance, self.dims
        rows = finite_rows(error) & (np.einsum("nii->ni", covariance) != 0).all(1)
        squared = np.full(len(error), np.nan)
        squared[rows] = normalised_squared(error[rows, :dims], covariance[rows, :dims, :dims])
        return squared


Metric = Callable[[MetricInputs], float]

PATH: dict[str, Metric] = {"path_length": lambda c: path_length(c.paths[1], c.step)}
SPATIAL: dict[str, Metric] = {
    "ate": lambda c: ate(*c.paths),
    "ate_ronin": lambda c: ate(*c.paths) / math.sqrt(c.dims),
    "ate_mean": lambda c: float(np.mean(c.errors)),
    "ate_median": lambda c: float(np.median(c.errors)),
    "ate_max": lambda c: float(np.max(c.errors)),
    "rte_60s": lambda c: rte(*c.paths, c.step),
    "rte_60s_ronin": lambda c: rte(*c.paths, c.step) / math.sqrt(c.dims),
    "rte_1m": lambda c: rte_distance(*c.paths, c.step, 1.0),
    "rte_10m": lambda c: rte_distance(*c.paths, c.step, 10.0),
    "rpe_1s": lambda c: rpe(c.raw, c.reference, c.step, 1.0, c.dims),
    "rpe_10s": lambda c: rpe(c.raw, c.reference, c.step, 10.0, c.dims),
    "rpe_se3": lambda c: rpe(c.raw, c.reference, c.step, 1.0, c.dims, full=True),
    "drift": lambda c: drift(*c.paths, c.step),
    "path_length_ratio": lambda c: path_length_ratio(*c._replace(aligned=c.raw).paths, c.step),
    "stationary_drift": lambda c: stationary_drift(*c._replace(aligned=c.raw).paths, c.step),
}
"""Metrics in 3-D, and in 2-D as `<name>_2d`. Those of `_ronin` also average over components: they
are the others divided by √d (RoNIN, DeepILS)."""
NEES: dict[str, Metric] = {
    "nees": lambda c: mean_normalised(c.nees(), c.dims),
    "nees_coverage": lambda c: coverage(c.nees(), c.dims),
}
"""Metrics of a filter, in 3-D and in 2-D."""
OTHERS: dict[str, Metric] = {
    "yaw_rmse": lambda c: yaw_rmse(c.aligned.orientation, c.reference.orientation),
    "yaw_drift": lambda c: yaw_drift(c.raw.orientation, c.reference.orientation, c.step),
}
OF_PIECES: dict[str, Metric] = {
    "t_rel": lambda c: t_rel(c.raw, c.reference, c.step),
    "r_rel": lambda c: r_rel(c.raw, c.reference, c.step),
}
"""Metrics of a reference with an unbroken stretch of more than 100 m."""
OF_FILTER: dict[str, Metric] = {
    "nis": lambda c: mean_normalised(c.filter_results().nis, 3),
    "nis_coverage": lambda c: coverage(c.filter_results().nis, 3),
    "accepted": lambda c: 100.0 * mean_normalised(c.filter_results().accepted, 1),
}
"""Metrics that need no reference."""
LEGS: dict[str, Metric] = {
    "path_length": lambda c: _length(c.at_waypoints()[1]),
    "legs": lambda c: float(len(c.at_waypoints()[1]) - 1),
}
OF_WAYPOINTS: dict[str, Metric] = {
    "leg_ratio": lambda c: leg_ratio(*c.at_waypoints()),
    "leg_path_ratio": lambda c: leg_path_ratio(*c.at_waypoints()),
    "leg_error": lambda c: leg_error(*c.at_waypoints()),
    "waypoint_rms": lambda c: ate(*c.at_waypoints()),
}
"""Horizontal metrics of a sequence with waypoints, which replace all that need poses."""
NAMES = (
    *(name + tag for tag in ("", "_2d") for name in SPATIAL | NEES),
    *OTHERS,
    *OF_PIECES,
    *OF_FILTER,
    *OF_WAYPOINTS,
)
POSITION_ERRORS = ("ate", "waypoint_rms")
"""Metrics of which every sequence has one as the error of its positions."""
OF_REFERENCE = {"path_length", "legs"}
"""Metrics that are finite for every estimate."""
SAME_TIME = 1e-3
"""Stamps that differ by no more are the same time, s."""
SHARES = {"nees_coverage", "nees_coverage_2d", "nis_coverage", "accepted"}
"""Metrics that are small when they are bad: 0 for an estimate that diverged."""


class Measures(NamedTuple):
    """The metrics of one sequence."""

    values: dict[str, float | None]
    """Metric → value: None if it is not defined, infinite if the estimate diverged."""
    reasons: dict[str, str]
    """Metric → reason why it is None or infinite, or 0 for an estimate that diverged."""
    diverged: bool
    """Whether the estimate is not finite in every row, or so wrong that the error of its positions
    is infinite. If only the NEES is infinite, the covariance is bad."""


def measure(
    estimate: Trajectory,
    reference: Trajectory,
    alignment: Alignment = "origin",
    filtered: Filtered | None = None,
    waypoints: Waypoints | None = None,
) -> Measures:
    """Every metric of one sequence.

    `ate*`, `rte*`, `drift` and `yaw_rmse` use the estimate with `alignment`, which is fitted in 3-D
    for the horizontal metrics too. NEES uses alignment at the start, because the filter's
    covariance is relative to its start; it has no value if the reference begins over a second
    later. An estimate with a row that is not finite has diverged: every metric that a finite one
    would have is infinite, and the shares are 0.

    Args:
        estimate: The estimated poses.
        reference: The true poses at the same stamps; NaN where they are not known.
        alignment: The rigid motion that is fitted before errors are computed (`align`).
        filtered: Covariances, innovations and gate of the filter, for its metrics.
        waypoints: The only reference of a sequence without poses. The metrics are then those of
            `OF_WAYPOINTS` and of the filter.

    Raises:
        ValueError: The reference has other stamps.
    """
    stamps = (estimate.time, reference.time)
    if waypoints is None and (
        len(set(map(len, stamps))) > 1 or np.ptp(stamps, 0).max() > SAME_TIME
    ):
        raise ValueError("reference: has other stamps than the estimate; interpolate it at those")
    trusted = finite_rows(reference.position)[:, None]
    poses = (np.where(trusted, part, np.nan) for part in reference[1:])
    reference = Trajectory(reference.time, *poses)
    path, lost = estimate, ""
    if not estimate.known.all():
        seconds = estimate.time[np.argmin(estimate.known)] - estimate.time[0]
        lost = f"the estimate is not finite from {seconds:.1f} s on"
        # The reference decides which metrics exist, so an estimate at rest is measured to find
        # them.
        level = np.tile([1.0, 0, 0, 0], (len(estimate.time), 1))
        path = Trajectory(estimate.time, np.zeros_like(estimate.position), level)
    aligned, started, missing = path, path, ""
    try:
        aligned = align(path, waypoints or reference, alignment)
        started = align(path, waypoints or reference)
    except Undefined as undefined:
        missing = str(undefined)
    step = float(np.median(np.diff(path.time))) if len(path.time) > 1 else 1.0
    inputs = MetricInputs(path, aligned, started, reference, step, filtered, waypoints)
    values: dict[str, float | None] = {"duration": float(path.time[-1] - path.time[0])}
    reasons: dict[str, str] = {}
    for name, metric, metric_inputs in _metrics(inputs):
        try:
            if missing and name not in OF_FILTER:
                raise Undefined(missing)
            with np.errstate(over="ignore", invalid="ignore"):
                value = metric(metric_inputs)
            reason = "" if name in OF_REFERENCE else lost
            if not reason and not math.isfinite(value):
                reason = "the error is too large for a number"
                if name.startswith("nees"):
                    reason = "the filter's covariance is not positive definite"
            if reason:
                value, reasons[name] = (0.0 if name in SHARES else math.inf), reason
            values[name] = value
        except Undefined as undefined:
            values[name], reasons[name] = None, str(undefined)
    far = any(values.get(name) == math.inf for name in POSITION_ERRORS)
    return Measures(values, reasons, bool(lost) or far)


def _metrics(inputs: MetricInputs) -> Iterator[tuple[str, Metric, MetricInputs]]:
    """Name, metric and its data, in the order of the files."""
    nees, filter_metrics = ({}, {}) if inputs.filtered is None else (NEES, OF_FILTER)
    if inputs.waypoints is None:
        spatial = SPATIAL | nees
        of_pieces = OF_PIECES if pieces(inputs.reference, inputs.step).size else {}
        others = OTHERS | of_pieces | filter_metrics
        groups = [(3, "", PATH | spatial), (2, "_2d", spatial), (3, "", others)]
    else:
        groups = [(3, "", LEGS | OF_WAYPOINTS | filter_metrics)]
    for dims, tag, metrics in groups:
        for name, metric in metrics.items():
            yield name + tag, metric, inputs._replace(dims=dims)


def score(estimates: Iterable[Any], alignment: Alignment = "origin") -> dict[str, Measures]:
    """Every metric of every `SequenceEstimate`, by sequence."""
    return {
        estimate.name: measure(
            estimate.trajectory,
            estimate.reference,
            alignment,
            estimate.filtered,
            estimate.waypoints,
        )
        for estimate in estimates
    }
