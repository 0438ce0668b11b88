"""Results as text: columns and cells of all tables, the table on the screen, Markdown, CSV."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rich import box
from rich.cells import cell_len
from rich.console import ConsoleOptions, Group
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from gnio_jax.data.readers import DATASETS
from gnio_jax.evaluation import statistics
from gnio_jax.evaluation.report import Report
from gnio_jax.evaluation.statistics import Cell, Difference, MetricSummary
from gnio_jax.files import with_ending, write_csv, write_text


class Column(NamedTuple):
    """The format of a metric."""

    heading: str
    unit: str = ""
    digits: int = 2
    best: float = 0.0
    """The best possible value."""

    @property
    def title(self) -> str:
        """Heading, unit, and the best value if it is not 0."""
        best = f"best {self.best:g}" if self.best else ""
        remarks = ", ".join(filter(None, (self.unit, best)))
        return f"{self.heading} ({remarks})" if remarks else self.heading


COLUMNS = {
    "duration": Column("time", "s", 0),
    "path_length": Column("path", "m", 0),
    "ate": Column("ATE", "m"),
    "rte_60s": Column("RTE 60 s", "m"),
    "rpe_1s": Column("RPE 1 s", "m", 3),
    "yaw_rmse": Column("yaw", "°", 1),
    "t_rel": Column("t_rel", "%"),
    "r_rel": Column("r_rel", "°/m", 5),
    "path_length_ratio": Column("path ratio", best=1.0),
    "stationary_drift": Column("standing", "m/min", 1),
    "nees": Column("NEES/3", best=1.0),
    "nees_2d": Column("NEES/2 2-D", best=1.0),
    "nees_coverage": Column("NEES<95 %", "%", 0, 95.0),
    "nis": Column("NIS/3", best=1.0),
    "nis_coverage": Column("NIS<95 %", "%", 0, 95.0),
    "accepted": Column("accepted", "%", 0, 100.0),
    "legs": Column("legs", digits=0),
    "leg_ratio": Column("leg ratio", best=1.0),
    "leg_path_ratio": Column("legs' path ratio", best=1.0),
    "leg_error": Column("leg error", "m"),
    "waypoint_rms": Column("waypoint rms", "m"),
}
SCREEN = ("ate", "rte_60s", "rpe_1s", "yaw_rmse", "path_length_ratio", "nees_coverage")
"""Metrics of the table on the screen, which fits into 80 columns. The files have all metrics."""
VEHICLE_SCREEN = ("ate", "rte_60s", "rpe_1s", "yaw_rmse", "t_rel", "nees_coverage")
"""The same for a dataset of vehicles."""
WAYPOINT_SCREEN = (
    "path_length",
    "legs",
    "leg_ratio",
    "leg_path_ratio",
    "leg_error",
    "waypoint_rms",
)
"""The same for sequences with waypoints instead of poses."""
MIXED_SCREEN = (*SCREEN[:3], *WAYPOINT_SCREEN[-3:])
"""The same for a split with both."""
TO_WAYPOINTS = "one turn and one shift to the waypoints"
PARTS = r"[^-_/.: ]*[-_/.: ]+|[^-_/.: ]+"
"""Parts of a name, between which it may be broken across lines."""
LONGEST_HEADING = 9
"""Largest number of letters of a heading; a longer one is broken on the screen."""
DIVERGED = (
    "∞: the estimate diverged. It counts in medians, with infinite errors and coverages of 0, "
    "but means, intervals and n leave it out in every column, so they cannot be compared "
    "with those of another run"
)


def column(metric: str) -> Column:
    """The format of any metric; a horizontal one has that of the spatial one."""
    if metric in COLUMNS:
        return COLUMNS[metric]
    spatial = COLUMNS.get(metric.removesuffix("_2d"))
    if spatial is None:
        return Column(metric, "", 3)
    return spatial._replace(heading=f"{spatial.heading} 2-D")


# --- cells


def number(value: float | None, digits: int) -> str:
    """One figure; – if it is not defined, ∞ if the estimate diverged."""
    if value is None or math.isnan(value):
        return "–"
    if math.isinf(value):
        return "∞"
    return f"{value:.{digits}f}" if abs(value) < 10 ** (7 - digits) else f"{value:.1e}"


def mean(summary: MetricSummary, digits: int) -> str:
    """Mean over sequences ± standard deviation over seeds, and † with the number that diverged."""
    text = number(summary.mean, digits)
    if summary.std is not None:
        text += f" ± {number(summary.std, digits)}"
    return f"{text} † {summary.diverged}/{summary.estimates}" if summary.diverged else text


def difference(change: Difference | None, digits: int) -> str:
    """Difference, its interval, and the number of sequences if it is not over all. It is empty for
    the first row."""
    if change is None:
        return ""
    if change.mean is None:
        return "– ‡" if change.withheld else "–"
    low, high = change.interval or (0.0, 0.0)
    # Enough digits to show two of the interval's half width, but at most three more than the
    # mean's.
    size = (high - low) / 2 or abs(change.mean)
    needed = 1 - math.floor(math.log10(size)) if size else digits
    digits = min(max(digits, needed), digits + 3)
    reach = f" ({low:+.{digits}f} to {high:+.{digits}f})" if change.interval else ""
    over = f" over {change.compared}" if change.compared < change.sequences else ""
    return f"{change.mean:+.{digits}f}{reach}{over}"


def cells(rows: Sequence[Sequence[Report]], metrics: Iterable[str]) -> dict[str, list[Cell]]:
    """Metric → a cell for each row, whose seeds are reports; compared with the first row."""
    groups = {
        name: group for row in rows for report in row for name, group in report.groups.items()
    }
    first, *others = ([report.scores for report in row] for row in rows)
    table = {}
    for metric in metrics:
        best = column(metric).best
        table[metric] = [Cell(statistics.summarise(first, metric, groups), None)]
        for seeds in others:
            difference = statistics.compare(seeds, first, metric, groups, best)
            table[metric].append(Cell(statistics.summarise(seeds, metric, groups), difference))
    return table


def records(
    heads: Sequence[Mapping[str, Any]], figures: Mapping[str, Sequence[Cell]]
) -> list[dict[str, Any]]:
    """The lines of a CSV, one for each metric and row: the head of the row, then its figures."""
    lines = []
    for metric, cells in figures.items():
        for head, (summary, difference) in zip(heads, cells, strict=True):
            low, high = (difference and difference.interval) or (None, None)
            line = {
                "metric": metric,
                "mean": summary.mean,
                "std": summary.std,
                "median": summary.median,
                "diverged": summary.diverged,
                "estimates": summary.estimates,
                "difference": difference and difference.mean,
                "difference_low": low,
                "difference_high": high,
                "gain_percent": difference and difference.gain,
                "better": None if difference is None or difference.withheld else difference.better,
                "compared": difference and difference.compared,
                "sequences": difference and difference.sequences,
                "groups": difference and difference.groups,
            }
            lines.append({**head, **line})
    return lines


def marks(cells: Sequence[Cell]) -> list[str]:
    """The meaning of the marks of a table, and the way its intervals were computed."""
    summaries = [cell.summary for cell in cells]
    differences = [cell.difference for cell in cells if cell.difference]
    counts = sorted({difference.groups for difference in differences if difference.interval})
    groups = " or ".join(map(str, counts))
    conditions = {
        f"The interval is Student's t over people or sessions; there are {groups}.": bool(groups),
        "No interval: the sequences compared are of one person or session.": any(
            difference.groups == 1 and not difference.withheld for difference in differences
        ),
        **dict.fromkeys(unevenness(differences), True),
        "A difference is over the sequences that both rows have with every seed, and on which no "
        "error is infinite; a mean is over all that a row has with every seed.": any(
            difference.compared < difference.sequences for difference in differences
        ),
        "† This number of all estimates diverged. Their sequences are not in the mean.": any(
            summary.diverged for summary in summaries
        ),
        "‡ Its remaining walks would be better than those of the first row, but it diverged more "
        "often, so no difference is shown.": any(difference.withheld for difference in differences),
        "∞: an error is too large for a number.": any(
            np.isinf(summary.seeds).any() for summary in summaries
        ),
        "–: this value does not exist for every seed, or there is nothing to compare it with.": any(
            summary.mean is None for summary in summaries
        ),
    }
    return [line for line, applies in conditions.items() if applies]


def unevenness(figures: Iterable[MetricSummary | Difference]) -> list[str]:
    """A line about the intervals, if one group has most of the sequences of any of the figures."""
    uneven = [figure for figure in figures if figure.interval and statistics.is_uneven(figure)]
    if not uneven:
        return []
    worst = max(uneven, key=lambda figure: figure.largest)
    count = worst.sequences if isinstance(worst, MetricSummary) else worst.compared
    share = f"One of {worst.groups} people or sessions has {worst.largest} of {count} sequences"
    return [f"{share}, so the interval may be too narrow."]


def few_groups(summaries: Iterable[MetricSummary]) -> str:
    """The reason why means have no interval, if they are of too few groups; else empty."""
    counts = {summary.groups for summary in summaries if summary.mean is not None}
    few = sorted(counts - {count for count in counts if count >= statistics.FEWEST_GROUPS})
    if not few:
        return ""
    groups = f"{' or '.join(map(str, few))} group{'s' if few != [1] else ''}"
    return f"no interval of a mean over {groups}: it needs {statistics.FEWEST_GROUPS}"


# --- how the figures were made


def describe_estimator(settings: Mapping[str, Any]) -> str:
    """The way trajectories were estimated: the estimator, and every choice other than the
    default."""
    loose = settings.get("coupling") == "loose"
    by_filter = settings["estimator"] == "imu_only" or settings.get("coupling") == "tight"
    orientation = settings.get("orientation_source")
    start = settings.get("initial_state", "reference")
    bias = settings.get("gyro_bias", "zero")
    parts = {
        settings["estimator"]: True,
        "loose coupling": loose,
        f"{orientation} orientation": orientation and not by_filter,
        f"{start} start": start != "reference",
        f"gyro bias: {bias}": bias != "zero",
        f"{settings['alignment']} alignment": settings["alignment"] != "origin",
        f"{settings.get('checkpoint')} checkpoint": settings.get("checkpoint") == "latest",
    }
    return ", ".join(text for text, applies in parts.items() if applies)


def describe(settings: Mapping[str, Any]) -> dict[str, str]:
    """The choices behind the figures, in words."""
    choices = {
        "window orientation": settings.get("orientation_source"),
        "initial state": settings.get("initial_state"),
        "gyro bias": settings.get("gyro_bias"),
        "IMU compensated": settings.get("imu_compensated"),
        "alignment": settings["alignment"],
    }
    if settings.get("reference") == "waypoints":
        choices["alignment"] = TO_WAYPOINTS
    if settings.get("model"):
        latest = ", latest checkpoint" if settings["checkpoint"] == "latest" else ""
        name = settings.get("network") or settings["model"]
        choices["network"] = f"{name} ({settings['model']}, step {settings['step']}{latest})"
        choices["windows"] = windows(settings)
    return {name: str(value) for name, value in choices.items() if value}


def windows(settings: Mapping[str, Any]) -> str:
    """The network's window and context, from fields of `DataConfig`."""
    text = f"{settings['window_seconds']:g} s at {settings['rate']:g} Hz"
    context = settings["context_seconds"]
    return f"{text}, and {context:g} s before" if context else text


