"""Every recording is read one way, and who reads it makes no difference."""

from __future__ import annotations

import dataclasses
import multiprocessing
import operator
import os
import warnings
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.dataset import Recording, Refusal, single
from gnio_jax.data.processes import map_in_processes
from gnio_jax.data.reading import check_recording, find_recordings, read_each, read_recording
from gnio_jax.errors import InputError
from tests.support.circle import circle


@pytest.fixture(scope="module", autouse=True)
def one_import_for_all(tmp_path_factory):
    """The processes come from one that has imported the package, in place of importing it each.

    They share its environment, and so one cache: every test has files of its own. Processes as the
    package starts them are those of the tests of OxIOD.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GNIO_CACHE", str(tmp_path_factory.mktemp("cache")))
        patch.setattr(multiprocessing, "get_context", lambda _: context)
        yield


# What other processes run must have a name there.


def walk(name, warning="", refusal="", damage=""):
    if warning:
        warnings.warn(warning, stacklevel=2)
    if refusal:
        raise Refusal(f"{name}.csv", refusal, "leave it out")
    if damage:
        raise InputError(f"{name}.csv", damage, "copy it again")
    return circle(seconds=4.0)._replace(name=name)


def upside_down(name):
    sequence = walk(name)
    return sequence._replace(accel=-sequence.accel)


def slow(tmp_path, name, read=walk, **options):
    """A recording of one file that is worth caching."""
    file = tmp_path / f"{name}.csv"
    file.write_text(name)
    recording = single(name, read, name, **options)
    return recording._replace(files=(file,), version="test 1", attributes={"lists": "three"})


def dataset(*recordings):
    return dataclasses.replace(data.get("tlio"), recordings=lambda root, split: list(recordings))


def outcome(about, workers):
    """(names, warnings, error) of a split."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            names, error = [s.name for s in read_each(about, Path("root"), "test", workers)], ""
        except InputError as mistake:
            names, error = [], str(mistake)
    return names, [(str(note.message), note.category) for note in caught], error


def six(tmp_path):
    form = slow(tmp_path, "e", refusal="field 'time' is ruined")
    return [
        slow(tmp_path, "a"),
        slow(tmp_path, "b", warning="b.csv: a gap was cut off"),
        slow(tmp_path, "c", refusal="its clock is ruined"),
        single("d", walk, "d", warning="d.csv: is short"),
        form._replace(form="raw", fallback=slow(tmp_path, "e2")._replace(name="e", form="syn")),
        slow(tmp_path, "f", upside_down),
    ]


@pytest.mark.parametrize("damage", [False, True])
def test_sequences_warnings_and_errors_do_not_depend_on_the_workers(tmp_path, damage):
    found = []
    for workers in (1, 2):
        folder = tmp_path / f"by {workers}"
        folder.mkdir()
        recordings = six(folder)
        if damage:
            recordings.insert(4, slow(folder, "g", damage="field 'gyro' is NaN"))
        found += [outcome(dataset(*recordings), workers) for _ in range(2)]  # cold and cached
    names, notes, error = found[0]
    assert found == [found[0]] * 4
    told = [
        "b.csv: a gap was cut off",
        "c: left out: c.csv: its clock is ruined; leave it out",
        "d.csv: is short",
    ]
    if damage:
        assert names == [] and error == "g.csv: field 'gyro' is NaN; copy it again"
    else:
        assert names == ["a", "b", "d", "e2"] and error == ""
        told.append("e: syn is used: e.csv: field 'time' is ruined; leave it out")
        assert notes[-1][0].startswith("f: left out by the self-check: mean of R·accel")
        notes = notes[:-1]
    assert notes == [(text, UserWarning) for text in told]


def test_only_what_is_slow_to_read_is_given_to_processes(tmp_path):
    """A function without a name elsewhere cannot be sent to a process: it was read here."""
    local = Recording("local", lambda: [walk("local")])
    shares = []
    about = dataset(local, slow(tmp_path, "a"), slow(tmp_path, "b"))
    sequences = list(read_each(about, tmp_path, "test", 2, shares.append))
    assert [sequence.name for sequence in sequences] == ["local", "a", "b"]
    assert shares == [0.5, 1.0]
    kept = [
        Recording(name, lambda: pytest.fail("built"), (tmp_path / f"{name}.csv",), "test 1")
        for name in "ab"
    ]
    again = read_each(dataset(local, *kept), tmp_path, "test", 2, shares.append)
    assert len(list(again)) == 3
    assert shares == [0.5, 1.0]


