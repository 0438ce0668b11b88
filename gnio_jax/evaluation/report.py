"""The figures of an evaluation: a table for the screen, JSON and CSV for programs, TUM trajectories
for evo."""

from __future__ import annotations

import csv
import json
import math
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich import box
from rich.console import Group
from rich.table import Table
from rich.text import Text

from gnio_jax.evaluation import metrics
from gnio_jax.evaluation.metrics import Measures, Summary, Trajectory
from gnio_jax.evaluation.odometry import Estimate

DEFINITIONS = 2
"""What the figures of metrics.json mean, in its `settings`. Raise it with every change after which
a file's figures cannot stand beside newer ones: another definition of a metric, of who counts as
diverged or of a mean, or something in the file that tables need. Those of 1 have no groups, and
yaw errors that are differences of Euler yaws."""

COLUMNS = {
    "duration": ("time", "s", 0),
    "path_length": ("path", "m", 0),
    "ate": ("ATE", "m", 2),
    "ate_2d": ("ATE 2-D", "m", 2),
    "rte_60s": ("RTE 60 s", "m", 2),
    "rpe_1s": ("RPE 1 s", "m", 3),
    "yaw_rmse": ("yaw", "°", 1),
    "path_length_ratio": ("path ratio", "", 2),
    "stationary_drift": ("standing", "m/min", 1),
    "nees_coverage": ("NEES<95 %", "%", 0),
    "nis": ("NIS/3", "", 2),
    "accepted": ("accepted", "%", 0),
}
"""Metrics in the table: heading, unit, digits. The files hold them all."""


class Scores(NamedTuple):
    """Metrics of one way of estimating, over sequences."""

    sequences: dict[str, Measures]
    summary: Summary
    groups: dict[str, str]
    """Sequence -> person or session, as the intervals draw them."""

    @property
    def diverged(self) -> list[str]:
        """Sequences whose estimate diverged (`metrics.diverged`)."""
        return [name for name, m in self.sequences.items() if metrics.diverged(m.values)]


class Report(NamedTuple):
    """Everything the files say."""

    settings: dict[str, Any]
    """What changes the meaning of the figures, for the reader of the table and of the JSON."""
    scores: Scores
    reference_rows: dict[str, Scores]
    """`never_moves` and `perfect_displacements`."""
    notes: dict[str, list[str]]
    """Sequence -> what a reader should know of its start and of its filter."""
    left_out: dict[str, str]
    """Sequence -> why it has no figures."""


def score(
    estimates: list[Estimate], groups: Mapping[str, Any], alignment: metrics.Alignment = "origin"
) -> Scores:
    """Every metric of every estimate, and over all of them; `groups` says which sequences belong
    together (`metrics.summarise`)."""
    sequences = {}
    for e in estimates:
        found = metrics.measure(e.trajectory, e.reference, alignment, e.position_covariance, e.nis)
        if e.accepted is not None:
            tried = e.accepted[~np.isnan(e.accepted)]
            share = float(100 * tried.mean()) if len(tried) else None
            found = Measures(
                found.values | {"accepted": share},
                found.undefined | ({} if len(tried) else {"accepted": "no measurement"}),
            )
        sequences[e.name] = found
    summary = metrics.summarise({name: m.values for name, m in sequences.items()}, groups)
    return Scores(sequences, summary, {name: str(groups[name]) for name in sequences})


# On the screen
# --------------------------------------------------------------------------------------------------------


