"""Figures of an evaluation. The only importer of Matplotlib; every function returns a `Figure` and
keeps no state.

Colours are those of Okabe and Ito, which the colour-blind can tell apart; the reference is black
throughout.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import PercentFormatter

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.metrics import Trajectory, Undefined
from gnio_jax.evaluation.odometry import Estimate, Progress
from gnio_jax.evaluation.report import Report, file_names

BLUE, VERMILION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "#8C8C8C"
AXES = {"x": BLUE, "y": VERMILION, "z": GREEN}
REFERENCE = "black"
STANDING = "#E8E8E8"
_DPI = 120


def save_all(
    folder: Path,
    estimates: list[Estimate],
    report: Report,
    window_seconds: float,
    progress: Progress | None = None,
) -> None:
    """Every figure as a PNG in `folder`: three for each sequence (`<name>_trajectory`, `_error`,
    `_displacement`) and `error_cdf`."""
    folder.mkdir(parents=True, exist_ok=True)
    alignment = report.settings["alignment"]
    for done, (stem, estimate) in enumerate(
        zip(file_names([e.name for e in estimates]), estimates, strict=True)
    ):
        if progress:
            progress(done / len(estimates))
        values = report.scores.sequences[estimate.name].values
        save(
            folder / f"{stem}_trajectory.png",
            trajectory(estimate, values.get("ate"), values.get("ate_2d"), alignment),
        )
        if np.isfinite(estimate.reference.position).any():
            save(folder / f"{stem}_error.png", position_error(estimate))
        if estimate.displacement is not None and np.isfinite(estimate.displacement).any():
            save(folder / f"{stem}_displacement.png", displacement(estimate, window_seconds))
    if any(np.isfinite(e.reference.position).any() for e in estimates):
        save(folder / "error_cdf.png", error_cdf(estimates, report))


def save(path: Path, figure: Figure) -> None:
    """Write one figure."""
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=_DPI)


def trajectory(
    estimate: Estimate,
    ate: float | None = None,
    ate_2d: float | None = None,
    alignment: metrics.Alignment = "origin",
) -> Figure:
    """Plan view of the estimate over the reference, both axes to the same scale."""
    figure = Figure(figsize=(6.4, 6.4), layout="constrained")
    axes = figure.add_subplot()
    path, reference = _aligned(estimate, alignment).position, estimate.reference.position
    axes.plot(reference[:, 0], reference[:, 1], color=REFERENCE, lw=1.6, label="reference")
    axes.plot(path[:, 0], path[:, 1], color=BLUE, lw=1.4, label="estimate")
    for track, colour in ((reference, REFERENCE), (path, BLUE)):
        good = track[np.isfinite(track).all(1)]
        if len(good):
            axes.plot(*good[0, :2], "o", color=colour, mfc="white", ms=8, mew=1.8, zorder=4)
            axes.plot(*good[-1, :2], "s", color=colour, ms=7, zorder=4)
    axes.plot([], [], "o", color=GREY, mfc="white", ms=8, mew=1.8, label="start")
    axes.plot([], [], "s", color=GREY, ms=7, label="end")
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    found = [
        f"ATE {ate:.2f} m" if ate is not None else "",
        f"{ate_2d:.2f} m in 2-D" if ate_2d is not None else "",
    ]
    axes.set_title(
        "\n".join(filter(None, [_short(estimate.name), ", ".join(filter(None, found))])),
        fontsize=11,
    )
    axes.legend(loc="best", ncols=2, fontsize=9, framealpha=0.9)
    _finish(axes)
    return figure


def position_error(estimate: Estimate) -> Figure:
    """Position error over time on each axis, start aligned, with the filter's ±3σ where there is a
    filter."""
    figure = Figure(figsize=(8.4, 6.0), layout="constrained")
    panels = figure.subplots(3, 1, sharex=True)
    time = estimate.trajectory.time - estimate.trajectory.time[0]
    aligned = _aligned(estimate, "origin")
    start, start_aligned = (path.orientation[:1] for path in (estimate.trajectory, aligned))
    turn = metrics.rotation_z(metrics.relative_yaw(start, start_aligned)[0])
    error = (
        aligned.position - estimate.reference.position
    ) @ turn.T  # in the filter's own frame, as its covariance is
    still = metrics.standing(estimate.reference.position, float(np.median(np.diff(time))))
    for k, (panel, (name, colour)) in enumerate(zip(panels, AXES.items(), strict=True)):
        _shade(panel, time, still)
        if estimate.std is not None:
            bound = 3 * estimate.std[:, 6 + k]
            panel.fill_between(time, -bound, bound, color=colour, alpha=0.16, lw=0, label="±3σ")
        panel.plot(time, error[:, k], color=colour, lw=1.2, label="error")
        panel.axhline(0, color=REFERENCE, lw=0.6)
        panel.set_ylabel(f"{name} (m)")
        _legend(panel)
        _finish(panel)
    panels[0].set_title(f"{_short(estimate.name)}: position error", fontsize=11)
    panels[-1].set_xlabel("time (s)")
    panels[-1].set_xlim(time[0], time[-1])
    return figure


def displacement(estimate: Estimate, window_seconds: float) -> Figure:
    """What the network says, at the middle of each window: speed, displacement and gate; grey where
    the reference stands still."""
    assert estimate.displacement is not None
    gate = estimate.diagnostics.get("gate")
    figure = Figure(figsize=(8.4, 7.6 if gate is not None else 5.6), layout="constrained")
    panels = figure.subplots(3 if gate is not None else 2, 1, sharex=True)
    time = estimate.trajectory.time - estimate.trajectory.time[0]
    step = float(np.median(np.diff(time)))
    middle = time - window_seconds / 2
    still = metrics.standing(estimate.reference.position, step)
    truth = _true_displacement(estimate, round(window_seconds / step))
    for panel in panels:
        _shade(panel, time, still)

    panels[0].plot(
        middle,
        np.linalg.norm(truth, axis=1) / window_seconds,
        color=REFERENCE,
        lw=1.4,
        label="reference",
    )
    panels[0].plot(
        middle,
        np.linalg.norm(estimate.displacement, axis=1) / window_seconds,
        color=BLUE,
        lw=1.1,
        label="network",
    )
    panels[0].set_ylabel("speed (m/s)")
    panels[0].set_ylim(bottom=0)
    panels[0].set_title(
        f"{_short(estimate.name)}: displacement of the window, at its middle", fontsize=11
    )

    for k, (name, colour) in enumerate(AXES.items()):
        panels[1].plot(
            middle, truth[:, k], color=colour, lw=3.0, alpha=0.35, label=f"{name}, reference"
        )
    for k, (name, colour) in enumerate(AXES.items()):
        panels[1].plot(middle, estimate.displacement[:, k], color=colour, lw=1.0, label=name)
    panels[1].set_ylabel("displacement (m)")
    if gate is not None:
        for k, (name, colour) in enumerate(AXES.items()):
            panels[2].plot(middle, gate[:, k], color=colour, lw=1.1, label=name)
        panels[2].axhline(0, color=REFERENCE, lw=0.6)
        lowest = -1.05 if np.nanmin(gate) < 0 else -0.05
        panels[2].set_ylim(lowest, 1.05)
        panels[2].set_ylabel("gate γ (–)")
    for panel in panels:
        _legend(panel)
        _finish(panel)
    panels[-1].set_xlabel("time (s)")
    panels[-1].set_xlim(time[0], time[-1])
    return figure


def error_cdf(estimates: list[Estimate], report: Report) -> Figure:
    """Distribution of errors over the set: of every sample's horizontal position, and of the
    sequences' ATE beside the reference rows."""
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    samples = []
    for e in estimates:
        path = _aligned(e, report.settings["alignment"]).position
        error = np.linalg.norm((path - e.reference.position)[:, :2], axis=1)
        error = error[metrics.finite_rows(e.reference.position)]
        if len(error):
            _step(left, error, BLUE, 0.7, alpha=0.25)
            samples.append(error)
    if samples:
        _step(left, np.concatenate(samples), BLUE, 2.2, label="all samples")
    left.plot([], [], color=BLUE, lw=0.7, alpha=0.5, label="one sequence")
    left.set_xlabel("horizontal position error (m)")
    left.set_ylabel("share with at most this error")
    left.yaxis.set_major_formatter(PercentFormatter(1.0))

    kinds = [("this network", report.scores, BLUE, "-")]
    kinds += [
        (label.replace("_", " "), scores, colour, style)
        for (label, scores), colour, style in zip(
            report.reference_rows.items(), (VERMILION, GREEN), ("--", "-."), strict=False
        )
    ]
    for label, scores, colour, style in kinds:
        values = np.array(
            [v for m in scores.sequences.values() if (v := m.values.get("ate_2d")) is not None]
        )
        if len(values):
            _step(
                right,
                values,
                colour,
                1.8,
                ls=style,
                label=f"{label} (median {np.median(values):.2f} m)",
            )
    right.set_xlabel("ATE in 2-D of a sequence (m)")
    for axes in (left, right):
        axes.set_ylim(0, 1.02)
        axes.set_xlim(left=0)
        axes.legend(loc="lower right", fontsize=9, framealpha=0.9)
        _finish(axes)
    settings = report.settings
    figure.suptitle(
        f"{settings['dataset']} {settings['split']}: {settings['estimator']}, {len(samples)} sequences",
        fontsize=11,
    )
    return figure


