"""Errors of a trajectory, each under a name that says which of the field's definitions it is.

Positions are (n, d) arrays in metres, rows a constant `step` (s) apart, d = 3 or, for the
horizontal metrics, 2. A row of the reference that cannot be trusted is NaN and counts nowhere, nor
does a displacement that starts or ends there. A metric without a value (no reference, too short,
never standing) raises `Undefined` with the reason; `measure` turns that into None and keeps the
reason. An estimate that is not finite has diverged: its errors are infinite, which is not the same
as no value, and no summary leaves them out in silence. Everything is NumPy in float64 and pure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.stats import chi2

Alignment = Literal["origin", "none", "yaw_position", "se3"]
Positions = Float[np.ndarray, "n d"]
Quaternions = Float[np.ndarray, "n 4"]
Angles = Float[np.ndarray, "n"]

STANDING_SPEED = 0.05
"""Mean speed over one second below which the reference stands still, m/s."""
STANDING_SECONDS = 2.0
"""Shortest stretch that counts as standing still, s."""
COVERAGES = frozenset({"nees_coverage", "nees_coverage_2d", "nis_coverage"})
"""Metrics that are small when they are bad: 0 for an estimate that diverged."""
NOT_FINITE, TOO_LARGE = "the estimate is not finite", "the error is too large for a number"
"""How the reasons of an infinite metric begin."""


class Undefined(ValueError):
    """The metric has no value for this trajectory; the text is the reason."""


class Trajectory(NamedTuple):
    """Poses at uniform times. A row without a trusted pose is NaN."""

    time: Float[np.ndarray, "n"]
    """Stamps, s."""
    position: Float[np.ndarray, "n 3"]
    """In the world (z up), m."""
    orientation: Quaternions
    """Body→world, unit quaternion wxyz."""


class Measures(NamedTuple):
    """The metrics of one sequence."""

    values: dict[str, float | None]
    """Metric -> value; None where it is not defined; errors are infinite where the estimate
    diverged (`diverged`)."""
    undefined: dict[str, str]
    """Metric -> reason, for those without a value and those that are infinite or, of an estimate
    that diverged, a coverage of 0."""


# Rotations
# ------------------------------------------------------------------------------------------------------------


def yaw(orientation: Quaternions) -> Angles:
    """Yaw atan2(R[1,0], R[0,0]) of quaternions wxyz, rad: that of the body's x axis, which has none
    where it is vertical. It is the frame of the network's windows. Two attitudes are compared with
    `relative_yaw`."""
    w, x, y, z = orientation.T
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def relative_yaw(estimate: Quaternions, reference: Quaternions) -> Angles:
    """Yaw error of attitudes R̂ against R, rad in (−π, π].

    It is the turn about the vertical that takes R nearest to R̂: ψ minimises ‖R̂ − R_z(ψ) R‖. With
    E = R̂ Rᵀ the square of that norm is 6 − 2 tr(R_z(ψ)ᵀ E), and the trace is
    cos ψ (E00 + E11) + sin ψ (E10 − E01) + E22, so ψ = atan2(E10 − E01, E00 + E11), whatever the
    attitude of the phone: the twist of E about z. With both attitudes level it is the difference of
    their `yaw`. It has no value only where E is half a turn about a horizontal axis and every ψ is
    as near: 0 there (ours). NaN stays NaN.
    """
    (a, b, c, d), (w, x, y, z) = estimate.T, reference.T
    # Of the quaternion of E.
    scalar, vertical = a * w + b * x + c * y + d * z, d * w - a * z + c * x - b * y
    return np.arctan2(2 * scalar * vertical, scalar**2 - vertical**2)


def rotation_matrices(orientation: Quaternions) -> Float[np.ndarray, "n 3 3"]:
    """Rotation matrices of unit quaternions wxyz; NaN stays NaN."""
    w, x, y, z = orientation.T
    return np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        -2,
    )


def _multiply(left: Float[np.ndarray, "4"], right: Quaternions) -> Quaternions:
    w, x, y, z = left
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return right @ matrix.T


def rotation_z(angle: Float[np.ndarray, "*k"] | float) -> Float[np.ndarray, "*k 3 3"]:
    """Rotation by an angle (rad) about the world's z axis."""
    cosine, sine = np.cos(angle), np.sin(angle)
    zero, one = np.zeros_like(cosine), np.ones_like(cosine)
    return np.stack(
        [
            np.stack([cosine, -sine, zero], -1),
            np.stack([sine, cosine, zero], -1),
            np.stack([zero, zero, one], -1),
        ],
        -2,
    )