def remarks(report: Report) -> list[str]:
    """Notes about intervals and about sequences: each note once with its sequences, the sequences
    that were left out with the reason, and those that diverged."""
    sequences_of: dict[str, list[str]] = {}
    for name, notes in report.notes.items():
        for note in notes:
            sequences_of.setdefault(note, []).append(name)
    lines = [
        f"{', '.join(names) if len(names) < 4 else f'{len(names)} sequences'}: {note}"
        for note, names in sequences_of.items()
    ]
    summaries = report.summary().values()
    lines += filter(None, (few_groups(summaries), *unevenness(summaries)))
    left_out: dict[str, list[str]] = {}  # end of the reason, without the file -> names
    for name, reason in report.left_out.items():
        left_out.setdefault(reason.partition(": ")[2] or reason, []).append(name)
    for names in left_out.values():
        reason = report.left_out[names[0]]
        several = f"{len(names)} recordings for one reason, the first: " if names[1:] else ""
        lines.append(f"left out: {several}{names[0]}: {reason}")
    return lines + [f"{name}: the estimate diverged, and is in no mean" for name in report.diverged]


def gaps(report: Report) -> str:
    """A line about the recordings that the figures do not have; empty if there is none."""
    if not report.left_out:
        return ""
    names, count = list(report.left_out), len(report.left_out)
    listed = ", ".join([*names[:3], *(["..."] if names[3:] else [])])
    return f"{count} of {count + len(report.scores)} recordings were left out: {listed}"


