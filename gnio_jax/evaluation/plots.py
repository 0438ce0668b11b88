"""Pictures of an evaluation. Every function returns a `Figure` and keeps no state.

Colours are those of Okabe and Ito, which the colour-blind can tell apart; the reference is black
throughout. Matplotlib is imported here, so import this module only where something is drawn.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.estimators.result import Estimate
from gnio_jax.evaluation.frames import in_the_references_frame
from gnio_jax.evaluation.report import Report, file_names
from gnio_jax.evaluation.setup import OnShare, no_progress
from gnio_jax.evaluation.trajectory import Alignment, relative_yaw
from gnio_jax.files import shown_name
from gnio_jax.numerics import finite_rows, rotation_z, spans
from gnio_jax.windows import true_displacement

BLUE, VERMILION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#8C8C8C"
AXES = {"x": BLUE, "y": VERMILION, "z": GREEN}
REFERENCE = "black"
STANDING = "#E8E8E8"
GRID = "#D9D9D9"
DOTS_PER_INCH = 120
START: dict[str, Any] = {"marker": "o", "ls": "", "mfc": "white", "ms": 8, "mew": 1.8}
END: dict[str, Any] = {"marker": "s", "ls": "", "ms": 7}


def save_all(
    folder: Path,
    estimates: list[Estimate],
    report: Report,
    window_seconds: float,
    progress: OnShare = no_progress,
) -> None:
    """Every picture as a PNG in `folder`: three for each sequence (`<name>_trajectory`, `_error`,
    `_displacement`) and `error_cdf`."""
    folder.mkdir(parents=True, exist_ok=True)
    alignment = report.settings["alignment"]
    stems = file_names([e.name for e in estimates])
    for done, (stem, estimate) in enumerate(zip(stems, estimates, strict=True)):
        progress(done / len(estimates))
        values = report.scores.sequences[estimate.name].values
        figure = trajectory(estimate, values.get("ate"), values.get("ate_2d"), alignment)
        save(folder / f"{stem}_trajectory.png", figure)
        if np.isfinite(estimate.reference.position).any():
            save(folder / f"{stem}_error.png", position_error(estimate))
        if estimate.displacement is not None and np.isfinite(estimate.displacement).any():
            save(folder / f"{stem}_displacement.png", displacement(estimate, window_seconds))
    if any(np.isfinite(e.reference.position).any() for e in estimates):
        save(folder / "error_cdf.png", error_cdf(estimates, report))


def save(path: Path, figure: Figure) -> None:
    """Write one figure."""
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=DOTS_PER_INCH)


# One sequence
# --------------------------------------------------------------------------------------------------


def trajectory(
    estimate: Estimate,
    ate: float | None = None,
    ate_2d: float | None = None,
    alignment: Alignment = "origin",
) -> Figure:
    """Plan view of the estimate over the reference, both axes to the same scale."""
    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    axes = figure.add_subplot()
    path = in_the_references_frame(estimate, alignment).trajectory.position
    reference = estimate.reference.position
    axes.plot(reference[:, 0], reference[:, 1], color=REFERENCE, lw=1.6, label="reference")
    axes.plot(path[:, 0], path[:, 1], color=BLUE, lw=1.4, label="estimate")
    for track, colour in ((reference, REFERENCE), (path, BLUE)):
        good = track[np.isfinite(track).all(1)]
        if len(good):
            axes.plot(*good[0, :2], color=colour, zorder=4, **START)
            axes.plot(*good[-1, :2], color=colour, zorder=4, **END)
    axes.plot([], [], color=GREY, label="start", **START)
    axes.plot([], [], color=GREY, label="end", **END)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    errors = [
        f"ATE {ate:.2f} m" if ate is not None else "",
        f"{ate_2d:.2f} m in 2-D" if ate_2d is not None else "",
    ]
    lines = [shown_name(estimate.name), ", ".join(filter(None, errors))]
    axes.set_title("\n".join(filter(None, lines)), fontsize=11)
    axes.legend(loc="best", ncols=2, fontsize=9, framealpha=0.9)
    finish(axes)
    return figure


def position_error(estimate: Estimate) -> Figure:
    """Position error over time on each axis, start aligned, with the filter's ±3σ where there is a
    filter."""
    figure = Figure(figsize=(8.4, 6.0), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    time = estimate.trajectory.time - estimate.trajectory.time[0]
    error = _error_in_filter_frame(estimate)
    still = metrics.standing(estimate.reference.position, float(np.median(np.diff(time))))
    for k, (panel, (name, colour)) in enumerate(zip(panels, AXES.items(), strict=True)):
        _shade(panel, time, still)
        if estimate.std is not None:
            bound = 3 * estimate.std[:, 6 + k]
            panel.fill_between(time, -bound, bound, color=colour, alpha=0.16, lw=0, label="±3σ")
        panel.plot(time, error[:, k], color=colour, lw=1.2, label="error")
        panel.axhline(0, color=REFERENCE, lw=0.6)
        panel.set_ylabel(f"{name} (m)")
    panels[0].set_title(f"{shown_name(estimate.name)}: position error", fontsize=11)
    _finish_over_time(panels, time)
    return figure


def displacement(estimate: Estimate, window_seconds: float) -> Figure:
    """What the network predicts, at the middle of each window: speed, displacement and gate; grey
    where the reference stands still."""
    assert estimate.displacement is not None
    gate = estimate.diagnostics.get("gate")
    rows, height = (2, 5.6) if gate is None else (3, 7.6)
    figure = Figure(figsize=(8.4, height), layout="constrained")
    panels = figure.subplots(rows, 1, sharex=True)
    time = estimate.trajectory.time - estimate.trajectory.time[0]
    step = float(np.median(np.diff(time)))
    still = metrics.standing(estimate.reference.position, step)
    for panel in panels:
        _shade(panel, time, still)
    middle = time - window_seconds / 2
    truth = _true_displacement(estimate, round(window_seconds / step))
    _draw_speed(panels[0], middle, truth, estimate.displacement, window_seconds)
    title = f"{shown_name(estimate.name)}: displacement of the window, at its middle"
    panels[0].set_title(title, fontsize=11)
    _draw_displacement(panels[1], middle, truth, estimate.displacement)
    if gate is not None:
        _draw_gate(panels[2], middle, gate)
    _finish_over_time(panels, time)
    return figure


def _draw_speed(
    axes: Axes,
    time: Float[np.ndarray, "k"],
    truth: Float[np.ndarray, "k 3"],
    predicted: Float[np.ndarray, "k 3"],
    seconds: float,
) -> None:
    true_speed = np.linalg.norm(truth, axis=1) / seconds
    axes.plot(time, true_speed, color=REFERENCE, lw=1.4, label="reference")
    speed = np.linalg.norm(predicted, axis=1) / seconds
    axes.plot(time, speed, color=BLUE, lw=1.1, label="network")
    axes.set_ylabel("speed (m/s)")
    axes.set_ylim(bottom=0)


def _draw_displacement(
    axes: Axes,
    time: Float[np.ndarray, "k"],
    truth: Float[np.ndarray, "k 3"],
    predicted: Float[np.ndarray, "k 3"],
) -> None:
    for k, (name, colour) in enumerate(AXES.items()):
        label = f"{name}, reference"
        axes.plot(time, truth[:, k], color=colour, lw=3.0, alpha=0.35, label=label)
    for k, (name, colour) in enumerate(AXES.items()):
        axes.plot(time, predicted[:, k], color=colour, lw=1.0, label=name)
    axes.set_ylabel("displacement (m)")


def _draw_gate(axes: Axes, time: Float[np.ndarray, "k"], gate: Float[np.ndarray, "k 3"]) -> None:
    for k, (name, colour) in enumerate(AXES.items()):
        axes.plot(time, gate[:, k], color=colour, lw=1.1, label=name)
    axes.axhline(0, color=REFERENCE, lw=0.6)
    lowest = -1.05 if np.nanmin(gate) < 0 else -0.05
    axes.set_ylim(lowest, 1.05)
    axes.set_ylabel("gate γ (–)")


# A set of sequences
# --------------------------------------------------------------------------------------------------


def error_cdf(estimates: list[Estimate], report: Report) -> Figure:
    """Distribution of errors over the set: of every sample's horizontal position, and of the
    sequences' ATE beside the reference rows."""
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    sequences = _draw_sample_errors(left, estimates, report.settings["alignment"])
    _draw_sequence_errors(right, report)
    for axes in (left, right):
        axes.set_ylim(0, 1.02)
        axes.set_xlim(left=0)
        axes.legend(loc="lower right", fontsize=9, framealpha=0.9)
        finish(axes)
    settings = report.settings
    subject = f"{settings['dataset']} {settings['split']}: {settings['estimator']}"
    figure.suptitle(f"{subject}, {sequences} sequences", fontsize=11)
    return figure


