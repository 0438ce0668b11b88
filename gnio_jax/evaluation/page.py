"""The page of an evaluation or a track: one file, which a browser opens without a network.

It has a map, curves over time, a slider and the table of measures. Bokeh draws the figures from
columns, which the selector of sequences exchanges (`page.js`). Bokeh is imported here, so import
this module only where a page is written.
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from bokeh.document import Document
from bokeh.embed import components
from bokeh.layouts import gridplot
from bokeh.models import ColumnDataSource, CustomJS, DataRange1d, Range1d
from bokeh.plotting import figure as new_figure
from bokeh.resources import Resources
from jaxtyping import Float
from jinja2 import Environment

from gnio_jax import drawing
from gnio_jax.evaluation import tabulate
from gnio_jax.evaluation.report import Report
from gnio_jax.evaluation.tabulate import COLUMNS
from gnio_jax.evaluation.views import SIGMAS, View, ellipses, horizontal_speed, map_corners
from gnio_jax.files import write_text

ROWS, FEWEST_ROWS = 9000, 150
"""Largest number of rows of a page, over all runs and sequences, and smallest number of rows of a
sequence. Fifteen minutes at ten rows per second are complete; longer sequences are thinned."""
LATER = ("command", "weights", "training data", "measured error")
"""Facts about the first run that are not shown under the title."""
STRIPS = {"gate": "gate γ (–)", "scale": "scale (–)", "std": "σ of network (m)"}
"""Curves with a value for each axis of the window's yaw frame, and their labels."""
LEVELS = (("mean", 3.0, drawing.GREEN), ("refused above", 11.345, drawing.VERMILION))
"""Levels of the NIS of three axes: the mean of χ², and the filter's default threshold."""
MAP_HEIGHT, STRIP_HEIGHT, LABEL_HEIGHT, LEFT = 560, 158, 30, 62
WAYPOINT = {"marker": "x", "color": drawing.REFERENCE, "line_width": 2.0}
LONGEST_LABEL = 45
"""Letters in a line of a legend, which fit on the screen of a phone."""
LONG = 1e6
"""Longer than a recording, s."""
MOVE_SLIDER = """
const slider = document.getElementById("time");
slider.value = cb_obj.x;
slider.dispatchEvent(new Event("input"));
"""
"""Script by which a tap on a strip moves the slider."""
Figures = Mapping[str, float | None]
"""Metric → value: None where it is not defined, infinite where the estimate diverged."""
Columns = dict[str, Float[np.ndarray, "_"]]
"""The columns of a sequence that the figures draw, by name."""


class PageRun(NamedTuple):
    """One run on the page."""

    name: str
    """Its difference from the other runs, in few words."""
    facts: dict[str, str]
    """How the figures were made: the command, alignment, orientation, ..."""
    views: list[View]
    figures: dict[str, Figures]
    """By sequence."""
    summary: dict[str, Figures] = {}
    """Row below the sequences (mean, median, ...) → its metrics."""
    warnings: tuple[str, ...] = ()
    """Warnings that limit the value of the figures; they are shown above them."""
    remarks: tuple[str, ...] = ()
    """Other notes for a reader."""
    settings: str = ""
    """The whole configuration, as text of several lines."""


# --- the runs that the page shows


def describe_report(
    report: Report, views: list[View], command: str = "", settings: str = "", name: str = ""
) -> PageRun:
    """Describe an evaluation as a run of the page; `settings` is the configuration with which it
    was trained."""
    split = f"{report.settings['dataset']}, split {report.settings['split']}"
    facts = {"command": command, "recordings": split, **tabulate.describe(report.settings)}
    summary = report.summary()
    rows = {
        statistic: {metric: getattr(of_metric, statistic) for metric, of_metric in summary.items()}
        for statistic in ("mean", "median")
    }
    for row in report.reference_rows:
        means = {metric: of_metric.mean for metric, of_metric in report.summary(row).items()}
        rows[row.replace("_", " ")] = means
    return PageRun(
        name or tabulate.describe_estimator(report.settings),
        {fact: text for fact, text in facts.items() if text},
        views,
        {sequence: measures.values for sequence, measures in report.scores.items()},
        rows,
        remarks=tuple(tabulate.remarks(report)),
        settings=settings,
    )


