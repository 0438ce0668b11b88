"""One run to a folder of ONNX models that other programs read, with `export.json` about them."""

from __future__ import annotations

import dataclasses
import json
import logging
from collections.abc import Mapping
from contextlib import ExitStack
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax

from gnio_jax.apps import packages
from gnio_jax.apps.onnx import accuracy, conversion, driver
from gnio_jax.apps.onnx.accuracy import Deviation
from gnio_jax.apps.onnx.flat_state import start_arrays
from gnio_jax.apps.onnx.programs import Program, programs
from gnio_jax.apps.track import tracking_filter
from gnio_jax.config.files import plain
from gnio_jax.errors import InputError, require_packages
from gnio_jax.evaluation import estimate
from gnio_jax.files import fingerprint, replacing_folder
from gnio_jax.filtering import initial_state
from gnio_jax.filtering.settings import FilterSetup
from gnio_jax.models import Network

PACKAGES = ("jax2onnx", "onnx", "onnxruntime")
SECONDS = 60.0
"""Of the walk over which an export is measured."""
FORMAT, VERSION = "gnio-export", 3
CONVENTIONS = (
    "SI units. The world is z-up with gravity (0, 0, -9.81) m/s². Rotations are matrices body → "
    "world. gyro and accel are raw, in the body frame, at `rate`, without holes; accel includes "
    "gravity. A displacement is expressed in the gravity frame of its window's first sample after "
    "the context, whose yaw is zero. covariance of a measurement: diag(exp(2 max(log_std, "
    "log_std_min))), m²; a displacement of NaN is no measurement. Errors of rotations are in the "
    "world frame, left-multiplied."
)


class Exported(NamedTuple):
    """What `export_run` left."""

    folder: Path
    bytes: dict[str, int]
    """Size of each model."""
    deviation: Deviation


def export_run(which: str | Path, out: Path, seconds: float = SECONDS) -> Exported:
    """Export the network and the filter of a run or package into the folder `out`.

    The filter is that of `gnio track`. The models are then driven over a simulated walk of so many
    seconds, and `export.json` records how far they are from the package, beside the tensors, size
    and SHA-256 of each model. The folder is written whole or not at all. JAX's x64 must be on.
    Raises `InputError` for a run without a checkpoint, a folder that is there already, a package of
    Python that is missing, or a conversion that is off.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(out, "is there already", "name another --out, or remove it")
    require_packages("gnio export", "onnx", *PACKAGES)
    place = packages.find(which)
    run = packages.load_pretrained(place)
    network, setup = Network.of(run.model, run.variables), tracking_filter(run)
    with replacing_folder(out) as folder, ExitStack() as at_end:
        at_end.callback(logging.disable, logging.root.manager.disable)
        logging.disable(logging.WARNING)  # Converters log what they do about every other node.
        files = {}
        for program in programs(network, setup):
            content = conversion.to_model(program, setup)
            (folder / f"{program.name}.onnx").write_bytes(content)
            files[f"{program.name}.onnx"] = {**fingerprint(content), **_tensors(program)}
        windows = run.config.data
        walk = accuracy.draw_walk(windows, setup, seconds)
        start = initial_state(setup.config, *walk.start[:-1], std=walk.start.std)
        models = driver.open_models(folder)
        found = driver.walk(models, start_arrays(start, setup), walk.gyro, walk.accel)
        (own,) = estimate([walk], network, windows, setup._replace(considered=None))
        deviation = accuracy.deviation(found.position, found.displacement, own)
        accuracy.check(deviation, place.name)
        manifest = {
            "format": FORMAT,
            "version": VERSION,
            "made_by": f"gnio-jax {version('gnio-jax')}",
            "conventions": CONVENTIONS,
            "run": place.name,
            "network": run.config.model.name,
            "epoch": run.epoch,
            "step": run.step,
            "accuracy": {"seconds": seconds, **deviation._asdict()},
            **_filter(setup),
            "files": files,
        }
        text = json.dumps(manifest, indent=2, ensure_ascii=False, allow_nan=False)
        (folder / "export.json").write_text(text + "\n", encoding="utf-8")
    return Exported(out, {name: each["bytes"] for name, each in files.items()}, deviation)


def _tensors(program: Program) -> dict[str, list[dict[str, Any]]]:
    """Name, shape and type of what a model takes and gives."""

    def described(arrays: Mapping[str, jax.ShapeDtypeStruct]) -> list[dict[str, Any]]:
        shapes = ((name, list(each.shape), str(each.dtype)) for name, each in arrays.items())
        return [{"name": name, "shape": shape, "dtype": dtype} for name, shape, dtype in shapes]

    return {"inputs": described(program.inputs), "outputs": described(program.outputs)}


def _filter(setup: FilterSetup) -> dict[str, Any]:
    """The filter as it is exported, whose settings cannot be changed any more."""
    config = setup.config
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
            "noise": plain(setup.noise),
            "initial_std": plain(setup.initial_std),
        },
    }