def _draw_sample_errors(axes: Axes, estimates: list[Estimate], alignment: Alignment) -> int:
    """Returns the number of sequences that have a reference."""
    samples = []
    for e in estimates:
        path = in_the_references_frame(e, alignment).trajectory.position
        error = np.linalg.norm((path - e.reference.position)[:, :2], axis=1)
        error = error[finite_rows(e.reference.position)]
        if len(error):
            _step(axes, error, color=BLUE, lw=0.7, alpha=0.25)
            samples.append(error)
    if samples:
        _step(axes, np.concatenate(samples), color=BLUE, lw=2.2, label="all samples")
    axes.plot([], [], color=BLUE, lw=0.7, alpha=0.5, label="one sequence")
    axes.set_xlabel("horizontal position error (m)")
    axes.set_ylabel("share with at most this error")
    axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    return len(samples)


def _draw_sequence_errors(axes: Axes, report: Report) -> None:
    scored = {"this network": report.scores, **report.reference_rows}
    styles = ((BLUE, "-"), (VERMILION, "--"), (GREEN, "-."))
    for (name, scores), (colour, style) in zip(scored.items(), styles, strict=False):
        errors = (m.values.get("ate_2d") for m in scores.sequences.values())
        values = np.array([error for error in errors if error is not None])
        if len(values):
            label = f"{name.replace('_', ' ')} (median {np.median(values):.2f} m)"
            _step(axes, values, color=colour, lw=1.8, ls=style, label=label)
    axes.set_xlabel("ATE in 2-D of a sequence (m)")


