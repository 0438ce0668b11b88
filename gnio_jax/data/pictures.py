"""One picture of a recording, which shows more than the figures of the self-check. This module is
only imported if a picture is requested."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gnio_jax import drawing
from gnio_jax.data.self_check import WINDOW_SECONDS, SelfCheck, gyro_windows
from gnio_jax.data.waypoints import with_poses
from gnio_jax.errors import InputError
from gnio_jax.files import shown_name
from gnio_jax.numerics import finite_rows
from gnio_jax.types import Sequence

UNTRUSTED = "#F3D9CC"
POINTS = 3000
"""Largest number of points of a line: more points than pixels only make the file larger."""
PALETTE = 96
"""Number of colours of a picture's file."""


def overview(sequence: Sequence, check: SelfCheck) -> Figure:
    """The trajectory from above, and over time the speed, |accel|, and the angle between integrated
    gyro and reference. Invalid times are shaded. Waypoints are drawn with the poses that training
    uses."""
    waypoints = sequence.waypoints
    if waypoints is not None:
        with suppress(InputError):
            sequence = with_poses(sequence)
    figure = Figure(figsize=(11.0, 5.4), dpi=90, layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.0, 1.25))
    plan = figure.add_subplot(grid[:, 0])
    if waypoints is not None:
        plan.plot(
            *waypoints.position.T, "o", ls="none", color=drawing.VERMILION, ms=4, label="waypoint"
        )
    _plan(plan, sequence)
    speed = figure.add_subplot(grid[0, 1])
    accel, gyro = (figure.add_subplot(grid[row, 1], sharex=speed) for row in (1, 2))
    _speed(speed, sequence)
    size = np.linalg.norm(sequence.accel, axis=1)
    _over_time(accel, sequence, size, color=drawing.VERMILION, lw=0.5)
    accel.set_ylabel("|accel| (m/s²)")
    _gyro(gyro, sequence)
    for panel in (speed, accel):
        panel.tick_params(labelbottom=False)
    for panel in (speed, accel, gyro):
        drawing.shade(panel, sequence.time - sequence.time[0], ~sequence.valid, UNTRUSTED)
        drawing.finish(panel)
    gyro.set_xlabel("time (s)")
    gyro.set_xlim(0.0, float(sequence.time[-1] - sequence.time[0]))
    used = f"{sequence.valid.mean():.1%} valid"
    if check.failures:
        used = f"left out: {check.failures[0]}"
    dataset = shown_name(str(sequence.attributes.get("dataset", "")))
    recorded = f"{check.duration:.0f} s at {check.rate:.4g} Hz"
    title = f"{dataset} {shown_name(sequence.name)}: {recorded}, {used}".strip()
    figure.suptitle(title, fontsize=10)
    return figure


def _over_time(axes: Axes, sequence: Sequence, values: np.ndarray, **style: Any) -> None:
    """Draw one value per sample, but at most as many as the picture has pixels."""
    stride = max(len(values) // POINTS, 1)
    axes.plot((sequence.time - sequence.time[0])[::stride], values[::stride], **style)


def _speed(axes: Axes, sequence: Sequence) -> None:
    speed = np.where(sequence.valid, np.linalg.norm(sequence.velocity, axis=1), np.nan)
    _over_time(axes, sequence, speed, color=drawing.BLUE, lw=0.9)
    axes.set_ylabel("speed (m/s)")
    axes.set_ylim(bottom=0.0)
    if not sequence.valid.all():
        axes.fill_between([], [], [], color=UNTRUSTED, lw=0, label="reference not valid")
        axes.legend(loc="upper right", fontsize=8, framealpha=0.9)


def _gyro(axes: Axes, sequence: Sequence) -> None:
    window = min(WINDOW_SECONDS, float(sequence.time[-1] - sequence.time[0]) / 4)
    starts, degrees = gyro_windows(sequence, window)
    middle = starts - sequence.time[0] + window / 2
    axes.plot(middle, degrees, "o-", color=drawing.GREEN, ms=2.5, lw=0.7)
    axes.set_ylabel(f"gyro vs. reference\nover {window:.3g} s (°)")
    axes.set_ylim(bottom=0.0)


def _plan(axes: Axes, sequence: Sequence) -> None:
    """The trajectory from above."""
    position = np.where(sequence.valid[:, None], sequence.position, np.nan)[:, :2]
    finite = position[finite_rows(position)]
    if len(finite):
        stride = max(len(position) // POINTS, 1)
        axes.plot(position[::stride, 0], position[::stride, 1], color=drawing.BLUE, lw=0.9)
        axes.plot(*finite[0], color=drawing.GREY, zorder=4, label="start", **drawing.START)
        axes.plot(*finite[-1], color=drawing.GREY, zorder=4, label="end", **drawing.END)
        axes.legend(loc="best", fontsize=8, framealpha=0.9)
        axes.margins(0.08)
    else:
        axes.text(
            0.5, 0.5, "no reference", transform=axes.transAxes, ha="center", color=drawing.GREY
        )
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    drawing.finish(axes)
