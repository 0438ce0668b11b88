"""Any dataset as the package's HDF5: one file a recording, a list for each split, and a journal by
which an interrupted conversion goes on."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

from gnio_jax.data.dataset import Dataset, Recording
from gnio_jax.data.hdf5 import read_hdf5, write_hdf5
from gnio_jax.data.processes import map_in_processes, suggested_workers
from gnio_jax.data.reading import check_recording, find_recordings
from gnio_jax.data.resampling import resample
from gnio_jax.errors import InputError
from gnio_jax.files import file_stem, write_text

_JOURNAL = ".converted"
"""Folder in the result: one JSON for each recording that is done, and settings.json."""


class Converted(NamedTuple):
    """What became of one recording."""

    kept: tuple[str, ...]
    """Stems of the files."""
    left_out: dict[str, str]
    """Sequence -> reason."""
    seconds: float
    """Length of what was kept."""
    notes: tuple[str, ...]
    """Warnings of the reader."""
    there_already: bool
    """An earlier conversion wrote it."""


class Conversion(NamedTuple):
    """What became of a dataset."""

    recordings: dict[str, Converted]
    splits: dict[str, tuple[str, ...]]
    """Names of the recordings of each split."""
    notes: list[str]

    def sequences(self, split: str) -> list[str]:
        """Stems of the files of a split."""
        return [stem for name in self.splits[split] for stem in self.recordings[name].kept]


def convert(
    dataset: Dataset,
    root: Path,
    out: Path,
    split: str = "all",
    rate: float | None = None,
    workers: int | None = 1,
    progress: Callable[[float], None] = lambda share: None,
) -> Conversion:
    """Write the sequences that pass the self-check below `out`, and the list of each split.

    What is there already, whole and with the same settings, is not written again. `rate`: Hz, None
    keeps each recording's own. `workers` processes share the work (None: as many as are worth
    starting), and `progress` is told the share that is done. Raises `InputError` when `out` is the
    folder of another conversion, or two recordings would be one file.
    """
    if dataset.needs_root and out.resolve() == root.resolve():
        raise InputError(out, "is the folder that is read", "choose another one for the result")
    found, splits, notes = find_recordings(dataset, root, split)
    _refuse_same_files(root, list(found))
    _claim(out, {"dataset": dataset.name, "rate": rate})
    done = {name: entry for name in found if (entry := _journal_entry(out, name)) is not None}
    missing = [name for name in found if name not in done]
    items = [(found[name], dataset, out, rate) for name in missing]
    count = workers or suggested_workers(len(items))
    converted = map_in_processes(_convert_recording, items, count, progress)
    done |= zip(missing, converted, strict=True)
    conversion = Conversion({name: done[name] for name in found}, splits, notes)
    _write_lists(out, conversion)
    return conversion


def _refuse_same_files(root: Path, names: list[str]) -> None:
    first: dict[str, str] = {}
    for name in names:
        other = first.setdefault(file_stem(name), name)
        if other != name:
            problem = f"'{other}' and '{name}' would be one file, {file_stem(name)}.h5"
            raise InputError(root, problem, "rename one of them")


def _claim(out: Path, settings: dict[str, Any]) -> None:
    """Make `out` the folder of one conversion.

    Raises `InputError` if it is that of another, or holds recordings of another origin.
    """
    path = out / _JOURNAL / "settings.json"
    if out.exists() and not out.is_dir():
        raise InputError(out, "is a file", "name a folder")
    if path.is_file():
        _compare_settings(out, path, settings)
        return
    entries = out.iterdir() if out.is_dir() else ()
    if any(entry.suffix in (".h5", ".hdf5", ".csv", ".txt") for entry in entries):
        problem = "holds recordings or lists that no conversion has written"
        raise InputError(out, problem, "choose another folder")
    write_text(path, json.dumps(settings))


def _compare_settings(out: Path, path: Path, settings: dict[str, Any]) -> None:
    try:
        there = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(path, f"cannot be read ({error})", "choose another folder") from None
    if there != settings:
        problem = f"holds {_spell(there)}, not {_spell(settings)}"
        raise InputError(out, problem, "choose another folder")


def _spell(settings: dict[str, Any]) -> str:
    rate = settings.get("rate")
    return f"{settings.get('dataset')} at {f'{rate:g} Hz' if rate else 'its own rate'}"


def _convert_recording(
    recording: Recording, dataset: Dataset, out: Path, rate: float | None
) -> Converted:
    """Write the sequences of a recording that pass the self-check."""
    found = check_recording(recording, dataset)
    if found.problem:  # not noted as done: it may be mended
        return Converted((), {recording.name: found.problem}, 0.0, found.notes, False)
    kept, left_out, seconds = [], {}, 0.0
    for sequence, figures in found.sequences:
        if figures.failures:
            left_out[sequence.name] = "; ".join(figures.failures)
            continue
        sequence = sequence if rate is None else resample(sequence, rate)
        attributes = _self_check_attributes(dataset) | sequence.attributes
        stem = file_stem(sequence.name)
        write_hdf5(out / f"{stem}.h5", sequence._replace(attributes=attributes))
        kept.append(stem)
        seconds += figures.duration
    result = Converted(tuple(kept), left_out, seconds, found.notes, False)
    write_text(_journal(out, recording.name), json.dumps(result._asdict()))
    return result


def _self_check_attributes(dataset: Dataset) -> dict[str, Any]:
    """What the dataset asks of its recordings, for the self-check of the converted ones."""
    correlation = dataset.min_correlation
    return {
        "check_pedestrian": dataset.pedestrian,
        "check_min_correlation": -1.0 if correlation is None else correlation,
    }


def _journal(out: Path, name: str) -> Path:
    return out / _JOURNAL / f"{file_stem(name)}.json"


def _journal_entry(out: Path, name: str) -> Converted | None:
    """What the journal says of a recording, if its files are there and whole."""
    try:
        entry = json.loads(_journal(out, name).read_text(encoding="utf-8"))
        for stem in entry["kept"]:
            read_hdf5(out / f"{stem}.h5")
        return Converted(
            tuple(entry["kept"]),
            dict(entry["left_out"]),
            float(entry["seconds"]),
            tuple(entry["notes"]),
            there_already=True,
        )
    except (OSError, ValueError, KeyError, TypeError):  # InputError is a ValueError
        return None


def _write_lists(out: Path, conversion: Conversion) -> None:
    """The list of each split; a split without a usable recording has none, and a note says so."""
    for split, names in conversion.splits.items():
        stems, path = conversion.sequences(split), out / f"{split}.txt"
        if stems:
            write_text(path, "".join(f"{stem}\n" for stem in stems))
        else:
            path.unlink(missing_ok=True)
            problem = f"none of its {len(names)} recordings can be used"
            conversion.notes.append(f"split '{split}' has no list: {problem}")