def _true_displacement(estimate: Estimate, rows: int) -> Float[np.ndarray, "k 3"]:
    """Of the reference over the window that ends at each row, in the yaw frame of its start, m."""
    reference = estimate.reference
    result = np.full_like(reference.position, np.nan)
    if rows < len(result):
        unyaw = metrics.rotation_z(-metrics.yaw(reference.orientation[:-rows]))
        result[rows:] = np.einsum(
            "kij,kj->ki", unyaw, reference.position[rows:] - reference.position[:-rows]
        )
    return result


def _aligned(estimate: Estimate, alignment: metrics.Alignment) -> Trajectory:
    """As it is where nothing says how to align it."""
    try:
        return metrics.align(estimate.trajectory, estimate.reference, alignment)
    except Undefined:
        return estimate.trajectory


def _shade(axes: Axes, time: Float[np.ndarray, "k"], still: np.ndarray) -> None:
    edges = np.flatnonzero(np.diff(np.concatenate([[0], still.astype(int), [0]])))
    for number, (start, stop) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
        label = "standing still" if not number else None  # once in the legend
        axes.axvspan(
            float(time[start]), float(time[stop - 1]), color=STANDING, lw=0, zorder=0, label=label
        )


def _step(
    axes: Axes, values: Float[np.ndarray, "k"], colour: str, width: float, **style: Any
) -> None:
    """What is not finite has diverged: it counts, and the line ends below 1."""
    x = np.sort(values[np.isfinite(values)])
    share = np.arange(len(x) + 1) / len(values)
    axes.step(np.concatenate([[0.0], x]), share, where="post", color=colour, lw=width, **style)


def _legend(axes: Axes) -> None:
    """Beside the axes, where it hides nothing."""
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9, frameon=False)


def _short(name: str) -> str:
    return name if len(name) <= 60 else f"…{name[-59:]}"


def _finish(axes: Axes) -> None:
    axes.grid(True, color="#D9D9D9", lw=0.6)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