def _quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)


# Alignment
# ------------------------------------------------------------------------------------------------------------


def align(estimate: Trajectory, reference: Trajectory, how: Alignment = "origin") -> Trajectory:
    """The estimate moved into the reference's frame by one rigid motion.

    It is fitted over the rows that are trusted and where the estimate is finite. `origin` matches
    position and yaw (`relative_yaw`) at the first (what a user of odometry knows); `none` changes
    nothing; `yaw_position` is the least-squares motion of four degrees of freedom (the unobservable
    ones of inertial odometry; VIO benchmarks); `se3` the least-squares motion of six (Horn/Kabsch,
    no scale; TUM, evo). Raises `Undefined` without such a row, or for `se3` with fewer than three.
    """
    if how == "none":
        return estimate
    trusted = _finite(reference) if how == "origin" else finite_rows(reference.position)
    if not trusted.any():
        raise Undefined("no trusted reference")
    rows = np.flatnonzero(trusted & _finite(estimate))
    if not len(rows):
        raise Undefined(f"{NOT_FINITE} in any trusted row")
    if how == "origin":
        first = rows[0]
        starts = (path.orientation[first : first + 1] for path in (reference, estimate))
        turn = rotation_z(relative_yaw(*starts)[0])
        source, target = estimate.position[first], reference.position[first]
    else:
        source, target = estimate.position[rows].mean(0), reference.position[rows].mean(0)
        a, b = estimate.position[rows] - source, reference.position[rows] - target
        if how == "yaw_position":
            turn = rotation_z(
                np.arctan2(
                    a[:, 0] @ b[:, 1] - a[:, 1] @ b[:, 0], a[:, 0] @ b[:, 0] + a[:, 1] @ b[:, 1]
                )
            )
        else:
            if len(rows) < 3:
                raise Undefined("fewer than three trusted rows to align")
            u, _, vt = np.linalg.svd(b.T @ a)
            turn = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return Trajectory(
        estimate.time,
        (estimate.position - source) @ turn.T + target,
        _multiply(_quaternion(turn), estimate.orientation),
    )


# Absolute errors
# ------------------------------------------------------------------------------------------------------


def ate(estimate: Positions, reference: Positions) -> float:
    """Absolute trajectory error sqrt(mean ‖p̂ − p‖²), m (TUM/evo's APE rmse, RNIN, TLIO's filter)."""
    return float(np.sqrt(np.mean(np.sum(_errors(estimate, reference) ** 2, 1))))


def ate_ronin(estimate: Positions, reference: Positions) -> float:
    """sqrt of the mean over rows and components of (p̂ − p)², m: `ate`/√d (the code of RoNIN and
    DeepILS)."""
    return float(np.sqrt(np.mean(_errors(estimate, reference) ** 2)))


def ate_mean(estimate: Positions, reference: Positions) -> float:
    """mean ‖p̂ − p‖, m (TLIO's network test)."""
    return float(np.mean(np.linalg.norm(_errors(estimate, reference), axis=1)))


def drift(estimate: Positions, reference: Positions, step: float) -> float:
    """Error at the last trusted row over the length of the reference path (`path_length`), %
    (position drift error, PDE).

    Undefined for a path below 1 m, where it says nothing.
    """
    length = path_length(reference, step)
    if length < 1.0:
        raise Undefined(f"the reference path is {length:.2f} m long, under 1 m")
    return float(100 * np.linalg.norm(_errors(estimate, reference)[-1]) / length)


