"""Each of the paper's tables, from its options to its files."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from gnio_jax import config as configuration
from gnio_jax import data, models
from gnio_jax.config import ModelConfig, TablesConfig, TrainConfig
from gnio_jax.cores import can_choose_cores, usable_cores
from gnio_jax.errors import InputError
from gnio_jax.evaluation import tabulate
from gnio_jax.evaluation.folder import read_views
from gnio_jax.evaluation.statistics import Cell, MetricSummary
from gnio_jax.files import with_ending, write_text
from gnio_jax.reporting import Lines, Reporter
from gnio_jax.tables import activities, experiments, published
from gnio_jax.tables.cost import device_name
from gnio_jax.tables.duration import announce
from gnio_jax.tables.experiments import OTHER_BLOCKS, SYSTEMS, Experiment
from gnio_jax.tables.runs import RowResult, run_row, unfinished_runs
from gnio_jax.training import loop
from gnio_jax.training.run_folder import read_rows

METRICS = (
    *("ate", "ate_2d", "ate_ronin", "ate_ronin_2d", "rpe_1s", "rte_60s", "path_length_ratio"),
    *("stationary_drift", "leg_ratio", "waypoint_rms", "nis", "nees", "nees_coverage"),
)
"""Metrics of every table, if rows have them. Rows are compared by the first."""

TITLES = {
    "ate_ronin": tabulate.Column("RoNIN's ATE", "m"),
    "ate_ronin_2d": tabulate.Column("RoNIN's ATE 2-D", "m"),
}
"""Metrics that tables of evaluations do not show."""
ABLATIONS = {
    "components": experiments.components,
    "gates": experiments.gates,
    "bank-size": experiments.bank_sizes,
}


def make(options: TablesConfig, reporter: Reporter | None = None, workers: int = 1) -> str:
    """Make a table: train and evaluate missing runs, write the files, and return the text to show.

    `workers` processes read recordings that are slow to read. Raises `InputError` for options that
    make no sense, and `runs.Interrupted` after a signal.
    """
    reporter = reporter or Lines()
    if options.table == "complexity":
        return make_complexity(Path(options.out), reporter)
    if options.table == "published":
        return published.make_published(Path(options.out))
    if options.seeds < 1:
        raise InputError("--seeds", f"must be at least 1, found {options.seeds}")
    base = base_config(options)
    if options.table in ABLATIONS:
        experiment = ABLATIONS[options.table](base)
    else:
        names = networks(options)
        experiment = experiments.comparison(
            base, measured_dataset(options, base), options.split, names
        )
    if options.table == "trajectories":
        options = dataclasses.replace(options, seeds=1)
    for row in experiment.rows:  # before hours go into the rows before it
        if unfinished_runs(row, Path(options.out), options.seeds):
            loop.refuse_untrainable(row.config)
    if options.table == "comparison":
        announce(experiment.rows, Path(options.out), options.seeds, reporter)
    results = []
    for row in experiment.rows:
        results.append(run_row(row, options, reporter, workers))
        jax.clear_caches()  # the programs of all networks need more memory maps than Linux allows
    path = Path(options.out) / file_name(options)
    remarks = notes(base, options, experiment)
    failed = [name for result in results for name in result.uncalibrated]
    if options.calibrate and failed:
        remarks += (
            f"\n\nNot calibrated, because the filter could not be fitted: {', '.join(failed)}."
        )
    if options.table == "trajectories":
        return make_trajectories(path, options, results)
    if options.table == "standing":
        return make_standing(path, options, experiment, results, remarks)
    return make_table(path, options, experiment, results, remarks)


def file_name(options: TablesConfig) -> str:
    """The name of a table's files, without their endings. Of a dataset that is named, tables of
    two folders have two names."""
    parts = [options.table]
    if options.dataset:
        parts.append(options.dataset)
        parts += [Path(options.data_root).resolve().name] if options.data_root else []
    parts += [options.split, options.estimator]
    return "_".join([*parts, *["calibrated"] * options.calibrate])


def base_config(options: TablesConfig) -> TrainConfig:
    """The experiment from which the rows are derived. Raises `InputError` if that is not
    possible."""
    base = configuration.load(options.base)
    learns_from_it = options.dataset is None or base.datasets == (options.dataset,)
    base = dataclasses.replace(
        base,
        data_root=(options.data_root if learns_from_it else None) or base.data_root,
        workdir=None,
        optim=dataclasses.replace(base.optim, epochs=options.epochs or base.optim.epochs),
    )
    if base.model.name != "gnio":
        remedy = "give a config of the network gnio; those of the others are derived from it"
        raise InputError(options.base, f"is of the network '{base.model.name}'", remedy)
    base = configuration.validate(base, options.base)
    measured_dataset(options, base)
    return base


def measured_dataset(options: TablesConfig, base: TrainConfig) -> str:
    """The dataset that is measured. Raises `InputError` if it is unknown, or if none is named and
    there are several to learn from."""
    first, *others = base.datasets
    if options.dataset is None and others:
        remedy = f"name the one to measure, e.g. --dataset {first}"
        raise InputError(options.base, f"has several datasets: {', '.join(base.datasets)}", remedy)
    dataset = options.dataset or first
    data.get(dataset)
    return dataset


def networks(options: TablesConfig) -> tuple[str, ...]:
    """The networks and systems named by --methods; "all" stands for GNIO, with which the others are
    compared, the other networks of this package that predict displacements, and the systems."""
    if options.methods == "all":
        others = (name for name in NETWORKS if name != "gnio" and _predicts_displacement(name))
        return ("gnio", *others, *SYSTEMS)
    names, rows = _words(options.methods), (*models.names(), *SYSTEMS)
    problems = [f"no network or system '{name}'" for name in names if name not in rows]
    problems = problems or [
        f"'{name}' predicts no displacement"
        for name in names
        if name not in SYSTEMS and not _predicts_displacement(name)
    ]
    if problems or not names:
        problem = problems[0] if problems else "names no network"
        raise InputError("--methods", problem, f"known: {', '.join(rows)}")
    return names


def _predicts_displacement(name: str) -> bool:
    return models.predicts_displacement(models.from_config(ModelConfig(name=name)))


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())


def notes(base: TrainConfig, options: TablesConfig, experiment: Experiment) -> str:
    """Notes that explain the figures."""
    on_cpu = jax.devices()[0].platform == "cpu"
    on_core = " on one core" if on_cpu and can_choose_cores() else ""
    calibrated = f", gnio calibrate on {base.data.val_split}" if options.calibrate else ""
    segments = ""
    if base.segments.seconds:
        segments = f"; networks with memory: segments of {base.segments.seconds:g} s"
    return (
        f"{measured_dataset(options, base)} {options.split}, {options.estimator}; every row: "
        f"{' and '.join(base.datasets)}, {base.optim.epochs} epochs of batches of "
        f"{base.optim.batch_size}, learning rate {base.optim.learning_rate:g}, width "
        f"{base.model.width or 64}, {base.data.rate:g} Hz, "
        f"{options.seeds} {'seed' if options.seeds == 1 else 'seeds'}{segments}{calibrated}; on "
        f"{hardware()}. ± is the standard deviation over seeds; the difference to the first "
        f"row is over sequences. ms / interval is the median time of network and filter for "
        f"{base.data.stride_seconds:g} s of a simulated walk{on_core}.\n\n"
        f"Published: {experiment.source}; the paper does not define its ATE."
    )


def hardware() -> str:
    """The hardware, as text."""
    cores, device = usable_cores(), device_name()
    if jax.devices()[0].platform != "cpu":
        return device
    return f"{cores} core{'s' if cores > 1 else ''} of a CPU ({device})"


# --- rows side by side


def make_table(
    path: Path,
    options: TablesConfig,
    experiment: Experiment,
    results: list[RowResult],
    remarks: str,
) -> str:
    """comparison, components, gates, bank-size: the files, and the text to show."""
    from gnio_jax.tables import plots  # Matplotlib takes a second to import

    figures = figures_of(results)
    if options.table == "gates":
        norms = [np.array([scale_gradients(run) for run in result.runs]) for result in results]
        plots.save(path.with_name(f"{path.name}_gradients.png"), plots.gradients(results, norms))
        figures |= _over_seeds("gradient of the scale, mean", [norm.mean(1) for norm in norms])
        figures |= _over_seeds("gradient of the scale, largest", [norm.max(1) for norm in norms])
    if options.table == "bank-size":
        entropies = [_entropies(result) for result in results]
        figures |= _over_seeds("entropy of a window", [entropy[:, 0] for entropy in entropies])
        figures |= _over_seeds("entropy of their mean", [entropy[:, 1] for entropy in entropies])
    plots.save(with_ending(path, ".png"), plots.table(experiment, results, figures["ate"]))
    table = render(experiment, figures, results)
    text = f"## {experiment.title}\n\n{remarks}\n\n{table}"
    heads = [
        {
            "row": row.name,
            "label": row.label,
            "seeds": options.seeds,
            "published": row.published,
            "interval_ms": result.cost.interval_ms,
            "parameters": result.cost.parameters,
        }
        for row, result in zip(experiment.rows, results, strict=True)
    ]
    tabulate.write(path, text, tabulate.records(heads, figures))
    return f"{text}\nresults: {path}.md, .csv, .png"


def scale_gradients(run: Path) -> list[float]:
    """Norm of the gradient of the scale's layer in every epoch of a run, a mean over its steps."""
    return [float(row["gradient_norm/head/scale"]) for row in read_rows(run)]


