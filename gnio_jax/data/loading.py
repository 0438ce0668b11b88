"""From a dataset's name to its sequences: find the recordings, read them (through the cache, by
several processes), check them, and write them in the package's own form."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, wait
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import NamedTuple, TypeVar

from gnio_jax.cores import usable_cores
from gnio_jax.data.dataset import Dataset, RecordingSource, Refusal
from gnio_jax.data.hdf5 import Reading, cache_entry, read_reading, write_hdf5, write_reading
from gnio_jax.data.registry import find_root, get
from gnio_jax.data.resampling import resample
from gnio_jax.data.self_check import SelfCheck, check_sequence
from gnio_jax.data.splits import parse_fold
from gnio_jax.errors import InputError, did_you_mean
from gnio_jax.files import file_stem, replacing_folder, write_text
from gnio_jax.reporting import Progress, silent
from gnio_jax.types import Sequence

Result = TypeVar("Result")
FEW = 8
"""Number of recordings up to which reading them is faster than starting processes."""
CONVERSION = "conversion.json"
"""File with the origin of a converted folder."""


# --- the sequences of a split


def load(
    name: str,
    root: str | os.PathLike[str] | None = None,
    split: str = "test",
    workers: int = 1,
    progress: Progress = silent,
) -> list[Sequence]:
    """The sequences of a split of a dataset, validated and self-checked, at its native rate, in the
    order of its recordings. `resample` changes the rate.

    Recordings that cannot be used, or that fail the physical self-check, are left out with a
    warning. Sequences, warnings and errors do not depend on the number of workers.

    Args:
        name: The dataset, one of `names()`.
        root: Its folder; None: `find_root` looks for it.
        split: A split, a fold of one, or all but a fold (`splits.Fold`).
        workers: Number of processes that read the recordings that are slow to read and not in the
            cache yet.
        progress: A function that gets the finished share of these recordings.

    Raises:
        InputError: The name or the split is unknown, the folder is missing, a file is damaged, two
            sequences have one name, or the split has no sequence.
    """
    return list(load_each(name, root, split, workers, progress))


def load_each(
    name: str,
    root: str | os.PathLike[str] | None = None,
    split: str = "test",
    workers: int = 1,
    progress: Progress = silent,
) -> Iterator[Sequence]:
    """The sequences of `load` one after another, if together they do not fit into memory.

    Args:
        name: The dataset, one of `names()`.
        root: Its folder; None: `find_root` looks for it.
        split: A split, a fold of one, or all but a fold.
        workers: Number of processes that read.
        progress: A function that gets the finished share.
    """
    if fold := parse_fold(split):
        return iter(fold.select(load_each(name, root, fold.split, workers, progress)))
    dataset = get(name)
    # If lists at the root define the splits, the reader knows them.
    if dataset.list_splits is None:
        _check_split(dataset, split, dataset.splits)
    folder = find_root(name, root) if dataset.needs_root else Path(root or ".")
    return read_split(dataset, folder, split, workers, progress)


def read_split(
    dataset: Dataset,
    root: Path,
    split: str,
    workers: int = 1,
    progress: Progress = silent,
) -> Iterator[Sequence]:
    """The sequences of `load_each` for a `Dataset`, which need not be registered."""
    recordings = dataset.recordings(root, split)
    if not recordings:
        raise _empty_split(dataset, root, split, "sequence")
    names, left_out = set(), []
    refused: dict[str, list[str]] = {}  # reason without the file -> all whole lines
    for recording, reading in zip(
        recordings, _read_all(recordings, workers, progress), strict=True
    ):
        for note in reading.notes:
            warnings.warn(note, stacklevel=2)
        for reason in reading.refusals:
            why = reason.partition(": ")[2]
            refused.setdefault(why, []).append(f"{recording.name}: left out: {reason}")
        if reading.damage is not None:
            _warn_of_refusals(refused)
            raise reading.damage
        for sequence in map(dataset.with_origin, reading.sequences):
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
    _warn_of_refusals(refused)
    if not names:
        problem = f"none of the {len(recordings)} recordings of split '{split}' can be used"
        raise InputError(root, problem, "see the warnings above")
    if len(left_out) == len(names):
        problem = f"none of {len(left_out)} sequences passes the physical self-check"
        remedy = "see the warnings above; check units, frames and time offset of the recordings"
        raise InputError(", ".join(left_out[:3]), problem, remedy)


def _warn_of_refusals(refused: dict[str, list[str]]) -> None:
    """Warn once for each reason, with the number of recordings if there are several."""
    for lines in refused.values():
        several = f"{len(lines)} recordings are left out for the same reason, the first: "
        warnings.warn(f"{several if lines[1:] else ''}{lines[0]}", stacklevel=3)


def _empty_split(dataset: Dataset, root: Path, split: str, what: str) -> InputError:
    problem = f"split '{split}' of dataset '{dataset.name}' holds no {what}"
    return InputError(root, problem, f"expected layout: {dataset.layout}")


def _check_split(dataset: Dataset, split: str, splits: Iterable[str]) -> None:
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
        if workers > 1 and recording.slow and not _entry(recording).is_file()
    ]
    readings = in_processes(read_recording, [(recording,) for recording in slow], workers, progress)
    in_pool, died = {id(recording) for recording in slow}, False
    for recording in recordings:
        if id(recording) in in_pool and not died:
            try:
                reading = next(readings)
                if reading.damage is not None:  # an error ends the work
                    with suppress(InputError):
                        readings.throw(reading.damage)
                yield reading
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
            if form.slow:
                entry = _entry(form)
                if (cached := read_reading(entry)) is not None:
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


def _entry(form: RecordingSource) -> Path:
    """The file of this form of a recording in the cache."""
    return cache_entry(f"{form.name} {form.form}", form.files)


# --- processes


class ProcessDied(InputError):
    """A process ended without a message; most often the system has run out of memory."""


def in_processes(
    function: Callable[..., Result],
    items: list[tuple],
    workers: int | None,
    progress: Progress = silent,
) -> Generator[Result, None, None]:
    """`function(*item)` for every item, in their order, by `workers` processes; 1 starts none, and
    None chooses a useful number. A process that may have no children does the work itself.

    At most `workers` + 2 results are in progress or waiting, so that memory is bounded. `progress`
    gets the finished share. Function and items must be picklable if there is more than one process.
    After an error of an item those in progress end first, so that their files are whole; Ctrl-C and
    a caller that stops early end them at once. Raises `ProcessDied`.
    """
    if workers is None:
        workers = usable_cores() if len(items) > FEW else 1
    workers = min(workers, len(items))
    if workers <= 1 or multiprocessing.current_process().daemon:
        for number, item in enumerate(items, 1):
            result = function(*item)
            progress(number / len(items))
            yield result
        return
    from loky.process_executor import (  # it takes a fifth of a second to import
        ProcessPoolExecutor,
        TerminatedWorkerError,
    )

    # A process that uses much memory is replaced, with the same results, so the user need not act.
    warnings.filterwarnings("ignore", "A worker was restarted", UserWarning, "loky")
    # Python's own pool can wait without end for a process that died while another one started. Only
    # this process handles Ctrl-C.
    ignore = (signal.SIGINT, signal.SIG_IGN)
    pool = ProcessPoolExecutor(workers, initializer=signal.signal, initargs=ignore)
    pending, waiting = iter(items), deque[Future[Result]]()
    try:
        for number in range(1, len(items) + 1):
            new = islice(pending, workers + 2 - len(waiting))
            waiting.extend(pool.submit(function, *item) for item in new)
            result = waiting.popleft().result()
            progress(number / len(items))
            yield result
    except TerminatedWorkerError:
        problem = "a process died, perhaps because memory ran out"
        raise ProcessDied("--workers", problem, "try --workers 1") from None
    except Exception:
        wait(waiting)
        raise
    finally:
        pool.shutdown(wait=False, kill_workers=True)


# --- the recordings of a whole dataset: finding, checking, writing


class RecordingIndex(NamedTuple):
    """The recordings of one split, or of all."""

    recordings: dict[str, RecordingSource]
    """Recordings by name."""
    splits: dict[str, tuple[str, ...]]
    """Split -> the names of its recordings."""
    notes: list[str]
    """Warnings, and the splits that have no recording."""


def find_recordings(dataset: Dataset, root: Path, split: str) -> RecordingIndex:
    """The recordings of a split, or of every split: "all".

    A dataset's own split of that name is every recording below the root. Raises `InputError` for an
    unknown split, or if no split has a recording.
    """
    splits = dataset.splits_at(root)
    _check_split(dataset, split, dict.fromkeys((*splits, "all")))
    index, mistakes = RecordingIndex({}, {}, []), {}
    for name in splits if split == "all" else (split,):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                recordings = dataset.recordings(root, name)
                index.splits[name] = tuple(recording.name for recording in recordings)
                for recording in recordings:
                    index.recordings.setdefault(recording.name, recording)
            except InputError as error:
                mistakes[name] = error
        for text in (str(warning.message) for warning in caught):
            index.notes.extend([text] if text not in index.notes else [])
    if not index.recordings and len(mistakes) == (len(splits) if split == "all" else 1):
        # A split of all recordings gives the best reason why there are none.
        raise mistakes.get("all", next(iter(mistakes.values())))
    if not index.recordings:
        raise _empty_split(dataset, root, split, "recording")
    reasons = {
        name: str(error).partition("; expected layout")[0] for name, error in mistakes.items()
    }
    for reason in dict.fromkeys(reasons.values()):
        names = ", ".join(name for name, other in reasons.items() if other == reason)
        index.notes.append(f"nothing in split {names}: {reason}")
    return index


class CheckResult(NamedTuple):
    """The self-check of one sequence, or the reason why a recording has none."""

    name: str
    splits: tuple[str, ...]
    """Splits that contain it; "all" is named if there is no other."""
    check: SelfCheck | None
    """The self-check; None if the recording could not be read."""
    reason: str
    """Reason why it is left out; empty if it is used."""


def check(
    dataset: Dataset,
    root: Path,
    split: str = "all",
    pictures: Path | None = None,
    workers: int | None = 1,
    progress: Progress = silent,
) -> tuple[list[CheckResult], list[str]]:
    """Read every recording of a split (or of all) and check it. The result is the checked
    sequences, notes of the readers, and notes about missing recordings.

    `pictures` is a folder for a picture of each. `workers` processes share the work.
    """
    recordings, splits, notes = find_recordings(dataset, root, split)
    items = [(recording, dataset, pictures) for recording in recordings.values()]
    results, checked = in_processes(_check_and_draw, items, workers, progress), []
    for name, (rows, reader_notes) in zip(recordings, results, strict=True):
        containing = [split_name for split_name, names in splits.items() if name in names]
        containing = tuple(
            split_name for split_name in containing if split_name != "all" or len(containing) == 1
        )
        checked += [row._replace(splits=containing) for row in rows]
        notes += [note for note in reader_notes if note not in notes]
    return checked, notes


def _check_and_draw(
    recording: RecordingSource, dataset: Dataset, pictures: Path | None
) -> tuple[list[CheckResult], tuple[str, ...]]:
    """The rows of one recording, without its splits, and the reader's notes."""
    rows, reading = check_recording(recording, dataset)
    if pictures is not None:
        from gnio_jax import drawing  # Matplotlib takes a second to import
        from gnio_jax.data.pictures import PALETTE, overview

        for sequence, row in zip(reading.sequences, rows, strict=False):
            assert row.check is not None
            path = pictures / f"{file_stem(sequence.name)}.png"
            drawing.save(path, overview(sequence, row.check), PALETTE)
    return rows, reading.notes


