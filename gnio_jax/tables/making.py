"""Each of the paper's tables, from its options to its files."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np

from gnio_jax import config as configuration
from gnio_jax import models
from gnio_jax.comparison.picture import save
from gnio_jax.config import TablesConfig, TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.files import with_ending, write_text
from gnio_jax.reporting import Lines, Reporter
from gnio_jax.tables import (
    activities,
    complexity,
    experiments,
    markdown,
    matrix,
    pictures,
    standing,
    summary,
)
from gnio_jax.tables.experiments import Experiment
from gnio_jax.tables.matrix import Result

Extra = dict[str, dict[str, float]]
"""Figures of a table beside the common ones: row -> heading -> value."""


def make(options: TablesConfig, reporter: Reporter | None = None, workers: int = 1) -> str:
    """Make a table: train and evaluate what is missing, write the files, return what to show.

    `workers` processes read recordings that are slow to read. Raises `InputError` for options that
    make no sense, and `matrix.Interrupted` after a signal.
    """
    reporter = reporter or Lines()
    match options.table:
        case "complexity":
            return make_complexity(options, reporter)
        case "trajectories":
            return make_trajectories(options, reporter, workers)
        case "standing":
            return make_standing(options, reporter, workers)
        case _:
            return make_table(options, reporter, workers)


def base_config(options: TablesConfig) -> TrainConfig:
    """The experiment that the rows vary. Raises `InputError` for options that make no sense."""
    if options.seeds < 1:
        raise InputError("--seeds", f"must be at least 1, found {options.seeds}")
    base = configuration.load(options.base)
    base = dataclasses.replace(
        base,
        data_root=options.data_root or base.data_root,
        workdir=None,
        optim=dataclasses.replace(base.optim, epochs=options.epochs or base.optim.epochs),
    )
    if base.model.name != "gnio":
        remedy = "give a config of gnio: the others are made from it"
        raise InputError(options.base, f"is of the network '{base.model.name}'", remedy)
    return configuration.validate(base, options.base)


def networks(options: TablesConfig) -> tuple[str, ...]:
    """The networks named by --methods."""
    names = _words(options.methods)
    known = f"known: {', '.join(models.names())}"
    for name in names:
        if name not in models.names():
            raise InputError("--methods", f"no network '{name}'", known)
    if not names:
        raise InputError("--methods", "names no network", known)
    return names


def _words(text: str) -> tuple[str, ...]:
    return tuple(word.strip() for word in text.split(",") if word.strip())


def experiment_of(options: TablesConfig, base: TrainConfig) -> Experiment:
    """The rows of the table."""
    match options.table:
        case "components":
            return experiments.components(base)
        case "gates":
            return experiments.gates(base)
        case "bank-size":
            return experiments.bank_sizes(base)
        case "bank-spread":
            return experiments.bank_spread(base)
        case "uncertainty":
            return experiments.remedies(base)
        case _:
            return experiments.comparison(base, options.split, networks(options))


def results_of(
    experiment: Experiment, options: TablesConfig, reporter: Reporter, workers: int
) -> list[Result]:
    """Every row trained and evaluated."""
    return [matrix.run_cell(cell, options, reporter, workers) for cell in experiment.cells]


def make_table(options: TablesConfig, reporter: Reporter, workers: int) -> str:
    """comparison, components, gates, bank-size, bank-spread, uncertainty."""
    base = base_config(options)
    experiment = experiment_of(options, base)
    results = results_of(experiment, options, reporter, workers)
    path, extra = _path(options), {}
    if options.table == "gates":
        extra = _gradient_norms(results)
        save(path.with_name(path.name + "_gradients.png"), pictures.gradients(results))
    if options.table in ("bank-size", "bank-spread"):
        extra = _entropies(path, options, results)
    found = summary.rows(experiment, results, extra)
    markdown.write(path, experiment, found, notes(base, options, experiment))
    save(with_ending(path, ".png"), pictures.table(experiment, results, found))
    text = with_ending(path, ".md").read_text(encoding="utf-8")
    return f"{text}\nresults: {path}.md, .csv, .png"


def _gradient_norms(results: list[Result]) -> Extra:
    """Norms of the scale's gradient over the epochs, by row."""
    extra = {}
    for result in results:
        norms = np.array([pictures.scale_gradients(run) for run in result.runs])
        extra[result.cell.name] = {
            "gradient of the scale, mean": float(norms.mean()),
            "largest epoch": float(norms.max()),
        }
    return extra


