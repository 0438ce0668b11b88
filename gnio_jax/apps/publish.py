"""Publishing: a trained network with a card for people who do not have its data."""

from __future__ import annotations

import json
import math
import shlex
import warnings
from importlib.metadata import version
from pathlib import Path

from gnio_jax import networks
from gnio_jax.config import CalibrateConfig
from gnio_jax.errors import InputError
from gnio_jax.evaluation import folder as results
from gnio_jax.evaluation import reuse, tabulate
from gnio_jax.evaluation.report import Report
from gnio_jax.evaluation.statistics import FEWEST_GROUPS, summarise
from gnio_jax.files import file_stem
from gnio_jax.networks import Card, TrainedNetwork
from gnio_jax.networks.folder import evaluations_folder, has_card, write_published

SHOWN = ("ate_2d", "rte_60s_2d", "path_length_ratio_2d", "yaw_rmse", "nees_coverage_2d")
"""Metrics of the card. Lists of networks show the first."""
AT_WAYPOINTS = ("leg_ratio", "waypoint_rms")
"""Further metrics, of evaluations of walks with waypoints."""


def publish(
    network: str | Path,
    out: Path,
    name: str,
    data: str,
    license: str,
    fails: tuple[str, ...] = (),
) -> Card:
    """Publish a network at `out`: a zip if its name ends with .zip, else a folder. It replaces an
    older one. It is written whole or not at all, and its settings do not contain folders of this
    machine. Its card has the figures of the evaluations of these weights; a warning names those of
    other weights.

    Args:
        network: The folder of a network, a published one, or a name.
        out: The place of the published network.
        name: Its name, a file name.
        data: The data on which it was trained: recordings, devices, people, ways of carrying.
        license: The terms under which the data may be used and the weights passed on.
        fails: The cases in which it fails, one sentence each.

    Raises:
        InputError: The network cannot be loaded, the name is no file name, a text is empty, or
            something at `out` is no published network.
    """
    if name != file_stem(name):
        remedy = "use letters, digits, '.', '_', '+' and '-'"
        raise InputError("--name", f"'{name}' is not the name of a folder", remedy)
    for option, text in (("--data", data), ("--license", license)):
        if not text.strip():
            remedy = "describe it in a sentence, because other people rely on it"
            raise InputError(option, "is empty", remedy)
    if out.exists() and not (out.is_dir() and not any(out.iterdir())) and not has_card(out):
        raise InputError(out, "exists already and is no published network", "name another --out")
    trained = networks.with_corrector(networks.load(network))
    figures, left_out = _read_figures(trained)
    for folder, problem in left_out.items():
        warnings.warn(f"{folder}: not on the card: {problem}", stacklevel=2)
    card = Card(
        name,
        trained.config.model.name,
        data,
        license,
        trained.epoch,
        trained.step,
        _describe_error(figures, trained.config.datasets),
        f"gnio-jax {version('gnio-jax')}",
        {},
    )
    return write_published(out, trained, card, _write_text(card, fails, trained, figures))


def describe_data(network: TrainedNetwork) -> str:
    """The training data of a network, in words."""
    if network.card is not None:
        return network.card.data
    names = ", ".join(network.config.datasets)
    return f"dataset {names}, split {network.config.data.train_split}"


def describe_error(network: TrainedNetwork) -> str:
    """The measured error of a network, in words; empty if it was not measured."""
    if network.card is not None:
        return network.card.measured
    try:
        return _describe_error(_read_figures(network)[0], network.config.datasets)
    except InputError:
        return ""  # a damaged evaluation must not prevent tracking


def _read_figures(network: TrainedNetwork) -> tuple[dict[str, Report], dict[str, str]]:
    """Read every evaluation of the weights of a network, by its folder's name, and say for the
    folders of other evaluations why they are left out. Raises `InputError`."""
    figures: dict[str, Report] = {}
    left_out: dict[str, str] = {}
    if network.path is None:
        return figures, left_out
    files = evaluations_folder(network.path).glob("*/metrics.json")
    for folder in sorted(file.parent for file in files):
        report = results.read(folder)
        if problem := reuse.find_change(report, network.path):
            left_out[str(folder)] = f"{problem}; evaluate the network again"
        elif report.settings.get("weights") != network.digest:
            problem = "its figures are of the latest checkpoint, not of the weights"
            left_out[str(folder)] = f"{problem}; evaluate without --checkpoint latest"
        else:
            figures[folder.name] = report
    return figures, left_out


def _describe_error(figures: dict[str, Report], datasets: tuple[str, ...]) -> str:
    """The error that lists of networks show, in words, with that of each way of carrying: the root
    mean square of the horizontal error of a walk. It is that of the first evaluation that has it.
    Evaluations with the filter come first, then those on the run's own datasets, then those on a
    test split. It is empty if no evaluation has it."""

    def rank(name: str) -> tuple[bool, bool, bool, int, str]:
        settings = figures[name].settings
        of_run, tested = settings["dataset"] in datasets, "test" in settings["split"]
        return settings["estimator"] != "ekf", not of_run, not tested, len(name), name

    for name in sorted(figures, key=rank):
        error = _cell(figures[name], SHOWN[0], " m")
        if not error.startswith(tabulate.number(None, 0)):
            seconds = summarise([figures[name].scores], "duration", figures[name].groups).mean
            length = "" if seconds is None else f" of {seconds:.0f} s"
            facts = "; ".join((name, *_by_placement(figures[name])))
            return f"typical error {error} on walks{length} ({facts})"
    return ""


