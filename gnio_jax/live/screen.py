"""The trajectory as a drawing of braille characters: two dots by four in each."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float

LEAST_EXTENT = 4.0
"""Metres that the drawing shows at least."""
_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
"""Bits of the Unicode braille patterns by row and column of the dot."""


def drawing(positions: Float[np.ndarray, "n d"], columns: int, rows: int) -> str:
    """A map of the path, x to the right and y up, at one scale; the last position is `●`."""
    finite = positions[np.isfinite(positions[:, :2]).all(1), :2]
    if not len(finite):
        return "\n".join(" " * columns for _ in range(rows))
    low, high = finite.min(axis=0), finite.max(axis=0)
    width, height = 2 * columns - 1, 4 * rows - 1
    extent = np.maximum(high - low, 1e-9)
    metres = max(extent[0] / width, extent[1] / height, LEAST_EXTENT / min(width, height))
    middle = (low + high) / 2
    across = np.rint((finite[:, 0] - middle[0]) / metres + width / 2).astype(int)
    down = np.rint(height / 2 - (finite[:, 1] - middle[1]) / metres).astype(int)
    across, down = np.clip(across, 0, width), np.clip(down, 0, height)
    cells = np.zeros((rows, columns), np.int64)
    np.bitwise_or.at(cells, (down // 4, across // 2), _DOTS[down % 4, across % 2])
    text = [[chr(0x2800 + bits) for bits in row] for row in cells.tolist()]
    text[down[-1] // 4][across[-1] // 2] = "●"
    return "\n".join("".join(row) for row in text)