def _entropies(result: RowResult) -> Float[np.ndarray, "seeds 2"]:
    """Entropies of the attention of each run; none for a network without a bank."""
    runs = result.runs if result.row.config.model.bank_size != 0 else []
    predictions = [activities.predict_split(run, _recordings(result)) for run in runs]
    entropies = [activities.entropy(windows.diagnostics["attention"]) for windows in predictions]
    return np.array(entropies).reshape(-1, 2)


def _recordings(result: RowResult) -> activities.Recordings:
    settings = result.reports[0].settings
    return activities.Recordings(*(settings[name] for name in activities.Recordings._fields))


def _over_seeds(name: str, rows: list[Float[np.ndarray, "_"]]) -> dict[str, list[Cell]]:
    """A figure of this table alone, for each row with its seeds."""
    means = [float(np.mean(values)) if len(values) else None for values in rows]
    summaries = [
        MetricSummary(mean, values.tolist(), None, None, 0, 0, 0, len(values))
        for mean, values in zip(means, rows, strict=True)
    ]
    return {name: [Cell(summary, None) for summary in summaries]}


def figures_of(results: list[RowResult]) -> dict[str, list[Cell]]:
    """Metric → the figures of every row, compared with the first, if a row has any."""
    cells = tabulate.cells([result.reports for result in results], METRICS)
    return {
        metric: row_cells
        for metric, row_cells in cells.items()
        if metric == "ate" or any(figure.summary.seeds for figure in row_cells)
    }


