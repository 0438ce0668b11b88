"""Which recordings make a split: lists, folders by their names, and people who are held out."""

from __future__ import annotations

import os
import warnings
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from gnio_jax.data.parsing.tables import shortened
from gnio_jax.errors import InputError

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


def listed(
    path: str | os.PathLike[str], find: Callable[[str], Path | None], root: Path, layout: str
) -> list[Path]:
    """What `find` says of the entries of a list file, one a line: the place of a recording, or None
    where this copy lacks it.

    Absent entries are warned of with their count. Raises `InputError` when the list cannot be read
    or names nothing that is present.
    """
    path = Path(path)
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise InputError(
            path, f"the list cannot be read ({reason})", f"expected layout: {layout}"
        ) from None
    entries = list(
        dict.fromkeys(line.strip() for line in lines if line.strip() and not line.startswith("#"))
    )
    found = {entry: _found(find, entry) for entry in entries}
    present = [place for place in found.values() if place is not None]
    absent = [entry for entry, place in found.items() if place is None]
    if not present:
        raise InputError(
            path,
            f"none of its {len(entries)} sequences is below {root}",
            f"expected layout: {layout}",
        )
    if absent:
        some = ", ".join([*map(shortened, absent[:3]), *(["..."] if len(absent) > 3 else [])])
        warnings.warn(
            f"{path}: {len(absent)} of {len(entries)} listed sequences are absent: {some}",
            stacklevel=3,
        )
    return present


def _found(find: Callable[[str], Path | None], entry: str) -> Path | None:
    try:
        return find(entry)
    except OSError:  # too long for a name, for one
        return None
