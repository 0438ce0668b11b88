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
from gnio_jax.evaluation.views import SIGMAS, View, ellipses
from gnio_jax.files import write_text

ROWS, FEWEST_ROWS = 9000, 150
"""Largest number of rows of a page, over all runs and sequences, and smallest number of rows of a
sequence. Fifteen minutes at ten rows per second are complete; longer sequences are thinned."""
LATER = ("command", "weights")
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
GO_THERE = """
const slider = document.getElementById("time");
slider.value = cb_obj.x;
slider.dispatchEvent(new Event("input"));
"""
"""A tap on a strip moves the slider."""
Figures = Mapping[str, float | None]
"""Metric → value: None where it is not defined, infinite where the estimate diverged."""
Columns = dict[str, Float[np.ndarray, "_"]]
"""The columns of a sequence that the figures draw, by name."""


class Run(NamedTuple):
    """One run on the page."""

    name: str
    """Its difference from the other runs, in few words."""
    about: dict[str, str]
    """Description of how the figures were made: the command, alignment, orientation, ..."""
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


def of_report(
    report: Report, views: list[View], command: str = "", settings: str = "", name: str = ""
) -> Run:
    """The run of the page for an evaluation; `settings` is the configuration of its run."""
    made, own = report.settings, report.summary()
    rows = {name: {x: getattr(of, name) for x, of in own.items()} for name in ("mean", "median")}
    for row in report.reference_rows:
        rows[row.replace("_", " ")] = {x: of.mean for x, of in report.summary(row).items()}
    recordings = {"recordings": f"{made['dataset']}, split {made['split']}"}
    return Run(
        name or tabulate.way(made),
        ({"command": command} if command else {}) | recordings | tabulate.about(made),
        views,
        {sequence: measures.values for sequence, measures in report.scores.items()},
        rows,
        remarks=tuple(tabulate.remarks(report)),
        settings=settings,
    )


# --- the file


def write(path: Path, title: str, runs: list[Run]) -> None:
    """Write the page of some runs of the same recordings, whole or not at all.

    The first run gives the sequences and the curves of network and filter; the others have only
    paths, errors and figures. At most `len(COLOURS)` runs are shown.
    """
    write_text(path, render(title, runs[: len(drawing.COLOURS)]))


