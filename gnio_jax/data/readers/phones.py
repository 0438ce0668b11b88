"""What the readers of phone recordings share: finding them, holding people out, velocities."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from gnio_jax.data.alignment import smooth_positions
from gnio_jax.numerics import within
from gnio_jax.types import Sequence

JUMP_SPEED = 6.0
"""m/s: faster than this not a person walks but a visual odometry that relocalises."""

SEED = 20181130
"""Of the hold-outs for validation."""


def find_folders(root: Path, is_recording: Callable[[Path], bool]) -> dict[str, Path]:
    """Name -> folder of every recording anywhere below `root`, links followed: archives unpack to
    folders of many names.

    Of several of one name the first in alphabetical order counts, the others are warned of.
    """
    found: dict[str, Path] = {}
    seen, again = set(), []
    for place, folders, _ in os.walk(root, followlinks=True):
        real = os.path.realpath(place)
        folder = Path(place)
        recording = is_recording(folder)
        if real in seen or recording:
            folders.clear()
        folders.sort()
        if recording and real not in seen:
            if folder.name in found:
                again.append(folder)
            found.setdefault(folder.name, folder)
        seen.add(real)
    if again:
        warnings.warn(
            f"{root}: {len(again)} recordings are there twice, e.g. {again[0]}; "
            f"{found[again[0].name]} is used",
            stacklevel=3,
        )
    return found


def find_list(root: Path, name: str) -> Path:
    """The list file `name` at `root`, in its folder `lists`, or else anywhere below; `root / name`
    where there is none."""
    for place in (root / name, root / "lists" / name):
        if place.is_file():
            return place
    return next(iter(sorted(root.rglob(name))), root / name)


def held_out(people: Mapping[str, str], share: float = 0.1, most: float = 0.25) -> set[str]:
    """Names of the recordings to validate with, from recording -> person: whole people, in an order
    drawn with a fixed seed.

    People are taken until they hold `share` of the recordings; who would bring it above `most` is
    passed over. Where that leaves nobody (too few people), whole recordings are taken instead, and
    none of fewer than four. Depends on the names alone.
    """
    for owner in (people, {name: name for name in people}):
        counts = Counter(owner.values())
        order = np.random.default_rng(SEED).permutation(sorted(counts)) if counts else []
        held: set[str] = set()
        for person in order:
            taken = sum(counts[other] for other in held)
            if taken < share * len(people) and taken + counts[str(person)] <= most * len(people):
                held.add(str(person))
        if held:
            return {name for name, person in owner.items() if person in held}
    return set()


def with_velocity(sequence: Sequence) -> Sequence:
    """`sequence` (on a uniform clock) with the velocity of its smoothed positions; around jumps of
    these it is no longer valid."""
    step = float(np.median(np.diff(sequence.time)))
    fast = np.linalg.norm(np.diff(sequence.position, axis=0), axis=1) > JUMP_SPEED * step
    jumps = np.concatenate([fast, [False]]) | np.concatenate([[False], fast])
    good = sequence.valid & ~within(jumps, max(round(0.1 / step), 1))
    _, velocity, _ = smooth_positions(sequence.position, good, step)
    return sequence._replace(velocity=velocity, valid=good)
