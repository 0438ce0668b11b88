"""The recordings of a split: lists, folders by their names, held-out people, and folds.

`train+0of4` is the first of four folds of the split `train`, and `train-0of4` is all but that one.
"""

from __future__ import annotations

import hashlib
import os
import re
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from gnio_jax.data.parsing.tables import shorten
from gnio_jax.errors import InputError
from gnio_jax.files import file_in
from gnio_jax.types import Sequence

SEED = 20181130
"""Seed of the hold-outs for validation."""


def find_folders(root: Path, is_recording: Callable[[Path], bool]) -> dict[str, Path]:
    """Name -> folder of every recording anywhere below `root`, including linked folders, because
    archives unpack to folders of many names.

    If several have the same name, the first in alphabetical order is used, with a warning about the
    others.
    """
    recordings: dict[str, Path] = {}
    visited, duplicates = set(), []
    for path, folders, _ in os.walk(root, followlinks=True):
        real, folder = os.path.realpath(path), Path(path)
        matches = is_recording(folder)
        if real in visited or matches:
            folders.clear()
        folders.sort()
        if matches and real not in visited and recordings.setdefault(folder.name, folder) != folder:
            duplicates.append(folder)
        visited.add(real)
    if duplicates:
        problem = f"{len(duplicates)} recordings are there twice, e.g. {duplicates[0]}"
        warnings.warn(f"{root}: {problem}; {recordings[duplicates[0].name]} is used", stacklevel=3)
    return recordings


def find_list(root: Path, name: str) -> Path:
    """The list file `name` at `root`, in its folder `lists`, or else anywhere below; `root / name`
    if there is none."""
    for path in (file_in(root, name), file_in(root / "lists", name)):
        if path.is_file():
            return path
    return next(iter(sorted(root.rglob(name))), root / name)


def hold_out(people: Mapping[str, str], share: float = 0.1, most: float = 0.25) -> set[str]:
    """Names of the recordings for validation, from recording -> person: whole people, in an order
    drawn with a fixed seed.

    People are taken until they have `share` of the recordings; a person with whom the share would
    exceed `most` is skipped. If nobody remains (too few people), whole recordings are taken
    instead, but none of fewer than four. The result depends only on the names.
    """
    for owner in (people, {name: name for name in people}):
        counts = Counter(owner.values())
        order = np.random.default_rng(SEED).permutation(sorted(counts)) if counts else []
        held: set[str] = set()
        for person in order:
            chosen = sum(counts[other] for other in held)
            if chosen < share * len(people) and chosen + counts[str(person)] <= most * len(people):
                held.add(str(person))
        if held:
            return {name for name, person in owner.items() if person in held}
    return set()


def draw_share(seed: str, name: str) -> float:
    """A number from 0 to 1 that depends only on a name, so that splits by it are the same in every
    copy of the data."""
    return int(hashlib.sha256(f"{seed} {name}".encode()).hexdigest()[:8], 16) / 2**32


def read_list(
    path: Path, find: Callable[[str], Path | None], root: Path, layout: str
) -> list[Path]:
    """The recordings that `find` gives for the entries of a list file, one per line: the place of a
    recording, or None if this copy lacks it.

    A warning has the number of absent entries. Raises `InputError` if the list cannot be read or
    names no recording that is present.
    """
    layout = f"expected layout: {layout}"
    path = file_in(path.parent, path.name)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(path, f"the list cannot be read ({reason})", layout) from None
    named = (line.strip() for line in lines if line.strip() and not line.startswith("#"))
    recordings: dict[str, Path | None] = {}
    for entry in named:
        try:
            recordings[entry] = find(entry)
        except OSError:  # for example, the name is too long
            recordings[entry] = None
    absent = [shorten(entry) for entry, recording in recordings.items() if recording is None]
    if len(absent) == len(recordings):
        raise InputError(path, f"none of its {len(recordings)} sequences is below {root}", layout)
    if absent:
        examples = ", ".join([*absent[:3], *(["..."] if len(absent) > 3 else [])])
        problem = f"{len(absent)} of {len(recordings)} listed sequences are absent: {examples}"
        warnings.warn(f"{path}: {problem}", stacklevel=3)
    return [recording for recording in recordings.values() if recording is not None]


# --- folds

_NOTATION = re.compile(r"(.+)([+-])(\d{1,4})of(\d{1,4})")


class Fold(NamedTuple):
    """A fold of a split, or all of the split but that fold."""

    split: str
    number: int
    """Number of the fold, from 0 to `count` − 1."""
    count: int
    left_out: bool

    def select(self, sequences: Iterable[Sequence]) -> list[Sequence]:
        """The split's sequences that belong to the fold. All sequences must be given, because a
        fold depends on the lengths of all. Raises `InputError` if none does, and for a fold without
        a sequence."""
        members = list(sequences)
        fold_of = folds(members, self.count)
        if self.number not in fold_of.values():
            problem = f"has nothing in fold {self.number} of {self.count}"
            remedy = f"there are {len(fold_of)} people or sessions to share; take fewer folds"
            raise InputError(f"split '{self.split}'", problem, remedy)
        chosen = [
            sequence
            for sequence in members
            if (fold_of[group(sequence)] == self.number) != self.left_out
        ]
        if not chosen:
            problem = f"has nothing beside fold {self.number} of {self.count}"
            remedy = f"there are {len(fold_of)} people or sessions to share; take two folds or more"
            remedy = remedy if len(fold_of) > 1 else "it is of one person or session; add others"
            raise InputError(f"split '{self.split}'", problem, remedy)
        return chosen


def parse_fold(split: str) -> Fold | None:
    """The fold that the name of a split describes; None for a split of the dataset itself.

    Raises `InputError` for a fold that does not exist.
    """
    match = _NOTATION.fullmatch(split)
    if match is None:
        return None
    name, sign, number, count = match.groups()
    if not int(number) < int(count):
        last = int(count) - 1
        raise InputError(f"split '{split}'", "has no such fold", f"they are numbered 0 to {last}")
    return Fold(name, int(number), int(count), sign == "-")


def group(sequence: Sequence) -> str:
    """The group of a sequence, within which recordings are not independent: the loader's group,
    else the person, else the sequence itself."""
    attributes = sequence.attributes
    return str(attributes.get("group") or attributes.get("subject") or sequence.name)


def folds(sequences: Iterable[Sequence], count: int) -> dict[str, int]:
    """Group -> its fold, 0 to `count` − 1. The longest group comes first, and each is assigned to
    the fold with the least time so far. The result depends only on names and lengths (ours)."""
    seconds: dict[str, float] = {}
    for sequence in sequences:
        length = float(sequence.time[-1] - sequence.time[0])
        seconds[group(sequence)] = seconds.get(group(sequence), 0.0) + length
    loads, fold_of = [0.0] * count, {}
    for name in sorted(seconds, key=lambda name: (-seconds[name], name)):
        fold_of[name] = min(range(count), key=lambda fold: loads[fold])
        loads[fold_of[name]] += seconds[name]
    return fold_of