def table(report: Report) -> Group:
    """The table and what belongs under it, for `rich.console.Console.print`."""
    shown = [
        name for name in COLUMNS if any(name in m.values for m in report.scores.sequences.values())
    ]
    settings = report.settings
    coupling = f", {settings['coupling']} coupling" if settings["estimator"] == "ekf" else ""
    grid = Table(
        title=f"{settings['dataset']} {settings['split']}: {settings['estimator']}{coupling}",
        title_style="bold",
        title_justify="left",
        box=box.SIMPLE_HEAD,
    )
    labels = [*report.scores.sequences, *report.reference_rows]
    grid.add_column("sequence", overflow="fold", min_width=min(40, max(map(len, labels))))
    for name in shown:
        heading, unit, _ = COLUMNS[name]
        grid.add_column(f"{heading}\n[dim]{unit}[/dim]", justify="right", no_wrap=True)

    def add(label: str, values: Mapping[str, Any], style: str = "", last: bool = False) -> None:
        grid.add_row(
            Text(label),
            *(_cell(values.get(name), COLUMNS[name][2]) for name in shown),
            style=style,
            end_section=last,
        )

    names = list(report.scores.sequences)
    for name in names:
        add(name, report.scores.sequences[name].values, last=name == names[-1])
    summary = report.scores.summary
    add(_mean_of(report.scores), summary.mean, "bold")
    add("median", summary.median)
    add("95 % interval", summary.interval)
    if report.scores.diverged:
        counts = (str(summary.diverged.get(name, 0)) for name in shown)
        grid.add_row("diverged", *counts, style="bold red")
    grid.add_row(
        "n", *(str(summary.count.get(name, 0)) for name in shown), style="dim", end_section=True
    )
    for label, scores in report.reference_rows.items():
        label = f"{label} ({_mean_of(scores)})" if scores.diverged else label
        add(label, scores.summary.mean, "italic")
    words = [
        f"window orientation: {settings['orientation_source']}",
        f"initial state: {settings['initial_state']}",
        f"gyro bias: {settings['gyro_bias']}",
        f"IMU compensated: {settings['imu_compensated']}",
        f"alignment: {settings['alignment']}",
    ]
    lines = [
        Text("; ".join(words), style="dim"),
        Text(
            "reference rows are means; – is not defined (the reason is in metrics.json)",
            style="dim",
        ),
    ]
    if any(scores.diverged for scores in (report.scores, *report.reference_rows.values())):
        lines.append(
            Text(
                "∞: the estimate diverged. It counts in medians, with infinite errors "
                "and coverages of 0; means, intervals and n are in every column of the "
                "others alone, so they cannot be compared with those of another run",
                style="yellow",
            )
        )
    said: dict[str, list[str]] = {}
    for name, notes in report.notes.items():
        for note in notes:
            said.setdefault(note, []).append(name)
    for note, names in said.items():
        lines.append(
            Text(
                f"{', '.join(names) if len(names) < 4 else f'{len(names)} sequences'}: {note}",
                style="yellow",
            )
        )
    lines += [
        Text(f"left out: {name}: {reason}", style="yellow")
        for name, reason in report.left_out.items()
    ]
    return Group(grid, *lines)


def _mean_of(scores: Scores) -> str:
    return f"mean without {len(scores.diverged)} diverged" if scores.diverged else "mean"


def _cell(value: Any, digits: int) -> str:
    if value is None:
        return "–"
    if value == math.inf:
        return "∞"
    if isinstance(value, tuple):
        return f"{_cell(value[0], digits)}–{_cell(value[1], digits)}"
    return f"{value:.{digits}f}" if abs(value) < 10 ** (7 - digits) else f"{value:.1e}"


# Files
# ----------------------------------------------------------------------------------------------------------------


def as_json(report: Report) -> dict[str, Any]:
    """The whole report as plain values; a metric without a finite value is None, with a reason.

    `mean` is over the sequences that did not diverge; its `diverged` counts those that did, the
    report's `diverged` by metric.
    """
    measured = report.scores.sequences.values()
    nowhere = {
        name: next(
            (m.undefined[name] for m in measured if name in m.undefined),
            "no estimate that did not diverge",
        )
        for name, value in _finite(report.scores.summary.mean).items()
        if value is None
    }
    sequences = _sequences(report.scores)
    for name, group in report.scores.groups.items():
        sequences[name]["group"] = group
    for name, notes in report.notes.items():
        sequences[name]["notes"] = notes
    return {
        "settings": report.settings,
        "sequences": sequences,
        **_summary(report.scores),
        "undefined": nowhere,
        "reference_rows": {
            label: {"sequences": _sequences(scores), **_summary(scores)}
            for label, scores in report.reference_rows.items()
        },
        "left_out": report.left_out,
    }


