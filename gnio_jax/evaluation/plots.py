"""Pictures of results. Every function returns a `Figure` and keeps no state.

Matplotlib is imported here, so import this module only where pictures are drawn.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from matplotlib.ticker import PercentFormatter

from gnio_jax import drawing
from gnio_jax.evaluation import metrics, statistics, tabulate
from gnio_jax.evaluation.report import Report
from gnio_jax.evaluation.views import SIGMAS, View, ellipses, horizontal_speed, map_corners
from gnio_jax.files import file_stems, shown_name
from gnio_jax.numerics import finite_rows
from gnio_jax.reporting import Progress, silent

STANDING = "#E8E8E8"
TAP: dict[str, Any] = {"marker": "x", "ls": "", "ms": 7, "mew": 1.8}
MARKERS = "os^Dv"
"""Markers; the next one is used when there are more rows than colours."""
CUT = 3.0
"""Number of times the largest error up to which a strip shows the filter's 3σ."""
ELLIPSES = 4
"""Number of outlines on a map, at equal times, the last at the end."""
TITLE = {"ate": "ATE", "ate_2d": "in 2-D", "waypoint_rms": "rms at waypoints"}
"""Errors that the title of a sequence names."""


# --- one sequence


def sequence(view: View, title: str = "") -> Figure:
    """A picture with a map on the left and curves over time on the right: the errors with the
    filter's 3σ, the speed, and the gate of the network, or if there is none, which displacements
    the filter used."""
    strips: list[Callable[[Axes, View], None]] = [_draw_speed]
    if view.has_reference or np.isfinite(view.filtered.covariance).any():
        strips = [_draw_error, functools.partial(_draw_error, vertical=True), *strips]
    elif len(view.at_waypoints):
        strips = [_draw_error, *strips]
    if np.isfinite(view.network.diagnostics.get("gate", np.nan)).any():
        strips.append(_draw_gate)
    elif np.isfinite(view.filtered.accepted).any():
        strips.append(_draw_accepted)
    figure = Figure(figsize=(12.6, 6.8), layout="constrained")
    grid = figure.add_gridspec(len(strips), 2, width_ratios=(1.1, 1.0))
    _draw_map(figure.add_subplot(grid[:, 0]), view)
    standing = metrics.standing(view.reference, view.step)
    for row, draw in enumerate(strips):
        axes = figure.add_subplot(grid[row, 1])
        drawing.shade(axes, view.time, standing, STANDING, "standing still")
        draw(axes, view)
        axes.set_xlim(view.time[0], max(view.time[-1], view.time[0] + 1e-3))
        axes.tick_params(labelbottom=draw is strips[-1])
        # The legend is beside the curves, where it hides nothing.
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9, frameon=False)
        drawing.finish(axes)
    figure.axes[-1].set_xlabel("time (s)")
    figure.suptitle(title or shown_name(view.name), fontsize=11)
    return figure


