"""Packages of trained networks: a package is made from a run, found by name, and loaded as a run.

A package is a folder or a zip of two files: `weights.safetensors` with the arrays, and
`manifest.json` with the settings, the model card and the SHA-256 of the weights and of itself.
Everything is checked before it is used. Nothing is unpacked to the disk, and nothing is executed.
docs/weights.md has the format.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
import shlex
import zipfile
import zlib
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from gnio_jax import config as configuration
from gnio_jax import models
from gnio_jax.errors import InputError, did_you_mean
from gnio_jax.evaluation import folder as results
from gnio_jax.evaluation import tabulate
from gnio_jax.evaluation.report import Report
from gnio_jax.evaluation.statistics import summarise
from gnio_jax.files import file_stem, fingerprint, replacing, replacing_folder
from gnio_jax.training import checkpoint
from gnio_jax.training.checkpoint import Run, Which

SHIPPED = Path(__file__).parents[1] / "weights"
"""The packages that come with gnio-jax."""
VARIABLE = "GNIO_WEIGHTS"
"""Variable with the folders of packages, separated as in $PATH."""
FORMAT, VERSION = "gnio-package", 2
MANIFEST, WEIGHTS = "manifest.json", "weights.safetensors"
LARGEST_MANIFEST, LARGEST_WEIGHTS = 2**20, 2**32
"""Largest sizes in bytes (ours), because a small zip may unpack to any size."""
SHOWN = ("ate_2d", "rte_60s_2d", "path_length_ratio_2d", "yaw_rmse", "nees_coverage_2d")
"""Metrics of the card. Lists of networks show the first."""
AT_WAYPOINTS = ("leg_ratio", "waypoint_rms")
"""Further metrics, of evaluations of walks with waypoints."""
_DAMAGED = "the package is damaged: fetch or publish it again"


class PackageManifest(NamedTuple):
    """The content of a package's manifest."""

    name: str
    network: str
    """Name of the network in the registry of `gnio_jax.models`."""
    data: str
    """The training data, in the publisher's words."""
    license: str
    epoch: int
    step: int
    measured: str
    """The error that lists of networks show, in words; empty if the run had no evaluation."""
    made_by: str
    """The program that published it, with its version."""
    card: list
    """Lines of the model card, Markdown."""
    config: dict
    """The settings, in the form of a run's config.yaml."""
    weights: dict
    """Size and SHA-256 of `weights.safetensors`, as `files.fingerprint` gives them."""


class Weights(NamedTuple):
    """A network for tracking."""

    name: str
    run: Run
    trained_on: str
    """Its training data, and its measured error if there is one."""


# --- where packages are found


def is_package(path: Path) -> bool:
    """Whether a folder or file is meant to be a package; its content is not checked."""
    return (path.is_file() and path.suffix == ".zip") or (path / MANIFEST).is_file()


def packages() -> dict[str, Path]:
    """Packages by name (that of the folder, or of the zip without its suffix), those of gnio-jax
    first. Raises `InputError` for a folder of $GNIO_WEIGHTS that is missing."""
    folders = [Path(folder) for folder in os.environ.get(VARIABLE, "").split(os.pathsep) if folder]
    paths: dict[str, Path] = {}
    for folder in (SHIPPED, *folders):
        if not folder.is_dir():
            raise InputError(
                f"${VARIABLE}", f"'{folder}' is not a folder", "name folders that contain packages"
            )
        for path in filter(is_package, sorted(folder.iterdir())):
            paths.setdefault(path.name.removesuffix(".zip"), path)
    return paths


def find(which: str | Path | None = None) -> Path:
    """The package or run of a path or a name; None: the first of gnio-jax, else the newest run
    below runs/. Raises `InputError` for neither."""
    paths = packages()
    if which is None:
        shipped = [
            shipped_path for shipped_path in paths.values() if shipped_path.parent == SHIPPED
        ]
        return shipped[0] if shipped else configuration.newest_run()
    path = Path(which)
    if is_package(path) or (path / "config.yaml").is_file():
        return path
    if str(which) in paths:
        return paths[str(which)]
    if path.exists():
        problem = f"holds neither a package ({MANIFEST}) nor a run (config.yaml)"
        raise InputError(path, problem, "gnio publish makes a package of a run")
    names = f"known names: {', '.join(paths) or 'none'}; give a folder, a zip or a name"
    hint = did_you_mean(str(which), paths).strip()
    raise InputError(which, "no such weights", hint or names)


