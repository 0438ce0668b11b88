"""Comparison of runs: the effect of a change, sequence by sequence, with its uncertainty.

find (the evaluations that the rows name) → check → make missing ones → compare → text
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax.config import CompareConfig, EvaluateConfig
from gnio_jax.data.contents import CONTENT
from gnio_jax.errors import InputError
from gnio_jax.evaluation import reuse, statistics, tabulate
from gnio_jax.evaluation.folder import REMEDY, read
from gnio_jax.evaluation.metrics import NAMES
from gnio_jax.evaluation.report import Report
from gnio_jax.evaluation.reuse import IDENTITY, RequestedEvaluation
from gnio_jax.evaluation.statistics import Cell
from gnio_jax.files import with_ending
from gnio_jax.networks import list_networks
from gnio_jax.networks.find import is_network
from gnio_jax.networks.folder import name_of
from gnio_jax.reporting import Lines, Reporter

USUAL = (
    *("ate", "rpe_1s", "yaw_rmse", "path_length_ratio"),
    *("leg_ratio", "leg_error", "waypoint_rms", "nis", "nees"),
)
"""Metrics that are compared if none are named."""
HEADER = ("metric", "row", "mean", "difference (95 %)", "better in")
SUMMED = "integrate"
"""The estimator that has no filter."""
SEED = re.compile(r"_s(\d+)(?=(_calibrated)?$)")
"""Pattern of the seed in the name of a run."""


class EvaluationSource(NamedTuple):
    """An evaluation of a row: an existing one, or that of a run."""

    path: Path
    """Path, as the user named it."""
    run: Path
    folder: Path
    identity: dict[str, Any]
    """Values of the settings `reuse.IDENTITY`."""
    figures: Report | RequestedEvaluation
    """The figures of a named evaluation, or for a run its requested evaluation."""


class ComparedRow(NamedTuple):
    """One configuration, with its seeds."""

    label: str
    runs: list[str]
    """Names of the seeds' runs."""
    reports: list[Report]

    @property
    def way(self) -> str:
        """The way its trajectories are estimated."""
        return " and ".join(
            dict.fromkeys(tabulate.describe_estimator(report.settings) for report in self.reports)
        )

    def recordings(self, metric: str | None = None) -> set[str]:
        """Recordings that all seeds have, and for which the metric, if given, has a value."""
        seeds = [report.scores for report in self.reports]
        if metric is not None:
            return set(statistics.collect_values(seeds, metric))
        return set.intersection(*map(set, seeds))


class Comparison(NamedTuple):
    """The result of a comparison."""

    rows: list[ComparedRow]
    cells: dict[str, list[Cell]]
    """Metric → a cell for each row."""


def compare(
    config: CompareConfig, reporter: Reporter | None = None, workers: int = 1
) -> Comparison:
    """Read the rows' evaluations, make those that are missing, and compare them.

    `workers` processes read recordings that are slow to read. Raises `InputError` for rows that
    cannot be compared and metrics that none of them has, if possible before it evaluates.
    """
    reporter = reporter or Lines()
    if config.metrics == ():
        raise InputError(
            "--metrics", "names no metric", "without --metrics the usual ones are compared"
        )
    for word in config.metrics or ():
        if word not in NAMES:
            remedy = f"write the runs before --metrics; the metrics are: {', '.join(NAMES)}"
            raise InputError("--metrics", f"no metric '{word}'", remedy)
    if len(config.rows) < 2:
        remedy = "name the one to compare with first, and all of them before --metrics"
        raise InputError("NETWORKS", "needs two or more", remedy)
    sources_by_row = [[_source(path, config) for path in find(word)] for word in config.rows]
    sources = [source for row in sources_by_row for source in row]
    _check_sources(sources)

    def report_of(evaluation: Report | RequestedEvaluation) -> Report:
        return (
            evaluation
            if isinstance(evaluation, Report)
            else reuse.load_or_evaluate(evaluation, reporter, workers)
        )

    rows = [
        ComparedRow(
            label,
            [name_of(source.run) for source in row],
            [report_of(source.figures) for source in row],
        )
        for label, row in zip(_labels(config.rows), sources_by_row, strict=True)
    ]
    reports = [report for row in rows for report in row.reports]
    _check_recordings([source.folder for source in sources], reports)
    for row in rows[1:]:
        if not row.recordings() & rows[0].recordings():
            problem = f"shares no recording with {rows[0].label} that all seeds have"
            raise InputError(row.label, problem, "compare evaluations of the same recordings")
    available = {
        name for report in reports for scores in report.scores.values() for name in scores.values
    }
    for metric in config.metrics or ():
        if metric not in available:
            has = ", ".join(name for name in NAMES if name in available)
            raise InputError("--metrics", f"no row has '{metric}'", f"there are: {has}")
    metrics = config.metrics or [metric for metric in USUAL if metric in available]
    return Comparison(rows, tabulate.cells([row.reports for row in rows], metrics))


# --- the evaluations


