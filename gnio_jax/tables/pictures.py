"""Pictures of the tables. Import it only where one is drawn (Matplotlib); colours are those of
Okabe and Ito, the reference is black."""

from __future__ import annotations

import json
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from gnio_jax.evaluation import plots
from gnio_jax.evaluation.plots import BLUE, GREEN, GREY, VERMILION
from gnio_jax.tables.activities import ACTIVITIES, HORIZONTAL, PredictedWindows
from gnio_jax.tables.experiments import Experiment
from gnio_jax.tables.matrix import Result
from gnio_jax.tables.summary import TableRow, errors

COLOURS = {
    "tlio": BLUE,
    "gnio": GREEN,
    "ronin_resnet": "#E69F00",
    "deepils": "#CC79A7",
    "ctin": VERMILION,
    "imot": "#56B4E9",
    "imot_text": "#F0E442",
}
"""TLIO blue and GNIO green, as in the paper's figure."""
OTHERS = (BLUE, VERMILION, GREEN, "#CC79A7", "#E69F00", "#56B4E9")
LIGHT_GRID = "#E5E5E5"


# Errors of the rows
# --------------------------------------------------------------------------------------------------


def table(experiment: Experiment, results: list[Result], found: list[TableRow]) -> Figure:
    """`ate` of each row: every seed a dot, their mean a bar, sequences behind it; beside it what
    the paper printed. Of what diverged there is no dot: the row's label says how many."""
    published = [row.published for row in found]
    beside = any(value is not None for value in published)
    figure = Figure(figsize=(9.0 if beside else 6.4, 1.4 + 0.45 * len(found)), layout="constrained")
    ratios = (2, 1) if beside else (1,)
    panels = np.atleast_1d(figure.subplots(1, len(ratios), sharey=True, width_ratios=ratios))
    ours = panels[0]
    _draw_ours(ours, results, found)
    ours.set(xlabel="ate, here (m)", title=experiment.title)
    ours.set_xlim(left=0)
    figure.legend(
        *ours.get_legend_handles_labels(),
        fontsize=8,
        frameon=False,
        loc="outside lower center",
        ncols=2,
    )
    if beside:
        _draw_published(panels[1], published)
    for axes in panels:
        plots.finish(axes, LIGHT_GRID)
    return figure


def _draw_ours(axes: Axes, results: list[Result], found: list[TableRow]) -> None:
    for place, (result, row) in enumerate(zip(results, found, strict=True)):
        seeds = row.seeds.get("ate", [])
        sequences = [ates.mean() for ates in errors(result).values() if np.isfinite(ates).all()]
        labels = ("sequence", "seed, mean over sequences") if place == 0 else (None, None)
        axes.barh(place, np.mean(seeds) if seeds else 0.0, color=GREEN, alpha=0.35, height=0.6)
        above = np.full(len(sequences), place) + 0.2
        axes.plot(sequences, above, "|", color=GREY, ms=7, label=labels[0])
        axes.plot(seeds, np.full(len(seeds), place), "o", color="black", ms=4, label=labels[1])
    lost = [
        f"\n({row.diverged} of {row.estimates} diverged)" if row.diverged else "" for row in found
    ]
    names = [row.label + words for row, words in zip(found, lost, strict=True)]
    axes.set_yticks(range(len(found)), names)
    axes.invert_yaxis()


def _draw_published(axes: Axes, published: list[float | None]) -> None:
    for place, value in enumerate(published):
        if value is not None:
            axes.barh(place, value, color=BLUE, alpha=0.35, height=0.6)
            axes.text(value, place, f" {value:.2f}", va="center", fontsize=8)
    axes.set(xlabel="published m, on other data", title="paper")
    axes.margins(x=0.2)


# Training
# --------------------------------------------------------------------------------------------------


