"""Positions and velocities of a noisy tracker."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float
from scipy.linalg import solveh_banded


def smooth_positions(
    position: Float[np.ndarray, "n 3"],
    good: Bool[np.ndarray, " n"],
    step: float,
    cutoff: float = 12.0,
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "n 3"], Bool[np.ndarray, " n"]]:
    """Positions (m), velocities (m/s) and which measurements were believed.

    The positions minimise Σ w |p − z|² + λ Σ |Δ³p|² (Whittaker's smoother): the response falls to
    one half at `cutoff` Hz and stays 1 to 0.1 % below a third of it. Weights fall with the
    residual, which removes single jumps; where nothing was measured the smoother bridges with the
    smoothest acceleration.
    """
    smoothness = (2.0 * np.sin(np.pi * cutoff * step)) ** -6 * _third_difference_bands(
        len(position)
    )
    filled = np.where(good[:, None], position, 0.0)
    weight = good.astype(float)
    smoothed = filled
    for _ in range(5):
        system = smoothness.copy()
        system[-1] += weight + 1e-9  # the diagonal
        smoothed = solveh_banded(system, weight[:, None] * filled)
        distance = np.linalg.norm(filled - smoothed, axis=1)
        scale = max(4.0 * float(np.median(distance[good])), 2e-3) if good.any() else 1.0
        weight = good / (1.0 + (distance / scale) ** 2) ** 2
    return smoothed, np.gradient(smoothed, step, axis=0), good & (weight > 0.1)


def _third_difference_bands(n: int) -> Float[np.ndarray, "4 n"]:
    """Δ³ᵀΔ³ in SciPy's upper banded form: bands[3 − d, j] couples j and j − d."""
    stencil = np.array([-1.0, 3.0, -3.0, 1.0])
    bands = np.zeros((4, n))
    for a in range(4):
        for b in range(a, 4):
            bands[3 - (b - a), b : n - 3 + b] += stencil[a] * stencil[b]
    return bands
