"""Errors of displacements between two rows of a trajectory."""

from __future__ import annotations

import numpy as np

from gnio_jax.evaluation.metrics.heading import relative_yaw
from gnio_jax.evaluation.metrics.trajectory import (
    Positions,
    Trajectory,
    Undefined,
    rms,
    trusted_pairs,
)
from gnio_jax.numerics import finite_rows, matrix_from_quaternion, rotation_z, spans


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
    return rms(
        error[rows_apart:] - error[:-rows_apart],
        trusted_pairs(reference, rows_apart),
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
    errors = [np.zeros((0, estimate.shape[1]))]
    # A path is known within an unbroken stretch of the reference only.
    for start, stop in spans(finite_rows(reference)):
        truth, error = reference[start:stop], (estimate - reference)[start:stop]
        walked = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth, axis=0), axis=1))])
        end = np.searchsorted(walked, walked + metres - 1e-9)
        begin = np.flatnonzero(end < len(walked))
        errors.append(error[end[begin]] - error[begin])
    found = np.concatenate(errors)
    return rms(found, np.ones(len(found), bool), f"no unbroken reference of {metres:g} m")


def rpe(
    estimate: Trajectory, reference: Trajectory, step: float, seconds: float, dims: int = 3
) -> float:
    """Relative pose error: RMS norm of the error of displacements over `seconds` with the yaw at
    their start aligned, m (TLIO).

    error_i = R_z(−ψ_i)(p̂_j − p̂_i) − (p_j − p_i), from every row i, with ψ the `relative_yaw` of
    the estimate's attitude, so that a wrong heading of the whole trajectory costs nothing; with
    `dims` 2 its horizontal part.
    """
    rows_apart = _rows_apart(estimate, step, seconds)
    start, start_true = (path.orientation[:-rows_apart] for path in (estimate, reference))
    turn = rotation_z(-relative_yaw(start, start_true))
    moved, moved_true = (_displacements(path, rows_apart) for path in (estimate, reference))
    error = np.einsum("nij,nj->ni", turn, moved) - moved_true
    return _rms_of_pairs(error[:, :dims], reference, rows_apart, seconds)


def rpe_se3(
    estimate: Trajectory, reference: Trajectory, step: float, seconds: float = 1.0, dims: int = 3
) -> float:
    """RMS of the translation part of the relative pose error with the full orientation at the
    start, all pairs, m (TUM, evo).

    error_i = R_i R̂_iᵀ (p̂_j − p̂_i) − (p_j − p_i) in the reference's world (its norm is evo's);
    with `dims` 2 its horizontal part.
    """
    rows_apart = _rows_apart(estimate, step, seconds)
    start, start_true = (
        matrix_from_quaternion(path.orientation[:-rows_apart]) for path in (estimate, reference)
    )
    moved, moved_true = (_displacements(path, rows_apart) for path in (estimate, reference))
    error = np.einsum("nij,nkj,nk->ni", start_true, start, moved) - moved_true
    return _rms_of_pairs(error[:, :dims], reference, rows_apart, seconds)


def _rows_apart(estimate: Trajectory, step: float, seconds: float) -> int:
    rows_apart = round(seconds / step)
    if rows_apart >= len(estimate.time):
        raise Undefined(f"no two trusted rows {seconds:g} s apart")
    return rows_apart


def _displacements(path: Trajectory, rows_apart: int) -> Positions:
    return path.position[rows_apart:] - path.position[:-rows_apart]


def _rms_of_pairs(
    error: Positions, reference: Trajectory, rows_apart: int, seconds: float
) -> float:
    """Over the pairs of trusted positions whose start has a trusted orientation."""
    oriented = finite_rows(reference.orientation[:-rows_apart])
    trusted = trusted_pairs(reference.position, rows_apart) & oriented
    return rms(error, trusted, f"no two trusted rows {seconds:g} s apart")
