"""The one way from recordings to sequences: forms and fallback, cache, processes, self-check."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

from gnio_jax.data.cache import cached, is_cached, is_refused
from gnio_jax.data.dataset import Dataset, Recording, Refusal
from gnio_jax.data.plausibility import SelfCheck, check_sequence, each_plausible
from gnio_jax.data.processes import ProcessDied, map_in_processes
from gnio_jax.errors import InputError
from gnio_jax.types import Sequence

# --- one recording


class Reading(NamedTuple):
    """What reading one recording gave. Problems and warnings are values, since they may come from
    another process."""

    sequences: list[Sequence]
    """Empty where the recording cannot be used."""
    notes: tuple[Warning, ...]
    """What the reader warned of, and why another form was used."""
    refusals: tuple[str, ...]
    """Why the recording is of no use, one reason for each of its forms; empty if it is of use."""
    damage: InputError | None
    """What is wrong with its files; None if nothing is."""


def read_recording(recording: Recording) -> Reading:
    """Read a recording, or its fallback where it is refused, through the cache."""
    sequences, damage = [], None
    refusals: list[str] = []
    form: Recording | None = recording
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        while form is not None:
            try:
                sequences = _read_form(form)
                break
            except Refusal as refusal:
                refusals.append(str(refusal))
                form = form.fallback
            except InputError as error:
                damage = error
                break
    notes = [_as_warning(warning) for warning in caught]
    if sequences and form is not None:
        used = f"{recording.name}: {form.form} is used"
        notes += [UserWarning(f"{used}: {reason}") for reason in refusals]
        refusals = []
    return Reading(sequences, tuple(notes), tuple(refusals), damage)


def _as_warning(caught: warnings.WarningMessage) -> Warning:
    message = caught.message
    return message if isinstance(message, Warning) else caught.category(message)


def _read_form(form: Recording) -> list[Sequence]:
    sequences = cached(form.files, form.version, form.read) if form.version else form.read()
    return [
        sequence._replace(attributes=sequence.attributes | form.attributes)
        for sequence in sequences
    ]


def _is_slow(recording: Recording) -> bool:
    """True where sequences must be made that are slow to make, and are not in the cache."""
    if not recording.version:
        return False
    try:
        if is_cached(recording.files, recording.version):
            return False
        refused = is_refused(recording.files, recording.version)
    except InputError:  # a file is gone: reading will say so
        return False
    if not refused:
        return True
    return recording.fallback is not None and _is_slow(recording.fallback)


# --- the recordings of a split


def read_each(
    dataset: Dataset,
    root: Path,
    split: str,
    workers: int = 1,
    progress: Callable[[float], None] = lambda share: None,
) -> Iterator[Sequence]:
    """The sequences of a split, one after another, in the order of its recordings.

    Recordings that are of no use, or fail the physical self-check, are left out with a warning.
    Recordings that are slow to read, and not in the cache, are read by `workers` processes; 1
    starts none. Sequences, warnings and errors do not depend on their number. `progress` is told
    the share of these recordings that is read. Raises `InputError` when a file is damaged, and at
    the end when there was no sequence.
    """
    sequences = _sequences(dataset, root, split, workers, progress)
    return each_plausible(sequences, dataset) if dataset.needs_root else sequences


def _sequences(
    dataset: Dataset, root: Path, split: str, workers: int, progress: Callable[[float], None]
) -> Iterator[Sequence]:
    recordings = dataset.recordings(root, split)
    if not recordings:
        raise InputError(
            root,
            f"split '{split}' of dataset '{dataset.name}' holds no sequence",
            f"expected layout: {dataset.layout}",
        )
    found = False
    readings = _read_all(recordings, workers, progress)
    for recording, reading in zip(recordings, readings, strict=True):
        for note in reading.notes:
            warnings.warn(note, stacklevel=3)  # where `load` was called
        for reason in reading.refusals:
            warnings.warn(f"{recording.name}: left out: {reason}", stacklevel=3)
        if reading.damage is not None:
            raise reading.damage
        found |= bool(reading.sequences)
        yield from reading.sequences
    if not found:
        raise InputError(
            root,
            f"none of the {len(recordings)} recordings of split '{split}' can be used",
            "see the warnings above",
        )


def _read_all(
    recordings: list[Recording], workers: int, progress: Callable[[float], None]
) -> Iterator[Reading]:
    """What reading each of them gave, in their order."""
    # What is quick to read is not worth a process, and the pipe that its sequences come through.
    is_slow = [workers > 1 and _is_slow(recording) for recording in recordings]
    slow = [recording for recording, apart in zip(recordings, is_slow, strict=True) if apart]
    readings = _read_slow(slow, workers, progress)
    for recording, apart in zip(recordings, is_slow, strict=True):
        yield next(readings) if apart else read_recording(recording)


def _read_slow(
    recordings: list[Recording], workers: int, progress: Callable[[float], None]
) -> Iterator[Reading]:
    """Readings by `workers` processes. Where one of them dies, this process reads what is left."""
    done = 0
    try:
        items = [(recording,) for recording in recordings]
        for reading in map_in_processes(read_recording, items, workers, progress):
            done += 1
            yield reading
    except ProcessDied:
        for recording in recordings[done:]:
            done += 1
            progress(done / len(recordings))
            yield read_recording(recording)


# --- finding and checking, for the command line


class Found(NamedTuple):
    """The recordings of one split, or of all."""

    recordings: dict[str, Recording]
    """By name."""
    splits: dict[str, tuple[str, ...]]
    """Split -> the names of its recordings."""
    notes: list[str]
    """What was warned of, and which splits hold nothing."""


def find_recordings(dataset: Dataset, root: Path, wanted: str) -> Found:
    """The recordings of a split, or of every split: "all".

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
    found = Found({}, {}, [])
    mistakes: list[InputError] = []
    reasons: dict[str, list[str]] = {}
    for split in known if wanted == "all" else (wanted,):
        try:
            here = _find_quietly(dataset, root, split, found.notes)
        except InputError as error:
            mistakes.append(error)
            reason = str(error).partition("; expected layout")[0]
            reasons.setdefault(reason, []).append(split)
            continue
        found.splits[split] = tuple(recording.name for recording in here)
        for recording in here:
            found.recordings.setdefault(recording.name, recording)
    if not found.recordings and mistakes:
        # Where a split takes everything, it says best why there is nothing.
        raise mistakes[-1 if "all" in known else 0]
    if not found.recordings:
        raise InputError(
            root,
            f"split '{wanted}' of dataset '{dataset.name}' holds no recording",
            f"expected layout: {dataset.layout}",
        )
    for reason, empty in reasons.items():
        found.notes.append(f"nothing in split {', '.join(empty)}: {reason}")
    return found


