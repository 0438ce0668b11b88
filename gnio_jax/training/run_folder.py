"""The folder of a run: its settings, and the recordings that it learns from."""

from __future__ import annotations

import dataclasses
import hashlib
from pathlib import Path
from typing import Any

import jax
import numpy as np
import yaml

from gnio_jax import config as configuration
from gnio_jax.config import TrainConfig
from gnio_jax.errors import InputError
from gnio_jax.files import write_text
from gnio_jax.scaling.processes import is_first, require_same, several

MAY_CHANGE = ("workdir", "data_root", "init_from", "checkpoint_every_seconds")
"""Settings that a resumed run may change: where things lie, not what is computed."""


def prepare(config: TrainConfig, resume: bool) -> Path:
    """The work folder of a run that `config` may start or continue; nothing is written.

    Raises `InputError` for a folder that holds a run already, and with `resume` for one that holds
    none, or one with other settings. Of several processes the first one alone sees the folder.
    """
    workdir = configuration.default_workdir(config)
    if not is_first():
        return workdir
    kept = workdir / "config.yaml"
    if not resume and kept.exists():
        remedy = "continue it with --resume, or choose another --workdir"
        raise InputError(workdir, "already holds a run", remedy)
    if resume and not kept.exists():
        problem = "holds no run to resume (config.yaml is missing)"
        raise InputError(workdir, problem, "start it without --resume")
    if resume:
        _refuse_other_settings(config, kept)
    return workdir


def _refuse_other_settings(config: TrainConfig, kept: Path) -> None:
    ours, theirs = (dataclasses.asdict(c) for c in (config, configuration.load(kept)))
    theirs["data"]["residency"] = ours["data"]["residency"]  # where things lie, too
    for name in ours:
        if name not in MAY_CHANGE and ours[name] != theirs[name]:
            problem = f"'{name}' was {theirs[name]} and is now {ours[name]}"
            raise InputError(kept, problem, "resume with the same settings")


def write_settings(
    workdir: Path, config: TrainConfig, splits: dict[str, list[str]], resume: bool
) -> None:
    """Write config.yaml and splits.yaml of a new run; compare the splits of a resumed one.

    Raises `InputError` when the run was begun with other recordings.
    """
    if not is_first():
        return
    workdir.mkdir(parents=True, exist_ok=True)
    if not resume:
        configuration.save(workdir / "config.yaml", config)
    path = workdir / "splits.yaml"
    if path.exists():
        _refuse_other_recordings(path, splits)
    else:
        write_text(path, yaml.safe_dump(splits, sort_keys=False, allow_unicode=True))


def compare_processes(
    config: TrainConfig, splits: dict[str, list[str]], recordings: Any, variables: Any
) -> None:
    """Raise `InputError` unless all processes have the same settings, recordings and weights to
    begin with: other ones would compute something else, or wait for each other for ever.

    Trees of arrays are compared by their shapes and a sample of their rows.
    """
    if not several():
        return
    settings = bytes.fromhex(identity(config))
    require_same("settings", settings, "start all with the same options, also --config")
    same_data = "give all of them the same data"
    require_same("recordings", _digest(splits), same_data)
    require_same("samples of the same recordings", _digest(_sampled(recordings)), same_data)
    same_run = "give all of them the same run in --init-from"
    require_same("weights to begin with", _digest(_sampled(variables)), same_run)


def identity(config: TrainConfig) -> str:
    """The same for all processes of a run, wherever its files lie for each."""
    settings = {k: v for k, v in dataclasses.asdict(config).items() if k not in MAY_CHANGE}
    return _digest(settings).hex()


def _sampled(tree: Any) -> list[Any]:
    """Shape, and the bytes of some rows, of each array of a tree."""
    leaves = [np.atleast_1d(leaf) for leaf in jax.tree.leaves(tree)]
    return [(leaf.shape, leaf[:: len(leaf) // 999 + 1].tobytes()) for leaf in leaves]


def _digest(value: Any) -> bytes:
    return hashlib.sha256(repr(value).encode()).digest()


def _refuse_other_recordings(path: Path, splits: dict[str, list[str]]) -> None:
    """Hold-outs are drawn from the recordings that a copy of the data holds: those may differ."""
    try:
        before = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        problem = f"cannot be read ({' '.join(str(error).split())})"
        remedy = "remove it, and the recordings are noted anew"
        raise InputError(path, problem, remedy) from None
    for split, names in splits.items():
        theirs = before.get(split) if isinstance(before, dict) else None
        if names != theirs:
            changed = sorted(set(names) ^ set(theirs if isinstance(theirs, list) else []))
            what = f", e.g. {changed[0]}" if changed else ", their order does"
            problem = (
                f"the run was begun with other recordings in split '{split}' "
                f"({len(changed)} differ{what})"
            )
            raise InputError(path, problem, "resume with the same data")
