"""The terminal: the newest pose in words, and the path as a drawing of braille characters, two dots
by four in each."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from jaxtyping import Float

from gnio_jax.filtering import Pose
from gnio_jax.live.following import Follower

LEAST_EXTENT = 4.0
"""Metres that the drawing shows at least."""
DRAWN_EVERY = 0.125
"""s. A drawing looks at the whole path: one for each pose would fall behind a long stream."""
_DOTS = np.array([[0x01, 0x08], [0x02, 0x10], [0x04, 0x20], [0x40, 0x80]])
"""Bits of the Unicode braille patterns by row and column of the dot."""


@contextlib.contextmanager
def shown(console: Any) -> Iterator[Callable[[Follower], None]]:
    """What is called after each clone step: it draws on the `rich` console of a terminal, and
    prints a line each second on another one."""
    if not console.is_terminal:
        yield lambda found: _print_each_second(console, found.poses)
        return
    from rich.live import Live
    from rich.text import Text

    with Live(console=console, refresh_per_second=8, transient=True) as screen:
        drawn = -math.inf

        def draw(found: Follower) -> None:
            nonlocal drawn
            if time.monotonic() - drawn < DRAWN_EVERY:
                return
            columns, rows = max(10, console.width - 2), max(5, console.height - 4)
            positions = np.array([pose.position for pose in found.poses])
            screen.update(Text(f"{drawing(positions, columns, rows)}\n{line(found.poses)}"))
            drawn = time.monotonic()

        yield draw


def _print_each_second(console: Any, poses: list[Pose]) -> None:
    newest, start = poses[-1].time, poses[0].time
    before = poses[-2].time if len(poses) > 1 else start - 1
    if int(newest - start) > int(before - start):
        console.print(line(poses), soft_wrap=True)


def line(poses: list[Pose]) -> str:
    """The newest pose in words."""
    pose = poses[-1]
    x, y, z = pose.position
    sigma = float(np.sqrt(np.maximum(np.trace(pose.covariance[6:8, 6:8]), 0.0)))
    path = np.array([each.position for each in poses[::10]])
    walked = float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum())
    health = "" if pose.healthy else "  THE FILTER DIVERGED"
    return (
        f"{pose.time - poses[0].time:7.1f} s  x {x:+8.2f}  y {y:+8.2f}  z {z:+7.2f} m  "
        f"± {sigma:.2f} m  walked {walked:.1f} m{health}"
    )


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