# Relative errors
# ------------------------------------------------------------------------------------------------------


def rte(estimate: Positions, reference: Positions, step: float, seconds: float = 60.0) -> float:
    """Relative trajectory error: RMS norm of the error of displacements over `seconds`, from every
    row, m (RoNIN's T-RTE, RNIN).

    Displacements are compared in the world, without turning the start. Where the trusted rows span
    less than `seconds`, the error at their end relative to their start, times `seconds` over that
    span (RoNIN's rule).
    """
    error = estimate - reference
    rows = np.flatnonzero(finite_rows(reference))
    if len(rows) < 2:
        raise Undefined("no trusted reference" if not len(rows) else "a single trusted row")
    rows_apart, span = round(seconds / step), int(rows[-1] - rows[0])
    if span < rows_apart:
        return float(np.linalg.norm(error[rows[-1]] - error[rows[0]]) * rows_apart / span)
    return _rms(
        error[rows_apart:] - error[:-rows_apart],
        _pairs(reference, rows_apart),
        f"no two trusted rows {seconds:g} s apart",
    )


def rte_ronin(
    estimate: Positions, reference: Positions, step: float, seconds: float = 60.0
) -> float:
    """`rte` over √d, m: the mean is over components too, as RoNIN's code has it."""
    return rte(estimate, reference, step, seconds) / float(np.sqrt(estimate.shape[1]))


def rte_distance(estimate: Positions, reference: Positions, metres: float) -> float:
    """RMS norm of the error of displacements over `metres` walked, from every row, m (D-RTE of CTIN
    and iMoT, with 1 m).

    The end of a displacement is the first row by which the reference has walked `metres`, its path
    summed row by row.
    """
    good = finite_rows(reference)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], good.astype(int), [0]])))
    errors = [np.zeros((0, estimate.shape[1]))]
    for start, stop in zip(
        edges[::2], edges[1::2], strict=True
    ):  # a path is known within an unbroken stretch only
        truth, error = reference[start:stop], (estimate - reference)[start:stop]
        walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth, axis=0), axis=1))])
        end = np.searchsorted(walked, walked + metres - 1e-9)
        begin = np.flatnonzero(end < len(walked))
        errors.append(error[end[begin]] - error[begin])
    found = np.concatenate(errors)
    return _rms(found, np.ones(len(found), bool), f"no unbroken reference of {metres:g} m")


def rpe(
    estimate: Trajectory, reference: Trajectory, step: float, seconds: float, dims: int = 3
) -> float:
    """Relative pose error: RMS norm of the error of displacements over `seconds` with the yaw at
    their start aligned, m (TLIO).

    error_i = R_z(−ψ_i)(p̂_j − p̂_i) − (p_j − p_i), from every row i, with ψ the `relative_yaw` of
    the estimate's attitude, so that a wrong heading of the whole trajectory costs nothing; with
    `dims` 2 its horizontal part.
    """
    rows_apart = round(seconds / step)
    reason = f"no two trusted rows {seconds:g} s apart"
    if rows_apart >= len(estimate.time):
        raise Undefined(reason)
    start, start_true = (path.orientation[:-rows_apart] for path in (estimate, reference))
    turn = rotation_z(-relative_yaw(start, start_true))
    moved, moved_true = (
        path.position[rows_apart:] - path.position[:-rows_apart] for path in (estimate, reference)
    )
    error = np.einsum("nij,nj->ni", turn, moved) - moved_true
    trusted = _pairs(reference.position, rows_apart) & finite_rows(start_true)
    return _rms(error[:, :dims], trusted, reason)


