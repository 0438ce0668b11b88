"""The table of activities: what the networks say of windows at rest, in slow and in fast motion."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gnio_jax.comparison.picture import save
from gnio_jax.tables import activities, markdown, pictures
from gnio_jax.tables.activities import PredictedWindows
from gnio_jax.tables.experiments import Cell

Activities = dict[str, dict[str, float]]
"""Activity -> figure -> value."""

_HEADER = [
    "network",
    "windows of",
    "n",
    "rms error m",
    "error / σ, rms",
    "median length m",
    "median gate",
    "median scale",
]
_FIGURES = ("error", "normalised", "length", "gate", "scale")


def mean_over_seeds(seeds: list[PredictedWindows]) -> Activities:
    """The figures of each activity, as means over the seeds."""
    figures = [activities.by_activity(seed) for seed in seeds]
    return {
        activity: {
            key: float(np.mean([figure[activity][key] for figure in figures])) for key in first
        }
        for activity, first in figures[0].items()
    }


def draw(cell: Cell, seeds: list[PredictedWindows], path: Path) -> list[str]:
    """Pictures of gate and attention beside `path`, where the network has them, and what to say."""
    lines, diagnostics = [], seeds[0].diagnostics
    if "gate" in diagnostics:
        picture = pictures.gate(seeds[0])
        save(path.with_name(f"{path.name}_{cell.name}_gate.png"), picture)
    if "attention" in diagnostics:
        told, chance = np.mean([activities.information(seed) for seed in seeds], axis=0)
        words = (
            f"the most attended prototype tells {told:.2f} bits of the activity, "
            f"by chance it would be {chance:.2f}"
        )
        lines.append(f"{cell.label}: {words}.")
        picture = pictures.attention(*activities.attention_by_activity(seeds[0]), words)
        save(path.with_name(f"{path.name}_{cell.name}_attention.png"), picture)
    return lines


def render(by_method: dict[str, Activities]) -> str:
    """Networks × activities as Markdown."""
    table = []
    for method, by_activity in by_method.items():
        for activity, figures in by_activity.items():
            numbers = (f"{figures[key]:.3f}" if key in figures else "–" for key in _FIGURES)
            table.append([method, activity, f"{figures['windows']:.0f}", *numbers])
    return markdown.grid(_HEADER, table)
