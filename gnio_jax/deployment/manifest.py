"""`export.json`: what an export holds, for the programs and people that use it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax

from gnio_jax.config.files import plain
from gnio_jax.deployment.programs import Program
from gnio_jax.filtering.settings import FilterSetup

FORMAT, VERSION = "gnio-export", 3
MANIFEST = "export.json"
CONVENTIONS = (
    "SI units. The world is z-up with gravity (0, 0, -9.81) m/s². Rotations are matrices body → "
    "world. gyro and accel are raw, in the body frame, at `rate`, without holes; accel includes "
    "gravity. A displacement is expressed in the gravity frame of its window's first sample after "
    "the context, whose yaw is zero. covariance of a measurement: diag(exp(2 max(log_std, "
    "log_std_min))), m²; a displacement of NaN is no measurement. Errors of rotations are in the "
    "world frame, left-multiplied."
)


def write_manifest(
    folder: Path, programs: list[Program], setup: FilterSetup, about: Mapping[str, Any]
) -> None:
    """Write `export.json` into the folder of the export: its tensors, the filter as it is exported,
    whose settings cannot be changed any more, and what else there is to say `about` it."""
    config = setup.config

    def tensors(arrays: Mapping[str, jax.ShapeDtypeStruct]) -> list[dict[str, Any]]:
        shapes = ((name, list(each.shape), str(each.dtype)) for name, each in arrays.items())
        return [{"name": name, "shape": shape, "dtype": dtype} for name, shape, dtype in shapes]

    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "made_by": f"gnio-jax {version('gnio-jax')}",
        "conventions": CONVENTIONS,
        **about,
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
        "files": {
            f"{each.name}.onnx": {"inputs": tensors(each.inputs), "outputs": tensors(each.outputs)}
            for each in programs
        },
    }
    text = json.dumps(manifest, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")
