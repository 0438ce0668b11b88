"""Pictures of the tables. Import this module only where one is drawn (Matplotlib)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from gnio_jax import drawing
from gnio_jax.drawing import save
from gnio_jax.evaluation import statistics
from gnio_jax.evaluation.statistics import Cell
from gnio_jax.evaluation.views import View
from gnio_jax.tables.activities import ACTIVITIES, HORIZONTAL, PredictedWindows
from gnio_jax.tables.experiments import Experiment
from gnio_jax.tables.runs import RowResult

__all__ = ["attention", "gate", "gradients", "save", "standing", "table", "trajectories"]

METHODS = {
    "tlio": drawing.BLUE,
    "gnio": drawing.GREEN,
    "ronin_resnet": drawing.ORANGE,
    "deepils": drawing.PURPLE,
    "ctin": drawing.VERMILION,
    "imot": drawing.SKY,
    "imot_text": drawing.YELLOW,
}
"""TLIO blue and GNIO green, as in the paper's figure."""


def table(experiment: Experiment, results: list[RowResult], ates: list[Cell]) -> Figure:
    """`ate` of each row: a dot for every seed, a bar for their mean, and sequences behind it;
    beside it the paper's figure. An estimate that diverged has no dot; the row's label has their
    number."""
    published = [row.published for row in experiment.rows]
    has_published = any(value is not None for value in published)
    size = (9.0 if has_published else 6.4, 1.4 + 0.45 * len(results))
    figure = Figure(figsize=size, layout="constrained")
    ratios = (2, 1) if has_published else (1,)
    panels = np.atleast_1d(figure.subplots(1, len(ratios), sharey=True, width_ratios=ratios))
    measured_axes, names = panels[0], []
    for index, (result, (summary, _)) in enumerate(zip(results, ates, strict=True)):
        lost = statistics.count_divergences(result.seeds)
        values_of = statistics.collect_values(result.seeds, "ate")
        sequences = [values.mean() for name, values in values_of.items() if name not in lost]
        labels = ("sequence", "seed, mean over sequences") if index == 0 else (None, None)
        measured_axes.barh(index, summary.mean or 0.0, color=drawing.GREEN, alpha=0.35, height=0.6)
        above = np.full(len(sequences), index) + 0.2
        measured_axes.plot(sequences, above, "|", color=drawing.GREY, ms=7, label=labels[0])
        seeds = np.full(len(summary.seeds), index)
        measured_axes.plot(summary.seeds, seeds, "o", color="black", ms=4, label=labels[1])
        diverged = (
            f"\n({summary.diverged} of {summary.estimates} diverged)" if summary.diverged else ""
        )
        names.append(result.row.label + diverged)
    measured_axes.set_yticks(range(len(results)), names)
    measured_axes.invert_yaxis()
    measured_axes.set(xlabel="ATE, here (m)", title=experiment.title)
    measured_axes.set_xlim(left=0)
    for index, value in enumerate(published):
        if value is not None:
            panels[1].barh(index, value, color=drawing.BLUE, alpha=0.35, height=0.6)
            panels[1].text(value, index, f" {value:.2f}", va="center", fontsize=8)
    if has_published:
        panels[1].set(xlabel="published (m), on other data", title="paper")
        panels[1].margins(x=0.2)
    form = {"fontsize": 8, "frameon": False, "loc": "outside lower center", "ncols": 2}
    figure.legend(*measured_axes.get_legend_handles_labels(), **form)
    for axes in panels:
        drawing.finish(axes)
    return figure


