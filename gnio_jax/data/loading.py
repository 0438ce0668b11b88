"""From a dataset's name to its sequences: find the recordings, read them (through the cache, by
several processes), check them, and write them in the package's own form."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import warnings
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from pathlib import Path
from typing import NamedTuple, TypeVar

from gnio_jax.cores import usable_cores
from gnio_jax.data.dataset import Dataset, Recording, Refusal, find_root, get
from gnio_jax.data.hdf5 import Reading, cache_entry, read_reading, write_hdf5, write_reading
from gnio_jax.data.resampling import resample
from gnio_jax.data.self_check import SelfCheck, check_sequence
from gnio_jax.data.splits import parse_fold
from gnio_jax.errors import InputError, did_you_mean
from gnio_jax.files import file_stem, replacing_folder, write_text
from gnio_jax.types import Sequence

Result = TypeVar("Result")
Progress = Callable[[float], None]
"""Called with the share that is done."""

FEW = 8
"""Recordings up to here are quicker read than processes are started."""
CONVERSION = "conversion.json"
"""File that says what a converted folder was made of."""


# --- the sequences of a split


def load(
    name: str,
    root: str | os.PathLike[str] | None = None,
    split: str = "test",
    workers: int = 1,
    progress: Progress = lambda share: None,
) -> list[Sequence]:
    """The sequences of a split of a dataset, validated and self-checked, at its native rate
    (`resample` changes that), in the order of its recordings. A split may be a fold, or all but a
    fold (see `splits.Fold`).

    Recordings that are of no use, or fail the physical self-check, are left out with a warning.
    With `workers` > 1 that many processes read the recordings that are slow to read and not in the
    cache yet; a script that asks for them needs its `if __name__ == "__main__"`. Sequences,
    warnings and errors do not depend on their number. `progress` is told the share of these
    recordings that is read. Raises `InputError` on an unknown name or split, a missing folder, a
    damaged file, two sequences of one name, or a split without a sequence.
    """
    return list(load_each(name, root, split, workers, progress))


def load_each(
    name: str,
    root: str | os.PathLike[str] | None = None,
    split: str = "test",
    workers: int = 1,
    progress: Progress = lambda share: None,
) -> Iterator[Sequence]:
    """The sequences of `load` one after another, for those that do not fit the memory together."""
    fold = parse_fold(split)
    if fold is not None:
        return iter(fold.select(load_each(name, root, fold.split, workers, progress)))
    dataset = get(name)
    # Where lists at the root name the splits, the reader knows them.
    if split not in dataset.splits and dataset.list_splits is None:
        known = f"known splits: {', '.join(dataset.splits)}"
        remedy = did_you_mean(split, dataset.splits) + known
        raise InputError(f"dataset {name}", f"unknown split '{split}'", remedy)
    folder = find_root(name, root) if dataset.needs_root else Path(root or ".")
    return read_split(dataset, folder, split, workers, progress)


def read_split(
    dataset: Dataset,
    root: Path,
    split: str,
    workers: int = 1,
    progress: Progress = lambda share: None,
) -> Iterator[Sequence]:
    """`load_each` of a dataset that is at hand."""
    recordings = dataset.recordings(root, split)
    if not recordings:
        problem = f"split '{split}' of dataset '{dataset.name}' holds no sequence"
        raise InputError(root, problem, f"expected layout: {dataset.layout}")
    read_any, names, left_out = False, set(), []
    for recording, reading in zip(
        recordings, _read_all(recordings, workers, progress), strict=True
    ):
        for note in reading.notes:
            warnings.warn(note, stacklevel=2)
        for reason in reading.refusals:
            warnings.warn(f"{recording.name}: left out: {reason}", stacklevel=2)
        if reading.damage is not None:
            raise reading.damage
        for sequence in reading.sequences:
            read_any = True
            if sequence.name in names:
                problem = f"two sequences of split '{split}' have the name '{sequence.name}'"
                raise InputError(root, problem, "rename or remove one of them")
            names.add(sequence.name)
            failures = check_sequence(sequence, dataset).failures if dataset.needs_root else ()
            if failures:
                text = f"{sequence.name}: left out by the self-check: {'; '.join(failures)}"
                warnings.warn(text, stacklevel=2)
                left_out.append(sequence.name)
            else:
                yield sequence
    if not read_any:
        problem = f"none of the {len(recordings)} recordings of split '{split}' can be used"
        raise InputError(root, problem, "see the warnings above")
    if len(left_out) == len(names):
        raise InputError(
            ", ".join(left_out[:3]),
            f"none of {len(left_out)} sequences passes the physical self-check",
            "see the warnings above; check units, frames and time offset of the recordings",
        )


def _read_all(recordings: list[Recording], workers: int, progress: Progress) -> Iterator[Reading]:
    """The reading of each of them, in their order."""
    # What is quick to read is not worth a process, and the pipe that its sequences come through.
    slow = [each for each in recordings if workers > 1 and _must_be_made(each)]
    readings = _read_slow(slow, workers, progress)
    waiting = iter(slow)
    following = next(waiting, None)
    for recording in recordings:
        if recording is following:
            yield next(readings)
            following = next(waiting, None)
        else:
            yield read_recording(recording)


def _read_slow(recordings: list[Recording], workers: int, progress: Progress) -> Iterator[Reading]:
    """Readings by `workers` processes. Where one of them dies, this process reads what is left."""
    done = 0
    try:
        items = [(recording,) for recording in recordings]
        for reading in in_processes(read_recording, items, workers, progress):
            done += 1
            yield reading
    except ProcessDied:
        for number, recording in enumerate(recordings[done:], done + 1):
            progress(number / len(recordings))
            yield read_recording(recording)


# --- one recording


def read_recording(recording: Recording) -> Reading:
    """Read a recording, or its fallback where it is refused, through the cache."""
    form: Recording | None = recording
    refusals: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    while form is not None:
        found = _read_form(form)
        notes += found.notes
        if found.damage is not None:
            return Reading([], notes, refusals, found.damage)
        if found.sequences:
            used = f"{recording.name}: {form.form} is used"
            sequences = [
                each._replace(attributes=each.attributes | form.attributes)
                for each in found.sequences
            ]
            return Reading(sequences, notes + tuple(f"{used}: {reason}" for reason in refusals))
        refusals += found.refusals
        form = form.fallback
    return Reading([], notes, refusals)


def _read_form(form: Recording) -> Reading:
    """Read a recording in this form, from the cache where it is there."""
    entry, reading = None, Reading([])
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            if form.slow:
                entry = cache_entry(f"{form.name} {form.form}", form.files)
                if (kept := read_reading(entry)) is not None:
                    return kept
            reading = Reading(form.read())
        except Refusal as refusal:
            reading = Reading([], refusals=(str(refusal),))
        except InputError as damage:
            reading = Reading([], damage=damage)
    reading = reading._replace(notes=tuple(str(each.message) for each in caught))
    if entry is not None and reading.damage is None:
        write_reading(entry, reading)
    return reading


def _must_be_made(recording: Recording) -> bool:
    """Whether reading is slow: its sequences are not in the cache."""
    if not recording.slow:
        return False
    try:
        return not cache_entry(f"{recording.name} {recording.form}", recording.files).is_file()
    except InputError:  # a file is gone: reading will say so
        return False


# --- processes


class ProcessDied(InputError):
    """A process ended without a word; most often the system has run out of memory."""


def in_processes(
    function: Callable[..., Result],
    items: list[tuple],
    workers: int | None,
    progress: Progress = lambda share: None,
) -> Iterator[Result]:
    """`function(*item)` for every item, in their order, by `workers` processes; 1 starts none, and
    None asks for as many as are worth starting.

    At most `workers` + 2 results are under way or wait, so that memory stays bounded. `progress` is
    told the share that is finished. Function and items must survive pickling when there is more
    than one process. Raises `ProcessDied`.
    """
    if workers is None:
        workers = usable_cores() if len(items) > FEW else 1
    workers = min(workers, len(items))
    if workers <= 1:
        for number, item in enumerate(items, 1):
            result = function(*item)
            progress(number / len(items))
            yield result
        return
    # Processes are spawned: a fork after JAX has started its threads can hang. Ctrl-C is this
    # process's to answer.
    pool = ProcessPoolExecutor(
        workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=signal.signal,
        initargs=(signal.SIGINT, signal.SIG_IGN),
    )

    def submit(item: tuple) -> Future[Result]:
        try:
            return pool.submit(function, *item)
        except OSError as error:
            # A process that dies while the next one is started closes the pipes between them, and
            # Python meets a closed pipe.
            raise BrokenProcessPool(str(error)) from error

    with pool:
        try:
            left, waiting = iter(items), deque[Future[Result]]()
            for number in range(1, len(items) + 1):
                waiting.extend(map(submit, islice(left, workers + 2 - len(waiting))))
                result = waiting.popleft().result()
                progress(number / len(items))
                yield result
        except BrokenProcessPool:
            problem = "a process died, perhaps for want of memory"
            raise ProcessDied("--workers", problem, "try --workers 1") from None
        finally:
            pool.shutdown(wait=False, cancel_futures=True)


# --- the recordings of a whole dataset: finding and checking


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
        problem, remedy = f"unknown split '{wanted}'", f"known splits: {', '.join(known)}, all"
        raise InputError(f"dataset {dataset.name}", problem, remedy)
    found = Found({}, {}, [])
    mistakes: list[InputError] = []
    empty: dict[str, list[str]] = {}
    for split in known if wanted == "all" else (wanted,):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                here = dataset.recordings(root, split)
                found.splits[split] = tuple(recording.name for recording in here)
                for recording in here:
                    found.recordings.setdefault(recording.name, recording)
            except InputError as error:
                mistakes.append(error)
                reason = str(error).partition("; expected layout")[0]
                empty.setdefault(reason, []).append(split)
        texts = [str(each.message) for each in caught]
        found.notes.extend(dict.fromkeys(text for text in texts if text not in found.notes))
    if not found.recordings and mistakes:
        # Where a split takes everything, it says best why there is nothing.
        raise mistakes[-1 if "all" in known else 0]
    if not found.recordings:
        problem = f"split '{wanted}' of dataset '{dataset.name}' holds no recording"
        raise InputError(root, problem, f"expected layout: {dataset.layout}")
    for reason, splits in empty.items():
        found.notes.append(f"nothing in split {', '.join(splits)}: {reason}")
    return found


class Checked(NamedTuple):
    """The self-check of one sequence, or why a recording has none."""

    name: str
    splits: tuple[str, ...]
    """That it is in; "all" is named where there is no other."""
    check: SelfCheck | None
    """None where it could not be read."""
    reason: str
    """Why it is left out; empty where it is used."""


def check(
    dataset: Dataset,
    root: Path,
    split: str = "all",
    pictures: Path | None = None,
    workers: int | None = 1,
    progress: Progress = lambda share: None,
) -> tuple[list[Checked], list[str]]:
    """Read every recording of a split (or of all) and check it: the sequences, and notes of the
    readers and on what could not be found.

    `pictures` is a folder for a picture of each. `workers` processes share the work.
    """
    recordings, splits, notes = find_recordings(dataset, root, split)
    items = [(recording, dataset, pictures) for recording in recordings.values()]
    checked = []
    for name, (rows, told) in zip(
        recordings, in_processes(_check_and_draw, items, workers, progress), strict=True
    ):
        own = [each for each, names in splits.items() if name in names]
        own = [each for each in own if each != "all" or len(own) == 1]
        checked += [Checked(row.name, tuple(own), row.check, row.reason) for row in rows]
        notes += [note for note in told if note not in notes]
    return checked, notes


def _check_and_draw(
    recording: Recording, dataset: Dataset, pictures: Path | None
) -> tuple[list[Checked], tuple[str, ...]]:
    """The rows of one recording, without its splits, and the reader's notes."""
    rows, reading = check_recording(recording, dataset)
    if pictures is not None:
        from gnio_jax.data.pictures import overview, save  # Matplotlib takes a second to import

        for sequence, row in zip(reading.sequences, rows, strict=False):
            assert row.check is not None
            save(pictures / f"{file_stem(sequence.name)}.png", overview(sequence, row.check))
    return rows, reading.notes


