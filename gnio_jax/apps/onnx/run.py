"""Export of a run to a folder of ONNX models for other programs. `export.json` describes them, and
states their deviation from the package over one synthetic walk of fixed seed."""

from __future__ import annotations

import dataclasses
import json
import logging
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from gnio_jax.apps.onnx import conversion, driver
from gnio_jax.apps.onnx.driver import WalkResult
from gnio_jax.apps.onnx.networks import deploy_network
from gnio_jax.apps.onnx.programs import programs, start_arrays
from gnio_jax.config import DataConfig
from gnio_jax.config.files import to_plain
from gnio_jax.data.simulated.walks import pedestrian
from gnio_jax.errors import InputError, require_packages
from gnio_jax.evaluation import PreparedRecording, SequenceEstimate, estimate, prepare
from gnio_jax.evaluation.metrics import ate
from gnio_jax.files import fingerprint, replacing_folder, write_part
from gnio_jax.filtering import Filter, make_filter
from gnio_jax.models import Network
from gnio_jax.networks import load

PACKAGES = ("jax2onnx", "onnx", "onnxruntime")
SECONDS = 60.0
"""Duration of the walk over which an export is measured, s."""
SEED, PERSON, PLACEMENT = 9000, 900, "handheld"
"""Seed, person and placement of that walk, which is in no split."""
DISPLACEMENT_LIMIT, POSITION_LIMIT = 1e-5, 1e-3
"""Largest deviation of an export from the package, m; a larger one is an error of the
conversion."""
STD_LIMIT = 5e-5
"""Deviation of a displacement over its standard deviation that is allowed, too. The mean of a wide
distribution over bins is rounded by more than `DISPLACEMENT_LIMIT`."""
FORMAT, VERSION = "gnio-export", 4
CONVENTIONS = (
    "SI units. The world is z-up with gravity (0, 0, -9.81) m/s². Rotations are matrices body → "
    "world. gyro and accel are raw, in the body frame, at `rate`, without holes; accel includes "
    "gravity. A displacement is expressed in the gravity frame of its window's first sample after "
    "the context, whose yaw is zero, or in the frame of a network's memory; with `measures` "
    "velocity it is the velocity in the body at the window's end, in metres per window. covariance "
    "of a measurement: diag(exp(2 max(log_std, log_std_min))), m², turned about z by the angle "
    "whose cosine and sine are the output axes, if there is one; a displacement of NaN is no "
    "measurement. Errors of rotations are in the world frame, left-multiplied."
)


class Deviation(NamedTuple):
    """Deviation of the exported odometry from the package's own."""

    displacement_rms: float
    """Deviation of the network, over the windows of the walk, m."""
    displacement_largest: float
    """m."""
    displacement_excess: float
    """Largest ratio of a window's deviation to what is allowed for it."""
    position_largest: float
    """Deviation of the filter, m."""
    ate: float
    """Error of the exported odometry against the truth, m."""
    ate_of_package: float
    """Error of the package's own odometry against the truth, m."""


class ExportResult(NamedTuple):
    """The result of `export_run`."""

    folder: Path
    bytes: dict[str, int]
    """Size of each model."""
    deviation: Deviation