def _find_quietly(dataset: Dataset, root: Path, split: str, notes: list[str]) -> list[Recording]:
    """The recordings of a split; what is warned of is added to `notes`, once."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            return dataset.recordings(root, split)
        finally:
            notes += [note for warning in caught if (note := str(warning.message)) not in notes]


class CheckedRecording(NamedTuple):
    """What became of one recording."""

    sequences: list[tuple[Sequence, SelfCheck]]
    """Its sequences, also those that fail the self-check."""
    problem: str
    """Why there are none; empty if there are."""
    notes: tuple[str, ...]
    """What the reader warned of."""


def check_recording(recording: Recording, dataset: Dataset) -> CheckedRecording:
    """Read a recording and check it; what is wrong with it is told, not raised."""
    reading = read_recording(recording)
    problem = ""
    if reading.damage is not None:
        problem = str(reading.damage).removeprefix(f"{recording.name}: ")
    elif not reading.sequences:
        reasons = [reason.removeprefix(f"{recording.name}: ") for reason in reading.refusals]
        problem = "; ".join(reasons) or "no piece of it is long enough"
    return CheckedRecording(
        [(sequence, check_sequence(sequence, dataset)) for sequence in reading.sequences],
        problem,
        tuple(dict.fromkeys(str(note) for note in reading.notes)),
    )