def test_a_recording_carries_what_lists_say_of_it(tmp_path):
    for _ in range(2):
        (sequence,) = read_recording(slow(tmp_path, "a")).sequences
        assert sequence.attributes == {"dataset": "test", "lists": "three"}


def test_a_split_of_which_nothing_is_left(tmp_path):
    about = dataset(slow(tmp_path, "c", refusal="ruined"), Recording("none", list))
    names, notes, error = outcome(about, 1)
    assert names == [] and [text for text, _ in notes] == [
        "c: left out: c.csv: ruined; leave it out"
    ]
    assert (
        error
        == "root: none of the 2 recordings of split 'test' can be used; see the warnings above"
    )


def test_a_check_tells_what_is_wrong_and_raises_nothing(tmp_path):
    about = dataset()
    recordings = {recording.name: recording for recording in six(tmp_path)}
    checked = {name: check_recording(entry, about) for name, entry in recordings.items()}
    ((_, figures),) = checked["a"].sequences
    assert checked["a"].problem == "" and figures.failures == ()
    assert checked["b"].notes == ("b.csv: a gap was cut off",)
    assert checked["c"].problem == "c.csv: its clock is ruined; leave it out"
    assert checked["e"].problem == "" and "syn is used" in checked["e"].notes[0]
    assert "mean of R·accel" in checked["f"].sequences[0][1].failures[0]
    assert (
        check_recording(Recording("none", list), about).problem == "no piece of it is long enough"
    )
    damaged = slow(tmp_path, "g", damage="field 'gyro' is NaN")
    assert check_recording(damaged, about).problem == "g.csv: field 'gyro' is NaN; copy it again"


def test_the_recordings_of_all_splits_are_found_once(tmp_path):
    shared, own = single("shared", walk, "shared"), single("own", walk, "own")

    def recordings(root, split):
        warnings.warn(f"{root}: is incomplete", stacklevel=2)
        if split == "val":
            raise InputError(root, "has no list val", "expected layout: any")
        return [shared, own] if split == "train" else [shared]

    about = dataclasses.replace(dataset(), recordings=recordings)
    found = find_recordings(about, Path("root"), "all")
    assert list(found.recordings) == ["shared", "own"]
    assert found.splits == {"train": ("shared", "own"), "test": ("shared",)}
    assert found.notes == [
        "root: is incomplete",
        "nothing in split val: root: has no list val",
    ]
    with pytest.raises(InputError, match="has no list val"):
        find_recordings(about, Path("root"), "val")
    with pytest.raises(
        InputError, match="unknown split 'dev'; known splits: train, val, test, all"
    ):
        find_recordings(about, Path("root"), "dev")
    with pytest.raises(InputError, match="split 'all' of dataset 'tlio' holds no recording"):
        find_recordings(dataset(), Path("root"), "all")


def test_work_by_processes_comes_back_in_order():
    shares = []
    items = [(base, 2) for base in range(5)]
    for workers in (1, 2, 7):
        assert list(map_in_processes(pow, items, workers, shares.append)) == [0, 1, 4, 9, 16]
    np.testing.assert_allclose(shares, [0.2, 0.4, 0.6, 0.8, 1.0] * 3)
    assert list(map_in_processes(pow, [], 2)) == []


def test_a_process_that_dies_is_told_in_one_line():
    items = [(partial(os._exit, 3),), (partial(int, 1),)]
    # What is called needs no import of the package in a process.
    with pytest.raises(InputError, match="--workers: a process died, perhaps for want of memory"):
        list(map_in_processes(operator.call, items, 2))


def test_a_process_that_dies_while_the_next_one_starts_is_told_too(monkeypatch):
    submit, started = ProcessPoolExecutor.submit, []

    def once(pool, *item):
        if started:
            raise OSError("handle is closed")
        started.append(item)
        return submit(pool, *item)

    monkeypatch.setattr(ProcessPoolExecutor, "submit", once)
    with pytest.raises(InputError, match="--workers: a process died"):
        list(map_in_processes(pow, [(2, 2), (3, 2)], 2))


def test_what_the_function_cannot_open_is_its_own_error(tmp_path):
    with pytest.raises(FileNotFoundError, match="nowhere"):
        list(map_in_processes(os.stat, [(tmp_path / "nowhere",), (tmp_path,)], 2))


def die_in_a_child(name):
    if multiprocessing.parent_process() is not None:
        os._exit(3)
    return walk(name)


def test_what_a_dead_process_left_is_read_here(tmp_path):
    recordings = [slow(tmp_path, name, die_in_a_child) for name in ("a", "b", "c")]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        found = list(read_each(dataset(*recordings), tmp_path, "test", workers=2))
    assert [sequence.name for sequence in found] == ["a", "b", "c"] and not caught
