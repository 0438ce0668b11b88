"""Errors of positions."""

from __future__ import annotations

import numpy as np

from gnio_jax.evaluation.metrics.movement import path_length
from gnio_jax.evaluation.metrics.trajectory import Positions, Undefined, trusted_errors


def ate(estimate: Positions, reference: Positions) -> float:
    """Absolute trajectory error sqrt(mean ‖p̂ − p‖²), m (TUM/evo's APE rmse, RNIN, TLIO's
    filter)."""
    return float(np.sqrt(np.mean(np.sum(trusted_errors(estimate, reference) ** 2, 1))))


def ate_ronin(estimate: Positions, reference: Positions) -> float:
    """sqrt of the mean over rows and components of (p̂ − p)², m: `ate`/√d (the code of RoNIN and
    DeepILS)."""
    return float(np.sqrt(np.mean(trusted_errors(estimate, reference) ** 2)))


def ate_mean(estimate: Positions, reference: Positions) -> float:
    """mean ‖p̂ − p‖, m (TLIO's network test)."""
    return float(np.mean(np.linalg.norm(trusted_errors(estimate, reference), axis=1)))


def drift(estimate: Positions, reference: Positions, step: float) -> float:
    """Error at the last trusted row over the length of the reference path (`path_length`), %
    (position drift error, PDE).

    Undefined for a path below 1 m, where it says nothing.
    """
    length = path_length(reference, step)
    if length < 1.0:
        raise Undefined(f"the reference path is {length:.2f} m long, under 1 m")
    return float(100 * np.linalg.norm(trusted_errors(estimate, reference)[-1]) / length)