def gradients(results: list[Result]) -> Figure:
    """Norm of the gradient of the scale's layer over training, one line per row: the mean over
    seeds, their range shaded."""
    figure = Figure(figsize=(6.8, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for result, colour in zip(results, OTHERS, strict=False):
        norms = np.array([scale_gradients(run) for run in result.runs])
        epochs = np.arange(1, norms.shape[1] + 1)
        axes.semilogy(epochs, norms.mean(0), color=colour, label=result.cell.label)
        axes.fill_between(epochs, norms.min(0), norms.max(0), color=colour, alpha=0.15, lw=0)
    axes.set(
        xlabel="epoch",
        ylabel="norm of the gradient of the scale's layer",
        title="How steadily the scale learns",
    )
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("{x:g}")
    axes.legend(fontsize=8, frameon=False)
    plots.finish(axes, LIGHT_GRID)
    return figure


def scale_gradients(run: Path) -> list[float]:
    """Norm of the gradient of the scale's layer in every epoch of a run, a mean over its steps."""
    lines = (run / "metrics.jsonl").read_text(encoding="utf-8").splitlines()
    return [json.loads(line)["gradient_norm/head/scale"] for line in lines]


# Trajectories
# --------------------------------------------------------------------------------------------------


class MethodPath(NamedTuple):
    """One method's path beside the reference's, metres, plan view."""

    method: str
    path: Float[np.ndarray, "n 2"]


def trajectories(
    sequences: dict[str, tuple[Float[np.ndarray, "n 2"], list[MethodPath]]], columns: int = 4
) -> Figure:
    """All methods over the reference, a panel for each sequence."""
    columns = min(columns, len(sequences))
    lines = -(-len(sequences) // columns)
    figure = Figure(figsize=(3.6 * columns, 3.6 * lines + 0.5), layout="constrained")
    panels = np.atleast_1d(figure.subplots(lines, columns)).ravel()
    used, unused = panels[: len(sequences)], panels[len(sequences) :]
    for axes, (name, (reference, tracks)) in zip(used, sequences.items(), strict=True):
        _draw_tracks(axes, reference, tracks)
        axes.set_title(name, fontsize=9)
        plots.finish(axes, LIGHT_GRID)
    for axes in unused:
        axes.set_visible(False)
    handles = {
        label: handle
        for axes in used
        for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        handles.values(),
        handles.keys(),
        loc="outside upper center",
        ncols=min(8, len(handles)),
        fontsize=9,
        frameon=False,
    )
    figure.supxlabel("x (m)", fontsize=9)
    figure.supylabel("y (m)", fontsize=9)
    return figure


def _draw_tracks(axes: Axes, reference: Float[np.ndarray, "n 2"], tracks: list[MethodPath]) -> None:
    axes.plot(*reference.T, color="black", lw=1.8, label="reference")
    for number, track in enumerate(tracks):
        axes.plot(*track.path.T, color=_colour(track.method, number), lw=1.1, label=track.method)
    axes.plot(*reference[0], "o", color="black", mfc="white", ms=6, zorder=4)
    axes.set_aspect("equal", adjustable="datalim")


# Windows at rest and in motion
# --------------------------------------------------------------------------------------------------


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
        "standing": (windows.activity == standing_still, VERMILION),
        "slow": (windows.activity == slow, GREY),
        "moving": (windows.activity > slow, BLUE),
    }
    for axes, (name, values) in zip(figure.subplots(1, 3), quantities.items(), strict=True):
        horizontal = values[:, HORIZONTAL]
        largest = 1.0 if name == "|gate|" else max(np.percentile(horizontal, 99), 1e-3)
        edges = np.linspace(0, largest, 41)
        for label, (chosen, colour) in rows.items():
            if chosen.any():
                share = np.histogram(horizontal[chosen], edges)[0] / (2 * chosen.sum())
                count = f"{label} ({chosen.sum():,})"
                axes.stairs(share, edges, color=colour, lw=1.6, label=count)
        axes.set(xlabel=name, ylabel="share of windows and axes")
        plots.finish(axes, LIGHT_GRID)
    figure.axes[0].legend(fontsize=8, frameon=False)
    return figure


def attention(names: list[str], lifts: Float[np.ndarray, "a p"], words: str) -> Figure:
    """How much more attention each prototype gets in each activity than on average; prototypes in
    the order of the activity they favour."""
    order = np.lexsort((-lifts.max(0), lifts.argmax(0)))
    figure = Figure(figsize=(9.0, 1.6 + 0.4 * len(names)), layout="constrained")
    axes = figure.add_subplot()
    limit = max(abs(np.log2(np.clip(lifts, 0.25, 4))).max(), 1e-3)
    image = axes.imshow(
        np.log2(np.maximum(lifts[:, order], 1e-6)),
        aspect="auto",
        cmap="RdBu_r",
        vmin=-limit,
        vmax=limit,
    )
    axes.set_yticks(range(len(names)), names)
    axes.set(xlabel="prototype, sorted by the activity it favours", title=words)
    axes.title.set_fontsize(9)
    figure.colorbar(image, ax=axes, label="log₂ of attention over its mean")
    return figure


def entropies(rows: list[str], of_window: list[list[float]], of_mean: list[list[float]]) -> Figure:
    """Entropy of the attention of each row, as a share of that of a uniform one; a dot for each
    seed."""
    figure = Figure(figsize=(5.6, 3.8), layout="constrained")
    axes = figure.add_subplot()
    for values, colour, label in [
        (of_window, GREEN, "of one window"),
        (of_mean, GREY, "of the mean over windows"),
    ]:
        axes.plot([np.mean(seeds) for seeds in values], color=colour, label=label)
        for place, seeds in enumerate(values):
            axes.plot(np.full(len(seeds), place), seeds, "o", color=colour, ms=4)
    axes.set_xticks(range(len(rows)), rows)
    axes.set(
        xlabel="bank",
        ylabel="entropy / log m",
        ylim=(0, 1.05),
        title="How the attention spreads over the bank",
    )
    axes.legend(fontsize=8, frameon=False)
    plots.finish(axes, LIGHT_GRID)
    return figure


def standing(by_method: dict[str, dict[str, dict[str, float]]]) -> Figure:
    """Error of a window's displacement by what the walker did, one line of dots per method."""
    names = [name for name in ACTIVITIES if any(name in figures for figures in by_method.values())]
    figure = Figure(figsize=(7.2, 4.0), layout="constrained")
    axes = figure.add_subplot()
    for number, (method, figures) in enumerate(by_method.items()):
        places = np.arange(len(names)) + 0.1 * (number - (len(by_method) - 1) / 2)
        values = [figures.get(name, {}).get("error", np.nan) for name in names]
        axes.semilogy(places, values, "o", color=_colour(method, number), label=method)
    axes.set_xticks(range(len(names)), names)
    axes.set(ylabel="rms error of a window's displacement (m)", title="By what the walker did")
    axes.legend(fontsize=8, frameon=False)
    plots.finish(axes, LIGHT_GRID)
    return figure


def _colour(method: str, number: int) -> str:
    return COLOURS.get(method, OTHERS[number % len(OTHERS)])