# --- files


def markdown(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Cells as a Markdown table."""
    lines = [header, ["---"] * len(header), *rows]
    escaped = [[" ".join(cell.split()).replace("|", "\\|") for cell in cells] for cells in lines]
    return "".join(f"| {' | '.join(cells)} |\n" for cells in escaped)


def write(path: Path, text: str, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write `path`.md with a text, and `path`.csv with rows, empty where there is no value."""
    write_text(with_ending(path, ".md"), text.rstrip() + "\n")
    write_csv(with_ending(path, ".csv"), [[*rows[0]], *([*row.values()] for row in rows)])


# --- the table of an evaluation on the screen


def render(report: Report) -> Group:
    """The table of an evaluation and the lines under it, for `rich.console.Console.print`: a row
    per sequence, then those of the set, then the reference rows."""
    summary = report.summary()
    kind = DATASETS.get(report.settings["dataset"])
    of_vehicle = kind is not None and not kind.pedestrian and "t_rel" in summary
    screen = VEHICLE_SCREEN if of_vehicle else SCREEN
    if "waypoint_rms" in summary:
        screen = MIXED_SCREEN if "ate" in summary else WAYPOINT_SCREEN
    shown = [name for name in screen if name in summary]
    settings = report.settings
    title = f"{settings['dataset']} {settings['split']}: {describe_estimator(settings)}"
    grid = Table(title=title, title_style="bold", title_justify="left", box=box.SIMPLE_HEAD)
    grid.add_column("sequence", overflow="fold")  # a name is never cut
    for name in shown:
        # Lines are short, and are not markup, which the console of results does not read.
        heading, unit, *_ = COLUMNS[name]
        words = heading.removesuffix(f" {unit}") if unit else heading
        if not unit or len(words) > LONGEST_HEADING:
            words = words.replace(" ", "\n")
        lines = filter(None, (words, unit))
        grid.add_column(Text("\n".join(lines)), justify="right", no_wrap=True)

    def add(label: str, cells: Iterable[str], style: str = "", last: bool = False) -> None:
        grid.add_row(_Name(label), *cells, style=style, end_section=last)

    def numbers(values: Mapping[str, float | None]) -> list[str]:
        return [number(values.get(name), COLUMNS[name].digits) for name in shown]

    for row_number, (name, measures) in enumerate(report.scores.items(), start=1):
        add(name, numbers(measures.values), last=row_number == len(report.scores))
    lost = report.diverged
    limits = {name: metric.interval or (None, None) for name, metric in summary.items()}
    means = {name: metric.mean for name, metric in summary.items()}
    add(_mean_label(lost), numbers(means), "bold")
    add("median", numbers({name: metric.median for name, metric in summary.items()}))
    for end, label in enumerate(("95 % from", "95 % to")):
        add(label, numbers({name: interval[end] for name, interval in limits.items()}))
    add("n", [str(summary[name].sequences) for name in shown], "dim")
    add("groups", [str(summary[name].groups) for name in shown], "dim", last=True)
    for row, scores in report.reference_rows.items():
        diverged = [name for name, measures in scores.items() if measures.diverged]
        label = f"{row} ({_mean_label(diverged)})" if diverged else row
        means = {name: metric.mean for name, metric in report.summary(row).items()}
        add(label, numbers(means), "italic")
        lost = lost + diverged
    choices = "; ".join(f"{name}: {text}" for name, text in describe(report.settings).items())
    signs = "reference rows are means; – is not defined (reasons: metrics.json of an evaluation)"
    warnings = [DIVERGED] if lost else []
    return Group(
        grid,
        *(Text(line, style="dim") for line in (choices, signs)),
        *(Text(line, style="yellow") for line in (*warnings, *remarks(report))),
    )


class _Name(NamedTuple):
    """A name in a cell. It is broken between its `PARTS`, and inside a part only if that is too
    long."""

    text: str

    def __rich_measure__(self, console: Any, options: ConsoleOptions) -> Measurement:
        longest = max(map(cell_len, re.findall(PARTS, self.text)), default=0)
        return Measurement(longest, cell_len(self.text)).with_maximum(options.max_width)

    def __rich_console__(self, console: Any, options: ConsoleOptions) -> Iterable[Text]:
        lines = [""]
        for part in re.findall(PARTS, self.text):
            if lines[-1] and cell_len(lines[-1] + part.rstrip()) > options.max_width:
                lines.append("")
            lines[-1] += part
        yield Text("\n".join(line.rstrip() for line in lines), overflow="fold")


def _mean_label(diverged: Sequence[str]) -> str:
    return f"mean without {len(diverged)} diverged" if diverged else "mean"