def export_run(which: str | Path, out: Path, seconds: float = SECONDS) -> ExportResult:
    """Export a network and its filter into the folder `out`.

    The filter is that of `gnio track`. The models are then run over a simulated walk of this
    duration, and `export.json` records their deviation from the package, with the tensors, size and
    SHA-256 of each model. The folder is written whole or not at all. JAX's x64 must be on. Raises
    `InputError` for a network that cannot be loaded, a folder that exists already, a missing Python
    package, or a conversion with a large deviation.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(out, "exists already", "name another --out, or remove it")
    require_packages("gnio export", "onnx", *PACKAGES)
    run = load(which)
    network = Network.of(run.model, run.variables)
    if run.config.filter.corrector is not None:
        problem = "has a corrector before its filter, which is not exported"
        raise InputError(which, problem, "set filter.corrector to null")
    ekf = make_filter(run.config.data, run.config.filter)
    with replacing_folder(out) as folder, ExitStack() as at_end:
        at_end.callback(logging.disable, logging.root.manager.disable)
        logging.disable(logging.WARNING)  # Converters write a log line for almost every node.
        files = {}
        deployed = deploy_network(network, ekf)
        for program in programs(deployed, ekf):
            content = conversion.to_model(program, ekf, deployed.first_inferred)
            (folder / f"{program.name}.onnx").write_bytes(content)
            files[f"{program.name}.onnx"] = {
                **fingerprint(content),
                "inputs": _describe_arrays(program.inputs),
                "outputs": _describe_arrays(program.outputs),
            }
        windows = run.config.data
        walk = draw_walk(windows, ekf, seconds)
        start = walk.start.state(ekf)
        models = driver.open_models(folder)
        result = driver.walk(models, start_arrays(start, deployed, ekf), walk.gyro, walk.accel)
        without = dataclasses.replace(ekf, considered=None)
        (package_estimate,) = estimate([walk], network, windows, without)
        deviation = deviation_of(result, package_estimate)
        check(deviation, run.name)
        manifest = {
            "format": FORMAT,
            "version": VERSION,
            "made_by": f"gnio-jax {version('gnio-jax')}",
            "conventions": CONVENTIONS,
            "run": run.name,
            "network": run.config.model.name,
            "epoch": run.epoch,
            "step": run.step,
            "accuracy": {"seconds": seconds, **deviation._asdict()},
            "first_inferred": deployed.first_inferred,
            **_filter(ekf),
            "files": files,
        }
        text = json.dumps(manifest, indent=2, ensure_ascii=False, allow_nan=False)
        write_part(folder / "export.json", text + "\n")
    return ExportResult(out, {name: file["bytes"] for name, file in files.items()}, deviation)


def _describe_arrays(arrays: dict[str, jax.ShapeDtypeStruct]) -> list[dict[str, Any]]:
    """Name, shape and type of the inputs or outputs of a model."""
    return [
        {"name": name, "shape": list(array.shape), "dtype": str(array.dtype)}
        for name, array in arrays.items()
    ]


def _filter(ekf: Filter) -> dict[str, Any]:
    """The settings of the exported filter, which are fixed."""
    config = ekf.config
    return {
        "rate": 1 / config.dt,
        "window": config.window,
        "context": config.context_samples,
        "samples_per_clone": config.samples_per_clone,
        "clones_per_window": config.clones_per_window,
        "first_measured": config.first_measured,
        "log_std_min": config.log_std_min,
        "filter": {
            "config": dataclasses.asdict(config),
            "noise": to_plain(ekf.noise),
            "initial_std": to_plain(ekf.start),
        },
    }


def draw_walk(windows: DataConfig, ekf: Filter, seconds: float) -> PreparedRecording:
    """A pedestrian at the network's rate, with its true start."""
    length = seconds + 1.0 / windows.rate  # a stride ends with the sample after it
    sequence = pedestrian(SEED, PERSON, PLACEMENT, seconds=length, rate=windows.rate)
    (walk,), _ = prepare([sequence], windows, ekf)
    return walk


def deviation_of(result: WalkResult, package_estimate: SequenceEstimate) -> Deviation:
    """The deviation of the models' walk from the package's own."""
    position, true = (
        trajectory.position[1:]
        for trajectory in (package_estimate.trajectory, package_estimate.reference)
    )
    assert package_estimate.displacements is not None
    rows = slice(-len(result.displacement), None)
    displacement = package_estimate.displacements.value[rows]
    std = np.linalg.norm(package_estimate.displacements.std[rows], axis=1)
    error = np.linalg.norm(result.displacement - displacement, axis=1)
    allowed = np.maximum(DISPLACEMENT_LIMIT, STD_LIMIT * std)
    return Deviation(
        displacement_rms=float(np.sqrt(np.mean(error**2))),
        displacement_largest=float(error.max()),
        displacement_excess=float((error / allowed).max()),
        position_largest=float(np.linalg.norm(result.position - position, axis=1).max()),
        ate=ate(result.position, true),
        ate_of_package=ate(position, true),
    )


def check(deviation: Deviation, where: Any) -> None:
    """Raise `InputError` if an export deviates from the package's odometry."""
    largest = deviation.displacement_largest, deviation.position_largest
    if not (deviation.displacement_excess <= 1.0 and largest[1] <= POSITION_LIMIT):
        problem = f"the conversion is off by {largest[0]:.2g} m a window, {largest[1]:.2g} m a walk"
        raise InputError(where, problem, "another version of jax2onnx may be more accurate")
