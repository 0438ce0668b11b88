"""Quaternions are wxyz here and everywhere in the package; SciPy's xyzw never leaves `rotations`
and `quaternions`."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation


def rotations(wxyz: Float[np.ndarray, "... 4"]) -> Rotation:
    """SciPy rotations of quaternions wxyz."""
    return Rotation.from_quat(np.asarray(wxyz)[..., [1, 2, 3, 0]])


def quaternions(rotation: Rotation) -> Float[np.ndarray, "... 4"]:
    """Unit quaternions wxyz of SciPy rotations."""
    return rotation.as_quat()[..., [3, 0, 1, 2]]


def cumulative_rotation(turns: Rotation) -> Rotation:
    """R_0, R_0 R_1, R_0 R_1 R_2, … of a stack of rotations, in log2(n) vectorized passes."""
    reach = 1
    while reach < len(turns):
        turns = Rotation.concatenate([turns[:reach], turns[:-reach] * turns[reach:]])
        reach *= 2
    return turns
