"""Any number of recordings of different lengths through one program, in bounded memory."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from gnio_jax.filtering.batch import batches, padded_signals
from gnio_jax.scaling.processes import on_host
from gnio_jax.types import Array

AHEAD = 16
"""Batches that are read ahead, so that recordings of like lengths find each other."""
SHORTEST, GROWTH = 16, 1.25
"""Clone intervals of the shortest batch, and the factor to the next length: few lengths, and few
compilations, for any number of recordings; at most a quarter is padding."""


class Recorded(NamedTuple):
    """What the filter starts from and reads of one recording."""

    start: Any
    """A tree of arrays: the state, or what it is made of."""
    gyro: Float[Array, "m 3"]
    accel: Float[Array, "m 3"]


def stream(
    run: Callable[[Any, Array, Array], Any],
    recordings: Iterable[Recorded],
    samples_per_clone: int,
    batch_size: int = 64,
) -> Iterator[Any]:
    """What `run` gives for each recording, in their order; rows of whole clone intervals.

    `run` takes the starts, gyro and accel of `batch_size` recordings, stacked, and gives a tree
    whose leaves lead with (recording, clone interval); e.g. `jax.jit(over_sequences(...))`. Of the
    recordings, and of the results, `AHEAD` batches are in memory at a time. In several processes
    all of them pass the same recordings.
    """
    given = iter(recordings)
    while chunk := list(itertools.islice(given, AHEAD * batch_size)):
        yield from _in_order(run, chunk, samples_per_clone, batch_size)


def _in_order(
    run: Callable[[Any, Array, Array], Any], chunk: list[Recorded], n: int, batch_size: int
) -> Iterator[Any]:
    intervals = [len(each.gyro) // n for each in chunk]
    found: dict[int, Any] = {}
    for batch in batches(intervals, batch_size, _padded):
        members = [chunk[i] for i in batch.members]
        starts = jax.tree.map(lambda *leaves: np.stack(leaves), *(each.start for each in members))
        signals = padded_signals(((each.gyro, each.accel) for each in members), batch.intervals * n)
        results = on_host(run(starts, *signals))
        for place, i in enumerate(dict.fromkeys(batch.members)):
            # A copy: a part would keep the whole batch in memory.
            found[i] = jax.tree.map(
                lambda leaf, p=place, k=intervals[i]: leaf[p, :k].copy(), results
            )
    for i in range(len(chunk)):
        yield found.pop(i)


def _padded(intervals: int) -> int:
    """The length that a batch is padded to."""
    length = SHORTEST
    while length < intervals:
        length = int(GROWTH * length)
    return length
