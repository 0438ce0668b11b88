"""The picture of a track: the map with the filter's 3σ, and speed, gate and σ over time."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from gnio_jax.evaluation import Estimate
from gnio_jax.evaluation.frames import with_the_reference_in_its_frame
from gnio_jax.evaluation.plots import AXES, BLUE, END, REFERENCE, START, finish, save
from gnio_jax.tracking.summary import Summary

__all__ = ["draw", "save"]

ELLIPSES = 12
"""On the map, at even times."""


def draw(estimate: Estimate, summary: Summary) -> Figure:
    """Map on the left, strips over time on the right."""
    figure = Figure(figsize=(12.6, 6.6), layout="constrained")
    grid = figure.add_gridspec(3, 2, width_ratios=(1.1, 1.0))
    _draw_map(figure.add_subplot(grid[:, 0]), estimate)
    strips = [figure.add_subplot(grid[row, 1]) for row in range(3)]
    time = estimate.trajectory.time - estimate.trajectory.time[0]
    _draw_speed(strips[0], time, estimate)
    _draw_gate(strips[1], time, estimate)
    _draw_std(strips[2], time, estimate)
    for strip in strips:
        strip.set_xlim(time[0], time[-1])
        strip.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9, frameon=False)
        finish(strip)
    strips[-1].set_xlabel("time (s)")
    length = f"{summary.path_length:.0f} m in {summary.seconds:.0f} s"
    expected = f"expected error at the end {summary.expected_error:.1f} m"
    # A dollar in a name would begin a formula.
    name = summary.recording[:60].replace("$", r"\$")
    figure.suptitle(f"{name}: {length}, {expected}", fontsize=11)
    return figure


def ellipse(
    place: Float[np.ndarray, "2"], covariance: Float[np.ndarray, "2 2"], sigmas: float = 3.0
) -> Ellipse:
    """The contour of a horizontal covariance (m²) around a place (m)."""
    variance, axes = np.linalg.eigh(covariance)
    across, along = 2.0 * sigmas * np.sqrt(np.maximum(variance, 0.0))
    angle = float(np.degrees(np.arctan2(axes[1, 1], axes[0, 1])))
    return Ellipse((place[0], place[1]), along, across, angle=angle)


def _draw_map(axes: Axes, estimate: Estimate) -> None:
    path, covariance = estimate.trajectory.position, estimate.position_covariance
    reference = with_the_reference_in_its_frame(estimate).reference.position
    if np.isfinite(reference).any():
        axes.plot(*reference[:, :2].T, color=REFERENCE, lw=1.6, label="reference")
    axes.plot(path[:, 0], path[:, 1], color=BLUE, lw=1.5, label="track")
    good = np.flatnonzero(np.isfinite(path).all(axis=1))
    assert covariance is not None
    for row in good[np.linspace(0, len(good) - 1, ELLIPSES).astype(int)]:
        shape = ellipse(path[row, :2], covariance[row, :2, :2])
        shape.set(facecolor=BLUE, edgecolor=BLUE, alpha=0.13)
        axes.add_patch(shape)
    axes.plot([], [], color=BLUE, lw=6, alpha=0.2, label="3σ")
    axes.plot(*path[good[0], :2], color=BLUE, zorder=4, label="start", **START)
    axes.plot(*path[good[-1], :2], color=BLUE, zorder=4, label="end", **END)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.legend(loc="best", fontsize=9, framealpha=0.9)
    finish(axes)


def _draw_speed(axes: Axes, time: Float[np.ndarray, "k"], estimate: Estimate) -> None:
    assert estimate.velocity is not None
    speed = np.linalg.norm(estimate.velocity[:, :2], axis=1)
    axes.plot(time, speed, color=BLUE, lw=1.1, label="horizontal")
    axes.set_ylabel("speed (m/s)")
    axes.set_ylim(bottom=0)


def _draw_gate(axes: Axes, time: Float[np.ndarray, "k"], estimate: Estimate) -> None:
    """The network's gate where it has one, else whether the filter took its displacements."""
    gate = estimate.diagnostics.get("gate")
    if gate is None:
        axes.plot(time, estimate.accepted, color=BLUE, lw=1.0, label="displacement used")
        axes.set_ylabel("accepted (–)")
    else:
        for k, (name, colour) in enumerate(AXES.items()):
            axes.plot(time, gate[:, k], color=colour, lw=1.0, label=name)
        axes.set_ylabel("gate γ (–)")
    axes.set_ylim(-1.05, 1.05)


def _draw_std(axes: Axes, time: Float[np.ndarray, "k"], estimate: Estimate) -> None:
    assert estimate.position_covariance is not None
    variance = np.diagonal(estimate.position_covariance, axis1=1, axis2=2)
    axes.plot(time, np.sqrt(variance[:, :2].sum(1)), color=BLUE, lw=1.4, label="horizontal")
    axes.plot(time, np.sqrt(variance[:, 2]), color=AXES["z"], lw=1.1, label="z")
    axes.set_ylabel("σ of position (m)")
    axes.set_ylim(bottom=0)
