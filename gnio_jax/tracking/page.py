"""The page of a track: the same as that of an evaluation, with what is told of a track."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from gnio_jax import config as configuration
from gnio_jax.config import TrainConfig
from gnio_jax.evaluation import page, tabulate
from gnio_jax.evaluation.plots import View
from gnio_jax.tracking.summary import Summary


def write(path: Path, seen: View, summary: Summary, config: TrainConfig, command: str = "") -> None:
    """Write the page; `config` is of the run whose weights track, `command` how it was called."""
    page.write(path, summary.recording, [run(seen, summary, config, command)])


def run(seen: View, summary: Summary, config: TrainConfig, command: str) -> page.Run:
    """What the page is told."""
    about = {
        "command": command,
        "walked": f"{summary.path_length:.1f} m in {summary.seconds:.0f} s, "
        f"ends {summary.from_start:.1f} m from the start",
        "expected error at the end": f"{summary.expected_error:.1f} m by the filter",
        "weights": f"{summary.weights}, trained on {summary.trained_on}",
        "window orientation": "filter",
        "alignment": "start position and yaw" if summary.errors else "",
        "windows": tabulate.windows(dataclasses.asdict(config.data)),
    }
    figures = summary.errors or {
        "duration": summary.seconds,
        "path_length": summary.path_length,
        "accepted": None if summary.accepted is None else 100.0 * summary.accepted,
    }
    warnings = [f"warning: {each}" for each in summary.warnings]
    return page.Run(
        "track",
        {name: text for name, text in about.items() if text},
        [seen],
        {seen.name: figures},
        remarks=(*warnings, summary.limits, *summary.notes),
        settings=configuration.text(config),
    )
