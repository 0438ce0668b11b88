"""The options of `python -m gnio_jax.tables`, and what each table does from its configurations to
its files."""

from __future__ import annotations

import dataclasses
import sys
from collections.abc import Sequence as Arguments
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import jax
import numpy as np
import tyro
from rich.console import Console

from gnio_jax import config as configuration
from gnio_jax import models
from gnio_jax.commands import console as cli
from gnio_jax.config import TrainConfig
from gnio_jax.cores import usable_cores
from gnio_jax.files import replacing
from gnio_jax.filtering import cores_as_devices
from gnio_jax.tables import activities, complexity, experiments, markdown, matrix, summary
from gnio_jax.tables.experiments import Experiment
from gnio_jax.tables.matrix import Interrupted, Result
from gnio_jax.types import InputError

DESCRIPTION = """The paper's tables, made anew with this package: every row is trained with the same recordings, batches, epochs, learning
rate and augmentation, each network with its own published loss, clipping and weight decay.

  python -m gnio_jax.tables complexity                                       parameters, operations, latency
  python -m gnio_jax.tables comparison --base configs/quickstart.yaml        the networks side by side
  python -m gnio_jax.tables components --base configs/gnio_oxiod_small.yaml --data-root DIR --split sessions_test
  python -m gnio_jax.tables gates --base ... [--epochs 3]                    gate and scale functions, norms of their gradients
  python -m gnio_jax.tables bank-size --base ...                             size of the Motion Bank, entropy of its attention
  python -m gnio_jax.tables bank-spread --base ...                           how far apart its prototypes start
  python -m gnio_jax.tables uncertainty --base ...                           what makes GNIO's uncertainty fit for the filter
  python -m gnio_jax.tables trajectories --base ... [--sequences A,B]        all methods over the reference, in one picture
  python -m gnio_jax.tables standing --base ...                              errors at rest and in slow walking, gate and attention

Runs are kept below OUT/runs and shared by the tables: a command that was interrupted goes on where it stopped, one that is
finished only writes its summary anew. Results: OUT/<table>_<split>_<estimator>.md, .csv and .png."""

Table = Literal[
    "complexity",
    "comparison",
    "components",
    "gates",
    "bank-size",
    "bank-spread",
    "uncertainty",
    "trajectories",
    "standing",
]


@dataclass(frozen=True)
class TablesConfig:
    """What `python -m gnio_jax.tables` is asked for."""

    table: tyro.conf.Positional[Table]
    """complexity, comparison, components, gates, bank-size, bank-spread, uncertainty, trajectories
    or standing."""
    base: str = "configs/quickstart.yaml"
    """Config whose recordings, budget and augmentation every row has (not for complexity)."""
    data_root: str | None = None
    """Folder of the dataset; without it the config's, $GNIO_DATA/<dataset>, or data/<dataset>."""
    split: str = "test"
    """Split that is measured."""
    estimator: Literal["ekf", "integrate"] = "ekf"
    """The paper's filter, or the displacements summed with the reference's orientation."""
    seeds: int = 3
    """Runs of every row: seeds 0, 1, 2, ..."""
    epochs: int | None = None
    """Instead of the config's."""
    width: int | None = None
    """Instead of the config's model.width, for the convolutional networks."""
    methods: str = ",".join(experiments.METHODS)
    """Networks of comparison, trajectories and standing, the one to compare with first, separated
    by commas."""
    sequences: str | None = None
    """Of trajectories: the sequences to draw, separated by commas; without it the first eight."""
    out: str = "runs/tables"
    """Folder of the runs and the tables."""


def main(argv: Arguments[str] | None = None) -> None:
    """Parse the options and make the table."""
    jax.config.update(
        "jax_enable_x64", True
    )  # for the filter; training and the networks state their float32
    options = cli.parse(
        TablesConfig, description=DESCRIPTION, argv=argv, prog="python -m gnio_jax.tables"
    )
    cores_as_devices()
    console = Console(highlight=False, soft_wrap=True)
    try:
        {
            "complexity": make_complexity,
            "trajectories": make_trajectories,
            "standing": make_standing,
        }.get(options.table, make_table)(options, console)
    except Interrupted as stopped:
        print("stopped and saved; the same command goes on from here", file=sys.stderr)
        sys.exit(128 + stopped.signum)


