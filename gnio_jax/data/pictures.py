"""One picture of a recording, by which an eye sees what the self-check's figures cannot say. Only
imported when one is asked for."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from gnio_jax.data.plausibility import SelfCheck, gyro_windows
from gnio_jax.files import replacing
from gnio_jax.types import Sequence

BLUE, VERMILION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#8C8C8C"
UNTRUSTED = "#F3D9CC"
POINTS = 3000
"""A line of more points than the picture has pixels only makes the file larger."""
WINDOW_SECONDS = 10.0
COLOURS = 96


def save(path: Path, figure: Figure) -> None:
    """Write one figure as PNG, whole or not at all. A few colours make a third of the file: there
    may be hundreds of them."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    picture = (
        Image.fromarray(np.asarray(canvas.buffer_rgba()))
        .convert("RGB")
        .quantize(COLOURS, dither=Image.Dither.NONE)
    )
    with replacing(path) as temporary:
        picture.save(temporary, format="PNG", optimize=True)


def overview(sequence: Sequence, check: SelfCheck) -> Figure:
    """Trajectory from above, and over time: speed, |accel|, angle between integrated gyro and
    reference. Shaded: not valid."""
    figure = Figure(figsize=(11.0, 5.4), dpi=90, layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.0, 1.25))
    _plan(figure.add_subplot(grid[:, 0]), sequence)
    panels: list[Axes] = []
    for row in range(3):
        panels.append(figure.add_subplot(grid[row, 1], sharex=panels[0] if panels else None))
    for panel in panels[:-1]:
        panel.tick_params(labelbottom=False)
    time = sequence.time - sequence.time[0]
    every = max(len(time) // POINTS, 1)
    for panel in panels:
        _shade(panel, time, sequence.valid)

    speed = np.where(sequence.valid, np.linalg.norm(sequence.velocity, axis=1), np.nan)
    panels[0].plot(time[::every], speed[::every], color=BLUE, lw=0.9)
    panels[0].set_ylabel("speed (m/s)")
    panels[0].set_ylim(bottom=0.0)
    panels[1].plot(
        time[::every], np.linalg.norm(sequence.accel, axis=1)[::every], color=VERMILION, lw=0.5
    )
    panels[1].set_ylabel("|accel| (m/s²)")
    window = min(WINDOW_SECONDS, (time[-1] - time[0]) / 4)
    starts, degrees = gyro_windows(sequence, window)
    panels[2].plot(
        starts - sequence.time[0] + window / 2, degrees, "o-", color=GREEN, ms=2.5, lw=0.7
    )
    panels[2].set_ylabel(f"gyro vs. reference\nover {window:.3g} s (°)")
    panels[2].set_ylim(bottom=0.0)
    panels[2].set_xlabel("time (s)")
    panels[2].set_xlim(time[0], time[-1])
    if not sequence.valid.all():
        panels[0].fill_between([], [], [], color=UNTRUSTED, lw=0, label="reference not valid")
        panels[0].legend(loc="upper right", fontsize=8, framealpha=0.9)
    for panel in panels:
        _finish(panel)
    verdict = (
        f"left out: {check.failures[0]}" if check.failures else f"{check.share_valid:.1%} valid"
    )
    figure.suptitle(
        f"{_short(str(sequence.attributes.get('dataset', '')))} {_short(sequence.name)}: {check.duration:.0f} s at "
        f"{check.rate:.4g} Hz, {verdict}".strip(),
        fontsize=10,
    )
    return figure


def _plan(axes: Axes, sequence: Sequence) -> None:
    place = np.where(sequence.valid[:, None], sequence.position, np.nan)[:, :2]
    rows = np.flatnonzero(np.isfinite(place).all(axis=1))
    if rows.size:
        every = max(len(place) // POINTS, 1)
        axes.plot(place[::every, 0], place[::every, 1], color=BLUE, lw=0.9)
        axes.plot(
            *place[rows[0]],
            "o",
            color=GREY,
            mfc="white",
            ms=8,
            mew=1.8,
            zorder=4,
            label="start",
            ls="none",
        )
        axes.plot(*place[rows[-1]], "s", color=GREY, ms=7, zorder=4, label="end", ls="none")
        axes.legend(loc="best", fontsize=8, framealpha=0.9)
        axes.margins(0.08)
    else:
        axes.text(0.5, 0.5, "no reference", transform=axes.transAxes, ha="center", color=GREY)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    _finish(axes)


def _shade(axes: Axes, time: np.ndarray, valid: np.ndarray) -> None:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], (~valid).astype(int), [0]])))
    for start, stop in zip(edges[::2], edges[1::2], strict=True):
        axes.axvspan(float(time[start]), float(time[stop - 1]), color=UNTRUSTED, lw=0, zorder=0)


def _short(name: str) -> str:
    return name if len(name) <= 60 else f"…{name[-59:]}"


def _finish(axes: Axes) -> None:
    axes.grid(True, color="#D9D9D9", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
