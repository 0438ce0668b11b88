"""Map and strips of the page, drawn by Bokeh from columns that the page's selectors exchange.

Colours are those of Okabe and Ito, which the colour-blind can tell apart; the reference is black.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from bokeh.layouts import gridplot
from bokeh.models import ColumnDataSource, CustomJS, DataRange1d, GridPlot, Range1d
from bokeh.plotting import figure as new_figure

from gnio_jax.evaluation.html.curves import Curves

BLACK, BLUE, VERMILION, GREEN = "#000000", "#0072B2", "#D55E00", "#009E73"
RUNS = (BLUE, VERMILION, GREEN, "#CC79A7", "#E69F00", "#56B4E9")
"""Colour of each run; more are not shown."""
AXES = dict(zip("xyz", (BLUE, VERMILION, GREEN), strict=True))
NOW = "#444444"
NIS_MEAN, NIS_REFUSED = 3.0, 11.345
"""Of an innovation of three axes: the mean of χ², and what the filter's gate refuses by default."""
GO_THERE = """
const slider = document.getElementById("time");
slider.value = cb_obj.x;
slider.dispatchEvent(new Event("input"));
"""
"""A tap on a strip moves the slider."""
MAP_HEIGHT, STRIP_HEIGHT, LABEL_HEIGHT, LEFT = 560, 158, 30, 62
LONG = 1e6
"""Longer than a recording, s."""
PER_AXIS = {"gate": "gate γ (–)", "scale": "scale (–)", "std": "σ of network (m)"}
"""Columns with a value for each axis of the window's yaw frame -> label."""


class Sources(NamedTuple):
    """Columns that the figures draw; the selectors put those of another sequence in their place."""

    paths: list[ColumnDataSource]
    """Of each run."""
    detail: ColumnDataSource
    """Of the run whose network and filter are shown."""
    marks: ColumnDataSource
    """A row for each run, at the time of the slider."""


class Figures(NamedTuple):
    """Map, strips and error against distance."""

    map: new_figure
    distance: new_figure
    strips: GridPlot
    times: Range1d
    """Their common x axis, s."""


def columns(curves: Curves) -> dict[str, np.ndarray]:
    """The arrays of one sequence by name, in float32: what the page holds."""
    found = {
        "time": curves.time,
        "x": curves.position[:, 0],
        "y": curves.position[:, 1],
        "reference_x": curves.reference[:, 0],
        "reference_y": curves.reference[:, 1],
        "error": curves.error,
        "distance": curves.distance,
        **curves.ellipses._asdict(),
    }
    if np.isfinite(curves.nis).any():
        found["nis"] = curves.nis
    for name in PER_AXIS:
        values = getattr(curves, name)
        if np.isfinite(values).any():
            found |= {f"{name}_{axis}": values[:, k] for k, axis in enumerate(AXES)}
    return {name: values.astype(np.float32) for name, values in found.items()}


def sources(runs: list[str], names: set[str]) -> Sources:
    """Sources with the columns `names`; the page fills them when it opens."""
    marks = ("time", "distance", "x", "y", "reference_x", "reference_y", "width", "height", "angle")
    colours = list(RUNS[: len(runs)])
    somewhere = {name: [1.0, 2.0] for name in names}
    return Sources(
        [ColumnDataSource(somewhere) for _ in runs],
        ColumnDataSource(somewhere),
        ColumnDataSource({**{name: [1.0] * len(runs) for name in marks}, "colour": colours}),
    )


def draw(runs: list[str], shown: Sources, names: set[str], with_reference: bool) -> Figures:
    """All figures; strips of what no run has are left away."""
    times = Range1d(0.0, 1.0)
    over_time = []
    if with_reference:
        over_time.append(_draw_error(runs, shown, _new_strip("error (m)", times), "time"))
    over_time += [
        _draw_axes(shown, _new_strip(label, times), name)
        for name, label in PER_AXIS.items()
        if f"{name}_x" in names
    ]
    if "nis" in names:
        over_time.append(_draw_nis(shown, _new_strip("NIS (–)", times, "log")))
    over_time[-1].xaxis.axis_label = "time (s)"
    over_time[-1].height = STRIP_HEIGHT + LABEL_HEIGHT
    strips = gridplot(
        [[strip] for strip in over_time],
        sizing_mode="stretch_width",
        toolbar_location="right",
        toolbar_options={"logo": None},
    )
    distance = _new_strip("error (m)", Range1d(0.0, 1.0))
    distance.xaxis.axis_label = "distance walked (m)"
    distance.height = STRIP_HEIGHT + LABEL_HEIGHT
    _draw_error(runs, shown, distance, "distance")
    return Figures(_draw_map(runs, shown, with_reference), distance, strips, times)


# The figures
# --------------------------------------------------------------------------------------------------