def choose(which: str | Path | None = None) -> Weights:
    """The weights of a name, package or run that `find` finds. Raises `InputError`."""
    path = find(which)
    if is_package(path):
        manifest, content = read(path)
        name, trained_on, measured = manifest.name, manifest.data, manifest.measured
        source = str(path / MANIFEST)
        config = configuration.parse(json.dumps(manifest.config), source)
        config = configuration.validate(config, source)
        model = models.from_config(config.model)
        shapes = models.variable_shapes(model, config.data.seen)
        template = {"params": shapes["params"], "batch_stats": shapes.get("batch_stats", {})}
        variables = from_bytes(content, template, path / WEIGHTS)
        run = Run(config, model, variables, manifest.epoch, manifest.step)
    else:
        run = checkpoint.load_run(path)
        names, split = ", ".join(run.config.datasets), run.config.data.train_split
        name, trained_on = path.name, f"dataset {names}, split {split}"
        try:
            measured = _measured(_figures(path), run.config.datasets)
        except InputError:
            measured = ""  # a damaged evaluation must not prevent tracking
    return Weights(name, run, f"{trained_on}, whose {measured}" if measured else trained_on)


def load_pretrained(which: str | Path | None = None) -> Run:
    """The network of `which` with its variables and configuration.

    `which` is the folder or zip of a package, the folder of a run, or the name of a package in
    gnio-jax or in a folder of $GNIO_WEIGHTS; None is the default of `gnio track`.
    `Run.model.apply(run.variables, windows)` gives a `Prediction` of windows (b, N, 6), float32,
    [accel m/s², gyro rad/s] in the gravity frame at `run.config.data.rate`; `run.config.filter` has
    the calibrated or trained settings of the filter. Raises `InputError`.
    """
    return choose(which).run


def card_of(which: str | Path) -> str:
    """The model card of a package, Markdown. Raises `InputError`, also for a run."""
    path = find(which)
    if not is_package(path):
        raise InputError(path, "is a run and has no model card", "gnio publish makes a package")
    return "\n".join(map(str, read_manifest(path).card))


def write_run(which: str | Path, workdir: Path) -> None:
    """Turn a package into a run, which all commands take: its settings, and its weights as the best
    checkpoint. The folder is written whole or not at all. Raises `InputError` as `load_pretrained`
    does, and for a folder that exists already."""
    if workdir.exists():
        raise InputError(workdir, "is there already", "name another folder")
    run = load_pretrained(which)
    run = run._replace(config=dataclasses.replace(run.config, workdir=str(workdir)))
    with replacing_folder(workdir) as new:
        configuration.save(new / "config.yaml", run.config)
        checkpoint.write_best(new, run)


# --- reading


def read(path: Path) -> tuple[PackageManifest, bytes]:
    """The manifest and the weights of a package. Raises `InputError` if it is damaged."""
    manifest = read_manifest(path)
    content = _content(path, WEIGHTS, LARGEST_WEIGHTS)
    if fingerprint(content) != manifest.weights:
        problem = f"'{WEIGHTS}' is not the file that the manifest describes (SHA-256 differs)"
        raise InputError(path, problem, _DAMAGED)
    return manifest, content


def read_manifest(path: Path) -> PackageManifest:
    """The manifest of a package; the weights are not read. Raises `InputError`."""
    try:
        manifest = json.loads(_content(path, MANIFEST, LARGEST_MANIFEST))
    except (ValueError, RecursionError) as error:  # InputError, too, is a ValueError
        if isinstance(error, InputError):
            raise
        raise InputError(path, f"'{MANIFEST}' is no JSON ({error})", _DAMAGED) from None
    if not isinstance(manifest, dict) or manifest.get("format") != FORMAT:
        raise InputError(path, f"'{MANIFEST}' is not that of a package", _DAMAGED)
    if manifest.get("version") != VERSION:
        problem = f"has format version {manifest.get('version')!r}; this program reads {VERSION}"
        raise InputError(
            path, problem, "publish its run again, or install the gnio-jax that made it"
        )
    if _digest(manifest) != manifest.get("sha256"):
        raise InputError(path, f"'{MANIFEST}' was changed (SHA-256 differs)", _DAMAGED)
    for name, kind in get_type_hints(PackageManifest).items():
        value = manifest.get(name)
        if type(value) is not kind or (isinstance(value, int) and not 0 <= value < 2**31):
            raise InputError(path, f"'{MANIFEST}' has no '{name}', or a wrong one", _DAMAGED)
    if manifest["weights"].keys() != {"bytes", "sha256"}:
        raise InputError(path, f"'{MANIFEST}' does not describe '{WEIGHTS}'", _DAMAGED)
    return PackageManifest(*(manifest[name] for name in PackageManifest._fields))


