"""From recordings that were found to sequences: what every loader's `read` shares, and work on many
recordings by many processes."""

from __future__ import annotations

import multiprocessing
import signal
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from gnio_jax.cores import usable_cores
from gnio_jax.data.cache import Refusal
from gnio_jax.data.sequence import (
    LONGEST_BRIDGE,
    WINDOW_SECONDS,
    Dataset,
    Recording,
    SelfCheck,
    judge,
    keep_plausible,
    stretches,
)
from gnio_jax.types import InputError, Sequence

Result = TypeVar("Result")

FEW = 8
"""Recordings up to here are quicker read than processes are started."""


def single(name: str, read: Callable[..., Sequence], *arguments: Any, **options: Any) -> Recording:
    """The recording that is one sequence, `read(*arguments, **options)`."""
    return Recording(name, partial(_alone, partial(read, *arguments, **options)))


def _alone(read: Callable[[], Sequence]) -> list[Sequence]:
    return [read()]


STAMP_ROUNDING = 1e-6
"""s: what float64 leaves of differences of unix stamps, and more."""


def divide(sequence: Sequence, source: object) -> list[Sequence]:
    """The pieces of a recording (on its native stamps) between gaps longer than a window.

    Each piece is a sequence of its own, since a filter integrates whatever lies between its first
    and its last sample. They share `group`, so that splits and intervals take them as one. A piece
    that holds no window with a valid reference is lost; a warning names what was kept and what was
    lost. Where one piece is left it keeps the recording's name, of several each has a number.
    Raises `Refusal` when none is left.
    """
    time, parts = sequence.time, stretches(sequence.time)
    if len(parts) == 1:
        return [sequence]
    first = np.array([time[part.start] for part in parts])
    last = np.array([time[part.stop - 1] for part in parts])
    gaps, seconds = first[1:] - last[:-1], last - first
    whole = [_longest_valid(time[part], sequence.valid[part]) for part in parts]
    kept = [k for k, longest in enumerate(whole) if longest >= WINDOW_SECONDS - STAMP_ROUNDING]
    problem = (
        f"field 'time' has gaps longer than {WINDOW_SECONDS:g} s ({len(gaps)}, "
        f"up to {gaps.max():.1f} s)"
    )
    if not kept:
        raise Refusal(
            source,
            f"{problem}, and no piece between them holds a window with a reference",
            "leave it out",
        )
    names = {k: f"{sequence.name}_piece{number}" for number, k in enumerate(kept, 1)}
    if len(kept) == 1:
        names[kept[0]] = sequence.name
    held = ", ".join(f"{name} ({first[k]:.1f} to {last[k]:.1f} s)" for k, name in names.items())
    short = seconds.sum() - seconds[kept].sum()
    lost = f"{gaps.sum():.1f} s in gaps"
    if len(kept) < len(parts):
        lost += f", {short:.1f} s in pieces without a whole window"
    warnings.warn(
        f"{source}: {problem}; kept: {seconds[kept].sum():.1f} of {last[-1] - first[0]:.1f} s, "
        f"{held}; lost: {lost}",
        stacklevel=2,
    )
    return [_piece(sequence, names[k], parts[k]) for k in kept]


def _piece(sequence: Sequence, name: str, part: slice) -> Sequence:
    fields = {
        field: value[part]
        for field, value in sequence._asdict().items()
        if isinstance(value, np.ndarray)
    }
    begin = float(sequence.time[part.start])
    attributes = dict(sequence.attributes)
    if "start_time" in attributes:
        attributes["start_time"] += begin
    return sequence._replace(
        **fields | {"name": name, "time": fields["time"] - begin, "attributes": attributes}
    )


def _longest_valid(time: np.ndarray, valid: np.ndarray) -> float:
    """Seconds of the longest run of valid samples, as `resample` will leave it."""
    joined = valid[1:] & valid[:-1] & (np.diff(time) <= LONGEST_BRIDGE)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], joined, [False]])))
    runs = time[edges[1::2]] - time[edges[::2]]
    return float(runs.max()) if runs.size else 0.0


def read_all(dataset: Dataset, root: Path, split: str) -> list[Sequence]:
    """The sequences of a split; those that are of no use or fail the physical self-check are named
    in a warning and left out.

    Raises `InputError` when a file is damaged or no sequence is left.
    """
    found = dataset.recordings(root, split)
    sequences = []
    for recording in found:
        try:
            sequences += recording.read()
        except Refusal as refusal:
            warnings.warn(f"{recording.name}: left out: {refusal}", stacklevel=2)
    if not sequences:
        raise InputError(
            root,
            f"none of the {len(found)} recordings of split '{split}' can be used",
            "see the warnings above",
        )
    return keep_plausible(
        sequences, dataset.pedestrian, dataset.min_correlation, dataset.needs_reference
    )


