"""Cross-validation: the recordings of a split shared into folds, people and sessions whole.

`train+0of4` is the first of four folds of the split `train`, and `train-0of4` is all but that one.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from typing import NamedTuple

from gnio_jax.errors import InputError
from gnio_jax.types import Sequence

_NOTATION = re.compile(r"(.+)([+-])(\d{1,4})of(\d{1,4})")


class Fold(NamedTuple):
    """A fold of a split, or all of the split but that fold."""

    split: str
    number: int
    """From 0 to `count` − 1."""
    count: int
    left_out: bool

    def select(self, sequences: Iterable[Sequence]) -> list[Sequence]:
        """Those of the split's sequences that belong to it. All must be given: a fold depends on
        the lengths of all. Raises `InputError` for a fold without a sequence."""
        every = list(sequences)
        fold_of = folds(every, self.count)
        if self.number not in fold_of.values():
            problem = f"has nothing in fold {self.number} of {self.count}"
            remedy = f"there are {len(fold_of)} people or sessions to share; take fewer folds"
            raise InputError(f"split '{self.split}'", problem, remedy)
        return [e for e in every if (fold_of[group(e)] == self.number) != self.left_out]


def parse_fold(split: str) -> Fold | None:
    """What the name of a split stands for; None for a split as the dataset has it.

    Raises `InputError` for a fold that is not there.
    """
    found = _NOTATION.fullmatch(split)
    if found is None:
        return None
    name, sign, number, count = found.groups()
    if not int(number) < int(count):
        last = int(count) - 1
        raise InputError(f"split '{split}'", "has no such fold", f"they are numbered 0 to {last}")
    return Fold(name, int(number), int(count), sign == "-")


def group(sequence: Sequence) -> str:
    """Whose recordings are not independent of each other: the loader's group, else the person, else
    each on its own."""
    attributes = sequence.attributes
    return str(attributes.get("group") or attributes.get("subject") or sequence.name)


def folds(sequences: Iterable[Sequence], count: int) -> dict[str, int]:
    """Group -> its fold, 0 to `count` − 1. The longest group comes first, and each goes to the fold
    that has the least time so far; a function of names and lengths alone (ours)."""
    seconds: dict[str, float] = {}
    for sequence in sequences:
        length = float(sequence.time[-1] - sequence.time[0])
        seconds[group(sequence)] = seconds.get(group(sequence), 0.0) + length
    filled, found = [0.0] * count, {}
    for name in sorted(seconds, key=lambda name: (-seconds[name], name)):
        found[name] = min(range(count), key=lambda fold: filled[fold])
        filled[found[name]] += seconds[name]
    return found
