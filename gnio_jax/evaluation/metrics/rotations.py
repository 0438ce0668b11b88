"""Rotations as the metrics need them, in NumPy."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

from gnio_jax.evaluation.metrics.trajectory import Quaternions


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


def multiply(left: Float[np.ndarray, "4"], right: Quaternions) -> Quaternions:
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


def quaternion(rotation: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "4"]:
    from scipy.spatial.transform import Rotation

    return np.roll(Rotation.from_matrix(rotation).as_quat(), 1)


def spans(mask):
    """Start and stop of each run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[0], mask.astype(int), [0]])))
    return list(zip(edges[::2], edges[1::2], strict=True))
