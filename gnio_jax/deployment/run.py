"""One run to a folder of ONNX models that other programs read."""

from __future__ import annotations

import logging
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

from gnio_jax.apps import packages
from gnio_jax.deployment import accuracy, conversion, driver
from gnio_jax.deployment.accuracy import Deviation
from gnio_jax.deployment.flat_state import start_arrays
from gnio_jax.deployment.manifest import write_manifest
from gnio_jax.deployment.programs import programs
from gnio_jax.errors import InputError, require_packages
from gnio_jax.evaluation.inference import inference_network
from gnio_jax.files import replacing_folder
from gnio_jax.filtering import initial_state
from gnio_jax.tracking.run import tracking_filter

PACKAGES = ("jax2onnx", "onnx", "onnxruntime")
SECONDS = 60.0
"""Of the walk over which an export is measured."""


class Exported(NamedTuple):
    """What `export_run` left."""

    folder: Path
    bytes: dict[str, int]
    """Size of each model."""
    deviation: Deviation


def export_run(which: str | Path, out: Path, seconds: float = SECONDS) -> Exported:
    """Export the network and the filter of a run or package into the folder `out`.

    The filter is that of `gnio track`. The models are then driven over a synthetic walk of so many
    seconds, and `export.json` records how far they are from the package. The folder is written
    whole or not at all. JAX's x64 must be on. Raises `InputError` for a run without a checkpoint, a
    folder that is there already, a package of Python that is missing, or a conversion that is off.
    """
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise InputError(out, "is there already", "name another --out, or remove it")
    require_packages("gnio export", "onnx", *PACKAGES)
    place = packages.find(which)
    run = packages.load_pretrained(place)
    network, setup = inference_network(run.model, run.variables), tracking_filter(run)
    made = programs(network, setup)
    with replacing_folder(out) as folder, ExitStack() as at_end:
        at_end.callback(logging.disable, logging.root.manager.disable)
        logging.disable(logging.WARNING)  # Converters log what they do about every other node.
        for program in made:
            model = conversion.to_model(program, setup)
            conversion.write(model, folder / f"{program.name}.onnx")
        walk = accuracy.draw_walk(run.config.data, seconds)
        start = initial_state(setup.config, **walk.start, std=setup.initial_std)
        models = driver.open_models(folder)
        found = driver.walk(models, start_arrays(start, setup), walk.gyro, walk.accel)
        history = accuracy.package_history(network, setup, walk)
        deviation = accuracy.deviation(found.position, found.displacement, history, walk)
        accuracy.check(deviation, place.name)
        about = {
            "run": place.name,
            "network": run.config.model.name,
            "epoch": run.epoch,
            "step": run.step,
            "accuracy": {"seconds": seconds, **deviation._asdict()},
        }
        write_manifest(folder, made, setup, about)
        sizes = {path.name: path.stat().st_size for path in sorted(folder.glob("*.onnx"))}
    return Exported(out, sizes, deviation)
