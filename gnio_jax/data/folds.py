"""Cross-validation: recordings shared into folds, people and sessions whole."""

from __future__ import annotations

from collections.abc import Iterable

from gnio_jax.types import Sequence


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