def _draw_map(axes: Axes, view: View) -> None:
    """Plan view, both axes to the same scale."""
    if view.has_reference:
        axes.plot(*view.reference[:, :2].T, color=drawing.REFERENCE, lw=1.6, label="reference")
    axes.plot(*view.position[:, :2].T, color=drawing.BLUE, lw=1.4, label="estimate")
    if len(view.at_waypoints):
        axes.plot(
            *view.waypoints.position.T, color=drawing.REFERENCE, zorder=5, label="waypoint", **TAP
        )
        for ends in np.stack([view.waypoints.position, view.at_waypoints], 1):
            axes.plot(*ends.T, color=drawing.VERMILION, lw=1.0, zorder=3)
        axes.plot([], [], color=drawing.VERMILION, lw=1.0, label="error at its time")
    shapes = ellipses(view.filtered.covariance)
    rows = np.flatnonzero(np.isfinite(shapes.major) & finite_rows(view.position))
    if len(rows):
        outline: dict[str, Any] = {"color": drawing.BLUE, "lw": 0.9, "alpha": 0.55}
        for row in rows[np.linspace(0, len(rows) - 1, ELLIPSES + 1).astype(int)[1:]]:
            size, angle = (2 * shapes.major[row], 2 * shapes.minor[row]), shapes.angle[row]
            shape = Ellipse(tuple(view.position[row, :2]), *size, angle=float(np.degrees(angle)))
            shape.set(fill=False, **outline)
            axes.add_artist(shape)  # unlike a patch it does not change the map's frame
        axes.plot([], [], label="3σ", **outline)
    for path, colour in ((view.reference, drawing.REFERENCE), (view.position, drawing.BLUE)):
        points = path[finite_rows(path)]
        if len(points):
            axes.plot(*points[0, :2], color=colour, zorder=4, **drawing.START)
            axes.plot(*points[-1, :2], color=colour, zorder=4, **drawing.END)
    axes.plot([], [], color=drawing.GREY, label="start", **drawing.START)
    axes.plot([], [], color=drawing.GREY, label="end", **drawing.END)
    paths = (view.position[:, :2], view.reference[:, :2], view.waypoints.position)
    axes.update_datalim(map_corners(np.concatenate(paths)))
    axes.margins(0.0)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.legend(loc="best", ncols=2, fontsize=9, framealpha=0.9)
    drawing.finish(axes)


def _draw_error(axes: Axes, view: View, vertical: bool = False) -> None:
    """Draw the error of the position, with the filter's 3σ behind it, which is cut where it is much
    larger; without a reference only the 3σ."""
    bound, colour, name = ellipses(view.filtered.covariance).major, drawing.BLUE, "horizontal"
    error = np.linalg.norm((view.position - view.reference)[:, :2], axis=1)
    if vertical:
        bound = SIGMAS * np.sqrt(np.maximum(view.filtered.covariance[:, 2, 2], 0.0))
        error, colour, name = (view.position - view.reference)[:, 2], drawing.GREEN, "vertical"
    if np.isfinite(bound).any():
        low = -bound if vertical else np.zeros_like(bound)
        axes.fill_between(view.time, low, bound, color=colour, alpha=0.16, lw=0, label="3σ")
    if view.has_reference:
        axes.plot(view.time, error, color=colour, lw=1.2, label="error")
    has_waypoints = len(view.at_waypoints) > 0 and not vertical
    if has_waypoints:
        style = {"color": drawing.REFERENCE, "label": "at waypoints", "clip_on": False, **TAP}
        axes.plot(view.waypoints.time, view.errors, **style)
    errors = np.abs(np.concatenate([error, view.errors if has_waypoints else error[:0]]))
    if np.isfinite(errors).any() and np.isfinite(bound).any():
        largest = np.nanmax(errors[np.isfinite(errors)])
        top = max(1.1 * largest, min(1.1 * np.nanmax(bound), CUT * largest))
        axes.set_ylim(-top if vertical else 0.0, max(top, 1e-3))
    axes.axhline(0, color=drawing.REFERENCE, lw=0.6)
    axes.set_ylabel(f"{name}\n{'error' if view.has_reference or has_waypoints else '3σ'} (m)")


def _draw_speed(axes: Axes, view: View) -> None:
    black = {"color": drawing.REFERENCE, "lw": 1.4}
    if view.has_reference:
        axes.plot(
            view.time, horizontal_speed(view.reference, view.step), label="reference", **black
        )
    if len(view.at_waypoints):
        times, positions = view.waypoints
        legs = np.linalg.norm(np.diff(positions, axis=0), axis=1) / np.diff(times)
        axes.stairs(legs, times, baseline=None, label="legs", **black)
    estimated = horizontal_speed(view.position, view.step)
    axes.plot(view.time, estimated, color=drawing.BLUE, lw=1.1, label="estimate")
    axes.set_ylabel("horizontal\nspeed (m/s)")
    axes.set_ylim(bottom=0)