def _sequences(scores: Scores) -> dict[str, dict[str, Any]]:
    return {
        name: {**_finite(m.values), **({"undefined": m.undefined} if m.undefined else {})}
        for name, m in scores.sequences.items()
    }


def read_metric(sequence: Mapping[str, Any], metric: str) -> float | None:
    """A metric of one of the `sequences` of metrics.json, as `Measures` has it: None where it is
    not defined, infinite where its reason says so."""
    value = sequence.get(metric)
    reason = sequence.get("undefined", {}).get(metric, "")
    return math.inf if value is None and metrics.is_infinite(reason) else value


def definitions(figures: Mapping[str, Any]) -> int:
    """`DEFINITIONS` of a metrics.json. Before files said it, those of 2 were the ones with groups."""
    grouped = all("group" in sequence for sequence in figures["sequences"].values())
    return figures["settings"].get("definitions", 2 if grouped else 1)


def _summary(scores: Scores) -> dict[str, Any]:
    summary = scores.summary
    interval = {
        name: None if value is None else list(value) for name, value in summary.interval.items()
    }
    return {
        "mean": {**_finite(summary.mean), "diverged": len(scores.diverged)},
        "median": _finite(summary.median),
        "interval": interval,
        "n": summary.count,
        "diverged": summary.diverged,
    }


def _finite(values: Mapping[str, float | None]) -> dict[str, float | None]:
    """JSON has no infinity."""
    return {name: None if value == math.inf else value for name, value in values.items()}


def write(folder: Path, report: Report, estimates: list[Estimate]) -> None:
    """metrics.json, metrics.csv, trajectories/ and references/ (TUM format) into an empty folder
    (see `replacing_folder`)."""
    text = json.dumps(as_json(report), indent=2, allow_nan=False, ensure_ascii=False)
    (folder / "metrics.json").write_text(text + "\n", encoding="utf-8")
    columns = list(
        dict.fromkeys(metric for m in report.scores.sequences.values() for metric in m.values)
    )
    with open(folder / "metrics.csv", "w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["sequence", *columns])
        for name, m in report.scores.sequences.items():
            rows.writerow(
                [
                    name,
                    *(
                        "" if m.values.get(column) is None else repr(m.values[column])
                        for column in columns
                    ),
                ]
            )
    for kind in ("trajectories", "references"):
        (folder / kind).mkdir()
    for stem, e in zip(file_names([e.name for e in estimates]), estimates, strict=True):
        write_tum(folder / "trajectories" / f"{stem}.txt", e.trajectory)
        if np.isfinite(e.reference.position).any():
            write_tum(folder / "references" / f"{stem}.txt", e.reference)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """`t x y z qx qy qz qw` a line, s and m, body→world; rows that are not finite are left out."""
    rows = np.column_stack(
        [trajectory.time, trajectory.position, trajectory.orientation[:, [1, 2, 3, 0]]]
    )
    np.savetxt(path, rows[np.isfinite(rows).all(1)], fmt="%.9f", header="t x y z qx qy qz qw")


def file_names(names: list[str]) -> list[str]:
    """A distinct file name for each sequence: its name with anything a file system could mind as
    `_`."""
    stems: list[str] = []
    for name in names:
        stem = re.sub(r"[^\w.=+-]+", "_", name).strip("._") or "sequence"
        while stem in stems:
            stem += "_"
        stems.append(stem)
    return stems


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield an empty folder beside `path`; on success it takes the place of `path`, on failure it
    is removed and `path` stays."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{path.name}.", dir=path.parent))
    try:
        new = temporary / "new"
        new.mkdir()
        yield new
        old = temporary / "old"
        if path.exists():
            path.rename(old)
        try:
            new.rename(path)
        except OSError:
            if old.exists():
                old.rename(path)
            raise
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
