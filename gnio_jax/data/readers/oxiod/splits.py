"""Which walks a split holds: by the authors' lists, or by seeded hold-out of whole sessions."""

from __future__ import annotations

import re
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gnio_jax.data.parsing.tables import shortened
from gnio_jax.data.readers.oxiod.walks import (
    LARGE_SCALE,
    LAYOUT,
    SINGLE_USER,
    UNSEEN,
    Walk,
    scene_folders,
)
from gnio_jax.errors import InputError

SPLITS = (
    "train",
    "val",
    "test",
    "seen",
    "unseen",
    "large_scale",
    "sessions_train",
    "sessions_val",
    "sessions_test",
)
SEED = 20180923
"""Of every hold-out below."""
SHARES = {"train": 0.7, "val": 0.1, "test": 0.2}
"""Of the time, which `share_out` aims at."""
DRAWS = 300


def select(walks: list[Walk], split: str, root: Path) -> list[Walk]:
    """The walks of `split`. Raises `InputError` on a list that is missing or empty."""
    if split == "unseen":
        return [walk for walk in walks if walk.scene in UNSEEN]
    if split == "large_scale":
        return [walk for walk in walks if walk.scene == LARGE_SCALE]
    if split.startswith("sessions_"):
        room = [walk for walk in walks if walk.scene != LARGE_SCALE]
        shares = share_out(room)
        return [walk for walk in room if shares[walk.session] == split.removeprefix("sessions_")]
    single_user = [walk for walk in walks if walk.scene in SINGLE_USER]
    if split in ("test", "seen"):
        return _on_lists(single_user, "Test.txt", root)
    listed = _on_lists(single_user, "Train.txt", root)
    held = held_out_sessions(listed)
    return [walk for walk in listed if (walk.session in held) == (split == "val")]


def _on_lists(walks: list[Walk], name: str, root: Path) -> list[Walk]:
    """The walks that the scenes' lists `name` name."""
    paths = {
        scene: place / name
        for scene in SINGLE_USER
        for place in scene_folders(root, scene)
        if (place / name).is_file()
    }
    if not paths:
        raise InputError(root, f"no scene has its list {name}", f"expected layout: {LAYOUT}")
    chosen: list[Walk] = []
    absent = 0
    for scene, path in paths.items():
        in_scene = [walk for walk in walks if walk.scene == scene]
        for folder, number in _entries(path):
            here = [
                walk
                for walk in in_scene
                if walk.folder == folder and (number is None or walk.number == number)
            ]
            absent += not here
            chosen += [walk for walk in here if walk not in chosen]
    if absent:
        warnings.warn(
            f"{root}: {absent} entries of the lists {name} are not in this copy", stacklevel=2
        )
    return chosen


def _entries(path: Path) -> Iterator[tuple[str, int | None]]:
    """(folder, number) of the lines `dataN` (all its walks: no number) and `dataN/imuK.csv`.

    The last line may lack its end.
    """
    text = path.read_text(encoding="utf-8", errors="replace")
    entries = [line.strip().replace("\\", "/") for line in text.splitlines() if line.strip()]
    if not entries:
        raise InputError(path, "the list is empty", "copy it again")
    for entry in entries:
        match = re.fullmatch(r"(data\d+)(?:/(?:imu)?(\d+)(?:\.csv)?)?", entry)
        if not match:
            raise InputError(
                path,
                f"entry '{shortened(entry)}' is neither dataN nor dataN/imuK.csv",
                "copy the list again",
            )
        yield match[1], None if match[2] is None else int(match[2])


def held_out_sessions(walks: list[Walk], share: float = 0.1) -> set[str]:
    """Whole sessions for validation, drawn with a fixed seed until they hold `share` of the time;
    never the last of a scene."""
    minutes = _minutes(walks)
    sessions = sorted(minutes)
    scenes = {walk.session: walk.scene for walk in walks}
    held: set[str] = set()
    for session in np.random.default_rng(SEED).permutation(sessions):
        left = [
            other
            for other in sessions
            if scenes[other] == scenes[session] and other not in held and other != session
        ]
        if left and sum(minutes[other] for other in held) < share * sum(minutes.values()):
            held.add(str(session))
    return held


def share_out(walks: list[Walk]) -> dict[str, str]:
    """Session -> "train", "val" or "test": of many seeded draws the one nearest to `SHARES`.

    A session is never divided, and every scene keeps one to train on: of two the other tests, of
    three the third validates.
    """
    minutes = _minutes(walks)
    scenes: dict[str, list[str]] = {}
    for walk in sorted(walks, key=lambda walk: walk.session):
        sessions = scenes.setdefault(walk.scene, [])
        if walk.session not in sessions:
            sessions.append(walk.session)
    total = max(sum(minutes.values()), 1e-9)
    generator = np.random.default_rng(SEED)
    best, best_error = {}, np.inf
    for _ in range(DRAWS):
        shares = {}
        for scene in sorted(scenes):
            shares |= _draw(scenes[scene], generator)
        error = 0.0
        for split, wanted in SHARES.items():
            time = sum(length for session, length in minutes.items() if shares[session] == split)
            error += abs(time / total - wanted)
        if error < best_error:
            best, best_error = shares, error
    return best


def _draw(sessions: list[str], generator: np.random.Generator) -> dict[str, str]:
    """One draw of the splits of a scene's sessions."""
    order = [str(session) for session in generator.permutation(sessions)]
    first = dict(zip(order, ("train", "test", "val"), strict=False))
    rest = {
        session: str(generator.choice(["train", "val", "test"], p=[0.8, 0.05, 0.15]))
        for session in order[3:]
    }
    return first | rest


def _minutes(walks: list[Walk]) -> dict[str, float]:
    """Session -> its length."""
    minutes: dict[str, float] = {}
    for walk in walks:
        minutes[walk.session] = minutes.get(walk.session, 0.0) + walk.minutes
    return minutes
