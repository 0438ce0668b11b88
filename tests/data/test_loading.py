"""Recordings are read one way, whoever reads; the cache is anew when files or readers change."""

import dataclasses
import importlib.util
import multiprocessing
import operator
import os
import sys
import time
import warnings
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data import hdf5, registry
from gnio_jax.data.conversion import check_recording, find_recordings
from gnio_jax.data.dataset import RecordingSource, Refusal
from gnio_jax.data.loading import read_recording, read_split
from gnio_jax.data.readers import DATASETS
from gnio_jax.data.workers import in_processes
from gnio_jax.errors import InputError
from gnio_jax.files import replacing
from tests.support.circle import circle


@pytest.fixture(scope="module", autouse=True)
def one_cache_for_all(tmp_path_factory):
    """Every test has files of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("GNIO_CACHE", str(tmp_path_factory.mktemp("cache")))
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


def alone(read, *arguments, **options):
    return [read(*arguments, **options)]


def single(name, read, *arguments, **options):
    """The recording that is one sequence."""
    return RecordingSource(name, partial(alone, read, *arguments, **options))


def upside_down(name):
    sequence = walk(name)
    return sequence._replace(accel=-sequence.accel)


def slow(tmp_path, name, read=walk, **options):
    """A recording of one file that is worth caching."""
    file = tmp_path / f"{name}.csv"
    file.write_text(name)
    recording = single(name, read, name, **options)
    return recording._replace(files=(file,), slow=True, attributes={"lists": "three"})


def dataset(*recordings):
    return dataclasses.replace(data.get("tlio"), recordings=lambda root, split: list(recordings))


def outcome(corpus, workers, progress=lambda share: None, left_out=None, strict=False):
    """(names, warnings, error) of a split."""
    names, error = [], ""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            read = read_split(corpus, Path("root"), "test", workers, progress, left_out, strict)
            names = [sequence.name for sequence in read]
        except InputError as mistake:
            error = str(mistake)
    return names, [str(note.message) for note in caught], error


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


@pytest.mark.parametrize("damage", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_sequences_warnings_and_errors_do_not_depend_on_the_workers(tmp_path, damage):
    outcomes, shares = [], []
    for workers in (1, 2):
        folder = tmp_path / f"by {workers}"
        folder.mkdir()
        recordings = six(folder)
        if damage:
            recordings.insert(4, slow(folder, "g", damage="field 'gyro' is NaN"))
        times = 1 if damage else 2  # cold and cached
        corpus = dataset(*recordings)
        outcomes += [outcome(corpus, workers, shares.append) for _ in range(times)]
    names, notes, error = outcomes[0]
    assert outcomes == [outcomes[0]] * len(outcomes)
    expected = ["b.csv: a gap was cut off", "d.csv: is short"]
    refused = "c: left out: c.csv: its clock is ruined; leave it out"
    assert names == ["a", "b", "d", "e2"] and error == ""
    if damage:
        expected.append("g: left out: g.csv: field 'gyro' is NaN; copy it again")
    expected.append("e: syn is used: e.csv: field 'time' is ruined; leave it out")
    checked = notes.pop(-2)
    assert checked.startswith("f: left out by the self-check: mean of R·accel")
    assert notes == [*expected, refused]
    if not damage:
        np.testing.assert_allclose(shares, [0.2, 0.4, 0.6, 0.8, 1.0])  # what processes read


def test_a_damaged_recording_is_left_out_by_name_and_reason(tmp_path):
    """The reasons of all that are left out are told. Where nothing else is there, or all are
    needed, the damage is an error; so it is where its warning is one."""
    damaged = slow(tmp_path, "g", damage="field 'gyro' is NaN")
    corpus, left_out = dataset(damaged, *six(tmp_path)), {}
    names, notes, error = outcome(corpus, 1, left_out=left_out)
    line = "g.csv: field 'gyro' is NaN; copy it again"
    assert names == ["a", "b", "d", "e2"] and error == "" and f"g: left out: {line}" in notes
    assert left_out.pop("f").startswith("the self-check: mean of R·accel")
    assert left_out == {"g": line, "c": "c.csv: its clock is ruined; leave it out"}
    assert outcome(corpus, 1, strict=True) == ([], [], line)
    refused = slow(tmp_path, "h", refusal="its clock is ruined")
    for split in (dataset(damaged), dataset(damaged, damaged._replace(name="k"), refused)):
        names, notes, error = outcome(split, 1)
        assert (names, error) == ([], line) and not any("gyro" in note for note in notes)
    with warnings.catch_warnings(), pytest.raises(InputError) as raised:
        warnings.simplefilter("ignore")
        warnings.simplefilter("error", data.DamagedRecording)
        list(read_split(corpus, Path("root"), "test"))
    assert str(raised.value) == line


def test_a_fold_needs_every_recording(tmp_path, monkeypatch):
    """Another one would change the folds of all."""
    damaged = slow(tmp_path, "g", damage="field 'gyro' is NaN")
    monkeypatch.setitem(DATASETS, "tlio", dataset(single("a", walk, "a"), damaged))
    (tmp_path / "root").mkdir()
    with pytest.raises(InputError, match=r"g\.csv: field 'gyro' is NaN; copy it again"):
        data.load("tlio", tmp_path / "root", "test+0of1")


def test_a_sequence_says_whose_it_is_unless_it_was_converted(tmp_path):
    def read(**attributes):
        name = "".join(attributes) or "own"
        return [circle(seconds=4.0)._replace(name=name, attributes=attributes)]

    converted = partial(read, dataset="oxiod", licence="theirs")
    corpus = dataset(RecordingSource("own", read), RecordingSource("other", converted))
    recordings = corpus.recordings(None, "")
    for sequences in (
        list(read_split(corpus, tmp_path, "test")),
        [check_recording(recording, corpus)[1].sequences[0] for recording in recordings],
    ):
        origins = [
            (sequence.attributes["dataset"], sequence.attributes["licence"])
            for sequence in sequences
        ]
        assert origins == [("tlio", data.get("tlio").licence), ("oxiod", "theirs")]


def test_recordings_that_are_left_out_for_one_reason_are_one_line(tmp_path):
    alike = [slow(tmp_path, name, refusal="holds 2 waypoints") for name in "bcd"]
    corpus = dataset(
        slow(tmp_path, "a"), *alike, slow(tmp_path, "e", refusal="its clock is ruined")
    )
    _, notes, _ = outcome(corpus, 1)
    assert notes == [
        "3 recordings are left out for the same reason, the first: b: left out: b.csv: "
        "holds 2 waypoints; leave it out",
        "e: left out: e.csv: its clock is ruined; leave it out",
    ]
    nothing = dataset(slow(tmp_path, "f", refusal="ruined"), RecordingSource("none", list))
    names, notes, error = outcome(nothing, 1)
    assert names == [] and notes == ["f: left out: f.csv: ruined; leave it out"]
    assert error.startswith("root: none of the 2 recordings of split 'test' can be used")


def die_in_a_child(name):
    if multiprocessing.parent_process() is not None:
        os._exit(3)
    return walk(name)


def test_only_what_is_slow_to_read_is_given_to_processes(tmp_path):
    """A function without a name elsewhere cannot be sent to a process: it was read here. So is what
    a dead process left."""
    local = RecordingSource("local", lambda: [walk("local")])
    slowly = [slow(tmp_path, name, die_in_a_child) for name in "ab"]
    assert outcome(dataset(local, *slowly), 2) == (["local", "a", "b"], [], "")
    recordings = [recording._replace(read=lambda: pytest.fail("built")) for recording in slowly]
    assert outcome(dataset(local, *recordings), 2) == (["local", "a", "b"], [], "")


def test_a_check_tells_what_is_wrong_and_raises_nothing(tmp_path):
    recordings = [*six(tmp_path), RecordingSource("none", list)]
    recordings.append(slow(tmp_path, "g", damage="field 'gyro' is NaN"))
    checked = {recording.name: check_recording(recording, dataset()) for recording in recordings}
    reason = {name: row.reason for name, ((row,), _) in checked.items()}
    assert reason["a"] == reason["b"] == reason["e"] == ""
    assert checked["a"][0][0].check.failures == () and checked["none"][0][0].check is None
    assert checked["b"][1].notes == ("b.csv: a gap was cut off",)
    assert reason["c"] == "c.csv: its clock is ruined; leave it out"
    assert "syn is used" in checked["e"][1].notes[0]
    assert "mean of R·accel" in reason["f"]
    assert reason["none"] == "no segment of it is long enough"
    assert reason["g"] == "g.csv: field 'gyro' is NaN; copy it again"


def test_the_recordings_of_all_splits_are_found_once(tmp_path):
    shared, solo = single("shared", walk, "shared"), single("own", walk, "own")

    def recordings(root, split):
        warnings.warn(f"{root}: is incomplete", stacklevel=2)
        if split == "val":
            raise InputError(root, "has no list val", "expected layout: any")
        return [shared, solo] if split == "train" else [shared]

    corpus = dataclasses.replace(dataset(), recordings=recordings)
    index = find_recordings(corpus, Path("root"), "all")
    assert list(index.recordings) == ["shared", "own"]
    assert index.splits == {"train": ("shared", "own"), "test": ("shared",)}
    assert index.notes == ["root: is incomplete", "nothing in split val: root: has no list val"]
    with pytest.raises(InputError, match="has no list val"):
        find_recordings(corpus, Path("root"), "val")
    unknown = "unknown split 'dev'; known splits: train, val, test, all"
    with pytest.raises(InputError, match=unknown):
        find_recordings(corpus, Path("root"), "dev")
    with pytest.raises(InputError, match="split 'all' of dataset 'tlio' holds no recording"):
        find_recordings(dataset(), Path("root"), "all")


def test_work_by_processes_comes_back_in_order_and_few_results_are_held(monkeypatch):
    """Who takes one result after the other never makes more than two beyond the workers, and who
    stops early does not wait. A process that may have no children does the work itself."""
    shares, begun = [], []
    items = [(base, 2) for base in range(5)]
    assert list(in_processes(pow, items, 1, shares.append)) == [0, 1, 4, 9, 16]
    np.testing.assert_allclose(shares, [0.2, 0.4, 0.6, 0.8, 1.0])
    assert list(in_processes(pow, [], 2)) == []

    class Items(list):
        def __iter__(self):
            for item in super().__iter__():
                begun.append(item)
                yield item

    shares.clear()
    results = in_processes(pow, Items([(2, power) for power in range(12)]), 2, shares.append)
    for count in range(1, 13):
        assert next(results) == 2 ** (count - 1)
        assert len(begun) <= count + 3
    assert len(begun) == 12 and shares[-1] == 1.0
    results.close()
    results = in_processes(time.sleep, [(0.0,), (60.0,)], 2)
    next(results)
    stopped = time.monotonic()
    results.close()
    assert time.monotonic() - stopped < 30.0
    config = multiprocessing.current_process()._config  # as of a child with daemon=True
    monkeypatch.setitem(config, "daemon", True)
    assert list(in_processes(os.getpid, [(), ()], 2)) == [os.getpid()] * 2


def test_a_process_that_dies_is_told_in_one_line(tmp_path):
    items = [(partial(os._exit, 3),), (partial(int, 1),)]
    # What is called needs no import of the package in a process.
    with pytest.raises(InputError, match=r"--workers: a process died, .*memory"):
        list(in_processes(operator.call, items, 2))
    with pytest.raises(FileNotFoundError, match="nowhere"):  # the function's own error
        list(in_processes(os.stat, [(tmp_path / "nowhere",), (tmp_path,)], 2))


def write_slowly(folder, name):
    with replacing(folder / name) as temporary:
        time.sleep(1.0)
        temporary.write_text("whole")
    return walk(name)


def damaged_meanwhile(folder, name):
    """Fails while another process writes."""
    until = time.monotonic() + 60.0
    while not any(folder.iterdir()) and time.monotonic() < until:
        time.sleep(0.01)
    raise RuntimeError("is ruined")


def test_an_error_leaves_no_file_of_another_half_written(tmp_path):
    (folder := tmp_path / "written").mkdir()
    recordings = [single("a", damaged_meanwhile, folder, "a")]
    recordings += [single(name, write_slowly, folder, name) for name in "bc"]
    recordings = [
        recording._replace(slow=True, files=(tmp_path / recording.name,))
        for recording in recordings
    ]
    with pytest.raises(RuntimeError, match="is ruined"):
        list(read_split(dataset(*recordings), tmp_path, "test", workers=2))
    names = {path.name for path in folder.iterdir()}
    assert "b" in names <= {"b", "c"}


def grow(number, ballast=[]):
    """Grow by more than a process may, at bounds that no memory is needed for."""
    from loky import process_executor as bounds

    assert bounds._MAX_MEMORY_LEAK_SIZE > 1e6 and bounds._MEMORY_LEAK_CHECK_DELAY > 0
    bounds._MAX_MEMORY_LEAK_SIZE, bounds._MEMORY_LEAK_CHECK_DELAY = 2e6, 0.01
    ballast.append(b"x" * 20_000_000)
    time.sleep(0.05)
    return number, os.getpid()


@pytest.mark.slow
def test_a_process_that_grows_is_replaced_without_a_word():
    pytest.importorskip("psutil")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        numbers, processes = zip(*in_processes(grow, [(k,) for k in range(8)], 2), strict=True)
    assert numbers == tuple(range(8)) and len(set(processes)) > 2 and not caught


# --- the cache


class Reader:
    """Counts its calls; makes a sequence whose first position says which one it was."""

    def __init__(self, error=None, warning="", names=("walk",)):
        self.calls, self.error, self.warning, self.names = 0, error, warning, names

    def __call__(self):
        self.calls += 1
        if self.warning:
            warnings.warn(self.warning, stacklevel=1)
        if self.error is not None:
            raise self.error
        walked = circle(seconds=1.0)
        moved = walked.position + self.calls
        return [walked._replace(name=name, position=moved) for name in self.names]


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("GNIO_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def source(cache):
    path = cache.parent / "imu.csv"
    path.write_text("1,2,3")
    return path


def call(reader, *files, name="walk"):
    """Which call of `reader` made what reading gives."""
    (sequence,) = read_recording(RecordingSource(name, reader, files, slow=True)).sequences
    return round(float(sequence.position[0, 0] - circle(seconds=1.0).position[0, 0]))


def test_the_second_reading_is_what_the_first_made_and_says_what_lists_say(source, cache, tmp_path):
    reader = Reader()
    assert call(reader, source) == 1 and len(list(cache.iterdir())) == 1
    assert call(reader, source) == 1 and reader.calls == 1
    assert call(reader, source, name="other") == 2
    for _ in range(2):
        (sequence,) = read_recording(slow(tmp_path, "a")).sequences
        assert sequence.attributes == {"dataset": "test", "lists": "three"}


def test_a_changed_file_or_package_is_read_again(source, tmp_path, monkeypatch):
    reader, other = Reader(), tmp_path / "sensor.yaml"
    assert call(reader, source) == 1
    status = source.stat()
    os.utime(source, ns=(status.st_atime_ns, status.st_mtime_ns + 1))
    assert call(reader, source) == 2
    source.write_text("1,2,3,4")
    os.utime(source, ns=(status.st_atime_ns, status.st_mtime_ns + 1))
    assert call(reader, source) == 3
    assert call(reader, source, other) == call(reader, source, other) == 4
    other.write_text("T_BS:")  # which was not there
    assert call(reader, source, other) == call(reader, source, other) == 5
    monkeypatch.setattr(hdf5, "_sources", lambda: "of another version")
    assert call(reader, source, other) == 6


def test_a_change_of_any_file_in_a_folder_is_read_again(cache):
    """The files of comma2k19 lie some folders below that of a minute, whose own time does not
    change with them."""
    folder, reader = cache.parent / "minute", Reader()
    inner = folder / "processed_log" / "IMU" / "gyro"
    inner.mkdir(parents=True)
    (inner / "value").write_text("1,2,3")
    status = (inner / "value").stat()
    assert call(reader, folder) == call(reader, folder) == 1
    (inner / "value").write_text("1,2,4")
    os.utime(inner / "value", ns=(status.st_atime_ns, status.st_mtime_ns + 1))
    assert call(reader, folder) == call(reader, folder) == 2
    (inner / "t").write_text("0")
    assert call(reader, folder) == call(reader, folder) == 3
    (inner / "t").unlink()
    assert call(reader, folder) == 4 and len(list(cache.iterdir())) == 1


def test_a_changed_reader_of_a_plugin_is_read_again(cache, source, monkeypatch):
    """A sign that is corrected in a plugin must show."""
    plugin = cache.parent / "mine.py"
    code = "from tests.support.circle import circle\n\n\ndef read(path):\n    return [CIRCLE]\n"
    turns = []
    for number, change in enumerate(("", "", "._replace(gyro=-circle(seconds=1.0).gyro)")):
        plugin.write_text(code.replace("CIRCLE", f"circle(seconds=1.0){change}"))
        os.utime(plugin, ns=(0, 10**9 * (number // 2)))
        spec = importlib.util.spec_from_file_location("gnio_jax_plugin_mine", plugin)
        module = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, "gnio_jax_plugin_mine", module)
        exec(compile(plugin.read_text(), plugin, "exec"), module.__dict__)
        recording = RecordingSource("walk", partial(module.read, source), (source,), slow=True)
        (sequence,) = read_recording(recording).sequences
        turns.append(sequence.gyro[0, 2])
    assert turns[0] == turns[1] == -turns[2] != 0


def test_a_recording_that_names_no_files_is_read_every_time(cache):
    """Otherwise it would be taken for another one of this name, in any folder."""
    reader = Reader()
    assert (call(reader), call(reader)) == (1, 2) and not cache.exists()


def test_a_new_entry_takes_the_place_of_those_of_the_same_recording(source, cache, monkeypatch):
    form = RecordingSource("walk", Reader(), (source,), slow=True, form="syn")

    def read_all():
        for name in ("walk", "other"):
            call(Reader(), source, name=name)
        read_recording(form)
        return set(cache.iterdir())

    before = read_all()
    monkeypatch.setattr(hdf5, "_sources", lambda: "of another version")
    call(Reader(), source)
    between = set(cache.iterdir())
    assert len(before) == len(between) == 3 and len(between & before) == 2
    after = read_all()
    assert len(after) == 3 and not after & before


def test_the_sources_that_decide_what_is_read_are_part_of_the_key(monkeypatch):
    read, digests = Path.read_bytes, []
    for name in ("none of them", "resampling.py", "numerics.py", "tlio.py"):
        hdf5._sources.cache_clear()
        changed = lambda path, name=name: read(path) + (b"#" if path.name == name else b"")  # noqa: E731
        monkeypatch.setattr(Path, "read_bytes", changed)
        digests.append(hdf5._sources())
    assert len(set(digests)) == 4
    monkeypatch.undo()
    hdf5._sources.cache_clear()
    assert hdf5._sources() == digests[0]


def test_an_entry_that_is_damaged_or_cannot_be_written_is_made_anew(source, cache, monkeypatch):
    reader = Reader()
    call(reader, source)
    (entry,) = cache.iterdir()
    entry.write_bytes(entry.read_bytes()[:300])
    assert call(reader, source) == call(reader, source) == reader.calls == 2
    monkeypatch.setenv("GNIO_CACHE", str(source / "below a file"))
    assert call(reader, source) == 3 and call(reader, source) == 4
    # Where nobody has said where it lies:
    monkeypatch.delenv("GNIO_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    assert hdf5.cache_folder() == cache / "gnio-jax"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", "/home/walker")
    assert str(hdf5.cache_folder()) == "/home/walker/.cache/gnio-jax"


def test_a_refusal_is_remembered_and_damage_is_not(source, cache):
    reader = Reader(Refusal(source, "field 'time' is ruined", "leave it out"))
    recording = RecordingSource("walk", reader, (source,), slow=True)
    for _ in range(2):
        reading = read_recording(recording)
        assert reading.refusals == (f"{source}: field 'time' is ruined; leave it out",)
        assert not reading.sequences and reader.calls == 1
    (entry,) = cache.iterdir()
    entry.write_text("{")
    assert read_recording(recording).refusals and reader.calls == 2
    broken = Reader(InputError(source, "field 'gyro' is NaN"))
    for calls in (1, 2):
        reading = read_recording(RecordingSource("other", broken, (source,), slow=True))
        assert str(reading.damage).endswith("field 'gyro' is NaN") and broken.calls == calls


def test_what_the_reader_warned_of_is_kept_with_every_segment(source):
    reader = Reader(warning="imu.csv: a gap was cut off", names=("b", "a", "c"))
    recording = RecordingSource("walk", reader, (source,), slow=True)
    for _ in range(2):
        reading = read_recording(recording)
        assert reading.notes == ("imu.csv: a gap was cut off",) and reader.calls == 1
        assert [sequence.name for sequence in reading.sequences] == ["b", "a", "c"]
        assert all(sequence.attributes == {"dataset": "test"} for sequence in reading.sequences)


# --- names, roots and splits


def test_the_root_is_the_argument_then_the_environment_then_the_working_folder(
    tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("GNIO_DATA", raising=False)
    corpus, elsewhere, local = data.get("tlio"), tmp_path / "elsewhere", tmp_path / "data" / "tlio"
    with pytest.raises(InputError) as error:
        data.find_root("tlio")
    assert all(words in str(error.value) for words in ("data/tlio", corpus.source, corpus.layout))
    monkeypatch.setenv("GNIO_DATA", str(elsewhere))
    for folder in (local, elsewhere / "tlio_layout", elsewhere / "tlio"):
        folder.mkdir(parents=True)
        assert data.find_root("tlio").resolve() == folder
    assert data.find_root("tlio", str(local)) == local
    with pytest.raises(InputError, match=r"nowhere: no folder of dataset 'tlio'"):
        data.find_root("tlio", tmp_path / "nowhere")


def test_a_dataset_of_ones_own_is_loaded_by_its_name(monkeypatch, tmp_path):
    monkeypatch.setattr(registry, "DATASETS", dict(DATASETS))
    monday = dataset(single("monday", walk, "monday"))
    mine = dataclasses.replace(monday, name="mine", licence="as I like")
    for _ in range(2):  # a cell of a notebook that runs again
        data.register(mine)
    assert "mine" in data.names() and data.get("mine") is mine
    [sequence] = data.load("mine", tmp_path)
    assert (sequence.name, sequence.attributes["licence"]) == ("monday", "as I like")
    with pytest.raises(InputError, match="dataset 'tlio': is a dataset of gnio-jax"):
        data.register(dataset())


def test_a_split_without_a_sequence_or_with_two_of_one_name_is_an_error(tmp_path, monkeypatch):
    monkeypatch.setitem(DATASETS, "tlio", dataset())
    with pytest.raises(InputError, match="split 'test' of dataset 'tlio' holds no sequence"):
        data.load("tlio", tmp_path)
    twice = [single(name, walk, "walk") for name in ("monday", "tuesday")]
    monkeypatch.setitem(DATASETS, "tlio", dataset(*twice))
    with pytest.raises(InputError, match="two sequences of split 'test' have the name 'walk'"):
        data.load("tlio", tmp_path)
