"""The cache rebuilds when, and only when, the files or the loader changed."""

import os
import warnings

import numpy as np
import pytest

from gnio_jax.data.cache import cached, folder, is_cached, is_refused
from gnio_jax.data.dataset import Refusal
from gnio_jax.errors import InputError
from gnio_jax.types import Sequence


class Builder:
    """Counts its calls; makes a sequence whose first position tells which one it was."""

    def __init__(self, error=None):
        self.calls, self.error = 0, error

    def __call__(self):
        self.calls += 1
        if self.error is not None:
            raise self.error
        n = 5
        still = np.zeros((n, 3))
        sequence = Sequence(
            name="walk",
            time=np.arange(n) / 100,
            gyro=still,
            accel=still + np.array([0, 0, 9.81]),
            orientation=np.tile([1.0, 0, 0, 0], (n, 1)),
            position=still + self.calls,
            velocity=still,
            valid=np.ones(n, dtype=bool),
        )
        return [sequence]


def one(files, version, build):
    """What `cached` gives of a recording that is one sequence."""
    (sequence,) = cached(files, version, build)
    return sequence


@pytest.fixture
def source(tmp_path, monkeypatch):
    monkeypatch.setenv("GNIO_CACHE", str(tmp_path / "cache"))
    path = tmp_path / "imu.csv"
    path.write_text("1,2,3")
    return path


def test_the_second_call_reads_what_the_first_made(source):
    build = Builder()
    assert not is_cached([source], "v1")
    assert one([source], "v1", build).position[0, 0] == 1
    assert is_cached([source], "v1") and not is_cached([source], "v2")
    assert not is_refused([source], "v1")
    assert one([str(source)], "v1", build).position[0, 0] == 1 and build.calls == 1


def test_a_changed_file_or_loader_is_built_again(source, tmp_path):
    build = Builder()
    one([source], "v1", build)
    assert one([source], "v2", build).position[0, 0] == 2
    status = source.stat()
    os.utime(source, ns=(status.st_atime_ns, status.st_mtime_ns + 1))
    assert one([source], "v1", build).position[0, 0] == 3
    source.write_text("1,2,3,4")
    os.utime(source, ns=(status.st_atime_ns, status.st_mtime_ns))
    assert one([source], "v1", build).position[0, 0] == 4
    other = tmp_path / "vi.csv"
    other.write_text("x")
    assert one([source, other], "v1", build).position[0, 0] == 5
    assert one([source, other], "v1", build).position[0, 0] == 5


def test_a_damaged_entry_is_made_anew(source):
    build = Builder()
    one([source], "v1", build)
    (entry,) = folder().iterdir()
    entry.write_bytes(entry.read_bytes()[:300])
    assert one([source], "v1", build).position[0, 0] == 2
    assert one([source], "v1", build).position[0, 0] == 2 and build.calls == 2


def test_a_refusal_is_remembered_and_other_errors_are_not(source):
    build = Builder(Refusal(source, "field 'time' is ruined", "leave it out"))
    messages = []
    for _ in range(2):
        with pytest.raises(Refusal) as refused:
            one([source], "v1", build)
        messages.append(str(refused.value))
    assert (
        build.calls == 1
        and messages[0] == messages[1] == f"{source}: field 'time' is ruined; leave it out"
    )
    assert is_refused([source], "v1") and not is_cached([source], "v1")
    (entry,) = folder().iterdir()
    entry.write_text("{")
    with pytest.raises(Refusal):
        one([source], "v1", build)
    assert build.calls == 2

    broken = Builder(InputError(source, "field 'gyro' is NaN"))
    for _ in range(2):
        with pytest.raises(InputError):
            one([source], "v2", broken)
    assert broken.calls == 2


def test_what_the_loader_warned_of_is_said_again(source):
    def build():
        warnings.warn("imu.csv: a gap was cut off", stacklevel=2)
        return Builder()()

    for _ in range(2):
        with pytest.warns(UserWarning, match="a gap was cut off") as said:
            sequence = one([source], "v1", build)
        assert len(said) == 1 and sequence.attributes == {}
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        one([source], "v2", Builder())


def test_a_cache_that_cannot_be_written_is_no_error(source, tmp_path, monkeypatch):
    monkeypatch.setenv("GNIO_CACHE", str(source / "below a file"))
    build = Builder()
    assert (
        one([source], "v1", build).position[0, 0] == 1
        and one([source], "v1", build).position[0, 0] == 2
    )
    with pytest.raises(Refusal):
        one([source], "v1", Builder(Refusal(source, "ruined")))


def test_a_missing_source_is_named(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.csv: cannot be read"):
        one([tmp_path / "nowhere.csv"], "v1", Builder())


def test_where_the_cache_lies(monkeypatch, tmp_path):
    monkeypatch.setenv("GNIO_CACHE", "/a/b")
    assert str(folder()) == "/a/b"
    monkeypatch.delenv("GNIO_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert folder() == tmp_path / "gnio-jax"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", "/home/walker")
    assert str(folder()) == "/home/walker/.cache/gnio-jax"


def test_several_sequences_of_one_recording_come_back_in_order(source):
    build = Builder()

    def pieces():
        warnings.warn("divided", stacklevel=1)
        return [build()[0]._replace(name=f"walk_piece{k}") for k in (1, 2, 3)]

    for calls in (3, 3):
        with pytest.warns(UserWarning, match="divided") as caught:
            found = cached([source], "v1", pieces)
        assert [sequence.name for sequence in found] == [
            "walk_piece1",
            "walk_piece2",
            "walk_piece3",
        ]
        assert [sequence.position[0, 0] for sequence in found] == [1, 2, 3] and build.calls == calls
        assert len(caught) == 1 and all(sequence.attributes == {} for sequence in found)
    # One of them lost or damaged: all are made anew.
    for spoil in (lambda entry: entry.unlink(), lambda entry: entry.write_bytes(b"HDF")):
        before = build.calls
        spoil(sorted(folder().iterdir())[1])
        with pytest.warns(UserWarning, match="divided"):
            assert len(cached([source], "v1", pieces)) == 3
        assert build.calls == before + 3
