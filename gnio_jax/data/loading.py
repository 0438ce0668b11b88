"""From a dataset's name to its sequences: the recordings of a split are read, through the cache and
by several processes, and checked."""

from __future__ import annotations

import functools
import os
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NoReturn

from gnio_jax.data.dataset import Dataset, RecordingSource, Refusal
from gnio_jax.data.hdf5 import Reading, cache_entry, read_reading, write_reading
from gnio_jax.data.registry import find_root, get
from gnio_jax.data.self_check import check_sequence
from gnio_jax.data.splits import parse_fold
from gnio_jax.data.workers import ProcessDied, in_processes
from gnio_jax.errors import InputError, did_you_mean
from gnio_jax.reporting import Progress, silent
from gnio_jax.types import Sequence

# --- the sequences of a split


class DamagedRecording(UserWarning):
    """A recording is left out, because a file of it is damaged. Where this warning is an error
    (`warnings.simplefilter("error", DamagedRecording)`), the damage is raised instead."""


def load(
    name: str,
    root: str | os.PathLike[str] | None = None,
    split: str = "test",
    workers: int = 1,
    progress: Progress = silent,
    left_out: dict[str, str] | None = None,
) -> list[Sequence]:
    """The sequences of a split of a dataset, validated and self-checked, at its native rate, in the
    order of its recordings. `resample` changes the rate.

    Recordings that are damaged, that cannot be used, or that fail the physical self-check, are left
    out with a warning. Sequences, warnings and errors do not depend on the number of workers.

    Args:
        name: The dataset, one of `names()`.
        root: Its folder; None: `find_root` looks for it.
        split: A split, a fold of one, or all but a fold (`splits.Fold`).
        workers: Number of processes that read the recordings that are slow to read and not in the
            cache yet.
        progress: A function that gets the finished share of these recordings.
        left_out: It gets the reason for each recording that is left out, by its name.

    Raises:
        InputError: The name or the split is unknown, the folder is missing, all recordings are
            damaged, or one is and the split is a fold, which depends on all; two sequences have one
            name, or the split has no sequence.
    """
    return list(load_each(name, root, split, workers, progress, left_out))


def load_each(
    name: str,
    root: str | os.PathLike[str] | None = None,
    split: str = "test",
    workers: int = 1,
    progress: Progress = silent,
    left_out: dict[str, str] | None = None,
) -> Iterator[Sequence]:
    """The sequences of `load` one after another, if together they do not fit into memory.

    Args:
        name: The dataset, one of `names()`.
        root: Its folder; None: `find_root` looks for it.
        split: A split, a fold of one, or all but a fold.
        workers: Number of processes that read.
        progress: A function that gets the finished share.
        left_out: It gets the reason for each recording that is left out.
    """
    fold, (dataset, folder, whole) = parse_fold(split), find_split(name, root, split)
    strict = fold is not None
    sequences = read_split(dataset, folder, whole, workers, progress, left_out, strict)
    return sequences if fold is None else iter(fold.select(sequences))


def find_split(
    name: str, root: str | os.PathLike[str] | None, split: str
) -> tuple[Dataset, Path, str]:
    """The dataset, its folder, and the split that the dataset knows, of which `split` may be a
    fold. Raises `InputError` if one of them does not exist."""
    fold = parse_fold(split)
    split = split if fold is None else fold.split
    dataset = get(name)
    # If lists at the root define the splits, the reader knows them.
    if dataset.list_splits is None:
        check_split(dataset, split, dataset.splits)
    return dataset, find_root(name, root) if dataset.needs_root else Path(root or "."), split


def read_split(
    dataset: Dataset,
    root: Path,
    split: str,
    workers: int = 1,
    progress: Progress = silent,
    left_out: dict[str, str] | None = None,
    strict: bool = False,
) -> Iterator[Sequence]:
    """The sequences of `load_each` for a `Dataset`, which need not be registered. With `strict` the
    first damage is raised."""
    recordings = dataset.recordings(root, split)
    if not recordings:
        refuse_empty_split(dataset, root, split, "sequence")
    reasons = {} if left_out is None else left_out
    names, implausible = set(), []
    damages: dict[str, InputError] = {}
    refused: dict[str, list[str]] = {}  # reason without the file -> all whole lines
    for recording, reading in zip(
        recordings, _read_all(recordings, workers, progress), strict=True
    ):
        for note in reading.notes:
            warnings.warn(note, stacklevel=2)
        for reason in reading.refusals:
            why = reason.partition(": ")[2]
            refused.setdefault(why, []).append(f"{recording.name}: left out: {reason}")
            reasons[recording.name] = reason
        if reading.damage is not None:
            damages[recording.name] = reading.damage
            reasons[recording.name] = str(reading.damage)
        for sequence in map(dataset.with_origin, reading.sequences):
            if sequence.name in names:
                problem = f"two sequences of split '{split}' have the name '{sequence.name}'"
                raise InputError(root, problem, "rename or remove one of them")
            names.add(sequence.name)
            failures = check_sequence(sequence, dataset).failures if dataset.needs_root else ()
            if failures:
                reason = f"the self-check: {'; '.join(failures)}"
                warnings.warn(f"{sequence.name}: left out by {reason}", stacklevel=2)
                implausible.append(sequence.name)
                reasons[sequence.name] = reason
            else:
                yield sequence
        if damages and (strict or names):  # a split of which all is damaged is an error below
            _warn_of_damages(damages, strict)
            damages.clear()
    _warn_of_refusals(refused)
    if damages:
        raise next(iter(damages.values()))
    if not names:
        problem = f"none of the {len(recordings)} recordings of split '{split}' can be used"
        raise InputError(root, problem, "see the warnings above")
    if len(implausible) == len(names):
        problem = f"none of {len(implausible)} sequences passes the physical self-check"
        remedy = "see the warnings above; check units, frames and time offset of the recordings"
        raise InputError(", ".join(implausible[:3]), problem, remedy)


