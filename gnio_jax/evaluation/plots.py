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
from gnio_jax.evaluation.views import SIGMAS, View, ellipses
from gnio_jax.files import file_stems, shown_name
from gnio_jax.numerics import finite_rows
from gnio_jax.reporting import Progress, silent

STANDING = "#E8E8E8"
TAP: dict[str, Any] = {"marker": "x", "ls": "", "ms": 7, "mew": 1.8}
MARKERS = "os^Dv"
"""Markers; the next one is used when there are more rows than colours."""
ELLIPSES = 4
"""Number of outlines on a map, at equal times, the last at the end."""
TITLE = {"ate": "ATE", "ate_2d": "in 2-D", "waypoint_rms": "rms at waypoints"}
"""Errors that the title of a sequence names."""


# --- one sequence


def speed(position: Float[np.ndarray, "n 3"], step: float) -> Float[np.ndarray, "n"]:
    """Horizontal speed, m/s, as a mean over the second around each row."""
    apart = max(1, round(1.0 / step))
    found = np.full(len(position), np.nan)
    if len(position) > apart:
        moved = np.linalg.norm((position[apart:] - position[:-apart])[:, :2], axis=1)
        found[apart // 2 :][: len(moved)] = moved / (apart * step)
    return found


def sequence(seen: View, title: str = "") -> Figure:
    """A picture with a map on the left and curves over time on the right: the errors with the
    filter's 3σ, the speed, and the gate of the network, or if there is none, which displacements
    the filter used."""
    strips: list[Callable[[Axes, View], None]] = [_draw_speed]
    if seen.known or np.isfinite(seen.filtered.covariance).any():
        strips = [_draw_error, functools.partial(_draw_error, vertical=True), *strips]
    elif len(seen.passed):
        strips = [_draw_error, *strips]
    if np.isfinite(seen.network.diagnostics.get("gate", np.nan)).any():
        strips.append(_draw_gate)
    elif np.isfinite(seen.filtered.accepted).any():
        strips.append(_draw_accepted)
    figure = Figure(figsize=(12.6, 6.8), layout="constrained")
    grid = figure.add_gridspec(len(strips), 2, width_ratios=(1.1, 1.0))
    _draw_map(figure.add_subplot(grid[:, 0]), seen)
    still = metrics.standing(seen.reference, seen.step)
    for row, draw in enumerate(strips):
        axes = figure.add_subplot(grid[row, 1])
        drawing.shade(axes, seen.time, still, STANDING, "standing still")
        draw(axes, seen)
        axes.set_xlim(seen.time[0], max(seen.time[-1], seen.time[0] + 1e-3))
        axes.tick_params(labelbottom=draw is strips[-1])
        # The legend is beside the curves, where it hides nothing.
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), fontsize=9, frameon=False)
        drawing.finish(axes)
    figure.axes[-1].set_xlabel("time (s)")
    figure.suptitle(title or shown_name(seen.name), fontsize=11)
    return figure


def _draw_map(axes: Axes, seen: View) -> None:
    """Plan view, both axes to the same scale."""
    if seen.known:
        axes.plot(*seen.reference[:, :2].T, color=drawing.REFERENCE, lw=1.6, label="reference")
    axes.plot(*seen.position[:, :2].T, color=drawing.BLUE, lw=1.4, label="estimate")
    if len(seen.passed):
        axes.plot(
            *seen.waypoints.position.T, color=drawing.REFERENCE, zorder=5, label="waypoint", **TAP
        )
        for ends in np.stack([seen.waypoints.position, seen.passed], 1):
            axes.plot(*ends.T, color=drawing.VERMILION, lw=1.0, zorder=3)
        axes.plot([], [], color=drawing.VERMILION, lw=1.0, label="error at its time")
    shapes = ellipses(seen.filtered.covariance)
    there = np.flatnonzero(np.isfinite(shapes.major) & finite_rows(seen.position))
    if len(there):
        outline: dict[str, Any] = {"color": drawing.BLUE, "lw": 0.9, "alpha": 0.55}
        for row in there[np.linspace(0, len(there) - 1, ELLIPSES + 1).astype(int)[1:]]:
            size, angle = (2 * shapes.major[row], 2 * shapes.minor[row]), shapes.angle[row]
            shape = Ellipse(tuple(seen.position[row, :2]), *size, angle=float(np.degrees(angle)))
            shape.set(fill=False, **outline)
            axes.add_patch(shape)
        axes.plot([], [], label="3σ", **outline)
    for path, colour in ((seen.reference, drawing.REFERENCE), (seen.position, drawing.BLUE)):
        good = path[finite_rows(path)]
        if len(good):
            axes.plot(*good[0, :2], color=colour, zorder=4, **drawing.START)
            axes.plot(*good[-1, :2], color=colour, zorder=4, **drawing.END)
    axes.plot([], [], color=drawing.GREY, label="start", **drawing.START)
    axes.plot([], [], color=drawing.GREY, label="end", **drawing.END)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.08)
    axes.set_xlabel("x (m)")
    axes.set_ylabel("y (m)")
    axes.legend(loc="best", ncols=2, fontsize=9, framealpha=0.9)
    drawing.finish(axes)