def _by_placement(figures: Report) -> list[str]:
    """The mean of this error for each way of carrying, the smallest first, in words."""
    errors: dict[str, list[float]] = {}
    for name, placement in figures.placements.items():
        scores = figures.scores[name]
        error = scores.values.get(SHOWN[0])
        if error is not None and math.isfinite(error) and not scores.diverged:
            errors.setdefault(placement, []).append(error)
    means = {placement: sum(values) / len(values) for placement, values in errors.items()}
    return [
        f"{placement} {means[placement]:.1f}" for placement in sorted(means, key=means.__getitem__)
    ]


def _cell(figures: Report, metric: str, unit: str = "") -> str:
    """The mean over the sequences with its 95 % interval, or the number of groups if that is too
    small for one."""
    summary = summarise([figures.scores], metric, figures.groups)
    digits = tabulate.column(metric).digits
    text = tabulate.number(summary.mean, digits) + unit
    if summary.interval is None:
        few = summary.mean is not None and summary.groups < FEWEST_GROUPS
        return f"{text} ({summary.groups} group{'s' * (summary.groups > 1)})" if few else text
    low, high = (tabulate.number(bound, digits) for bound in summary.interval)
    return f"{text} ({low} to {high})"


def _shorten(network: str) -> str:
    """The name of a network, or a run without the folders of this machine."""
    names = {str(path): name for name, path in networks.list_networks().items()}
    is_name = network in names.values() and not Path(network).exists()
    return shlex.quote(network if is_name else names.get(network, f"runs/{Path(network).name}"))


def _write_recipe(card: Card, network: TrainedNetwork) -> str:
    """The commands that make the network, Markdown, and to what its filter is fitted."""
    if network.card is not None:
        return f"It is the published network `{network.card.name}`, whose card has the recipe."
    config, folder = network.config, network.path or Path()
    start = f" --init-from {_shorten(config.init_from)}" if config.init_from else ""
    if config.data.poses_by:
        start += f" --set data.poses_by={_shorten(config.data.poses_by)}"
    steps, remark = [f"gnio train --config config.yaml --workdir runs/{card.name}{start}"], ""
    record, default = folder / "calibration.json", list(CalibrateConfig().fit)
    if record.is_file():
        try:
            calibration = json.loads(record.read_text(encoding="utf-8"))
            fitted, split = _shorten(str(calibration["run"])), calibration["split"]
            parts = list(map(str, calibration.get("fitted") or default))
        except (OSError, ValueError, LookupError, TypeError):
            problem = "is not the record of a calibration"
            remedy = "remove the folder, and calibrate its run again"
            raise InputError(record, problem, remedy) from None
        if fitted == f"runs/{folder.name.removesuffix('_calibrated')}":
            fitted = f"runs/{card.name}"
        steps = steps if "runs/" in fitted else []  # a published network has its own recipe
        options = " --average-headings" if calibration.get("average_headings") else ""
        if parts != default:
            options += f" --fit {' '.join(parts)}"
        steps.append(f"gnio calibrate --network {fitted}{options}")
        name = fitted.removeprefix("runs/")
        remark = f"\n\nThe filter is fitted to split `{split}` of run `{name}`."
    return "\n".join(("```", *steps, "```")) + remark


def _write_text(
    card: Card, fails: tuple[str, ...], network: TrainedNetwork, figures: dict[str, Report]
) -> str:
    """The text of the card, Markdown."""
    config, windows, name = network.config, network.config.data, card.name
    considered = [name for name, std in config.filter.considered._asdict().items() if std > 0]
    has_waypoints = any(AT_WAYPOINTS[0] in evaluation.summary() for evaluation in figures.values())
    metrics = (*SHOWN, *AT_WAYPOINTS) if has_waypoints else SHOWN
    header = ["evaluation", "sequences", "groups", *(tabulate.column(x).title for x in metrics)]
    rows = [
        [
            folder,
            str(len(evaluation.scores)),
            str(len(set(evaluation.groups.values()))),
            *(_cell(evaluation, metric) for metric in metrics),
        ]
        for folder, evaluation in figures.items()
    ]
    means = "Means over sequences, with 95 % intervals over groups (people, sessions)."
    uneven = [
        f"{folder}: {line}"
        for folder, evaluation in figures.items()
        for line in tabulate.unevenness(evaluation.summary().values())
    ]
    table = f"{tabulate.markdown(header, rows)}\n{' '.join([means, *uneven])}"
    fails = fails or ("Its publisher has not said. Try it on recordings like yours.",)
    return f"""# {name}

Network `{config.model.name}` for neural inertial odometry by {card.made_by}: windows of \
{windows.window_seconds:g} s at {windows.rate:g} Hz, a displacement every \
{windows.stride_seconds:g} s. Epoch {card.epoch}, step {card.step}.

```
gnio track RECORDING --network {name}
gnio evaluate --network {name} --dataset NAME
```

## Data and licence

Trained on: {card.data}

Licence: {card.license}

## Recipe

{_write_recipe(card, network)}

Dataset `{", ".join(config.datasets)}`, seed {config.seed}. config.yaml beside this card has all \
settings, those of the filter as they are used. Consider covariance of the filter: \
{", ".join(considered) or "none"}.

## Figures

{table if figures else "There is no evaluation."}

## Where it fails

{chr(10).join(f"- {sentence}" for sentence in fails)}"""