def _draw_map(runs: list[str], shown: Sources, with_reference: bool) -> new_figure:
    """Plan view, both axes to the same scale."""
    plan = new_figure(
        height=MAP_HEIGHT,
        sizing_mode="stretch_width",
        match_aspect=True,
        tools="pan,wheel_zoom,box_zoom,reset,save",
        active_scroll="wheel_zoom",
        x_axis_label="x (m)",
        y_axis_label="y (m)",
    )
    lines = []
    if with_reference:
        style = {"color": BLACK, "line_width": 2.0, "legend_label": "reference"}
        lines.append(plan.line("reference_x", "reference_y", source=shown.paths[0], **style))
    for run, path, colour in zip(runs, shown.paths, RUNS, strict=False):
        style = {"color": colour, "line_width": 1.8, "legend_label": run}
        lines.append(plan.line("x", "y", source=path, **style))
    # The ellipse alone does not move the map's frame.
    plan.x_range, plan.y_range = DataRange1d(renderers=lines), DataRange1d(renderers=lines)
    marks = {"source": shown.marks, "line_color": "colour", "line_width": 2.0}
    contour = {**marks, "line_width": 1.2, "fill_color": "colour", "fill_alpha": 0.18}
    plan.ellipse("x", "y", "width", "height", "angle", legend_label="3σ", **contour)
    plan.scatter("x", "y", size=11, fill_color="colour", **{**marks, "line_color": "white"})
    if with_reference:
        black = {"source": shown.marks, "fill_color": BLACK, "line_color": "white", "size": 9}
        plan.scatter("reference_x", "reference_y", **black)
    return _finish(plan, grid_x=True)


def _draw_error(runs: list[str], shown: Sources, strip: new_figure, along: str) -> new_figure:
    """Horizontal error of every run, and how large the filter thinks it can be."""
    grey = {"color": "#BBBBBB", "alpha": 0.35, "legend_label": "3σ"}
    strip.varea(along, 0.0, "major", source=shown.detail, **grey)
    for run, path, colour in zip(runs, shown.paths, RUNS, strict=False):
        strip.line(along, "error", source=path, color=colour, line_width=1.4, legend_label=run)
    return _with_now(strip, shown, along)


def _draw_axes(shown: Sources, strip: new_figure, name: str) -> new_figure:
    """What the network says for each axis."""
    for axis, colour in AXES.items():
        column = f"{name}_{axis}"
        style = {"color": colour, "line_width": 1.2, "legend_label": axis}
        strip.line("time", column, source=shown.detail, **style)
    return _with_now(strip, shown, "time")


def _draw_nis(shown: Sources, strip: new_figure) -> new_figure:
    """Normalised innovation squared, its mean where the filter is right, and the gate."""
    strip.line("time", "nis", source=shown.detail, color=BLUE, line_width=1.0, legend_label="NIS")
    for name, level, colour in (("mean", NIS_MEAN, GREEN), ("gate", NIS_REFUSED, VERMILION)):
        label = f"{name} ({level:.3g})"
        strip.line([0.0, LONG], [level, level], color=colour, legend_label=label)
    return _with_now(strip, shown, "time")


# Parts of a figure
# --------------------------------------------------------------------------------------------------


def _new_strip(label: str, x_range: Range1d, y_axis: str = "linear") -> new_figure:
    return new_figure(
        height=STRIP_HEIGHT,
        sizing_mode="stretch_width",
        x_range=x_range,
        y_axis_type=y_axis,
        y_axis_label=label,
        tools="xpan,xwheel_zoom,reset,save",
    )


def _with_now(strip: new_figure, shown: Sources, along: str) -> new_figure:
    """With the line of the slider."""
    strip.y_range = DataRange1d(renderers=list(strip.renderers))
    strip.vspan(along, source=shown.marks, line_color=NOW, line_width=1.2)
    if along == "time":
        strip.js_on_event("tap", CustomJS(code=GO_THERE))
    return _finish(strip)


def _finish(figure: new_figure, grid_x: bool = False) -> new_figure:
    """Dark text on white, a light grid, a legend that hides what is clicked."""
    figure.min_border_left = LEFT
    figure.toolbar.logo = None
    figure.outline_line_color = None
    figure.axis.axis_label_text_font_style = "normal"
    figure.axis.axis_label_text_color = figure.axis.major_label_text_color = "#222222"
    figure.axis.minor_tick_line_color = None
    figure.grid.grid_line_color = "#E3E3E3"
    figure.xgrid.visible = grid_x
    legend = figure.legend[0]
    legend.click_policy = "hide"
    legend.orientation = "horizontal"
    legend.label_text_font_size = "12px"
    legend.margin = 3
    legend.background_fill_alpha = 0.0
    legend.border_line_color = None
    figure.add_layout(legend, "above")
    return figure