def rpe_se3(
    estimate: Trajectory, reference: Trajectory, step: float, seconds: float = 1.0, dims: int = 3
) -> float:
    """RMS of the translation part of the relative pose error with the full orientation at the
    start, all pairs, m (TUM, evo).

    error_i = R_i R̂_iᵀ (p̂_j − p̂_i) − (p_j − p_i) in the reference's world (its norm is evo's);
    with `dims` 2 its horizontal part.
    """
    rows_apart = round(seconds / step)
    reason = f"no two trusted rows {seconds:g} s apart"
    if rows_apart >= len(estimate.time):
        raise Undefined(reason)
    start, start_true = (
        rotation_matrices(trajectory.orientation[:-rows_apart])
        for trajectory in (estimate, reference)
    )
    moved, moved_true = (
        trajectory.position[rows_apart:] - trajectory.position[:-rows_apart]
        for trajectory in (estimate, reference)
    )
    error = np.einsum("nij,nkj,nk->ni", start_true, start, moved) - moved_true
    oriented = finite_rows(reference.orientation[:-rows_apart])
    trusted = _pairs(reference.position, rows_apart) & oriented
    return _rms(error[:, :dims], trusted, reason)


# Heading
# --------------------------------------------------------------------------------------------------------------


def yaw_rmse(estimate: Quaternions, reference: Quaternions) -> float:
    """Root mean square of the yaw error (`relative_yaw`), degrees (TLIO)."""
    error = relative_yaw(estimate, reference)[_oriented(reference)]
    return float(np.degrees(np.sqrt(np.mean(error**2))))


def yaw_drift(estimate: Quaternions, reference: Quaternions, step: float) -> float:
    """Size of the change of the yaw error from the first to the last trusted row, degrees per hour.

    Of the unwrapped `relative_yaw` (TLIO). Undefined for less than 10 s, which an hour cannot be
    told from.
    """
    rows = _oriented(reference)
    error = np.unwrap(relative_yaw(estimate, reference)[rows])
    hours = (rows[-1] - rows[0]) * step / 3600
    if hours < 10 / 3600:
        raise Undefined("trusted for less than 10 s")
    return float(abs(np.degrees(error[-1] - error[0])) / hours)


# Movement
# -------------------------------------------------------------------------------------------------------------


def path_length(position: Positions, step: float, seconds: float = 1.0) -> float:
    """Length of the polygon through the rows `seconds` apart (and the last row), m; what touches an
    untrusted row is left out.

    Summing row by row would count the noise of positions as walking: 5 mm at 10 Hz is 3 m a minute.
    """
    if len(position) < 2:
        raise Undefined("a single row")
    corners = position[
        np.unique(
            np.append(np.arange(0, len(position), max(1, round(seconds / step))), len(position) - 1)
        )
    ]
    return float(np.nansum(np.linalg.norm(np.diff(corners, axis=0), axis=1)))


def path_length_ratio(estimate: Positions, reference: Positions, step: float) -> float:
    """Estimated over true `path_length` (through points 1 s apart), over the stretches that are
    trusted: 1 is right, 0 never moved."""
    length = path_length(reference, step)
    if length < 1.0:
        raise Undefined(f"the reference path is {length:.2f} m long, under 1 m")
    return path_length(np.where(finite_rows(reference)[:, None], estimate, np.nan), step) / length


def standing(reference: Positions, step: float) -> Bool[np.ndarray, "n"]:
    """Rows of the stretches of at least 2 s in which every displacement over 1 s is below 0.05 m.

    One second, because that is what the network is asked for, and because it forgives the noise of
    the reference and the swaying of a person who stands.
    """
    apart = max(1, round(1.0 / step))
    still = np.zeros(len(reference), bool)
    if len(reference) <= apart:
        return still
    with np.errstate(invalid="ignore"):
        slow = (
            np.linalg.norm(reference[apart:] - reference[:-apart], axis=1)
            < STANDING_SPEED * apart * step
        )
    edges = np.flatnonzero(np.diff(np.concatenate([[0], slow.astype(int), [0]])))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if (stop - 1 - start + apart) * step >= STANDING_SECONDS - 1e-9:
            still[start : stop + apart] = True
    return still & finite_rows(reference)