def base_config(options: TablesConfig) -> TrainConfig:
    """The experiment that the rows vary. Raises `InputError` for options that make no sense."""
    if options.seeds < 1:
        raise InputError("--seeds", f"must be at least 1, found {options.seeds}")
    base = configuration.load(options.base)
    base = dataclasses.replace(
        base,
        data_root=options.data_root or base.data_root,
        workdir=None,
        model=dataclasses.replace(base.model, width=options.width or base.model.width),
        optim=dataclasses.replace(base.optim, epochs=options.epochs or base.optim.epochs),
    )
    if base.model.name != "gnio":
        raise InputError(
            options.base,
            f"is of the network '{base.model.name}'",
            "give a config of gnio: the others are made from it",
        )
    return configuration.validate(base, options.base)


def networks(options: TablesConfig) -> tuple[str, ...]:
    """The networks named by --methods."""
    names = tuple(name.strip() for name in options.methods.split(",") if name.strip())
    for name in names:
        if name not in models.names():
            raise InputError(
                "--methods", f"no network '{name}'", f"known: {', '.join(models.names())}"
            )
    if not names:
        raise InputError("--methods", "names no network", f"known: {', '.join(models.names())}")
    return names


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


def results_of(experiment: Experiment, options: TablesConfig, console: Console) -> list[Result]:
    """Every row trained and evaluated."""
    return [
        matrix.run_cell(
            cell,
            options.seeds,
            Path(options.out) / "runs",
            options.split,
            options.estimator,
            console,
            usable_cores(),
        )
        for cell in experiment.cells
    ]


def make_table(options: TablesConfig, console: Console) -> None:
    """comparison, components, gates, bank-size, bank-spread, uncertainty."""
    from gnio_jax.tables import pictures

    base = base_config(options)
    experiment = experiment_of(options, base)
    results = results_of(experiment, options, console)
    path, extra = _path(options), {}
    if options.table == "gates":
        for result in results:
            norms = np.array([pictures.scale_gradients(run) for run in result.runs])
            extra[result.cell.name] = {
                "gradient of the scale, mean": float(norms.mean()),
                "largest epoch": float(norms.max()),
            }
        pictures.save(path.with_name(path.name + "_gradients.png"), pictures.gradients(results))
    if options.table in ("bank-size", "bank-spread"):
        extra = _entropies(path, options, results)
    found = summary.rows(experiment, results, extra)
    markdown.write(path, experiment, found, notes(base, options, experiment))
    pictures.save(path.with_suffix(".png"), pictures.table(experiment, results, found))
    console.print(path.with_suffix(".md").read_text(encoding="utf-8"), markup=False)
    console.print(f"results: {path}.md, .csv, .png")


def _entropies(
    path: Path, options: TablesConfig, results: list[Result]
) -> dict[str, dict[str, float]]:
    """Entropy of the attention of the rows with a bank, with its picture."""
    from gnio_jax.tables import pictures

    labels, each, mean, extra = [], [], [], {}
    for result in results:
        if result.cell.config.model.bank_size == 0:
            continue
        found = [
            activities.entropy(
                activities.predict_split(run, options.split).diagnostics["attention"]
            )
            for run in result.runs
        ]
        labels.append(result.cell.label)
        each.append([a for a, _ in found])
        mean.append([b for _, b in found])
        extra[result.cell.name] = {
            "entropy of a window": float(np.mean(each[-1])),
            "of their mean": float(np.mean(mean[-1])),
        }
    pictures.save(
        path.with_name(path.name + "_entropy.png"), pictures.entropies(labels, each, mean)
    )
    return extra


def make_complexity(options: TablesConfig, console: Console) -> None:
    """complexity."""
    found = []
    for network in complexity.NETWORKS:
        console.print(f"timing {network}")
        found.append(complexity.measure(network))
    text = complexity.markdown(found, complexity.hardware())
    path = Path(options.out) / "complexity.md"
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    console.print(text, markup=False)
    console.print(f"results: {path}")