def check_recording(recording: Recording, dataset: Dataset) -> tuple[list[Checked], Reading]:
    """Read a recording and check its sequences; what is wrong with it is reported, not raised."""
    reading = read_recording(recording)
    checks = [(sequence.name, check_sequence(sequence, dataset)) for sequence in reading.sequences]
    rows = [Checked(name, (), check, "; ".join(check.failures)) for name, check in checks]
    if not rows:
        reasons = [str(reading.damage)] if reading.damage is not None else [*reading.refusals]
        reasons = [reason.removeprefix(f"{recording.name}: ") for reason in reasons]
        reason = "; ".join(reasons) or "no segment of it is long enough"
        rows = [Checked(recording.name, (), None, reason)]
    return rows, reading


# --- any dataset as the package's HDF5


class Converted(NamedTuple):
    """What became of a dataset."""

    sequences: dict[str, list[str]]
    """Split -> stems of its files."""
    files: int
    hours: float
    left_out: dict[str, str]
    """Sequence -> reason."""
    notes: list[str]


def convert(
    dataset: Dataset,
    root: Path,
    out: Path,
    split: str = "all",
    rate: float | None = None,
    workers: int | None = 1,
    progress: Progress = lambda share: None,
) -> Converted:
    """Write the sequences that pass the self-check as one file each, and the list of each split.

    The folder `out` is written whole or not at all. It must be new or empty, or hold an earlier
    conversion of the same recordings with the same settings, which is then replaced. `rate`: Hz,
    None keeps each recording's own. `workers` processes share the work. Raises `InputError` when
    `out` holds anything else, two recordings would be one file, or none can be used.
    """
    settings = {"dataset": dataset.name, "split": split, "rate": rate}
    if dataset.needs_root:
        settings["root"] = str(root.resolve())
    _check_target(out, settings)
    recordings, splits, notes = find_recordings(dataset, root, split)
    first: dict[str, str] = {}
    for name in recordings:
        if (other := first.setdefault(file_stem(name), name)) != name:
            problem = f"'{other}' and '{name}' would be one file, {file_stem(name)}.h5"
            raise InputError(root, problem, "rename one of them")
    stems, left_out, hours = {}, {}, 0.0
    with replacing_folder(out) as folder:
        items = [(recording, dataset, folder, rate) for recording in recordings.values()]
        for name, (rows, told) in zip(
            recordings, in_processes(_convert, items, workers, progress), strict=True
        ):
            used = [row for row in rows if not row.reason]
            stems[name] = [file_stem(row.name) for row in used]
            left_out |= {row.name: row.reason for row in rows if row.reason}
            hours += sum(row.check.duration for row in used if row.check) / 3600.0
            notes += [note for note in told if note not in notes]
        if not any(stems.values()):
            problem = f"none of {len(recordings)} recordings can be used"
            raise InputError(root, problem, "; ".join(list(left_out.values())[:3]))
        lists = {
            each: [stem for name in names for stem in stems[name]] for each, names in splits.items()
        }
        for each, files in lists.items():
            if files:
                write_text(folder / f"{each}.txt", "".join(f"{stem}\n" for stem in files))
            else:
                problem = f"none of its {len(splits[each])} recordings can be used"
                notes.append(f"split '{each}' has no list: {problem}")
        write_text(folder / CONVERSION, json.dumps(settings, indent=2) + "\n")
    return Converted(lists, sum(map(len, stems.values())), hours, left_out, notes)