def in_splits(
    dataset: Dataset, root: Path, wanted: str
) -> tuple[dict[str, Recording], dict[str, tuple[str, ...]], list[str]]:
    """(recordings by name, the names of each split, what could not be found and was warned of) of a
    split, or of every split: "all".

    A dataset's own split of that name is every recording below the root. Raises `InputError` on an
    unknown split, or when none of the splits holds a recording.
    """
    known = dataset.splits_at(root)
    if wanted != "all" and wanted not in known:
        raise InputError(
            f"dataset {dataset.name}",
            f"unknown split '{wanted}'",
            f"known splits: {', '.join(known)}, all",
        )
    found: dict[str, Recording] = {}
    splits: dict[str, tuple[str, ...]] = {}
    notes: list[str] = []
    mistakes: list[InputError] = []
    reasons: dict[str, list[str]] = {}
    for split in known if wanted == "all" else (wanted,):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                here = dataset.recordings(root, split)
            except InputError as error:
                mistakes.append(error)
                reasons.setdefault(str(error).partition("; expected layout")[0], []).append(split)
                continue
            finally:
                notes += [note for warning in caught if (note := str(warning.message)) not in notes]
        splits[split] = tuple(recording.name for recording in here)
        for recording in here:
            found.setdefault(recording.name, recording)
    if not found and mistakes:
        raise mistakes[
            -1 if "all" in known else 0
        ]  # where a split takes everything, it says best why there is nothing
    if not found:
        raise InputError(
            root,
            f"split '{wanted}' of dataset '{dataset.name}' holds no recording",
            f"expected layout: {dataset.layout}",
        )
    return (
        found,
        splits,
        [
            *notes,
            *(
                f"nothing in split {', '.join(empty)}: {reason}"
                for reason, empty in reasons.items()
            ),
        ],
    )


class Examined(NamedTuple):
    """What became of one recording."""

    sequences: list[tuple[Sequence, SelfCheck]]
    """Its sequences, also those that fail the self-check."""
    problem: str
    """Why there are none; empty if there are."""
    notes: tuple[str, ...]
    """What the loader warned of."""


def examine(recording: Recording, dataset: Dataset) -> Examined:
    """Read a recording and check it; what is wrong with it is told, not raised."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        sequences, problem = [], ""
        try:
            sequences = recording.read()
            if not sequences:
                problem = "no piece of it is long enough"
        except InputError as error:
            problem = str(error).removeprefix(f"{recording.name}: ")
        checked = [
            (
                sequence,
                judge(
                    sequence, dataset.pedestrian, dataset.min_correlation, dataset.needs_reference
                ),
            )
            for sequence in sequences
        ]
    return Examined(
        checked, problem, tuple(dict.fromkeys(str(warning.message) for warning in caught))
    )


def each(
    function: Callable[..., Result],
    items: list[tuple],
    workers: int | None = None,
    done: Callable[[float], None] = lambda share: None,
) -> Iterator[Result]:
    """`function(*item)` of every item, in their order, by `workers` processes (None: as many as
    there are cores, if it is worth it).

    `done` is told the share that is finished. Function and items must survive pickling when there
    is more than one process.
    """
    count = usable_cores() if workers is None else workers
    count = 1 if workers is None and len(items) <= FEW else min(count, len(items))
    if count <= 1:
        for index, item in enumerate(items):
            yield function(*item)
            done((index + 1) / len(items))
        return
    # Processes are spawned: a fork after JAX has started its threads can hang.
    context = multiprocessing.get_context("spawn")
    # Ctrl-C is this process's to answer.
    with ProcessPoolExecutor(
        count,
        mp_context=context,
        initializer=signal.signal,
        initargs=(signal.SIGINT, signal.SIG_IGN),
    ) as pool:
        futures = [pool.submit(function, *item) for item in items]
        try:
            for finished, _ in enumerate(as_completed(futures), 1):
                done(finished / len(items))
            for future in futures:
                yield future.result()
        except BrokenProcessPool:
            raise InputError(
                "--workers", "a process died, perhaps for want of memory", "try --workers 1"
            ) from None
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