def find(word: str) -> list[Path]:
    """The networks, or folders of evaluations, that `word` names: itself, or its seeds.

    A name without a seed stands for all its seeds, in their order: `runs/gnio` for `runs/gnio_s0`,
    `runs/gnio_s1` and so on, `runs/gnio_calibrated` for `runs/gnio_s0_calibrated` and so on. Raises
    `InputError` if there is nothing, if some seeds have such a path and others do not, or if two
    have the same number.
    """
    path = Path(word)
    if path.exists():
        return [path]
    seeds: dict[int, Path] = {}
    parent = next((folder for folder in path.parents if folder.exists()), path.parent)
    name, *folders = path.relative_to(parent).parts
    for run in sorted(path.parent for path in parent.glob("*/config.yaml")):
        seed = SEED.search(run.name)
        if seed and run.name[: seed.start()] + run.name[seed.end() :] == name:
            if other := seeds.get(int(seed[1])):
                raise InputError(word, f"has a seed twice: {other}, {run}", "rename one")
            seeds[int(seed[1])] = run
    paths = [seeds[seed].joinpath(*folders) for seed in sorted(seeds)]
    missing = [seed_path for seed_path in paths if not seed_path.exists()]
    if missing and len(missing) < len(paths):
        problem = f"exists for {len(paths) - len(missing)} of {len(paths)} seeds only"
        raise InputError(word, problem, f"missing: {', '.join(map(str, missing))}")
    if not paths and word in list_networks():
        return [list_networks()[word]]
    if not paths or missing:
        remedy = (
            "name a network, the folder of an evaluation, or a run of several seeds without _s0"
        )
        if "eval" in path.parts:
            remedy = "make it with gnio evaluate, whose help names the options"
        raise InputError(word, "is not there", remedy)
    return paths


def _source(path: Path, config: CompareConfig) -> EvaluationSource:
    """The evaluation of a network with all options at their defaults, or the evaluation that is
    named."""
    if is_network(path):
        names = ("dataset", "data_root", "split", "estimator")
        settings = {name: getattr(config, name) for name in names}
        evaluation = reuse.find_existing(EvaluateConfig(str(path), plots=False, **settings))
        identity = {name: getattr(evaluation.config, name) for name in IDENTITY}
        return EvaluationSource(path, path, evaluation.folder, identity, evaluation)
    report = read(path)
    folder = Path(os.path.abspath(path)).parent
    run = folder.parent if folder.name == "eval" else folder
    in_run = path.resolve().parent.name == "eval"
    problem = reuse.find_change(report, run) if in_run else ""
    if problem := problem or reuse.find_other_recordings(report):
        raise InputError(path, problem, REMEDY)
    identity = {name: report.settings.get(name) for name in IDENTITY}
    return EvaluationSource(path, run, path, identity, report)


def _check_sources(sources: list[EvaluationSource]) -> None:
    """Raise `InputError` if an evaluation is named twice, or if rows are of different recordings or
    measured in different ways."""
    named: dict[Path, Path] = {}
    first = sources[0]
    for source in sources:
        if other := named.get(source.folder.resolve()):
            same = source.path == other
            problem = "is named twice" if same else f"is the same evaluation as {other}"
            raise InputError(source.path, problem, "name each once")
        named[source.folder.resolve()] = source.path
    for source in sources:
        for name, value in source.identity.items():
            if value == first.identity[name]:
                continue
            words = name.replace("_", " ")
            remedy = f"compare evaluations of one {words}"
            existing = [
                evaluation.identity[name]
                for evaluation in sources
                if isinstance(evaluation.figures, Report)
            ]
            if name in ("split", "data_root") and len(existing) < len(sources):
                choice = existing[0] if existing else value
                remedy = f"give --{name.replace('_', '-')} {choice} for the runs, or {remedy}"
            problem = f"is of {words} {value}, the first row of {first.identity[name]}"
            raise InputError(source.path, problem, remedy)


def _check_recordings(folders: list[Path], reports: list[Report]) -> None:
    """Raise `InputError` if recordings of one name have different lengths or files, or belong to
    different people or sessions. The seeds of a row are checked too."""
    references: dict[str, tuple[Path, str, float]] = {}
    contents: dict[str, tuple[Path, str]] = {}
    for folder, report in zip(folders, reports, strict=True):
        for name, digests in report.settings.get("contents", {}).items():
            first, content = contents.setdefault(name, (folder, digests[CONTENT]))
            if content != digests[CONTENT]:
                problem = f"recording {name} has other files here than in {first}"
                raise InputError(folder, problem, f"evaluate it again, or {first}")
        for name, group in report.groups.items():
            seconds = report.settings["recordings"][name]
            first, *other = references.setdefault(name, (folder, group, seconds))
            remedy = f"evaluate it again, or {first}"
            if group != other[0]:
                problem = f"sequence {name} is of {group} here, of {other[0]} in {first}"
                raise InputError(folder, problem, remedy)
            if abs(seconds - other[1]) > 0.01:
                problem = f"sequence {name} takes {seconds:g} s here, {other[1]:g} s in {first}"
                raise InputError(folder, problem, remedy)