def stationary_drift(estimate: Positions, reference: Positions, step: float) -> float:
    """Metres the estimate walks per minute in which the reference stands (`standing`); the path is
    through points 1 s apart.

    What a gate on the displacement is for (GNIO). Undefined where the reference never stands for 2
    s.
    """
    still = standing(reference, step)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    walked, seconds = 0.0, 0.0
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        if stop - start > 1:
            walked += path_length(estimate[start:stop], step)
            seconds += (stop - 1 - start) * step
    if not seconds:
        raise Undefined(f"the reference never stands still for {STANDING_SECONDS:g} s")
    return float(walked / (seconds / 60))


# Consistency
# ----------------------------------------------------------------------------------------------------------


def normalised_squared(
    error: Float[np.ndarray, "n d"], covariance: Float[np.ndarray, "n d d"]
) -> Float[np.ndarray, "n"]:
    """eᵀ P⁻¹ e of each row, infinite where P is not finite and positive definite.

    Such a P claims to know some direction exactly, which no error agrees with. It is judged to the
    rounding of float64, after scaling to unit variances, so that units do not matter (ours).
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
    """Mean of normalised squared errors over their expectation d: 1 is consistent, above it the
    filter is overconfident.

    With eᵀ P⁻¹ e of the position it is `nees`, with rᵀ S⁻¹ r of the measurements `nis`
    (Bar-Shalom). NaN counts nowhere.
    """
    return float(np.mean(_present(squared)) / dims)


def coverage(squared: Float[np.ndarray, "n"], dims: int, level: float = 0.95) -> float:
    """Share of rows whose normalised squared error lies inside the χ² region of probability
    `level`, %: 95 is consistent."""
    return float(100 * np.mean(_present(squared) <= chi2.ppf(level, dims)))


# All of them
# ----------------------------------------------------------------------------------------------------------


def measure(
    estimate: Trajectory,
    reference: Trajectory,
    alignment: Alignment = "origin",
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
    reference = Trajectory(
        reference.time,
        np.where(finite_rows(reference.position)[:, None], reference.position, np.nan),
        np.where(finite_rows(reference.position)[:, None], reference.orientation, np.nan),
    )
    step = float(np.median(np.diff(estimate.time))) if len(estimate.time) > 1 else 1.0
    metrics: dict[str, Callable[[], float]] = {}
    finite, diverged = _finite(estimate), ""
    if not finite.all():
        since = estimate.time[np.argmin(finite)] - estimate.time[0]
        diverged = f"{NOT_FINITE} from {since:.1f} s on"
        # Which metrics there would be depends on the reference: a finite stand-in finds out.
        level = np.tile([1.0, 0, 0, 0], (len(finite), 1))
        estimate = Trajectory(estimate.time, np.zeros_like(estimate.position), level)
    aligned, origin, missing = estimate, estimate, ""
    try:
        aligned, origin = (
            align(estimate, reference, alignment),
            align(estimate, reference, "origin"),
        )
    except Undefined as reason:
        missing = str(reason)
    for dims in (3, 2):
        a, e, r = (
            aligned.position[:, :dims],
            estimate.position[:, :dims],
            reference.position[:, :dims],
        )
        tag = "" if dims == 3 else "_2d"
        metrics |= {
            f"ate{tag}": lambda a=a, r=r: ate(a, r),
            f"ate_ronin{tag}": lambda a=a, r=r: ate_ronin(a, r),
            f"ate_mean{tag}": lambda a=a, r=r: ate_mean(a, r),
            f"rte_60s{tag}": lambda a=a, r=r: rte(a, r, step),
            f"rte_60s_ronin{tag}": lambda a=a, r=r: rte_ronin(a, r, step),
            f"rte_1m{tag}": lambda a=a, r=r: rte_distance(a, r, 1.0),
            f"rte_10m{tag}": lambda a=a, r=r: rte_distance(a, r, 10.0),
            f"rpe_1s{tag}": lambda dims=dims: rpe(estimate, reference, step, 1.0, dims),
            f"rpe_10s{tag}": lambda dims=dims: rpe(estimate, reference, step, 10.0, dims),
            f"rpe_se3{tag}": lambda dims=dims: rpe_se3(estimate, reference, step, 1.0, dims),
            f"drift{tag}": lambda a=a, r=r: drift(a, r, step),
            f"path_length_ratio{tag}": lambda e=e, r=r: path_length_ratio(e, r, step),
            f"stationary_drift{tag}": lambda e=e, r=r: stationary_drift(e, r, step),
        }
        if position_covariance is not None:
            squared = lambda dims=dims: position_nees(
                origin, estimate, reference, position_covariance, dims
            )
            metrics |= {
                f"nees{tag}": lambda s=squared, dims=dims: mean_normalised(s(), dims),
                f"nees_coverage{tag}": lambda s=squared, dims=dims: coverage(s(), dims),
            }
    attitude = reference.orientation
    metrics |= {
        "yaw_rmse": lambda: yaw_rmse(aligned.orientation, attitude),
        "yaw_drift": lambda: yaw_drift(estimate.orientation, attitude, step),
    }
    free_of_estimate = {"path_length": lambda: path_length(reference.position, step)}
    free_of_truth = {}
    if nis is not None:
        free_of_truth = {
            "nis": lambda: mean_normalised(nis, 3),
            "nis_coverage": lambda: coverage(nis, 3),
        }
    values: dict[str, float | None] = {"duration": float(estimate.time[-1] - estimate.time[0])}
    undefined: dict[str, str] = {}
    for name, compute in (metrics | free_of_estimate | free_of_truth).items():
        try:
            if missing and name not in free_of_truth:
                raise Undefined(missing)
            with np.errstate(over="ignore", invalid="ignore"):  # too large for a number: said below
                value = compute()
        except Undefined as reason:
            values[name], undefined[name] = None, str(reason)
            continue
        infinite = diverged if name not in free_of_estimate else ""
        if not np.isfinite(value):
            infinite = infinite or TOO_LARGE
        values[name] = value if not infinite else 0.0 if name in COVERAGES else math.inf
        if infinite:
            undefined[name] = infinite
    return Measures(values, undefined)


def is_infinite(reason: str) -> bool:
    """Whether a reason in `Measures.undefined` is that of an infinite value."""
    return reason.startswith((NOT_FINITE, TOO_LARGE))


def diverged(values: Mapping[str, float | None]) -> bool:
    """Whether the estimate of a sequence diverged: its `ate` is infinite or, where there is none
    for want of a reference, anything else is. An infinite NEES alone is a bad covariance."""
    ate = values.get("ate")
    return math.inf in values.values() if ate is None else math.isinf(ate)


def position_nees(
    aligned: Trajectory,
    estimate: Trajectory,
    reference: Trajectory,
    covariance: Float[np.ndarray, "n 3 3"],
    dims: int = 3,
) -> Float[np.ndarray, "n"]:
    """eᵀ P⁻¹ e of the position, NaN where there is no reference: the error of the start-aligned
    estimate, turned back into the filter's own frame, in which its covariance is. Infinite where
    the covariance is not finite and positive definite."""
    turn = rotation_z(relative_yaw(estimate.orientation[:1], aligned.orientation[:1])[0])
    error = (aligned.position - reference.position) @ turn.T
    variance = np.einsum("nii->ni", covariance)
    squared = np.full(len(error), np.nan)
    # A start given as exact has nothing to be normalised by.
    good = finite_rows(error) & (variance != 0).all(1)
    squared[good] = normalised_squared(error[good, :dims], covariance[good, :dims, :dims])
    return squared


class Summary(NamedTuple):
    """Metrics over the sequences of a set. None where no sequence has the metric, or (interval) it
    has fewer than two groups."""

    mean: dict[str, float | None]
    """Over the sequences that did not diverge: of no worth without `diverged` beside it. Infinite
    where one of them is (NEES, with a covariance that is not positive definite)."""
    median: dict[str, float | None]
    """Over all that have the metric: of an error, infinite where half of them diverged."""
    interval: dict[str, tuple[float, float] | None]
    """Bootstrap 95 % interval of a finite mean, groups (people, sessions) drawn with replacement.
    """
    count: dict[str, int]
    """Sequences in the mean."""
    diverged: dict[str, int]
    """Sequences that have the metric and are in no mean, because their estimate diverged."""


def summarise(
    measures: Mapping[str, Mapping[str, float | None]],
    groups: Mapping[str, Any],
    seed: int = 0,
    draws: int = 2000,
) -> Summary:
    """Mean, median and bootstrap 95 % interval of every metric over sequences, each sequence
    counted once.

    `measures` is sequence -> metric -> value, `groups` sequence -> the person or session it belongs
    to: recordings of one are not independent, so whole groups are drawn (`bootstrap`). A sequence
    that `diverged` is left out of the mean, interval and count of every metric alike. The same seed
    gives the same interval.
    """
    lost = {name for name, values in measures.items() if diverged(values)}
    names = list(dict.fromkeys(metric for values in measures.values() for metric in values))
    summary = Summary({}, {}, {}, {}, {})
    for metric in names:
        present = [name for name, values in measures.items() if values.get(metric) is not None]
        numbers = np.array([measures[name][metric] for name in present], float)
        kept = np.array([name not in lost for name in present], bool)
        summary.count[metric], summary.diverged[metric] = int(kept.sum()), int((~kept).sum())
        mean = summary.mean[metric] = float(numbers[kept].mean()) if kept.any() else None
        summary.median[metric] = float(np.median(numbers)) if present else None
        drawn = [groups[name] for name in present if name not in lost]
        interval = bootstrap(numbers[kept], drawn, seed, draws) if mean != math.inf else None
        summary.interval[metric] = interval
    return summary


def bootstrap(
    values: Float[np.ndarray, "n"], groups: Iterable[Any], seed: int = 0, draws: int = 2000
) -> tuple[float, float] | None:
    """95 % interval of the mean of `values`, whole groups drawn with replacement.

    `groups` holds the group of each value. A draw's mean is over its values, so a large group
    weighs more than a small one. None of fewer than two groups.
    """
    members, index = np.unique([str(group) for group in groups], return_inverse=True)
    if len(members) < 2:
        return None
    sums, sizes = np.bincount(index, values), np.bincount(index)
    drawn = np.random.default_rng(seed).integers(0, len(members), (draws, len(members)))
    low, high = np.percentile(sums[drawn].sum(1) / sizes[drawn].sum(1), [2.5, 97.5])
    return float(low), float(high)


def finite_rows(rows: Float[np.ndarray, "n d"]) -> Bool[np.ndarray, "n"]:
    """Which rows hold neither NaN nor Inf."""
    return np.asarray(np.isfinite(rows).all(1))


def _finite(trajectory: Trajectory) -> Bool[np.ndarray, "n"]:
    return finite_rows(trajectory.position) & finite_rows(trajectory.orientation)


def _errors(estimate: Positions, reference: Positions) -> Float[np.ndarray, "m d"]:
    good = finite_rows(reference)
    if not good.any():
        raise Undefined("no trusted reference")
    return (estimate - reference)[good]


def _oriented(reference: Quaternions) -> Int[np.ndarray, "m"]:
    rows = np.flatnonzero(finite_rows(reference))
    if not len(rows):
        raise Undefined("no trusted reference")
    return rows


def _pairs(reference: Positions, rows_apart: int) -> Bool[np.ndarray, "m"]:
    good = finite_rows(reference)
    return good[rows_apart:] & good[:-rows_apart]


def _rms(errors: Float[np.ndarray, "m d"], trusted: Bool[np.ndarray, "m"], reason: str) -> float:
    if not trusted.any():
        raise Undefined(reason)
    return float(np.sqrt(np.mean(np.sum(errors[trusted] ** 2, 1))))


def _present(squared: Float[np.ndarray, "n"]) -> Float[np.ndarray, "m"]:
    present = squared[~np.isnan(squared)]
    if not len(present):
        raise Undefined("no measurement or no trusted reference")
    return present