def render(title: str, runs: list[Run]) -> str:
    """The page as text. It loads nothing, and its content security policy forbids loading."""
    sequences = [seen.name for seen in runs[0].views]
    rows = max(FEWEST_ROWS, ROWS // (len(runs) * len(sequences)))
    document, names = _document(runs, [_held(run, sequences, rows) for run in runs])
    script, figures = components(document.roots)
    shown = [x for x in COLUMNS if any(x in own for run in runs for own in run.figures.values())]
    environment = Environment(autoescape=True)
    environment.filters["parts"] = re.compile(tabulate.PARTS).findall
    page = environment.from_string(_file("page.html"))
    about = runs[0].about
    return page.render(
        title=title,
        subtitle="; ".join(f"{name}: {text}" for name, text in about.items() if name not in LATER),
        command=about.get("command"),
        sequences=sequences,
        runs=[run._asdict() | {"colour": drawing.COLOURS[place]} for place, run in enumerate(runs)],
        below=list(dict.fromkeys(name for run in runs for name in run.summary)),
        columns={metric: COLUMNS[metric] for metric in shown},
        number=tabulate.number,
        figures=dict(zip(names, figures, strict=True)),
        library=Resources(mode="inline", components=["bokeh"]).render_js(),
        script=script,
    )


def _file(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding="utf-8")


# --- columns


def _held(run: Run, sequences: list[str], rows: int) -> list[Columns]:
    """The columns of each sequence, all with the same names; a row of NaN if the run lacks the
    sequence."""
    found = {seen.name: columns(seen, rows) for seen in run.views}
    names = dict.fromkeys(name for own in found.values() for name in own)
    held = []
    for own in (found.get(sequence, {}) for sequence in sequences):
        nothing = np.full(len(own.get("time", "-")), np.nan, np.float32)
        held.append({name: own.get(name, nothing) for name in names})
    return held


def columns(seen: View, rows: int) -> Columns:
    """The curves of a sequence in float32, in at most `rows` rows, evenly spaced in time."""
    step = -(-len(seen.time) // rows)
    path, reference = seen.position, seen.reference
    found = {
        "time": seen.time,
        "x": path[:, 0],
        "y": path[:, 1],
        "reference_x": reference[:, 0],
        "reference_y": reference[:, 1],
        "error": np.linalg.norm((path - reference)[:, :2], axis=1),
        **ellipses(seen.filtered.covariance)._asdict(),
    }
    curves = {**seen.network.diagnostics, "std": seen.network.std}
    for name in STRIPS:
        if name in curves and np.isfinite(values := curves[name]).any():
            found |= {f"{name}_{axis}": values[:, k] for k, axis in enumerate(drawing.AXES)}
    found = {name: values[::step] for name, values in found.items()}
    if len(seen.passed):
        # A waypoint is in the row that is nearest in time; other rows are NaN.
        rows = np.abs(found["time"][:, None] - seen.waypoints.time).argmin(0)
        x, y = seen.waypoints.position.T
        tapped = {"waypoint_x": x, "waypoint_y": y, "waypoint_error": seen.errors}
        for name, values in tapped.items():
            found[name] = np.full(len(found["time"]), np.nan)
            found[name][rows] = values
    if np.isfinite(nis := seen.filtered.nis).any():
        # The largest of each `step` rows is used, so that a thinned curve keeps its peaks.
        peaks = np.full(-(-len(nis) // step) * step, -np.inf)
        peaks[: len(nis)] = np.where(np.isnan(nis), -np.inf, nis)
        largest = peaks.reshape(-1, step).max(axis=1)
        found["nis"] = np.where(np.isneginf(largest), np.nan, largest)
    return {name: values.astype(np.float32) for name, values in found.items()}


def frame(runs: list[Run], sequence: str) -> dict[str, list[float]]:
    """Corners of the map of a sequence: they enclose the paths of all runs, and the ellipses of the
    first."""
    views = [seen for run in runs for seen in run.views if seen.name == sequence]
    variance = np.diagonal(views[0].filtered.covariance, axis1=1, axis2=2)[:, :2]
    reach = np.nan_to_num(SIGMAS * np.sqrt(np.maximum(variance, 0.0)))
    own = views[0].position[:, :2]
    parts = [
        part[:, :2]
        for seen in views
        for part in (seen.position, seen.reference, seen.waypoints.position)
    ]
    points = np.concatenate([own - reach, own + reach, *parts])
    points = points[np.isfinite(points).all(1)] if np.isfinite(points).any() else np.zeros((1, 2))
    (low_x, low_y), (high_x, high_y) = points.min(0).tolist(), points.max(0).tolist()
    return {"x": [low_x, high_x], "y": [low_y, high_y]}


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


def _document(runs: list[Run], held: list[list[Columns]]) -> tuple[Document, list[str]]:
    """Bokeh's document, with the script that fills its figures when they are drawn, and the names
    of its figures."""
    palette, one = list(drawing.COLOURS[: len(runs)]), [1.0] * len(runs)
    marks = ("time", "x", "y", "reference_x", "reference_y", "width", "height", "angle")
    sources = Sources(
        [ColumnDataSource({name: [1.0, 2.0] for name in of_run[0]}) for of_run in held],
        ColumnDataSource(dict.fromkeys(marks, one) | {"colour": palette}),
        ColumnDataSource({"x": one, "y": one, "colour": palette}),
        ColumnDataSource({"x": [0.0, 1.0], "y": [0.0, 1.0]}),
    )
    first, there = sources.paths[0], held[0][0].keys()
    known = any(seen.known for seen in runs[0].views)
    tapped = "waypoint_x" in there
    times = Range1d(0.0, 1.0)
    drawn = [
        (path, run.name, own) for path, run, own in zip(sources.paths, runs, palette, strict=True)
    ]
    figures: dict[str, Any] = {"map": _draw_map(drawn, sources, known, tapped)}
    label_of_error = "error" if len(runs) == 1 else ""  # for several runs the map names the colours
    errors = [(path, "error", label_of_error, colour) for path, _, colour in drawn if known]
    label = "error (m)" if known or tapped else "3σ (m)"
    strips = [_draw_strip(sources, times, label, errors, band=True, tapped=tapped)]
    for name, label in STRIPS.items():
        if f"{name}_x" in there:
            curves = [
                (first, f"{name}_{axis}", axis, colour) for axis, colour in drawing.AXES.items()
            ]
            strips.append(_draw_strip(sources, times, label, curves))
    if "nis" in there:
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
    for place, line in enumerate(figures["map"].select(name="x")):
        # A run that is hidden in the legend of the map is hidden everywhere.
        for plot in plots[1:]:
            for other in plot.select(name="error"):
                if other.data_source is sources.paths[place]:
                    line.js_link("visible", other, "visible")
    arguments = {
        **sources._asdict(),
        "columns": [[ColumnDataSource(own) for own in of_run] for of_run in held],
        "frames": [frame(runs, seen.name) for seen in runs[0].views],
        "plan": figures["map"],
        "legends": [plot.legend[0] for plot in plots if plot.legend],
        "times": times,
    }
    document.js_on_event("document_ready", CustomJS(args=arguments, code=_file("page.js")))
    return document, list(figures)


def _draw_map(
    drawn: list[tuple[Any, str, str]], sources: Sources, known: bool, tapped: bool
) -> new_figure:
    """Plan view, both axes to the same scale. `drawn` is source, name and colour of each run. If
    there are waypoints, lines join them to the first run at their times."""
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
    if known:
        black = {"color": drawing.REFERENCE, "line_width": 2.0, "legend_label": "reference"}
        path = {"source": sources.paths[0], "name": "reference_x"}
        plan.line("reference_x", "reference_y", **path, **black)
    if tapped:
        ends = {"x0": "x", "y0": "y", "x1": "waypoint_x", "y1": "waypoint_y"}
        label = {"source": sources.paths[0], "legend_label": "waypoint, error"}
        label |= {"name": "waypoint_x"}
        plan.segment(**ends, color=drawing.VERMILION, line_width=1.2, **label)
        plan.scatter("waypoint_x", "waypoint_y", size=9, **WAYPOINT, **label)
    for path, name, colour in drawn:
        label = textwrap.fill(name, LONGEST_LABEL)
        plan.line("x", "y", source=path, color=colour, line_width=1.8, legend_label=label, name="x")
    contour = {"line_color": "colour", "fill_color": "colour", "fill_alpha": 0.12}
    size = ("width", "height", "angle")
    plan.ellipse("x", "y", *size, source=sources.marks, name="major", legend_label="3σ", **contour)
    begin = {"line_color": "colour", "line_width": 2.0, "fill_color": "white", "size": 9}
    plan.scatter("x", "y", source=sources.starts, legend_label="start", **begin)
    now = {"source": sources.marks, "line_color": "white", "line_width": 2.0}
    plan.scatter("x", "y", size=11, fill_color="colour", **now)
    if known:
        plan.scatter("reference_x", "reference_y", size=9, fill_color=drawing.REFERENCE, **now)
    return _finish(plan, grid_x=True)


def _draw_strip(
    sources: Sources,
    x_range: Range1d,
    label: str,
    curves: list[tuple[ColumnDataSource, str, str, str]],
    band: bool = False,
    tapped: bool = False,
    levels: tuple[tuple[str, float, str], ...] = (),
) -> new_figure:
    """Curves over time, each with its source, column, label and colour. A `band` is the filter's 3σ
    behind errors, which include those at waypoints (`tapped`); `levels` are marked on a logarithmic
    axis."""
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
    if tapped:
        marks = {"source": sources.paths[0], "name": "waypoint_error", **WAYPOINT}
        strip.scatter("time", "waypoint_error", size=8, legend_label="at waypoints", **marks)
    for text, level, colour in levels:
        style = {"color": colour, "legend_label": f"{text} {level:.3g}"}
        strip.line([0.0, LONG], [level, level], **style)
    strip.y_range = DataRange1d(renderers=list(strip.renderers))
    strip.vspan("time", source=sources.marks, line_color="#444444", line_width=1.2)
    strip.js_on_event("tap", CustomJS(code=GO_THERE))
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