def _labels(words: tuple[str, ...]) -> list[str]:
    """The rows' names without the folders that are common to all at the beginning and at the
    end."""
    paths = [Path(os.path.abspath(word)) for word in words]
    common = os.path.commonpath([path.parent for path in paths])
    parts = [path.relative_to(common).parts for path in paths]
    while len({names[-1] for names in parts}) == 1 and all(len(names) > 1 for names in parts):
        parts = [names[:-1] for names in parts]
    return [str(Path(*names)) for names in parts]


# --- text


def title(comparison: Comparison) -> str:
    """Recordings, the way the trajectories are estimated, and the first row."""
    ways, settings = {row.way for row in comparison.rows}, comparison.rows[0].reports[0].settings
    way = f", {ways.pop()}" if len(ways) == 1 else ""
    head = f"{settings['dataset']} {settings['split']}{way}"
    return f"{head}; differences to {comparison.rows[0].label}, paired by sequence"


def lines(comparison: Comparison) -> list[list[str]]:
    """The cells of `HEADER`: each metric's rows one below the other. Means over different
    recordings state their number."""
    table = []
    for metric, cells in comparison.cells.items():
        column = tabulate.column(metric)
        alike = all(
            row.recordings(metric) == comparison.rows[0].recordings(metric)
            for row in comparison.rows
        )
        for index, (row, (summary, difference)) in enumerate(
            zip(comparison.rows, cells, strict=True)
        ):
            better = ""
            if difference and difference.compared and not difference.withheld:
                better = f"{difference.better} of {difference.compared}"
            text = tabulate.mean(summary, column.digits)
            text += "" if alike else f" over {summary.sequences}"
            head = ["" if index else column.title, row.label, text]
            table.append([*head, tabulate.difference(difference, column.digits), better])
    return table


def explanations(comparison: Comparison) -> list[str]:
    """Sentences that explain the figures."""
    rows, cells = (
        comparison.rows,
        [cell for metric_cells in comparison.cells.values() for cell in metric_cells],
    )
    remarks = ["There is one seed of each run, so the variation between seeds is not known."]
    if any(len(row.runs) > 1 for row in rows):
        seeds = "; ".join(
            f"{row.label}: {', '.join(row.runs) if len(row.runs) > 1 else 'one'}" for row in rows
        )
        remarks = [f"Seeds of {seeds}. ± is their standard deviation."]
    if len({row.way for row in rows}) > 1:
        ways = "; ".join(f"{row.label}: {row.way}" for row in rows)
        remarks.append(f"The rows were estimated with different settings: {ways}.")
    first = rows[0].recordings()
    if any(row.recordings() != first for row in rows):
        others = "; ".join(
            f"{row.label} has {len(row.recordings() & first)} of them and "
            f"{len(row.recordings() - first)} others"
            for row in rows[1:]
        )
        remarks.append(
            "The rows are not of the same recordings, so their means cannot be compared, only "
            f"their differences. {rows[0].label} has {len(first)}; {others}."
        )
    for row in rows:
        gaps = dict.fromkeys(filter(None, map(tabulate.gaps, row.reports)))
        remarks += [f"{row.label}: {line}" for line in gaps]
    if options := filter_options(comparison):
        remarks.append(f"The rows differ in options of the filter: {', '.join(options)}.")
    return remarks + tabulate.marks(cells)


def filter_options(comparison: Comparison) -> list[str]:
    """Names of the filter's options in which a row differs from the first, if both have a
    filter."""
    first, *others = (
        [
            report.settings["filter"]
            for report in row.reports
            if report.settings["estimator"] != SUMMED
        ]
        for row in comparison.rows
    )
    pairs = [(reference, other) for row in others for reference in first for other in row]
    return sorted(
        {
            option
            for reference, other in pairs
            for option in reference | other
            if reference.get(option) != other.get(option)
        }
    )


def write(path: Path, comparison: Comparison) -> None:
    """Write `path`.md, `path`.csv and `path`.png."""
    from gnio_jax import drawing  # Matplotlib takes a second to import
    from gnio_jax.evaluation import plots

    text = f"{title(comparison)}\n\n{tabulate.markdown(HEADER, lines(comparison))}\n"
    text += "\n\n".join(explanations(comparison))
    settings = comparison.rows[0].reports[0].settings
    recordings = {name: settings[name] for name in ("dataset", "split")}
    heads = [
        {**recordings, "estimated": row.way, "row": row.label, "seeds": len(row.runs)}
        for row in comparison.rows
    ]
    tabulate.write(path, text, tabulate.records(heads, comparison.cells))
    drawable = [
        metric
        for metric, cells in comparison.cells.items()
        if any(cell.summary.seeds for cell in cells)
    ]
    rows = {row.label: row.reports for row in comparison.rows}
    picture = plots.sequence_dots(rows, next(iter(drawable or comparison.cells)))
    drawing.save(with_ending(path, ".png"), picture)
