"""`export.json`: what an export holds, for the programs and people that use it."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from gnio_jax.errors import InputError
from gnio_jax.filtering.options import FilterSetup

FORMAT, VERSION = "gnio-export", 2
MANIFEST = "export.json"
CONVENTIONS = (
    "SI units. The world is z-up with gravity (0, 0, -9.81) m/s². Rotations are matrices body → "
    "world. gyro and accel are raw, in the body frame, at `rate`, without holes; accel includes "
    "gravity. A displacement is told in the gravity frame of its window's first sample after the "
    "context, whose yaw is zero. covariance of a measurement: diag(exp(2 max(log_std, "
    "log_std_min))), m²; a displacement of NaN is no measurement. Errors of rotations are in the "
    "world frame, left-multiplied."
)
_MEANINGS = {
    "window": "[accel m/s², gyro rad/s] in the frame of the displacement, context first",
    "displacement": "over the window, m",
    "log_std": "logarithm of the standard deviation of the displacement, m",
    "covariance": "m², of the displacement",
    "gyro": "rad/s, body frame, raw",
    "accel": "m/s², body frame, raw",
    "rotation": "body → world",
    "velocity": "m/s, world",
    "position": "m, world",
    "gyro_bias": "rad/s",
    "accel_bias": "m/s²",
    "offset": "position from the anchor, m, world",
    "anchor": "a past position, m, world",
    "move": "of the anchor, from the one before it, m",
    "lasting": "errors of the displacements that last: window (3), log scale, heading rad",
    "clone_rotation": "of the ring of clones, body → world",
    "clone_offset": "of the ring of clones, from their anchor, m",
    "core_covariance": "of the errors of rotation, velocity, offset, biases, anchor, move, lasting",
    "cross_covariance": "of the core with the clones",
    "clone_covariance": "of the clones' rotations and offsets",
    "step": "clone intervals since the start",
    "samples": "the last ones, [gyro, accel], raw",
    "gate.converged": "χ² gate: it has begun to judge",
    "gate.last_success": "χ² gate: sample of the last measurement that passed; -1: none",
    "gate.pause_end": "χ² gate: sample at which a pause ends",
    "imu.quiet": "clone intervals in a row in which the IMU was quiet",
    "healthy": "false once the filter has diverged: all since is void",
    "accepted": "1 the measurement was used, 0 it was not, NaN there was none",
    "nis": "normalised innovation squared; NaN where there was no measurement",
}
_POSE_COVARIANCE = "of the errors of rotation, velocity, position, gyro_bias, accel_bias"


class Contents(NamedTuple):
    """What a manifest says of one file."""

    content: bytes
    inputs: Mapping[str, jax.ShapeDtypeStruct]
    outputs: Mapping[str, jax.ShapeDtypeStruct]


def describe(files: Mapping[str, Contents]) -> dict[str, Any]:
    """Size, digest, inputs and outputs of each file."""
    return {
        name: {
            **_digest(each.content),
            "inputs": _tensors(each.inputs),
            "outputs": _tensors(each.outputs),
        }
        for name, each in files.items()
    }


def describe_filter(setup: FilterSetup) -> dict[str, Any]:
    """The filter's options as they are exported: they cannot be changed any more."""
    config = setup.config
    return {
        "rate": 1 / config.dt,
        "window": config.window,
        "context": config.context_samples,
        "samples_per_clone": config.samples_per_clone,
        "clones_per_window": config.clones_per_window,
        "first_measured": config.first_measured,
        "samples_per_round": config.samples_per_clone * config.clones,
        "log_std_min": config.log_std_min,
        "filter": {
            "config": dataclasses.asdict(config),
            "noise": _plain(setup.noise),
            "initial_std": _plain(setup.initial_std),
        },
    }


def write_manifest(folder: Path, said: Mapping[str, Any]) -> None:
    """Write `export.json` into the folder of the export."""
    manifest = {
        "format": FORMAT,
        "version": VERSION,
        "made_by": f"gnio-jax {version('gnio-jax')}",
        "conventions": CONVENTIONS,
        **said,
    }
    text = json.dumps(manifest, indent=2, ensure_ascii=False, allow_nan=False)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")


def read_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of an export. Raises `InputError` where there is none."""
    path = Path(folder) / MANIFEST
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(path, f"cannot be read ({error})", "gnio export writes it") from None
    if not isinstance(found, dict) or found.get("format") != FORMAT:
        raise InputError(path, "is not that of an export", "gnio export writes it")
    if found.get("version") != VERSION:
        problem = f"has format version {found.get('version')!r}; this program reads {VERSION}"
        raise InputError(path, problem, "install a newer gnio-jax")
    return found


def read_file(folder: Path, name: str, manifest: Mapping[str, Any]) -> bytes:
    """A file of an export. Raises `InputError` where it is missing or not the one described."""
    path = Path(folder) / name
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror})", "export it again") from None
    if not _digest(content).items() <= manifest["files"].get(name, {}).items():
        problem = "is not the file that export.json describes (SHA-256 differs)"
        raise InputError(path, problem, "export it again")
    return content


def _digest(content: bytes) -> dict[str, Any]:
    return {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}


def _tensors(arrays: Mapping[str, jax.ShapeDtypeStruct]) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "shape": [size if isinstance(size, int) else str(size) for size in each.shape],
            "dtype": str(each.dtype),
            "meaning": _meaning(name),
        }
        for name, each in arrays.items()
    ]


def _meaning(name: str) -> str:
    kind, _, rest = name.partition(".")
    if name == "pose.covariance":
        return _POSE_COVARIANCE
    return _MEANINGS[rest if kind in ("state", "next", "pose") else name]


def _plain(tree: Any) -> Any:
    """NamedTuples of numbers as dictionaries and lists for JSON."""
    if hasattr(tree, "_asdict"):
        return {name: _plain(value) for name, value in tree._asdict().items()}
    if isinstance(tree, tuple | list):
        return [_plain(value) for value in tree]
    return None if tree is None else float(np.asarray(tree))