def _digest(manifest: dict[str, Any]) -> str:
    """The SHA-256 of all fields of a manifest except this digest."""
    fields = {name: value for name, value in manifest.items() if name != "sha256"}
    return str(fingerprint(json.dumps(fields, sort_keys=True).encode())["sha256"])


def _content(path: Path, name: str, most: int) -> bytes:
    """The content of a file of at most `most` bytes."""
    try:
        if path.is_dir():
            with (path / name).open("rb") as file:
                content = file.read(most + 1)
        else:
            with zipfile.ZipFile(path) as archive, archive.open(name) as file:
                content = file.read(most + 1)
    except (FileNotFoundError, KeyError):
        raise InputError(path, f"'{name}' is missing", _DAMAGED) from None
    except (OSError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise InputError(path, f"'{name}' cannot be read ({error})", _DAMAGED) from None
    if len(content) > most:
        raise InputError(path, f"'{name}' is larger than {most} bytes", _DAMAGED)
    return content


def to_bytes(variables: Any) -> bytes:
    """Variables as a safetensors file; the name of an array is its path, `params/head/kernel`."""
    return save({name: np.asarray(leaf, np.float32) for name, leaf in _named(variables).items()})


def from_bytes(content: bytes, template: Any, where: object) -> Any:
    """The variables of a file in the structure of `template` (arrays or shapes). Raises
    `InputError` if a name or a shape differs, or if a value is not finite."""
    try:
        tensors = load(content)
    except (SafetensorError, ValueError, KeyError) as error:
        problem = f"cannot be read ({str(error)[:120]})"
        raise InputError(where, problem, "it must be a safetensors file") from None
    expected = _named(template)
    for name in sorted(expected.keys() | tensors.keys()):
        shape, expected_shape = (
            tree[name].shape if name in tree else None for tree in (tensors, expected)
        )
        if shape != expected_shape:
            problem = f"'{name}' has shape {shape}; the configured network has {expected_shape}"
            raise InputError(where, problem, "weights and settings must be of one run")
        if not np.isfinite(tensors[name]).all():
            raise InputError(where, f"'{name}' holds values that are not finite")
    leaves = [jnp.asarray(tensors[name], jnp.float32) for name in expected]
    return jax.tree.unflatten(jax.tree.structure(template), leaves)


def _named(tree: Any) -> dict[str, Any]:
    leaves = jax.tree_util.tree_leaves_with_path(tree)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


# --- publishing


def publish(
    workdir: Path,
    out: Path,
    name: str,
    data: str,
    license: str,
    fails: tuple[str, ...] = (),
    which: Which = "best",
) -> PackageManifest:
    """Make a package from a run at `out`: a zip if its name ends with .zip, else a folder. It
    replaces an older package. It is written whole or not at all, and its settings do not contain
    folders of this machine.

    The publisher must describe the `data` on which the network was trained (recordings, devices,
    people, carrying positions), the `license` under which the data may be used and the weights
    passed on, and the cases in which it `fails`, one sentence each.

    Raises `InputError` for a run that cannot be loaded, a name that is not a file name, empty
    texts, or something at `out` that is no package.
    """
    if name != file_stem(name):
        remedy = "use letters, digits, '.', '_', '+' and '-'"
        raise InputError("--name", f"'{name}' is no name of a folder", remedy)
    for option, text in (("--data", data), ("--license", license)):
        if not text.strip():
            remedy = "describe it in a sentence, because other people rely on it"
            raise InputError(option, "is empty", remedy)
    if out.exists() and not (out.is_dir() and not any(out.iterdir())) and not _has_manifest(out):
        raise InputError(out, "is there already and is no package", "name another --out")
    run = checkpoint.load_run(workdir, which)
    figures = _figures(workdir)
    weights = to_bytes(run.variables)
    manifest = PackageManifest(
        name,
        run.config.model.name,
        data,
        license,
        run.epoch,
        run.step,
        _measured(figures, run.config.datasets),
        f"gnio-jax {version('gnio-jax')}",
        [],
        configuration.to_plain(configuration.without_paths(run.config)),
        fingerprint(weights),
    )
    manifest = manifest._replace(card=_card(manifest, fails, run, figures, workdir).split("\n"))
    fields = {"format": FORMAT, "version": VERSION, **manifest._asdict()}
    fields["sha256"] = _digest(fields)
    text = json.dumps(fields, indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    files = {MANIFEST: text.encode(), WEIGHTS: weights}
    if out.suffix == ".zip":
        with replacing(out) as temporary, zipfile.ZipFile(temporary, "w") as archive:
            for name, content in files.items():
                # With a date the bytes of the same package would differ.
                archive.writestr(zipfile.ZipInfo(name), content, zipfile.ZIP_DEFLATED)
    else:
        with replacing_folder(out) as folder:
            for name, content in files.items():
                (folder / name).write_bytes(content)
    return manifest


def _has_manifest(path: Path) -> bool:
    """Whether it holds the manifest of a package, of any version."""
    try:
        return f'"{FORMAT}"'.encode() in _content(path, MANIFEST, LARGEST_MANIFEST)
    except InputError:
        return False


def _figures(workdir: Path) -> dict[str, Report]:
    """Read every evaluation of a run, by its folder's name. Raises `InputError`."""
    folders = sorted(path.parent for path in workdir.glob("eval/*/metrics.json"))
    return {folder.name: results.read(folder) for folder in folders}


def _measured(figures: dict[str, Report], datasets: tuple[str, ...]) -> str:
    """The error that lists of networks show, in words, with that of each way of carrying. It is
    that of the first evaluation that has it. Evaluations with the filter come first, then those on
    the run's own datasets, then those on a test split. It is empty if no evaluation has it."""

    def rank(name: str) -> tuple[bool, bool, bool, int, str]:
        settings = figures[name].settings
        of_run, tested = settings["dataset"] in datasets, "test" in settings["split"]
        return settings["estimator"] != "ekf", not of_run, not tested, len(name), name

    for name in sorted(figures, key=rank):
        if (error := _cell(figures[name], SHOWN[0])) != tabulate.number(None, 0):
            text = f"{tabulate.column(SHOWN[0]).heading} is {error} m on {name}"
            by_placement = _by_placement(figures[name])
            return f"{text} ({'; '.join(by_placement)})" if by_placement else text
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


def _cell(figures: Report, metric: str) -> str:
    """The mean over the sequences with its 95 % interval."""
    summary = summarise([figures.scores], metric, figures.groups)
    digits = tabulate.column(metric).digits
    text = tabulate.number(summary.mean, digits)
    if summary.interval is None:
        return text
    low, high = (tabulate.number(bound, digits) for bound in summary.interval)
    return f"{text} ({low} to {high})"


def _named_run(which: str) -> str:
    """The name of a package, or a run without the folders of this machine."""
    is_package_name = which in packages() and not Path(which).exists()
    return shlex.quote(which if is_package_name else f"runs/{Path(which).name}")


def _card(
    manifest: PackageManifest,
    fails: tuple[str, ...],
    run: Run,
    figures: dict[str, Report],
    workdir: Path,
) -> str:
    """The model card, Markdown."""
    config, windows, name = run.config, run.config.data, manifest.name
    start = f" --init-from {_named_run(config.init_from)}" if config.init_from else ""
    if windows.poses_by:
        start += f" --set data.poses_by={_named_run(windows.poses_by)}"
    steps, filter_note = [f"gnio train --config config.yaml --workdir runs/{name}{start}"], ""
    if (workdir / "calibration.json").is_file():
        calibration = json.loads((workdir / "calibration.json").read_text(encoding="utf-8"))
        fitted_run = Path(calibration["run"]).name
        if fitted_run == workdir.name.removesuffix("_calibrated"):
            fitted_run = name
        headings = " --average-headings" if calibration.get("average_headings") else ""
        steps.append(f"gnio calibrate --workdir runs/{fitted_run}{headings}")
        filter_note = (
            f" The filter is fitted to split `{calibration['split']}` of run `{fitted_run}`."
        )
    recipe = "\n".join(("```", *steps, "```"))
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
    table = f"{tabulate.markdown(header, rows)}\n{means}"
    fails = fails or ("Its publisher has not said. Try it on recordings like yours.",)
    return f"""# {name}

Network `{config.model.name}` for neural inertial odometry by {manifest.made_by}: windows of \
{windows.window_seconds:g} s at {windows.rate:g} Hz, a displacement every \
{windows.stride_seconds:g} s. Epoch {run.epoch}, step {run.step}.

```
gnio track RECORDING --weights {name}
```

## Data and licence

Trained on: {manifest.data}

Licence: {manifest.license}

## Recipe

{recipe}

Dataset `{", ".join(config.datasets)}`, seed {config.seed}; `gnio weights {name} --out \
runs/{name}` writes config.yaml with all settings, those of the filter as they are used. Consider \
covariance of the filter: {", ".join(considered) or "none"}.{filter_note}

## Figures

{table if figures else "The run holds no evaluation."}

## Where it fails

{chr(10).join(f"- {sentence}" for sentence in fails)}"""