def _entropies(path: Path, options: TablesConfig, results: list[Result]) -> Extra:
    """Entropy of the attention of the rows with a bank, with its picture."""
    labels, of_window, of_mean, extra = [], [], [], {}
    for result in results:
        if result.cell.config.model.bank_size == 0:
            continue
        predicted = [activities.predict_split(run, options.split) for run in result.runs]
        seeds = [activities.entropy(windows.diagnostics["attention"]) for windows in predicted]
        labels.append(result.cell.label)
        of_window.append([entropy.of_window for entropy in seeds])
        of_mean.append([entropy.of_mean for entropy in seeds])
        extra[result.cell.name] = {
            "entropy of a window": float(np.mean(of_window[-1])),
            "of their mean": float(np.mean(of_mean[-1])),
        }
    picture = pictures.entropies(labels, of_window, of_mean)
    save(path.with_name(path.name + "_entropy.png"), picture)
    return extra


def make_complexity(options: TablesConfig, reporter: Reporter) -> str:
    """Parameters, operations and latency of every network."""
    found = []
    for network in complexity.NETWORKS:
        reporter.line(f"timing {network}")
        found.append(complexity.measure(network))
    text = complexity.markdown(found, complexity.hardware())
    path = Path(options.out) / "complexity.md"
    write_text(path, text)
    return f"{text}\nresults: {path}"


def make_trajectories(options: TablesConfig, reporter: Reporter, workers: int) -> str:
    """All methods over the reference in one picture and one page, with the first seed of each."""
    from gnio_jax.evaluation import html  # Bokeh takes a second to import

    base = base_config(options)
    experiment = experiment_of(options, base)
    results = results_of(experiment, dataclasses.replace(options, seeds=1), reporter, workers)
    paths = {
        result.cell.name: matrix.paths(result, options.split, options.estimator)
        for result in results
    }
    first = next(iter(paths.values()))
    wanted = list(first)[:8]
    if options.sequences:
        wanted = [name.strip() for name in options.sequences.split(",")]
    for name in wanted:
        if name not in first:
            problem = f"no sequence '{name}' in split '{options.split}'"
            raise InputError("--sequences", problem, f"there are: {', '.join(first)}")
    drawn = {
        name: (
            first[name].reference,
            [
                pictures.MethodPath(method, of_method[name].estimate)
                for method, of_method in paths.items()
            ],
        )
        for name in wanted
    }
    path = with_ending(_path(options), ".png")
    save(path, pictures.trajectories(drawn))
    page = with_ending(_path(options), ".html")
    title = f"{base.dataset} {options.split}: {options.estimator} of all methods"
    html.write_report(page, title, _entries(results, options))
    return f"picture: {path}\npage: {page}"


def _entries(results: list[Result], options: TablesConfig) -> list[Any]:
    """What the page is told: the first seed of each method."""
    from gnio_jax.evaluation import html

    return [
        html.read_entry(
            matrix.results_folder(result, options.split, options.estimator), result.cell.label
        )
        for result in results
    ]


def make_standing(options: TablesConfig, reporter: Reporter, workers: int) -> str:
    """Errors at rest and in slow walking, gate and attention: where the gate's claim stands."""
    base = base_config(options)
    experiment = experiment_of(options, base)
    results = results_of(experiment, options, reporter, workers)
    path, lines, by_method = _path(options), [], {}
    for result in results:
        seeds = [activities.predict_split(run, options.split) for run in result.runs]
        by_method[result.cell.name] = standing.mean_over_seeds(seeds)
        lines += standing.draw(result.cell, seeds, path)
    save(with_ending(path, ".png"), pictures.standing(by_method))
    found = summary.rows(experiment, results)
    remarks = [*notes(base, options, experiment), *lines]
    table = markdown.render(experiment, found, remarks)
    text = f"{table}\n{standing.render(by_method)}"
    write_text(with_ending(path, ".md"), text)
    return f"{text}\nresults: {path}.md, .png and the pictures beside them"


def notes(base: TrainConfig, options: TablesConfig, experiment: Experiment) -> list[str]:
    """What a reader must know of the figures."""
    budget = (
        f"{base.optim.epochs} epochs of batches of {base.optim.batch_size}, "
        f"learning rate {base.optim.learning_rate:g}, width {base.model.width or 64}, "
        f"{base.data.rate:g} Hz, {options.seeds} seeds"
    )
    calibrated = f", gnio calibrate on {base.data.val_split}" if options.calibrate else ""
    return [
        f"{base.dataset} {options.split}, {options.estimator}; every row: {budget}{calibrated}; "
        f"on {complexity.hardware()}. ± is the standard deviation over seeds; "
        "the difference to the first row is over sequences.",
        "",
        f"Published: {experiment.source}; the paper does not define its ATE.",
    ]


def _path(options: TablesConfig) -> Path:
    name = f"{options.table}_{options.split}_{options.estimator}"
    return Path(options.out) / (f"{name}_calibrated" if options.calibrate else name)