def render(
    experiment: Experiment, figures: Mapping[str, list[Cell]], results: list[RowResult]
) -> str:
    """The table as Markdown, followed by the meaning of its marks.

    Its last rows are those to compare with, of the first evaluation: never moving, and perfect
    displacements in its filter.
    """
    columns = {name: TITLES.get(name) or tabulate.column(name) for name in figures}
    header = ["", *(column.title for column in columns.values()), "median ATE (m)", "change of ATE"]
    header += ["difference of ATE, m (95 %)", "ms / interval", "parameters"]
    header += ["published (m)", "its change"]
    table, first = [], experiment.rows[0].published
    for index, row in enumerate(experiment.rows):
        summary, difference = figures["ate"][index]
        means = [
            tabulate.mean(figures[x][index].summary, column.digits) for x, column in columns.items()
        ]
        gain = arrow(difference and difference.gain) if index else ""
        published_gain = 100 * (1 - row.published / first) if row.published and first else None
        measured = [tabulate.number(summary.median, 2), gain, tabulate.difference(difference, 2)]
        cost = results[index].cost
        measured += [tabulate.number(cost.interval_ms, 2), f"{cost.parameters:,}"]
        printed = [tabulate.number(row.published, 2), arrow(published_gain) if index else ""]
        table.append([row.label, *means, *measured, *printed])
    report = results[0].reports[0]
    for name in report.reference_rows:
        summaries = report.summary(name)
        means = [
            tabulate.mean(summaries[x], column.digits) if x in summaries else "–"
            for x, column in columns.items()
        ]
        median = tabulate.number(summaries["ate"].median, 2) if "ate" in summaries else "–"
        table.append([name.replace("_", " "), *means, median, *[""] * 6])
    marks = "".join(f"\n{line}\n" for line in tabulate.marks(figures["ate"]))
    return tabulate.markdown(header, table) + marks