def _draw_gate(axes: Axes, view: View) -> None:
    gate = view.network.diagnostics["gate"]
    for k, (name, colour) in enumerate(drawing.AXES.items()):
        axes.plot(view.time, gate[:, k], color=colour, lw=1.1, label=name)
    axes.axhline(0, color=drawing.REFERENCE, lw=0.6)
    axes.set_ylim(-1.05 if np.nanmin(gate) < 0 else -0.05, 1.05)
    axes.set_ylabel("gate γ (–)")


def _draw_accepted(axes: Axes, view: View) -> None:
    axes.plot(view.time, view.filtered.accepted, color=drawing.BLUE, lw=1.0, label="accepted")
    axes.set_ylim(-0.05, 1.05)
    axes.set_ylabel("displacement")


# --- a set of sequences


def error_cdf(views: list[View], report: Report) -> Figure:
    """Distributions of errors over the set: of every sample's horizontal position, and of the
    sequences' ATE with the reference rows. For a sequence with waypoints these are its errors there
    and their root mean square."""
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    sample_axes, sequence_axes = figure.subplots(1, 2, sharey=True)
    errors = [view.errors for view in views if len(view.errors)]
    has_references = any(view.has_reference for view in views)
    has_waypoints = any(len(view.at_waypoints) for view in views)
    for error in errors:
        _step(sample_axes, error, color=drawing.BLUE, lw=0.7, alpha=0.25)
    if errors:
        label = "all samples" if has_references else "all waypoints"
        _step(sample_axes, np.concatenate(errors), color=drawing.BLUE, lw=2.2, label=label)
    sample_axes.plot([], [], color=drawing.BLUE, lw=0.7, alpha=0.5, label="one sequence")
    sample_axes.set_xlabel("horizontal position error (m)")
    sample_axes.set_ylabel("share with at most this error")
    sample_axes.yaxis.set_major_formatter(PercentFormatter(1.0))
    rows = {"this network": report.scores, **report.reference_rows}
    styles = ((drawing.BLUE, "-"), (drawing.VERMILION, "--"), (drawing.GREEN, "-."))
    for (name, scores), (colour, style) in zip(rows.items(), styles, strict=False):
        metrics_of = [measures.values for measures in scores.values()]
        figures = [row.get(metric) for row in metrics_of for metric in ("ate_2d", "waypoint_rms")]
        values = np.array([value for value in figures if value is not None])
        if len(values):
            label = f"{name.replace('_', ' ')} (median {np.median(values):.2f} m)"
            _step(sequence_axes, values, color=colour, lw=1.8, ls=style, label=label)
    kinds = {"ATE in 2-D": has_references, "rms at waypoints": has_waypoints}
    shown = " or ".join(text for text, applies in kinds.items() if applies)
    sequence_axes.set_xlabel(f"{shown} of a sequence (m)")
    for axes in (sample_axes, sequence_axes):
        axes.set_ylim(0, 1.02)
        axes.set_xlim(left=0)
        axes.legend(loc="lower right", fontsize=9, framealpha=0.9)
        drawing.finish(axes)
    settings = report.settings
    subject = f"{settings['dataset']} {settings['split']}: {settings['estimator']}"
    figure.suptitle(f"{subject}, {len(errors)} sequences", fontsize=11)
    return figure


def _step(axes: Axes, values: Float[np.ndarray, "k"], **style: Any) -> None:
    """Draw a cumulative distribution. A value that is not finite has diverged: it counts, so the
    line ends below 1."""
    x = np.sort(values[np.isfinite(values)])
    share = np.arange(len(x) + 1) / len(values)
    axes.step(np.concatenate([[0.0], x]), share, where="post", **style)