def _warn_of_damages(damages: dict[str, InputError], strict: bool) -> None:
    """Warn of damaged recordings, or raise the first damage."""
    for name, damage in damages.items():
        if strict:
            raise damage
        try:
            warnings.warn(DamagedRecording(f"{name}: left out: {damage}"), stacklevel=3)
        except DamagedRecording:
            raise damage from None


def _warn_of_refusals(refused: dict[str, list[str]]) -> None:
    """Warn once for each reason, with the number of recordings if there are several."""
    for lines in refused.values():
        several = f"{len(lines)} recordings are left out for the same reason, the first: "
        warnings.warn(f"{several if lines[1:] else ''}{lines[0]}", stacklevel=3)


def refuse_empty_split(dataset: Dataset, root: Path, split: str, what: str) -> NoReturn:
    """Raise `InputError` for a split without a sequence or recording (`what`)."""
    problem = f"split '{split}' of dataset '{dataset.name}' holds no {what}"
    raise InputError(root, problem, f"expected layout: {dataset.layout}")


def check_split(dataset: Dataset, split: str, splits: Iterable[str]) -> None:
    """Raise `InputError` unless `split` is one of `splits`."""
    if split not in splits:
        remedy = f"{did_you_mean(split, splits)}known splits: {', '.join(splits)}"
        raise InputError(f"dataset {dataset.name}", f"unknown split '{split}'", remedy)


def _read_all(
    recordings: list[RecordingSource], workers: int, progress: Progress
) -> Iterator[Reading]:
    """The readings of the recordings, in their order.

    Processes read recordings that are slow to read and not in the cache. For quick recordings a
    process and the transfer of their sequences would take longer.
    """
    slow = [
        recording
        for recording in recordings
        if workers > 1 and recording.slow and not _is_cached(recording)
    ]
    readings = in_processes(read_recording, [(recording,) for recording in slow], workers, progress)
    in_pool, died = {id(recording) for recording in slow}, False
    for recording in recordings:
        if id(recording) in in_pool and not died:
            try:
                yield next(readings)
                continue
            except ProcessDied:  # this process reads the remaining ones
                died = True
        yield read_recording(recording)


# --- one recording


def read_recording(recording: RecordingSource) -> Reading:
    """Read a recording, or its fallback if it is refused, through the cache."""
    form: RecordingSource | None = recording
    previous = Reading([])
    while form is not None:
        reading = _read_form(form)
        notes, refusals = previous.notes + reading.notes, previous.refusals
        if reading.damage is not None:
            return reading._replace(notes=notes, refusals=refusals)
        if reading.sequences:
            notes += tuple(f"{recording.name}: {form.form} is used: {why}" for why in refusals)
            attributes = form.attributes
            sequences = [
                sequence._replace(attributes=sequence.attributes | attributes)
                for sequence in reading.sequences
            ]
            return Reading(sequences, notes)
        previous, form = Reading([], notes, refusals + reading.refusals), form.fallback
    return previous


def _read_form(form: RecordingSource) -> Reading:
    """Read a recording in this form, from the cache if it is there."""
    entry, reading = None, Reading([])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            entry = _entry(form)
            if entry is not None and (cached := read_reading(entry)) is not None:
                return cached
            reading = Reading(form.read())
        except Refusal as refusal:
            reading = Reading([], refusals=(str(refusal),))
        except InputError as damage:
            reading = Reading([], damage=damage)
    reading = reading._replace(notes=tuple(str(warning.message) for warning in caught))
    if entry is not None and reading.damage is None:
        write_reading(entry, reading)
    return reading


def _is_cached(form: RecordingSource) -> bool:
    entry = _entry(form)
    return entry is not None and entry.is_file()


def _entry(form: RecordingSource) -> Path | None:
    """The file of this form of a recording in the cache; None for a recording that is quick to
    read, or that names no files, by which a change could be seen."""
    if not form.slow or not form.files:
        return None
    return cache_entry(f"{form.name} {form.form}", (*form.files, *_reader_file(form.read)))


def _reader_file(read: Callable[..., Any]) -> tuple[Path, ...]:
    """The source file of a plugin's reader. Those of the package are part of every entry."""
    while isinstance(read, functools.partial):
        read = read.func
    module = sys.modules.get(read.__module__)
    file = getattr(module, "__file__", None)
    is_ours = read.__module__.partition(".")[0] == __name__.partition(".")[0]
    return () if is_ours or file is None else (Path(file),)
