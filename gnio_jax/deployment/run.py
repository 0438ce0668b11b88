"""One run to a folder that other programs read."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NamedTuple

from gnio_jax import pretrained
from gnio_jax.config import DataConfig
from gnio_jax.deployment import accuracy, conversion
from gnio_jax.deployment.accuracy import Deviation, Said, Walk
from gnio_jax.deployment.driver import Walked, open_models, open_session
from gnio_jax.deployment.manifest import Contents, describe, describe_filter, write_manifest
from gnio_jax.deployment.odometry import FILE, odometry_program, whole_odometry
from gnio_jax.deployment.precision import Precision, in_precision
from gnio_jax.deployment.programs import NETWORK, Program, programs
from gnio_jax.errors import InputError, require_packages
from gnio_jax.evaluation.inference import Network, inference_network
from gnio_jax.files import replacing_folder
from gnio_jax.filtering.options import FilterSetup
from gnio_jax.tracking.run import tracking_filter
from gnio_jax.training.checkpoint import Run

Kind = Literal["onnx", "stablehlo"]
PACKAGES = ("jax2onnx", "onnx", "onnxruntime")


class Exported(NamedTuple):
    """What `export_run` left."""

    folder: Path
    bytes: dict[str, int]
    """Size of each file."""
    deviation: Deviation


class _Source(NamedTuple):
    """What is exported, and what the package makes of the walk on which that is measured."""

    network: Network
    setup: FilterSetup
    windows: DataConfig
    drawn: Walk
    package: Said

    def deviation(self, export: Said) -> Deviation:
        return accuracy.deviation(self.drawn, self.package, export)


def export_run(
    which: str | Path,
    out: Path,
    kind: Kind,
    precision: Precision = "float32",
    seconds: float = accuracy.SECONDS,
) -> Exported:
    """Export the network and the filter of a run or package into the folder `out`.

    The filter is that of `gnio track`. What was exported is then driven over a synthetic walk of so
    many seconds, and `export.json` says how far it is from the package. The folder is written whole
    or not at all. JAX's x64 must be on. Raises `InputError` for a run without a checkpoint, a
    folder that is there already, a package of Python that is missing, or a conversion that is off.
    """
    _check(out, kind, precision)
    place = pretrained.find(which)
    run = pretrained.load_pretrained(place)
    source = _source(run, seconds)
    with replacing_folder(out) as folder, _quiet_converters():
        write = _write_onnx if kind == "onnx" else _write_stablehlo
        contents, deviation = write(folder, source, precision)
        files = describe(contents)
        write_manifest(
            folder,
            {
                **_describe_run(place.name, run, kind, precision),
                **describe_filter(source.setup),
                "files": files,
                "accuracy": {"walk": _describe_walk(seconds), **deviation._asdict()},
            },
        )
    return Exported(out, {name: each["bytes"] for name, each in files.items()}, deviation)


def _check(out: Path, kind: Kind, precision: Precision) -> None:
    """What can be refused before the work."""
    if kind == "onnx":
        require_packages("--to onnx", "onnx", *PACKAGES)
    else:
        require_packages("--to stablehlo", "stablehlo", "flatbuffers")
        if precision != "float32":
            problem = f"'{precision}' is for --to onnx alone"
            raise InputError("--precision", problem, "leave it out")
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(out, "is there already", "name another --out, or remove it")


def _source(run: Run, seconds: float) -> _Source:
    network, setup = inference_network(run.model, run.variables), tracking_filter(run)
    drawn = accuracy.draw_walk(run.config.data, seconds)
    package = accuracy.of_package(network, setup, drawn)
    return _Source(network, setup, run.config.data, drawn, package)


def _write_onnx(
    folder: Path, source: _Source, precision: Precision
) -> tuple[dict[str, Contents], Deviation]:
    """The four models."""
    made = {program.name: program for program in programs(source.network, source.setup)}
    for program in made.values():
        conversion.write(conversion.to_model(program, source.setup), _path(folder, program))
    found = _drive(folder, source.drawn, source.setup)
    deviation = source.deviation(Said(found.position, found.displacement))
    accuracy.check(deviation, "--to onnx", "jax2onnx")
    if precision != "float32":
        deviation = _write_variant(folder, source, precision, found)
    contents = {
        f"{name}.onnx": Contents(_path(folder, each).read_bytes(), each.inputs, each.outputs)
        for name, each in made.items()
    }
    return contents, deviation


def _write_variant(folder: Path, source: _Source, precision: Precision, found: Walked) -> Deviation:
    """Put the network in another precision in the place of that in float32, which `found` something
    on the walk."""
    models = open_models(folder)
    windows = accuracy.calibration_windows(models, source.windows, source.setup)
    path = folder / f"{NETWORK}.onnx"
    conversion.write(in_precision(conversion.read(path), precision, windows), path)
    displacement = accuracy.of_windows(open_session(path), found.windows)
    position = _drive(folder, source.drawn, source.setup).position
    return source.deviation(Said(position, displacement))


def _drive(folder: Path, drawn: Walk, setup: FilterSetup) -> Walked:
    return accuracy.drive(open_models(folder), drawn, setup)


def _path(folder: Path, program: Program) -> Path:
    return folder / f"{program.name}.onnx"


def _write_stablehlo(
    folder: Path, source: _Source, _precision: Precision
) -> tuple[dict[str, Contents], Deviation]:
    """The whole odometry as one program."""
    program = odometry_program(source.network, source.setup)
    (folder / FILE).write_bytes(program.content)
    contents = {FILE: Contents(program.content, program.inputs, program.outputs)}
    drawn, config = source.drawn, source.setup.config
    odometry = whole_odometry(program.content, config.samples_per_clone, config.clones)
    found = odometry({**drawn.start, "gyro": drawn.gyro, "accel": drawn.accel})
    displacement = found["displacement"][config.first_measured :]
    deviation = source.deviation(Said(found["position"], displacement))
    accuracy.check(deviation, "--to stablehlo", "jax")
    return contents, deviation


def _describe_run(name: str, run: Run, kind: Kind, precision: Precision) -> dict[str, Any]:
    return {
        "kind": kind,
        "run": name,
        "network": run.config.model.name,
        "epoch": run.epoch,
        "step": run.step,
        "precision": precision,
    }


def _describe_walk(seconds: float) -> dict[str, Any]:
    return {
        "kind": "synthetic pedestrian",
        **accuracy.MEASURED._asdict(),
        "seconds": seconds,
    }


@contextmanager
def _quiet_converters() -> Iterator[None]:
    """Converters log what they do about every other node."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(before)