def sequence_dots(rows: Mapping[str, Sequence[Report]], metric: str) -> Figure:
    """A metric of every sequence for every row. A dot is the mean over seeds, and a fainter stroke
    is one seed; rows are one below the other. Each sequence has a line, sorted by the first row,
    with its name and its person or session. A mark shows that a row diverged; this row then has no
    dot."""
    seeds = [[report.scores for report in row] for row in rows.values()]
    divergences = [statistics.count_divergences(row) for row in seeds]
    tables = [statistics.collect_values(row, metric) for row in seeds]
    groups = {
        name: group
        for row in rows.values()
        for report in row
        for name, group in report.groups.items()
    }
    settings = next(iter(rows.values()))[0].settings
    first = {name: float(np.mean(values)) for name, values in tables[0].items()}
    names = sorted(
        dict.fromkeys(name for table in tables for name in table),
        key=lambda name: (name in first, first.get(name, 0.0), name),
    )
    size = 8.0, 2.0 + (0.24 + 0.08 * len(rows)) * len(names)
    figure = Figure(figsize=size, layout="constrained")
    axes, legend = figure.add_subplot(), {}
    palette = (drawing.GREY, *drawing.COLOURS)
    for number, (label, table, diverged) in enumerate(zip(rows, tables, divergences, strict=True)):
        colour = palette[number % len(palette)]
        marker = MARKERS[number // len(palette) % len(MARKERS)]
        shift = 0.6 * (0.5 - number / max(len(rows) - 1, 1))  # equal values would hide each other
        heights = [line + shift for line, name in enumerate(names) if name in table]
        rows_of_seeds = [
            table[name] * (np.nan if name in diverged else 1.0) for name in names if name in table
        ]
        means = [np.mean(row) if np.isfinite(row).all() else np.nan for row in rows_of_seeds]
        (dots,) = axes.plot(means, heights, marker, ms=6, color=colour, zorder=3)
        for height, row in zip(heights, rows_of_seeds, strict=True):
            if len(row) > 1:
                axes.plot(row, [height] * len(row), "|", ms=8, color=colour, alpha=0.6)
        # Matplotlib ignores labels that begin with an underscore, so a zero-width space goes before
        # it.
        text = shown_name(label, 100)
        legend["\u200b" + text if text.startswith("_") else text] = dots
    marked = {name for diverged in divergences for name in diverged}
    ticks = [
        f"{shown_name(name, 40)}  ({shown_name(groups[name], 20)}){' †' if name in marked else ''}"
        for name in names
    ]
    axes.set_yticks(range(len(names)), ticks, fontsize=8)
    axes.set_xlabel(tabulate.column(metric).title)
    axes.set_title(f"{settings['dataset']} {settings['split']}", fontsize=11)
    if marked & {*names}:
        legend["† an estimate diverged"] = Line2D([], [], ls="")
    columns = 2 if max(map(len, legend)) < 40 else 1
    style = {"fontsize": 8, "frameon": False, "loc": "outside lower center", "ncols": columns}
    figure.legend(legend.values(), legend.keys(), **style)
    drawing.finish(axes)
    return figure


def save_all(folder: Path, views: list[View], report: Report, progress: Progress = silent) -> None:
    """Every picture as a PNG in `folder`: one for each sequence, and `error_cdf`."""
    folder.mkdir(parents=True, exist_ok=True)
    stems = file_stems([view.name for view in views])
    for number, (stem, view) in enumerate(zip(stems, views, strict=True)):
        progress(number / len(views))
        values = report.scores[view.name].values
        headings = {name: text for name, text in TITLE.items() if values.get(name) is not None}
        errors = [f"{heading} {values[name]:.2f} m" for name, heading in headings.items()]
        title = ": ".join(filter(None, (shown_name(view.name), ", ".join(errors))))
        drawing.save(folder / f"{stem}.png", sequence(view, title))
    if any(len(view.errors) for view in views):
        drawing.save(folder / "error_cdf.png", error_cdf(views, report))