def check_recording(
    recording: RecordingSource, dataset: Dataset
) -> tuple[list[CheckResult], Reading]:
    """Read a recording and check its sequences; problems are reported, not raised."""
    reading = read_recording(recording)
    reading = reading._replace(sequences=[*map(dataset.with_origin, reading.sequences)])
    checks = [(sequence.name, check_sequence(sequence, dataset)) for sequence in reading.sequences]
    if checks:
        return [
            CheckResult(name, (), check, "; ".join(check.failures)) for name, check in checks
        ], reading
    reasons = reading.refusals if reading.damage is None else (str(reading.damage),)
    reason = "; ".join(text.removeprefix(f"{recording.name}: ") for text in reasons)
    row = CheckResult(recording.name, (), None, reason or "no segment of it is long enough")
    return [row], reading


class ConversionResult(NamedTuple):
    """The result of a conversion."""

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
    progress: Progress = silent,
) -> ConversionResult:
    """Write the sequences that pass the self-check as one file each, and the list of each split.

    The folder `out` is written whole or not at all. It must be new or empty, or hold an earlier
    conversion of the same recordings with the same settings, which is then replaced. `rate`: Hz,
    None keeps each recording's own. `workers` processes share the work. Raises `InputError` if
    `out` holds anything else, if two sequences would be one file, or if none can be used.
    """
    settings = {"dataset": dataset.name, "split": split, "rate": rate}
    if dataset.needs_root:
        settings["root"] = str(root.resolve())
    _check_target(out, settings)
    recordings, splits, notes = find_recordings(dataset, root, split)
    owners: dict[str, str] = {}

    def check_file(name: str, recording: str) -> None:
        """Check that no other recording has the file of this sequence."""
        stem = file_stem(name)
        if (other := owners.setdefault(stem, recording)) != recording:
            problem = f"'{other}' and '{recording}' would be one file, {stem}.h5"
            raise InputError(root, problem, "rename one of them")

    for name in recordings:
        check_file(name, name)
    stems, left_out, hours = {}, {}, 0.0
    with replacing_folder(out) as folder:
        items = [(recording, dataset, folder, rate) for recording in recordings.values()]
        results = in_processes(_check_and_write, items, workers, progress)
        for name, (rows, reader_notes) in zip(recordings, results, strict=True):
            used = [row for row in rows if not row.reason]
            for row in used:  # pieces of a recording have names of their own
                check_file(row.name, name)
            stems[name] = [file_stem(row.name) for row in used]
            left_out |= {row.name: row.reason for row in rows if row.reason}
            hours += sum(row.check.duration for row in used if row.check) / 3600.0
            notes += [note for note in reader_notes if note not in notes]
        if not any(stems.values()):
            problem = f"none of {len(recordings)} recordings can be used"
            raise InputError(root, problem, "; ".join(list(left_out.values())[:3]))
        lists = {}
        for split_name, names in splits.items():
            lists[split_name] = [stem for name in names for stem in stems[name]]
            if lists[split_name]:
                write_text(
                    folder / f"{split_name}.txt", "".join(f"{stem}\n" for stem in lists[split_name])
                )
            else:
                problem = f"none of its {len(names)} recordings can be used"
                notes.append(f"split '{split_name}' has no list: {problem}")
        write_text(folder / CONVERSION, json.dumps(settings, indent=2) + "\n")
    return ConversionResult(lists, sum(map(len, stems.values())), hours, left_out, notes)


