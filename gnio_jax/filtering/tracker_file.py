"""A tracker in a file: all but the network, written whole or not at all, read back to the bit."""

from __future__ import annotations

import dataclasses
import json
import os
import zipfile
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from gnio_jax.config import ConsideredStd, InitialStd, NoiseModel
from gnio_jax.errors import InputError
from gnio_jax.files import replacing
from gnio_jax.filtering.clock import Clock
from gnio_jax.filtering.config import FilterConfig
from gnio_jax.filtering.inputs import checked_noise
from gnio_jax.filtering.intake import Intake, SampleRun, checked_design
from gnio_jax.filtering.online import (
    GRID_COLUMNS,
    TrackerCore,
    TrackerSettings,
    TrackerState,
    core_shapes,
)
from gnio_jax.filtering.pose import POSE_LENGTH

_FORMAT = "gnio-jax tracker 4"
_DAMAGED = "it is damaged"

Arrays = dict[str, np.ndarray]


def save_tracker(
    path: str | os.PathLike[str], settings: TrackerSettings, state: TrackerState
) -> None:
    """Write an .npz file: numbers as JSON in `about`, all else as arrays."""
    arrays: Arrays = {"pending": state.pending}
    if state.core is not None and state.latest is not None:
        core = {name: np.asarray(leaf) for name, leaf in _named_leaves(state.core).items()}
        arrays |= {"latest": state.latest, **core}
    intake, run = None, None
    if state.intake is not None:
        run = state.intake.run
        intake = state.intake._asdict() | {"run": None if run is None else run.first}
    if run is not None:
        arrays |= {"stamps": run.stamps, "samples": run.samples}
    about = {
        "format": _FORMAT,
        "config": dataclasses.asdict(settings.config),
        "noise": _numbers(settings.noise),
        "hole": settings.design.hole,
        "rest": settings.rest,
        "std": list(settings.std),
        "dtype": settings.dtype.name,
        "clock": None if state.clock is None else state.clock._asdict(),
        "imu_rate": settings.design.imu_rate,
        "intake": intake,
    }
    if settings.considered is not None:
        about["considered"] = list(settings.considered)
    arrays["about"] = np.array(json.dumps(about))
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]


def load_tracker(
    path: str | os.PathLike[str], config: FilterConfig, noise: NoiseModel
) -> tuple[TrackerSettings, TrackerState]:
    """What `save_tracker` wrote. Raises `InputError` for a file that is damaged or of another
    config or noise."""
    path = Path(path)
    about, arrays = _read(path)
    _check_same(path, "FilterConfig", about["config"], dataclasses.asdict(config))
    _check_same(path, "NoiseModel", about["noise"], _numbers(noise))
    dtype = np.dtype(about["dtype"])
    settings = TrackerSettings(
        config=config,
        noise=checked_noise(noise, dtype),
        design=checked_design(config.dt, about["hole"], about["imu_rate"]),
        dtype=dtype,
        rest=about["rest"],
        std=InitialStd(*about["std"]),
        considered=ConsideredStd(*about["considered"]) if "considered" in about else None,
    )
    shapes = core_shapes(settings) if "latest" in arrays else None
    _check_arrays(path, arrays, _wanted_arrays(about, arrays, dtype, shapes))
    _check_pending(path, arrays["pending"], settings, started=shapes is not None)
    state = TrackerState(
        core=None if shapes is None else _core(arrays, shapes),
        latest=arrays.get("latest"),
        pending=arrays["pending"],
        clock=_clock(about["clock"]),
        intake=_intake(about["intake"], arrays),
    )
    return settings, state


class _Like(NamedTuple):
    """What an array in the file must be."""

    shape: tuple[int, ...]
    dtype: Any


def _wanted_arrays(
    about: dict[str, Any], arrays: Arrays, dtype: np.dtype, shapes: TrackerCore | None
) -> dict[str, _Like]:
    """The arrays that a file with this `about` holds; the lengths of lists are the file's own."""
    wanted = {"pending": _Like((len(arrays.get("pending", ())), GRID_COLUMNS), dtype)}
    if about["intake"] is not None and about["intake"]["run"] is not None:
        kept = len(arrays.get("stamps", ()))
        wanted["stamps"] = _Like((kept,), np.float64)
        wanted["samples"] = _Like((kept, 6), np.float64)
    if shapes is not None:
        wanted["latest"] = _Like((POSE_LENGTH,), dtype)
        for name, leaf in _named_leaves(shapes).items():
            wanted[name] = _Like(leaf.shape, leaf.dtype)
    return wanted


def _check_same(path: Path, what: str, saved: dict[str, Any], given: dict[str, Any]) -> None:
    for name in sorted(saved.keys() | given.keys()):
        if saved.get(name) != given.get(name):
            raise InputError(
                path,
                f"was saved with {what}.{name} = {saved.get(name)!r}, not {given.get(name)!r}",
                "restore it with the settings it was saved with",
            )


def _check_arrays(path: Path, arrays: Arrays, wanted: dict[str, _Like]) -> None:
    for name, like in wanted.items():
        found = arrays.get(name)
        if found is None or found.shape != like.shape or found.dtype != like.dtype:
            expected = f"{np.dtype(like.dtype)} of shape {like.shape}"
            raise InputError(path, f"its array '{name}' is missing or not {expected}", _DAMAGED)


def _check_pending(
    path: Path, pending: np.ndarray, settings: TrackerSettings, started: bool
) -> None:
    """There are never as many as make a clone step, or the start."""
    n = settings.config.samples_per_clone
    if len(pending) >= (n if started else settings.rest):
        raise InputError(path, f"holds {len(pending)} samples of an interval of {n}", _DAMAGED)


def _core(arrays: Arrays, shapes: TrackerCore) -> TrackerCore:
    leaves = [jnp.array(arrays[name]) for name in _named_leaves(shapes)]
    return jax.tree.unflatten(jax.tree.structure(shapes), leaves)


def _clock(saved: dict[str, Any] | None) -> Clock | None:
    return None if saved is None else Clock(**(saved | {"sample": tuple(saved["sample"])}))


def _intake(saved: dict[str, Any] | None, arrays: Arrays) -> Intake | None:
    if saved is None:
        return None
    first = saved["run"]
    run = None if first is None else SampleRun(first, arrays["stamps"], arrays["samples"])
    return Intake(**(saved | {"run": run}))


def _named_leaves(core: TrackerCore) -> dict[str, Any]:
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): leaf
        for path, leaf in jax.tree_util.tree_leaves_with_path(core)
    }


def _numbers(noise: NoiseModel) -> dict[str, float]:
    return {
        jax.tree_util.keystr(path, simple=True, separator="."): float(value)
        for path, value in jax.tree_util.tree_leaves_with_path(noise)
    }


def _read(path: Path) -> tuple[dict[str, Any], Arrays]:
    damaged = ValueError, KeyError, AttributeError, EOFError, zipfile.BadZipFile
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        about = json.loads(str(arrays.pop("about")))
    except FileNotFoundError:
        raise InputError(path, "no such file", "write one with Tracker.save") from None
    except OSError as error:
        raise InputError(path, f"cannot be read ({error.strerror or error})") from None
    except damaged:
        raise InputError(path, "is no file of Tracker.save, or damaged", "write it again") from None
    if not isinstance(about, dict) or about.get("format") != _FORMAT:
        raise InputError(path, f"is not a '{_FORMAT}' file", "write it again with this version")
    return about, arrays