# --- the file


def write(path: Path, title: str, runs: list[PageRun]) -> None:
    """Write the page of some runs of the same recordings, whole or not at all.

    The first run gives the sequences and the curves of network and filter; the others have only
    paths, errors and figures. At most `len(COLOURS)` runs are shown.
    """
    write_text(path, render(title, runs[: len(drawing.COLOURS)]))


def render(title: str, runs: list[PageRun]) -> str:
    """The page as text. It loads nothing, and its content security policy forbids loading."""
    sequences = [view.name for view in runs[0].views]
    rows = max(FEWEST_ROWS, ROWS // (len(runs) * len(sequences)))
    document, names = _draw(runs, [_collect_columns(run, sequences, rows) for run in runs])
    script, plots = components(document.roots)
    figures = [figures for run in runs for figures in run.figures.values()]
    shown = [metric for metric in COLUMNS if any(metric in row for row in figures)]
    environment = Environment(autoescape=True)
    environment.filters["parts"] = re.compile(tabulate.PARTS).findall
    page = environment.from_string(_file("page.html"))
    facts = runs[0].facts
    return page.render(
        title=title,
        subtitle="; ".join(f"{name}: {text}" for name, text in facts.items() if name not in LATER),
        command=facts.get("command"),
        sequences=sequences,
        runs=[
            run._asdict() | {"colour": drawing.COLOURS[number]} for number, run in enumerate(runs)
        ],
        below=list(dict.fromkeys(name for run in runs for name in run.summary)),
        columns={metric: COLUMNS[metric] for metric in shown},
        number=tabulate.number,
        figures=dict(zip(names, plots, strict=True)),
        library=Resources(mode="inline", components=["bokeh"]).render_js(),
        script=script,
    )


def _file(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


# --- columns


def _collect_columns(run: PageRun, sequences: list[str], rows: int) -> list[Columns]:
    """Collect the columns of each sequence, all with the same names; a row of NaN if the run lacks
    the sequence."""
    columns_of = {view.name: make_columns(view, rows) for view in run.views}
    names = dict.fromkeys(name for columns in columns_of.values() for name in columns)
    collection = []
    for columns in (columns_of.get(sequence, {}) for sequence in sequences):
        nothing = np.full(len(columns.get("time", "-")), np.nan, np.float32)
        collection.append({name: columns.get(name, nothing) for name in names})
    return collection


def make_columns(view: View, rows: int) -> Columns:
    """The curves of a sequence in float32, in at most `rows` rows, evenly spaced in time, and
    besides in the last row and in those that are nearest in time to the waypoints."""
    count = len(view.time)
    nearest = np.abs(view.time[:, None] - view.waypoints.time).argmin(axis=0)
    even = np.arange(0, count, -(-count // rows))
    numbers = np.unique(np.concatenate([even, nearest, [count - 1]]))
    path, reference = view.position, view.reference
    curves = {
        "time": view.time,
        "x": path[:, 0],
        "y": path[:, 1],
        "reference_x": reference[:, 0],
        "reference_y": reference[:, 1],
        "error": np.linalg.norm((path - reference)[:, :2], axis=1),
        "speed": horizontal_speed(path, view.step),
        "reference_speed": horizontal_speed(reference, view.step),
        **ellipses(view.filtered.covariance)._asdict(),
    }
    quantities = {**view.network.diagnostics, "std": view.network.std}
    for name in STRIPS:
        if name in quantities and np.isfinite(values := quantities[name]).any():
            curves |= {f"{name}_{axis}": values[:, k] for k, axis in enumerate(drawing.AXES)}
    curves = {name: values[numbers] for name, values in curves.items()}
    if len(view.at_waypoints):  # rows without one are NaN
        x, y = view.waypoints.position.T
        at_waypoints = {"waypoint_x": x, "waypoint_y": y, "waypoint_error": view.errors}
        for name, values in at_waypoints.items():
            curves[name] = np.full(len(numbers), np.nan)
            curves[name][np.searchsorted(numbers, nearest)] = values
    if np.isfinite(nis := view.filtered.nis).any():
        # The largest from a row to the next one is used, so that a thinned curve keeps its peaks.
        largest = np.maximum.reduceat(np.where(np.isnan(nis), -np.inf, nis), numbers)
        curves["nis"] = np.where(np.isneginf(largest), np.nan, largest)
    return {name: values.astype(np.float32) for name, values in curves.items()}


def frame(runs: list[PageRun], sequence: str, whole: bool = False) -> dict[str, list[float]]:
    """Corners of the map of a sequence: they enclose the paths of all runs, and if it is the
    `whole` map, the ellipses of the first."""
    views = [view for run in runs for view in run.views if view.name == sequence]
    parts = [
        part[:, :2]
        for view in views
        for part in (view.position, view.reference, view.waypoints.position)
    ]
    corners = map_corners(np.concatenate(parts))
    if whole:
        variance = np.diagonal(views[0].filtered.covariance, axis1=1, axis2=2)[:, :2]
        reach = np.nan_to_num(SIGMAS * np.sqrt(np.maximum(variance, 0.0)))
        position = views[0].position[:, :2]
        ends = np.concatenate([position - reach, position + reach])
        ends = np.concatenate([corners, ends[np.isfinite(ends).all(axis=1)]])
        corners = np.stack([ends.min(axis=0), ends.max(axis=0)])
    return {"x": corners[:, 0].tolist(), "y": corners[:, 1].tolist()}


# --- the figures


class Sources(NamedTuple):
    """The sources of the figures. `page.js` replaces their columns by those of another sequence."""

    paths: list[ColumnDataSource]
    """The paths of each run; the first also has the curves of network and filter."""
    marks: ColumnDataSource
    """A row for each run, at the time of the slider."""
    starts: ColumnDataSource
    """The start of each run."""
    corners: ColumnDataSource
    """Corners of the map."""


def _draw(runs: list[PageRun], columns: list[list[Columns]]) -> tuple[Document, list[str]]:
    """Draw Bokeh's document, with the script that fills its figures when they are shown. The second
    result is the names of its figures. `columns` are those of each run and sequence."""
    palette, one = list(drawing.COLOURS[: len(runs)]), [1.0] * len(runs)
    marks = ("time", "x", "y", "reference_x", "reference_y", "width", "height", "angle")
    sources = Sources(
        [
            ColumnDataSource({name: [1.0, 2.0] for name in run_columns[0]})
            for run_columns in columns
        ],
        ColumnDataSource(dict.fromkeys(marks, one) | {"colour": palette}),
        ColumnDataSource({"x": one, "y": one, "colour": palette}),
        ColumnDataSource({"x": [0.0, 1.0], "y": [0.0, 1.0]}),
    )
    first, names = sources.paths[0], columns[0][0].keys()
    has_reference = any(view.has_reference for view in runs[0].views)
    has_waypoints = "waypoint_x" in names
    times = Range1d(0.0, 1.0)
    paths = [
        (source, run.name, colour)
        for source, run, colour in zip(sources.paths, runs, palette, strict=True)
    ]
    figures: dict[str, Any] = {"map": _draw_map(paths, sources, has_reference, has_waypoints)}
    legend = "error" if len(runs) == 1 else ""  # for several runs the map names the colours
    errors = [(source, "error", legend, colour) for source, _, colour in paths if has_reference]
    has_errors = has_reference or has_waypoints
    label = f"horizontal {'error' if has_errors else '3σ'} (m)"
    strips = [_draw_strip(sources, times, label, errors, True, has_waypoints)]
    if has_errors and all(view.has_reference or len(view.at_waypoints) for view in runs[0].views):
        # The errors decide the scale: 3σ may be ten times as large, and is cut.
        drawn = [glyph for glyph in strips[0].renderers if glyph.name != "major"]
        strips[0].y_range = DataRange1d(renderers=drawn, start=0.0, range_padding=1.0)
    speeds = [(first, "speed", "estimate", drawing.BLUE)]
    if has_reference:
        speeds.insert(0, (first, "reference_speed", "reference", drawing.REFERENCE))
    strips.append(_draw_strip(sources, times, "speed (m/s)", speeds))
    for name, label in STRIPS.items():
        if f"{name}_x" in names:
            curves = [
                (first, f"{name}_{axis}", axis, colour) for axis, colour in drawing.AXES.items()
            ]
            strips.append(_draw_strip(sources, times, label, curves))
    if "nis" in names:
        curve = [(first, "nis", "NIS", drawing.BLUE)]
        strips.append(_draw_strip(sources, times, "NIS (–)", curve, levels=LEVELS))
    strips[-1].xaxis.axis_label, strips[-1].height = "time (s)", STRIP_HEIGHT + LABEL_HEIGHT
    figures["strips"] = gridplot(
        [[strip] for strip in strips],
        sizing_mode="stretch_width",
        toolbar_location="right",
        toolbar_options={"logo": None},
    )
    document = Document()
    for root in figures.values():
        document.add_root(root)
    plots: list[Any] = [figures["map"], *strips]
    for source, line in zip(sources.paths, figures["map"].select(name="x"), strict=True):
        # A run that is hidden in the legend of the map is hidden everywhere.
        for plot in plots[1:]:
            for other in plot.select(name="error"):
                if other.data_source is source:
                    line.js_link("visible", other, "visible")
    arguments = {
        **sources._asdict(),
        "columns": [[*map(ColumnDataSource, run_columns)] for run_columns in columns],
        "frames": [
            [frame(runs, view.name, whole) for whole in (False, True)] for view in runs[0].views
        ],
        "plan": figures["map"],
        "legends": [plot.legend[0] for plot in plots if plot.legend],
        "times": times,
    }
    document.js_on_event("document_ready", CustomJS(args=arguments, code=_file("page.js")))
    return document, list(figures)


def _draw_map(
    paths: list[tuple[Any, str, str]], sources: Sources, has_reference: bool, has_waypoints: bool
) -> new_figure:
    """Draw the plan view, both axes to the same scale. `paths` is source, name and colour of each
    run. If there are waypoints, lines join them to the first run at their times."""
    plan = new_figure(
        height=MAP_HEIGHT,
        sizing_mode="stretch_width",
        match_aspect=True,
        tools="pan,wheel_zoom,box_zoom,reset,save",
        active_scroll="wheel_zoom",
        x_axis_label="x (m)",
        y_axis_label="y (m)",
    )
    # Items that the slider moves do not change the map's frame.
    corners = plan.scatter("x", "y", source=sources.corners, alpha=0.0)
    plan.x_range, plan.y_range = DataRange1d(renderers=[corners]), DataRange1d(renderers=[corners])
    if has_reference:
        black = {"color": drawing.REFERENCE, "line_width": 2.0, "legend_label": "reference"}
        plan.line(
            "reference_x", "reference_y", source=sources.paths[0], name="reference_x", **black
        )
    if has_waypoints:
        ends = {"x0": "x", "y0": "y", "x1": "waypoint_x", "y1": "waypoint_y"}
        label = {"source": sources.paths[0], "legend_label": "waypoint, error"}
        label |= {"name": "waypoint_x"}
        plan.segment(**ends, color=drawing.VERMILION, line_width=1.2, **label)
        plan.scatter("waypoint_x", "waypoint_y", size=9, **WAYPOINT, **label)
    for source, name, colour in paths:
        style = {"color": colour, "line_width": 1.8}
        label = textwrap.fill(name, LONGEST_LABEL)
        plan.line("x", "y", source=source, legend_label=label, name="x", **style)
    contour = {"line_color": "colour", "fill_color": "colour", "fill_alpha": 0.12}
    size = ("width", "height", "angle")
    plan.ellipse("x", "y", *size, source=sources.marks, name="major", legend_label="3σ", **contour)
    begin = {"line_color": "colour", "line_width": 2.0, "fill_color": "white", "size": 9}
    plan.scatter("x", "y", source=sources.starts, legend_label="start", **begin)
    at_slider = {"source": sources.marks, "line_color": "white", "line_width": 2.0}
    plan.scatter("x", "y", size=11, fill_color="colour", **at_slider)
    if has_reference:
        plan.scatter(
            "reference_x", "reference_y", size=9, fill_color=drawing.REFERENCE, **at_slider
        )
    return _finish(plan, grid_x=True)


def _draw_strip(
    sources: Sources,
    x_range: Range1d,
    label: str,
    curves: list[tuple[ColumnDataSource, str, str, str]],
    band: bool = False,
    has_waypoints: bool = False,
    levels: tuple[tuple[str, float, str], ...] = (),
) -> new_figure:
    """Draw curves over time, each with its source, column, label and colour. A `band` is the
    filter's 3σ behind errors, which include those at waypoints if there are any; `levels` are
    marked on a logarithmic axis."""
    strip = new_figure(
        height=STRIP_HEIGHT,
        sizing_mode="stretch_width",
        x_range=x_range,
        y_axis_type="log" if levels else "linear",
        y_axis_label=label,
        tools="xpan,xwheel_zoom,reset,save",
    )
    if band:
        grey = {"color": "#BBBBBB", "alpha": 0.35, "legend_label": "3σ", "name": "major"}
        strip.varea("time", 0.0, "major", source=sources.paths[0], **grey)
    for source, name, text, colour in curves:
        style: dict[str, Any] = {"color": colour, "line_width": 1.3, "name": name}
        style |= {"legend_label": text} if text else {}
        strip.line("time", name, source=source, **style)
    if has_waypoints:
        marks = {"source": sources.paths[0], "name": "waypoint_error", **WAYPOINT}
        strip.scatter("time", "waypoint_error", size=8, legend_label="at waypoints", **marks)
    for text, level, colour in levels:
        style = {"color": colour, "legend_label": f"{text} {level:.3g}"}
        strip.line([0.0, LONG], [level, level], **style)
    strip.y_range = DataRange1d(renderers=list(strip.renderers))
    strip.vspan("time", source=sources.marks, line_color="#444444", line_width=1.2)
    strip.js_on_event("tap", CustomJS(code=MOVE_SLIDER))
    return _finish(strip)


def _finish(figure: new_figure, grid_x: bool = False) -> new_figure:
    """Style a figure: dark text on white, a light grid, and a legend that hides a clicked curve."""
    figure.min_border_left = LEFT
    figure.toolbar.logo = None
    figure.outline_line_color = None
    figure.axis.axis_label_text_font_style = "normal"
    figure.axis.axis_label_text_color = figure.axis.major_label_text_color = "#222222"
    figure.axis.minor_tick_line_color = None
    figure.grid.grid_line_color = drawing.GRID
    figure.xgrid.visible = grid_x
    if not figure.legend:
        return figure
    legend = figure.legend[0]
    legend.click_policy = "hide"
    legend.orientation = "horizontal"
    legend.label_text_font_size = "12px"
    legend.margin = 3
    legend.background_fill_alpha = 0.0
    legend.border_line_color = None
    figure.add_layout(legend, "above")
    return figure