def gradients(
    results: list[RowResult], norms: Sequence[Float[np.ndarray, "seeds epochs"]]
) -> Figure:
    """Norm of the gradient of the scale's layer over training, one line per row: the mean over
    seeds, with their range shaded."""
    figure = Figure(figsize=(6.8, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for result, norm, colour in zip(results, norms, drawing.COLOURS, strict=False):
        epochs = np.arange(1, norm.shape[1] + 1)
        axes.semilogy(epochs, norm.mean(0), color=colour, label=result.row.label)
        axes.fill_between(epochs, norm.min(0), norm.max(0), color=colour, alpha=0.15, lw=0)
    axes.set(xlabel="epoch", ylabel="norm of the gradient of the scale's layer")
    axes.set_title("How steadily the scale learns")
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("{x:g}")
    axes.legend(fontsize=8, frameon=False)
    drawing.finish(axes)
    return figure


def trajectories(
    names: Sequence[str], methods: Mapping[str, Sequence[View]], columns: int = 4
) -> Figure:
    """All methods over the reference, a panel for each of the sequences `names`."""
    columns = min(columns, len(names))
    lines = -(-len(names) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.6 * lines + 0.5), layout="constrained")
    panels = np.atleast_1d(figure.subplots(lines, columns)).ravel()
    handles = {}
    for axes, name in zip(panels, names, strict=False):
        views = {
            method: view
            for method, method_views in methods.items()
            for view in method_views
            if view.name == name
        }
        reference = next(iter(views.values())).reference[:, :2]
        (handles["reference"],) = axes.plot(*reference.T, color=drawing.REFERENCE, lw=1.8)
        for number, (method, view) in enumerate(views.items()):
            colour = METHODS.get(method, drawing.COLOURS[number % len(drawing.COLOURS)])
            (handles[method],) = axes.plot(*view.position[:, :2].T, color=colour, lw=1.1)
        first = reference[np.isfinite(reference).all(1)][0]
        axes.plot(*first, color=drawing.REFERENCE, zorder=4, **drawing.START)
        axes.set_aspect("equal", adjustable="datalim")
        axes.set_title(name, fontsize=9)
        drawing.finish(axes)
    for axes in panels[len(names) :]:
        axes.set_visible(False)
    columns = min(8, len(handles))
    form = {"fontsize": 9, "frameon": False, "loc": "outside upper center", "ncols": columns}
    figure.legend(handles.values(), handles.keys(), **form)
    figure.supxlabel("x (m)", fontsize=9)
    figure.supylabel("y (m)", fontsize=9)
    return figure


def gate(windows: PredictedWindows) -> Figure:
    """Distribution of the gate, the scale and their product, horizontal axes, at rest and in
    motion."""
    figure = Figure(figsize=(10.0, 3.4), layout="constrained")
    quantities = {
        "|gate|": np.abs(windows.diagnostics["gate"]),
        "scale (m)": np.abs(windows.diagnostics["scale"]),
        "|scale × gate| (m)": np.abs(windows.displacement),
    }
    standing_still, slow = (ACTIVITIES.index(name) for name in ("standing", "slow"))
    rows = {
        "standing": (windows.activity == standing_still, drawing.VERMILION),
        "slow": (windows.activity == slow, drawing.GREY),
        "moving": (windows.activity > slow, drawing.BLUE),
    }
    for axes, (name, values) in zip(figure.subplots(1, 3), quantities.items(), strict=True):
        horizontal = values[:, HORIZONTAL]
        largest = 1.0 if name == "|gate|" else max(np.percentile(horizontal, 99), 1e-3)
        edges = np.linspace(0, largest, 41)
        for label, (mask, colour) in rows.items():
            if mask.any():
                share = np.histogram(horizontal[mask], edges)[0] / (2 * mask.sum())
                count = f"{label} ({mask.sum():,})"
                axes.stairs(share, edges, color=colour, lw=1.6, label=count)
        axes.set(xlabel=name, ylabel="share of windows and axes")
        drawing.finish(axes)
    figure.axes[0].legend(fontsize=8, frameon=False)
    return figure


def attention(names: list[str], lifts: Float[np.ndarray, "a p"], words: str) -> Figure:
    """Ratio of the attention of each prototype in each activity to its average; prototypes are
    sorted by the activity that they favour."""
    order = np.lexsort((-lifts.max(0), lifts.argmax(0)))
    figure = Figure(figsize=(9.0, 1.6 + 0.4 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    limit = max(abs(np.log2(np.clip(lifts, 0.25, 4))).max(), 1e-3)
    log_ratios, colour = np.log2(np.maximum(lifts[:, order], 1e-6)), {"vmin": -limit, "vmax": limit}
    image = axes.imshow(log_ratios, aspect="auto", cmap="RdBu_r", **colour)
    axes.set_yticks(range(len(names)), names)
    axes.set(xlabel="prototype, sorted by the activity it favours", title=words)
    axes.title.set_fontsize(9)
    figure.colorbar(image, ax=axes, label="log₂ of attention over its mean")
    return figure


def standing(by_method: dict[str, dict[str, dict[str, float]]]) -> Figure:
    """Error of a window's displacement by the walker's activity, one line of dots per method."""
    names = [name for name in ACTIVITIES if any(name in figures for figures in by_method.values())]
    figure = Figure(figsize=(7.2, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for number, (method, figures) in enumerate(by_method.items()):
        places = np.arange(len(names)) + 0.1 * (number - (len(by_method) - 1) / 2)
        values = [figures.get(name, {}).get("error", np.nan) for name in names]
        axes.semilogy(places, values, "o", color=METHODS.get(method, drawing.GREY), label=method)
    axes.set_xticks(range(len(names)), names)
    axes.set(ylabel="rms error of a window's displacement (m)", title="By activity")
    axes.legend(fontsize=8, frameon=False)
    drawing.finish(axes)
    return figure
