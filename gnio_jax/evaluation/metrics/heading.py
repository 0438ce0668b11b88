"""Yaw of attitudes, and the errors of a heading."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from gnio_jax.evaluation.metrics.trajectory import Quaternions, Undefined
from gnio_jax.numerics import finite_rows

Angles = Float[np.ndarray, "n"]


def relative_yaw(estimate: Quaternions, reference: Quaternions) -> Angles:
    """Yaw error of attitudes R̂ against R, rad in (−π, π].

    It is the turn about the vertical that takes R nearest to R̂: ψ minimises ‖R̂ − R_z(ψ) R‖. With
    E = R̂ Rᵀ the square of that norm is 6 − 2 tr(R_z(ψ)ᵀ E), and the trace is
    cos ψ (E00 + E11) + sin ψ (E10 − E01) + E22, so ψ = atan2(E10 − E01, E00 + E11), whatever the
    attitude of the phone: the twist of E about z. With both attitudes level it is the difference of
    their yaws. It has no value only where E is half a turn about a horizontal axis and every ψ is
    as near: 0 there (ours). NaN stays NaN.
    """
    (a, b, c, d), (w, x, y, z) = estimate.T, reference.T
    # Parts of the quaternion of E.
    scalar, vertical = a * w + b * x + c * y + d * z, d * w - a * z + c * x - b * y
    return np.arctan2(2 * scalar * vertical, scalar**2 - vertical**2)


def yaw_rmse(estimate: Quaternions, reference: Quaternions) -> float:
    """Root mean square of the yaw error (`relative_yaw`), degrees (TLIO)."""
    error = relative_yaw(estimate, reference)[_trusted(reference)]
    return float(np.degrees(np.sqrt(np.mean(error**2))))


def yaw_drift(estimate: Quaternions, reference: Quaternions, step: float) -> float:
    """Size of the change of the yaw error from the first to the last trusted row, degrees per hour.

    The yaw error is the unwrapped `relative_yaw` (TLIO). Undefined for less than 10 s, which says
    nothing of an hour.
    """
    rows = _trusted(reference)
    error = np.unwrap(relative_yaw(estimate, reference)[rows])
    hours = (rows[-1] - rows[0]) * step / 3600
    if hours < 10 / 3600:
        raise Undefined("trusted for less than 10 s")
    return float(abs(np.degrees(error[-1] - error[0])) / hours)


def _trusted(reference: Quaternions) -> Int[np.ndarray, "m"]:
    rows = np.flatnonzero(finite_rows(reference))
    if not len(rows):
        raise Undefined("no trusted reference")
    return rows