def _check_target(out: Path, settings: dict) -> None:
    """Raise `InputError` where a conversion must not be written to `out`."""
    if out.exists() and not out.is_dir():
        raise InputError(out, "is a file", "name a folder")
    if "root" in settings and str(out.resolve()) == settings["root"]:
        raise InputError(out, "is the folder that is read", "choose another one for the result")
    if not out.is_dir() or not any(out.iterdir()):
        return
    try:
        there = json.loads((out / CONVERSION).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise InputError(out, "holds files of another origin", "choose another folder") from None
    if there != settings:
        named = ", ".join(f"{key} {value}" for key, value in there.items())
        raise InputError(out, f"holds another conversion ({named})", "choose another folder")


def _convert(
    recording: Recording, dataset: Dataset, folder: Path, rate: float | None
) -> tuple[list[Checked], tuple[str, ...]]:
    """Write the sequences of a recording that pass the self-check."""
    rows, reading = check_recording(recording, dataset)
    for sequence, row in zip(reading.sequences, rows, strict=False):
        if row.reason:
            continue
        sequence = sequence if rate is None else resample(sequence, rate)
        # What the dataset asks of its recordings, for the self-check of the converted ones.
        asked = {"check_pedestrian": dataset.pedestrian, "check_correlation": dataset.correlates}
        attributes = asked | sequence.attributes
        path = folder / f"{file_stem(sequence.name)}.h5"
        write_hdf5(path, sequence._replace(attributes=attributes))
    return rows, reading.notes