def _draw_error(axes: Axes, seen: View, vertical: bool = False) -> None:
    """Draw the error of the position, with the filter's 3σ behind it; without a reference only the
    3σ."""
    bound, colour, name = ellipses(seen.filtered.covariance).major, drawing.BLUE, "horizontal"
    error = np.linalg.norm((seen.position - seen.reference)[:, :2], axis=1)
    if vertical:
        bound = SIGMAS * np.sqrt(np.maximum(seen.filtered.covariance[:, 2, 2], 0.0))
        error, colour, name = (seen.position - seen.reference)[:, 2], drawing.GREEN, "vertical"
    if np.isfinite(bound).any():
        low = -bound if vertical else np.zeros_like(bound)
        axes.fill_between(seen.time, low, bound, color=colour, alpha=0.16, lw=0, label="3σ")
    if seen.known:
        axes.plot(seen.time, error, color=colour, lw=1.2, label="error")
    tapped = len(seen.passed) > 0 and not vertical
    if tapped:
        style = {"color": drawing.REFERENCE, "label": "at waypoints", "clip_on": False, **TAP}
        axes.plot(seen.waypoints.time, seen.errors, **style)
    axes.axhline(0, color=drawing.REFERENCE, lw=0.6)
    axes.set_ylabel(f"{name}\n{'error' if seen.known or tapped else '3σ'} (m)")


def _draw_speed(axes: Axes, seen: View) -> None:
    black = {"color": drawing.REFERENCE, "lw": 1.4}
    if seen.known:
        axes.plot(seen.time, speed(seen.reference, seen.step), label="reference", **black)
    if len(seen.passed):
        times, places = seen.waypoints
        legs = np.linalg.norm(np.diff(places, axis=0), axis=1) / np.diff(times)
        axes.stairs(legs, times, baseline=None, label="legs", **black)
    own = speed(seen.position, seen.step)
    axes.plot(seen.time, own, color=drawing.BLUE, lw=1.1, label="estimate")
    axes.set_ylabel("horizontal\nspeed (m/s)")
    axes.set_ylim(bottom=0)


def _draw_gate(axes: Axes, seen: View) -> None:
    gate = seen.network.diagnostics["gate"]
    for k, (name, colour) in enumerate(drawing.AXES.items()):
        axes.plot(seen.time, gate[:, k], color=colour, lw=1.1, label=name)
    axes.axhline(0, color=drawing.REFERENCE, lw=0.6)
    axes.set_ylim(-1.05 if np.nanmin(gate) < 0 else -0.05, 1.05)
    axes.set_ylabel("gate γ (–)")


def _draw_accepted(axes: Axes, seen: View) -> None:
    axes.plot(seen.time, seen.filtered.accepted, color=drawing.BLUE, lw=1.0, label="used")
    axes.set_ylim(-0.05, 1.05)
    axes.set_ylabel("displacement")


# --- a set of sequences