def make_trajectories(options: TablesConfig, console: Console) -> None:
    """trajectories: the first seed of each method."""
    from gnio_jax.tables import pictures

    experiment = experiment_of(options, base_config(options))
    results = results_of(experiment, dataclasses.replace(options, seeds=1), console)
    by_method = {
        result.cell.name: matrix.paths(result, options.split, options.estimator)
        for result in results
    }
    known = list(next(iter(by_method.values())))
    wanted = (
        [name.strip() for name in options.sequences.split(",")] if options.sequences else known[:8]
    )
    for name in wanted:
        if name not in known:
            raise InputError(
                "--sequences",
                f"no sequence '{name}' in split '{options.split}'",
                f"there are: {', '.join(known)}",
            )
    drawn = {
        name: (
            next(iter(by_method.values()))[name][0],
            [pictures.Track(method, of_method[name][1]) for method, of_method in by_method.items()],
        )
        for name in wanted
    }
    path = _path(options).with_suffix(".png")
    pictures.save(path, pictures.trajectories(drawn))
    console.print(f"picture: {path}")


def make_standing(options: TablesConfig, console: Console) -> None:
    """standing: where the gate's claim stands or falls."""
    from gnio_jax.tables import pictures

    base = base_config(options)
    experiment = experiment_of(options, base)
    results = results_of(experiment, options, console)
    path, lines = _path(options), []
    by_method = {}
    for result in results:
        seeds = [activities.predict_split(run, options.split) for run in result.runs]
        figures = [activities.by_activity(one) for one in seeds]
        by_method[result.cell.name] = {
            activity: {
                key: float(np.mean([f[activity][key] for f in figures]))
                for key in figures[0][activity]
            }
            for activity in figures[0]
        }
        if "gate" in seeds[0].diagnostics:
            pictures.save(
                path.with_name(f"{path.name}_{result.cell.name}_gate.png"), pictures.gate(seeds[0])
            )
        if "attention" in seeds[0].diagnostics:
            told, chance = np.mean([activities.information(one) for one in seeds], axis=0)
            words = f"the most attended prototype tells {told:.2f} bits of the activity, by chance it would be {chance:.2f}"
            lines.append(f"{result.cell.label}: {words}.")
            pictures.save(
                path.with_name(f"{path.name}_{result.cell.name}_attention.png"),
                pictures.attention(*activities.attention_by_activity(seeds[0]), words),
            )
    pictures.save(path.with_suffix(".png"), pictures.standing(by_method))
    found = summary.rows(experiment, results)
    text = (
        markdown.render(experiment, found, [*notes(base, options, experiment), *lines])
        + "\n"
        + _activities(by_method)
    )
    with replacing(path.with_suffix(".md")) as temporary:
        temporary.write_text(text, encoding="utf-8")
    console.print(text, markup=False)
    console.print(f"results: {path}.md, .png and the pictures beside them")


def _activities(by_method: dict[str, dict[str, dict[str, float]]]) -> str:
    header = [
        "network",
        "windows of",
        "n",
        "rms error m",
        "error / σ, rms",
        "median length m",
        "median gate",
        "median scale",
    ]
    table = []
    for method, found in by_method.items():
        for activity, figures in found.items():
            numbers = (
                f"{figures[key]:.3f}" if key in figures else "–"
                for key in ("error", "normalised", "length", "gate", "scale")
            )
            table.append([method, activity, f"{figures['windows']:.0f}", *numbers])
    return markdown.grid(header, table)


def notes(base: TrainConfig, options: TablesConfig, experiment: Experiment) -> list[str]:
    """What a reader must know of the figures."""
    budget = (
        f"{base.optim.epochs} epochs of batches of {base.optim.batch_size}, learning rate {base.optim.learning_rate:g}, "
        f"width {base.model.width or 64}, {base.data.rate:g} Hz, {options.seeds} seeds"
    )
    return [
        f"{base.dataset} {options.split}, {options.estimator}; every row: {budget}; on {complexity.hardware()}. "
        "± is the standard deviation over seeds; the difference to the first row is over "
        "sequences.",
        "",
        f"Published: {experiment.source}; the paper does not define its ATE.",
    ]


def _path(options: TablesConfig) -> Path:
    return Path(options.out) / f"{options.table}_{options.split}_{options.estimator}"
