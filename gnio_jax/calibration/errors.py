"""How far the network's standard deviations are from its errors."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gnio_jax.evaluation.estimators.result import Estimate

LEAST_WINDOWS = 100
"""Below this many windows with a reference nothing is fitted (ours)."""
LEAST_FACTOR = 1e-3
"""No axis is surer than this of what the network says (ours)."""


def std_factors(
    estimates: list[Estimate], truths: list[Float[np.ndarray, "m 3"]]
) -> Float[np.ndarray, "3"]:
    """Root mean square of error over standard deviation, of each axis, over all windows.

    `truths` are the true displacements of the windows, in the yaw frame of the reference at their
    starts; the network's are in the filter's own, which is the frame that it answers in.
    Raises `ValueError` where too few windows have both.
    """
    normalised = np.concatenate(
        [_normalised(estimate, truth) for estimate, truth in zip(estimates, truths, strict=True)]
    )
    if len(normalised) < LEAST_WINDOWS:
        raise ValueError(f"{len(normalised)} windows have a reference, {LEAST_WINDOWS} are needed")
    return np.maximum(np.sqrt(np.mean(normalised**2, axis=0)), LEAST_FACTOR)


def _normalised(estimate: Estimate, truth: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "w 3"]:
    assert estimate.displacement is not None and estimate.displacement_std is not None
    last = slice(len(estimate.displacement) - len(truth), None)
    found = (estimate.displacement[last] - truth) / estimate.displacement_std[last]
    return found[np.isfinite(found).all(1)]