def _step(axes: Axes, values: Float[np.ndarray, "k"], **style: Any) -> None:
    """Cumulative distribution. A value that is not finite has diverged: it counts, and the line
    ends below 1."""
    x = np.sort(values[np.isfinite(values)])
    share = np.arange(len(x) + 1) / len(values)
    axes.step(np.concatenate([[0.0], x]), share, where="post", **style)


# Parts of a picture
# --------------------------------------------------------------------------------------------------


def finish(axes: Axes, grid: str = GRID) -> None:
    """Grid behind the lines, no frame above and to the right."""
    axes.grid(True, color=grid, lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def _finish_over_time(panels: np.ndarray, time: Float[np.ndarray, "k"]) -> None:
    """Legends beside the panels, where they hide nothing, and the common time axis."""
    for panel in panels:
        panel.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9, frameon=False)
        finish(panel)
    panels[-1].set_xlabel("time (s)")
    panels[-1].set_xlim(time[0], time[-1])


def _shade(axes: Axes, time: Float[np.ndarray, "k"], still: Bool[np.ndarray, "k"]) -> None:
    """Grey where the reference stands still; once in the legend."""
    for number, (start, stop) in enumerate(spans(still)):
        begin, end = float(time[start]), float(time[stop - 1])
        label = "standing still" if not number else None
        axes.axvspan(begin, end, color=STANDING, lw=0, zorder=0, label=label)


def _error_in_filter_frame(estimate: Estimate) -> Float[np.ndarray, "k 3"]:
    """Position error of the start-aligned estimate, m, in the frame of the filter's covariance."""
    aligned = in_the_references_frame(estimate).trajectory
    start, aligned_start = (path.orientation[:1] for path in (estimate.trajectory, aligned))
    turn = rotation_z(relative_yaw(start, aligned_start)[0])
    return (aligned.position - estimate.reference.position) @ turn.T


def _true_displacement(estimate: Estimate, rows: int) -> Float[np.ndarray, "k 3"]:
    """Of the reference over the window that ends at each row, in the yaw frame of its start, m."""
    reference = estimate.reference
    found = np.full_like(reference.position, np.nan)
    if rows < len(found):
        start = np.arange(len(found) - rows)
        found[rows:] = true_displacement(reference.orientation, reference.position, start, rows)
    return found
