"""What all pictures share: colours, marks, the grid and the file.

The colours are those of Okabe and Ito, which colour-blind readers can distinguish; the reference is
always black. Matplotlib is imported here, so import this module only where something is drawn.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from gnio_jax.files import replacing
from gnio_jax.numerics import spans

BLUE, VERMILION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#8C8C8C"
PURPLE, ORANGE, SKY, YELLOW = "#CC79A7", "#E69F00", "#56B4E9", "#F0E442"
REFERENCE = "#000000"
COLOURS = (BLUE, VERMILION, GREEN, PURPLE, ORANGE, SKY)
"""One for each run, method or row."""
AXES = {"x": BLUE, "y": VERMILION, "z": GREEN}
GRID = "#DDDDDD"
START: dict[str, Any] = {"marker": "o", "ls": "", "mfc": "white", "ms": 8, "mew": 1.8}
END: dict[str, Any] = {"marker": "s", "ls": "", "ms": 7}
DOTS_PER_INCH = 120


def save(path: Path, figure: Figure, palette: int | None = None) -> None:
    """Write one figure as a PNG, whole or not at all.

    With a `palette` of so many colours the file has a third of the size, which matters if there are
    hundreds of files.
    """
    canvas = FigureCanvasAgg(figure)
    with replacing(path) as temporary:
        if palette is None:
            figure.savefig(temporary, dpi=DOTS_PER_INCH)
            return
        canvas.draw()
        picture = Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB")
        picture = picture.quantize(palette, dither=Image.Dither.NONE)
        picture.save(temporary, format="PNG", optimize=True)


def finish(axes: Axes) -> None:
    """Put the grid behind the lines, and remove the frame above and to the right."""
    axes.grid(True, color=GRID, lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def shade(
    axes: Axes,
    time: Float[np.ndarray, "n"],
    rows: Bool[np.ndarray, "n"],
    colour: str,
    label: str | None = None,
) -> None:
    """Shade the times of some rows, with one entry in the legend."""
    for number, (start, stop) in enumerate(spans(rows)):
        begin, end = float(time[start]), float(time[stop - 1])
        axes.axvspan(begin, end, color=colour, lw=0, zorder=0, label=None if number else label)