def error_cdf(views: list[View], report: Report) -> Figure:
    """Distributions of errors over the set: of every sample's horizontal position, and of the
    sequences' ATE with the reference rows. For a sequence with waypoints these are its errors there
    and their root mean square."""
    figure = Figure(figsize=(9.6, 4.4), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    errors = [seen.errors for seen in views if len(seen.errors)]
    posed = any(seen.known for seen in views)
    tapped = any(len(seen.passed) for seen in views)
    for error in errors:
        _step(left, error, color=drawing.BLUE, lw=0.7, alpha=0.25)
    if errors:
        label = "all samples" if posed else "all waypoints"
        _step(left, np.concatenate(errors), color=drawing.BLUE, lw=2.2, label=label)
    left.plot([], [], color=drawing.BLUE, lw=0.7, alpha=0.5, label="one sequence")
    left.set_xlabel("horizontal position error (m)")
    left.set_ylabel("share with at most this error")
    left.yaxis.set_major_formatter(PercentFormatter(1.0))
    scored = {"this network": report.scores, **report.reference_rows}
    styles = ((drawing.BLUE, "-"), (drawing.VERMILION, "--"), (drawing.GREEN, "-."))
    for (name, scores), (colour, style) in zip(scored.items(), styles, strict=False):
        found = [own.values.get(x) for own in scores.values() for x in ("ate_2d", "waypoint_rms")]
        values = np.array([value for value in found if value is not None])
        if len(values):
            label = f"{name.replace('_', ' ')} (median {np.median(values):.2f} m)"
            _step(right, values, color=colour, lw=1.8, ls=style, label=label)
    errors_of = {"ATE in 2-D": posed, "rms at waypoints": tapped}
    shown = " or ".join(text for text, there in errors_of.items() if there)
    right.set_xlabel(f"{shown} of a sequence (m)")
    for axes in (left, right):
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


def paired(rows: Mapping[str, Sequence[Report]], metric: str) -> Figure:
    """A metric of every sequence for every row. A dot is the mean over seeds, and a fainter stroke
    is one seed; rows are one below the other. Each sequence has a line, sorted by the first row,
    with its name and its person or session. A mark shows that a row diverged; this row then has no
    dot."""
    seeds = [[report.scores for report in row] for row in rows.values()]
    lost = [statistics.lost(row) for row in seeds]
    tables = [statistics.values(row, metric) for row in seeds]
    groups = {n: own for row in rows.values() for each in row for n, own in each.groups.items()}
    settings = next(iter(rows.values()))[0].settings
    first = {name: float(np.mean(own)) for name, own in tables[0].items()}
    names = sorted(
        dict.fromkeys(name for table in tables for name in table),
        key=lambda name: (name in first, first.get(name, 0.0), name),
    )
    height = 0.24 + 0.08 * len(rows)
    figure = Figure(figsize=(8.0, 2.0 + height * len(names)), layout="constrained")
    axes, legend = figure.add_subplot(), {}
    palette = (drawing.GREY, *drawing.COLOURS)
    for number, (label, table, diverged) in enumerate(zip(rows, tables, lost, strict=True)):
        colour = palette[number % len(palette)]
        marker = MARKERS[number // len(palette) % len(MARKERS)]
        shift = 0.6 * (0.5 - number / max(len(rows) - 1, 1))  # equal values would hide each other
        places = [place + shift for place, name in enumerate(names) if name in table]
        values = [table[n] * (np.nan if n in diverged else 1.0) for n in names if n in table]
        means = [np.mean(own) if np.isfinite(own).all() else np.nan for own in values]
        (dots,) = axes.plot(means, places, marker, ms=6, color=colour, zorder=3)
        for place, own in zip(places, values, strict=True):
            if len(own) > 1:
                axes.plot(own, [place] * len(own), "|", ms=8, color=colour, alpha=0.6)
        # Matplotlib ignores labels that begin with an underscore, so a zero-width space goes before
        # it.
        text = shown_name(label, 100)
        legend["\u200b" + text if text.startswith("_") else text] = dots
    marked = {name for diverged in lost for name in diverged}
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
    stems = file_stems([seen.name for seen in views])
    for done, (stem, seen) in enumerate(zip(stems, views, strict=True)):
        progress(done / len(views))
        values = report.scores[seen.name].values
        known = {x: text for x, text in TITLE.items() if values.get(x) is not None}
        errors = [f"{heading} {values[name]:.2f} m" for name, heading in known.items()]
        title = ": ".join(filter(None, (shown_name(seen.name), ", ".join(errors))))
        drawing.save(folder / f"{stem}.png", sequence(seen, title))
    if any(len(seen.errors) for seen in views):
        drawing.save(folder / "error_cdf.png", error_cdf(views, report))
