"""All recordings of a dataset: they are listed by split, checked, and written in the package's own
form."""

from __future__ import annotations

import json
import warnings
from pathlib import Path
from typing import NamedTuple

from gnio_jax.data.dataset import Dataset, RecordingSource
from gnio_jax.data.hdf5 import Reading, write_hdf5
from gnio_jax.data.loading import check_split, read_recording, refuse_empty_split
from gnio_jax.data.resampling import resample
from gnio_jax.data.self_check import SelfCheck, check_sequence
from gnio_jax.data.workers import in_processes
from gnio_jax.errors import InputError
from gnio_jax.files import file_stem, replacing_folder, write_text
from gnio_jax.reporting import Progress, silent

CONVERSION = "conversion.json"
"""File with the origin of a converted folder."""


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
    check_split(dataset, split, dict.fromkeys((*splits, "all")))
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
        refuse_empty_split(dataset, root, split, "recording")
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