def arrow(gain: float | None) -> str:
    """A gain as the paper prints it: ↓ and the reduction of the error in %, or ↑ and its
    increase."""
    if gain is None:
        return "–"
    if round(gain, 1) == 0:
        return "0 %"
    return f"{'↓' if gain > 0 else '↑'} {abs(gain):.1f} %"


# --- all methods over the reference, and windows by the walker's activity


def make_trajectories(path: Path, options: TablesConfig, results: list[RowResult]) -> str:
    """All methods over the reference in one picture and one page, with the first seed of each."""
    # Bokeh and Matplotlib take seconds to import.
    from gnio_jax.evaluation import page
    from gnio_jax.tables import plots

    runs = []
    for result in results:
        report = result.reports[0]
        views = read_views(result.folders[0], report)
        runs.append(page.describe_report(report, views, name=result.row.label))
    settings = results[0].reports[0].settings
    available = [view.name for view in runs[0].views if view.has_reference]
    if not available:
        subject = f"{settings['dataset']} {settings['split']}"
        problem = "has no sequence with poses, over which trajectories could be drawn"
        raise InputError(subject, problem, "name another --dataset or --split")
    names = _words(options.sequences) if options.sequences else available[:8]
    for name in names:
        if name not in available:
            problem = f"no sequence '{name}' in split '{options.split}'"
            raise InputError("--sequences", problem, f"there are: {', '.join(available)}")
    figure = plots.trajectories(names, {run.name: run.views for run in runs})
    plots.save(with_ending(path, ".png"), figure)
    title = f"{settings['dataset']} {options.split}: {options.estimator} of all methods"
    page.write(with_ending(path, ".html"), title, runs)
    return f"picture: {path}.png\npage: {path}.html"


def make_standing(
    path: Path,
    options: TablesConfig,
    experiment: Experiment,
    results: list[RowResult],
    remarks: str,
) -> str:
    """Errors at rest and in slow walking, gate and attention, which test the claim about the
    gate."""
    from gnio_jax.tables import plots  # Matplotlib takes a second to import

    lines, by_method = [], {}
    for result in results:
        seeds = [activities.predict_split(run, _recordings(result)) for run in result.runs]
        by_method[result.row.name] = activities.mean_over_seeds(seeds)
        stem = f"{path.name}_{result.row.name}"
        if "gate" in seeds[0].diagnostics:
            plots.save(path.with_name(f"{stem}_gate.png"), plots.gate(seeds[0]))
        if "attention" in seeds[0].diagnostics:
            bits, chance = np.mean([activities.information(seed) for seed in seeds], axis=0)
            words = f"the most attended prototype carries {bits:.2f} bits about the activity, "
            words += f"by chance it would be {chance:.2f}"
            lines.append(f"{result.row.label}: {words}.\n\n")
            picture = plots.attention(*activities.attention_by_activity(seeds[0]), words)
            plots.save(path.with_name(f"{stem}_attention.png"), picture)
    plots.save(with_ending(path, ".png"), plots.standing(by_method))
    table = render(experiment, figures_of(results), results)
    head = f"## {experiment.title}\n\n{remarks}\n\n{''.join(lines)}"
    text = f"{head}{table}\n{activities.render(by_method)}"
    write_text(with_ending(path, ".md"), text)
    return f"{text}\nresults: {path}.md, .png and the pictures beside them"


# --- complexity