def _check_target(out: Path, settings: dict) -> None:
    """Raise `InputError` if a conversion must not be written to `out`."""
    if out.exists() and not out.is_dir():
        raise InputError(out, "is a file", "name a folder")
    if settings.get("root") == str(out.resolve()):
        raise InputError(out, "is the folder that is read", "choose another one for the result")
    if not out.is_dir() or not any(out.iterdir()):
        return
    try:
        earlier = json.loads((out / CONVERSION).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        raise InputError(out, "holds files of another origin", "choose another folder") from None
    if earlier != settings:
        named = ", ".join(f"{key} {value}" for key, value in earlier.items())
        raise InputError(out, f"holds another conversion ({named})", "choose another folder")


def _check_and_write(
    recording: RecordingSource, dataset: Dataset, folder: Path, rate: float | None
) -> tuple[list[CheckResult], tuple[str, ...]]:
    """Write the sequences of one recording that pass, and return its rows and the reader's
    notes."""
    rows, reading = check_recording(recording, dataset)
    # Requirements of the dataset, for the self-check of the converted recordings.
    requirements = {"check_pedestrian": dataset.pedestrian, "check_correlation": dataset.correlates}
    for sequence, row in zip(reading.sequences, rows, strict=False):
        if not row.reason:
            sequence = sequence._replace(attributes=requirements | sequence.attributes)
            sequence = sequence if rate is None else resample(sequence, rate)
            write_hdf5(folder / f"{file_stem(sequence.name)}.h5", sequence)
    return rows, reading.notes