NETWORKS = ("tlio", "ronin_resnet", "deepils", "ctin", "imot", "imot_text", "gnio")
NETWORKS += ("ronin_lstm", "ronin_tcn", "gru", "state_space")
NETWORKS += ("ionet", "ai_imu", "airio", "ionext", "experts", "trunk", "ridi")
VARIANTS: dict[str, dict[str, Any]] = {
    "tlio behind airimu": {"name": "tlio", "corrector": "airimu"},
    "tlio in o2_frame": {"name": "tlio", "equivariance": "o2_frame"},
    "tlio in so2_frame": {"name": "tlio", "equivariance": "so2_frame"},
    "ronin_resnet in o2_frame": {"name": "ronin_resnet", "equivariance": "o2_frame"},
    "ronin_resnet in so2_frame_shallow": {
        "name": "ronin_resnet",
        "equivariance": "so2_frame_shallow",
    },
    "gnio with bins": {"name": "gnio", "head": "bins"},
    **{f"trunk of {block}": {"name": "trunk", "block": block} for block in OTHER_BLOCKS},
}
"""Networks with options, by the names of their rows."""
PAPERS_COST = {
    "tlio": (5.42, 0.08),
    "deepils": (2.29, 0.03),
    "ctin": (0.56, 7.27),
    "imot": (14.49, 7.79),
    "gnio": (4.90, 0.08),
}
"""Parameters in millions and the column "GFLOPs", as the paper prints them."""
SAMPLES, BATCHES, SECONDS = 200, (1, 128), 3.0
"""Samples of a window, windows per call, and time for which a call is measured, s."""


class Complexity(NamedTuple):
    """The computational cost of one network."""

    parameters: int
    gflops: float
    """Floating-point operations of one window in the compiled program, 10⁹; NaN if the compiler
    does not count them."""
    latency: list[float]
    """Time per window of each size of a batch, ms, median."""


def make_complexity(out: Path, reporter: Reporter) -> str:
    """Parameters, operations and latency of every network, beside the paper's columns."""
    table = []
    for network in (*NETWORKS, *VARIANTS):
        reporter.line(f"timing {network}")
        cost = measure(network)
        millions, gflops = PAPERS_COST.get(network, (None, None))
        measured = [f"{cost.parameters:,}", tabulate.number(500 * cost.gflops, 1)]
        measured += [tabulate.number(cost.gflops, 3)]
        measured += [tabulate.number(milliseconds, 2) for milliseconds in cost.latency]
        printed = "–" if millions is None else f"{millions:.2f} M"
        table.append([network, *measured, printed, tabulate.number(gflops, 2)])
    header = ["", "parameters", "10⁶ multiply-adds / window", "GFLOP / window"]
    header += [f"ms / window, batch {batch}" for batch in BATCHES]
    text = (
        f"## Complexity\n\nOne window of {SAMPLES} samples, float32, on {hardware()}. The paper's "
        "CNN rows are 2 × multiply-adds of one window, as is the measured column, which leaves out "
        "the taps in the padding. Its transformer rows repeat those papers' own "
        '"GFLOPs/s", another quantity; compare the measured column. Its GNIO has no bank: '
        "4,901,385 parameters, 4,934,153 with it. DeepILS and RoNIN are counted with three "
        "outputs.\n\n" + tabulate.markdown([*header, "paper: parameters", 'paper: "GFLOPs"'], table)
    )
    path = out / "complexity.md"
    write_text(path, text)
    return f"{text}\nresults: {path}"


def measure(
    network: str, batches: tuple[int, ...] = BATCHES, seconds: float = SECONDS
) -> Complexity:
    """Cost of a network's inference, batch norms folded, on this machine; each latency is timed for
    about `seconds`."""
    model = models.create(**VARIANTS.get(network, {"name": network}))
    variables = models.initialise(model, jax.random.key(0), SAMPLES)
    frozen, inference = models.inference_variables(model, variables), models.Inference(model)
    latency, operations = [], math.nan
    for batch in batches:
        samples = np.random.default_rng(0).standard_normal((batch, SAMPLES, models.channels(model)))
        windows = jnp.asarray(samples, jnp.float32)
        compiled = jax.jit(inference).lower(frozen, windows).compile()
        if batch == batches[0]:
            operations = (compiled.cost_analysis() or {}).get("flops", math.nan) / batch
        jax.block_until_ready(compiled(frozen, windows))
        times: list[float] = []
        while sum(times) < seconds and len(times) < 500:
            start = time.perf_counter()
            jax.block_until_ready(compiled(frozen, windows))
            times.append(time.perf_counter() - start)
        latency.append(1e3 * float(np.median(times)) / batch)
    parameters = sum(leaf.size for leaf in jax.tree.leaves(variables["params"]))
    return Complexity(parameters, operations / 1e9, latency)
