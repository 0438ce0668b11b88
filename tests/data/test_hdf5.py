"""What is written comes back to the bit; what is damaged is named."""

import errno
import subprocess
import sys

import h5py
import numpy as np
import pytest

from gnio_jax.data import hdf5
from gnio_jax.data.hdf5 import read_hdf5, write_hdf5
from gnio_jax.errors import InputError
from gnio_jax.types import Waypoints
from tests.support.circle import changed, circle
from tests.support.sequences import assert_same_arrays


@pytest.mark.parametrize("device", [True, False])
def test_hdf5_returns_every_bit(tmp_path, device):
    sequence = changed(circle(), "valid", 3, False)
    sequence = changed(sequence, "position", 3, np.nan)._replace(
        device_orientation=circle().orientation if device else None,
        imu_valid=circle().time < 0.5 if device else None,
        waypoints=None if device else Waypoints(np.arange(3.0), np.eye(3)[:, :2]),
        attributes={"truth": "Vicon", "rows": 7, "bias": 0.25, "calibrated": True, "person": "Ö"},
    )
    path = tmp_path / "deep" / "walk.h5"
    write_hdf5(path, sequence)
    back = read_hdf5(path)
    assert back.name == "circle" and back.attributes == sequence.attributes
    assert {key: type(value) for key, value in back.attributes.items()} == {
        key: type(value) for key, value in sequence.attributes.items()
    }
    assert_same_arrays(back, sequence)


def test_hdf5_that_is_cut_short_or_foreign_is_named(tmp_path):
    path = tmp_path / "walk.h5"
    write_hdf5(path, circle())
    whole = path.read_bytes()

    def fails(*words):
        with pytest.raises(InputError) as error:
            read_hdf5(path)
        assert str(error.value).startswith(f"{path}: ")
        assert all(word in str(error.value) for word in words)
        assert "cut short" in words or "cut short" not in str(error.value)

    for content in (whole[: len(whole) // 2], whole[:9], b"", b"time,gyro_x\n0,1\n"):
        path.write_bytes(content)
        fails("cut short")
    path.write_bytes(whole)
    with h5py.File(path, "a") as file:
        del file["gyro"]
        file["gyro"] = h5py.SoftLink("/accel")
    fails("field 'gyro' is a link")
    with h5py.File(path, "a") as file:
        file.attrs["format"] = "gnio-jax sequence 2"
    fails("is not a 'gnio-jax sequence 1' file (format: 'gnio-jax sequence 2')")
    with h5py.File(path, "w") as file:
        file["synced"] = 1.0
    fails("format")
    path.unlink()
    fails("no such file")


def test_a_mistake_of_ours_and_a_lack_of_memory_are_no_damage(tmp_path, monkeypatch):
    path = tmp_path / "walk.h5"
    write_hdf5(path, circle())
    for name, error, expected, words in (
        ("Sequence", TypeError("ours"), TypeError, "ours"),
        ("hdf5_field", NameError("ours"), NameError, "ours"),
        ("hdf5_field", MemoryError(), InputError, "does not fit into memory"),
    ):

        def fails(*_, error=error, **__):
            raise error

        with monkeypatch.context() as patch, pytest.raises(expected, match=words):
            patch.setattr(hdf5, name, fails)
            read_hdf5(path)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "walk.h5"
    write_hdf5(path, circle())
    before = path.read_bytes()
    with pytest.raises(InputError, match="'shape' is list"):
        write_hdf5(path, circle()._replace(attributes={"shape": [1, 2]}))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    "key, value, shown",
    [
        ("start_time", "abc", "'abc', no possible number"),
        ("start_time", np.nan, "nan, no possible number"),
        ("start_time", np.inf, "inf, no possible number"),
        ("start_time", np.arange(2.0), r"array\(\[0., 1.\]\), no text or number"),
        ("recorded_rate", "fast", "'fast', no possible number"),
        ("recorded_rate", 0.0, "0.0, no possible number"),
        ("recorded_rate", -5, "-5, no possible number"),
        ("accel_clipped", -0.5, "-0.5, no possible number"),
        ("group", np.array(["a", "b"], "S1"), r"array\(.*\), no text or number"),
        ("person", 1j, "1j, no text or number"),
        ("person", h5py.Empty("f8"), r"Empty\(.*\), no text or number"),
    ],
)
def test_an_attribute_of_another_program_is_named(tmp_path, key, value, shown):
    path = tmp_path / "walk.h5"
    write_hdf5(path, circle()._replace(attributes={"start_time": -12.5, "accel_clipped": 0.0}))
    assert read_hdf5(path).attributes == {"start_time": -12.5, "accel_clipped": 0.0}
    with h5py.File(path, "a") as file:
        file["attributes"].attrs[key] = value
    with pytest.raises(InputError, match=rf"walk\.h5: attribute '{key}' is .*{shown}; convert"):
        read_hdf5(path)


def limited(code, limit=120_000):
    """Run `code` in a process in which a file can have so many bytes, as on a full disk."""
    start = f"import resource; resource.setrlimit(resource.RLIMIT_FSIZE, ({limit}, {limit}))\n"
    imports = "from tests.support.circle import circle\nfrom gnio_jax.data import hdf5\n"
    return subprocess.run(
        [sys.executable, "-c", start + imports + code], capture_output=True, text=True
    )


def test_a_recording_on_a_full_disk_leaves_the_old_one_and_is_an_error(tmp_path):
    path = tmp_path / "walk.h5"
    write_hdf5(path, circle(seconds=4.0))
    before = path.read_bytes()
    for seconds in (8.0, 60.0):  # with fields below and above the buffers of the library
        code = f"hdf5.write_hdf5({str(path)!r}, circle(seconds={seconds}))"
        process = limited(code, 60_000)
        assert process.returncode == 1
        last = process.stderr.splitlines()[-1]
        assert last.startswith(f"OSError: [Errno {errno.EFBIG}]") and last.endswith(f"'{path}'")
        assert "Exception ignored" not in process.stderr
        assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]


def test_a_cache_on_a_full_disk_is_no_error(tmp_path):
    """Nor are its texts that HDF5 does not store."""
    entry = tmp_path / "cache" / "a-b.h5"
    code = f"""from pathlib import Path
entry = Path({str(entry)!r})
for name in ("walk", "w\\0lk"):
    reading = hdf5.Reading([circle(seconds=60.0)._replace(name=name)])
    assert hdf5.write_reading(entry, reading) is None
    assert hdf5.read_reading(entry) is None
"""
    process = limited(code)
    assert (process.returncode, process.stderr) == (0, "")
    assert list(entry.parent.iterdir()) == []
    hdf5.write_reading(entry, hdf5.Reading([circle()._replace(name="w\0lk")]))
    assert not entry.exists()


def test_a_cache_entry_with_nothing_in_it_is_none(tmp_path):
    """It neither gives a recording nor says why there is none, so the recording is read again."""
    entry = tmp_path / "a-b.h5"
    hdf5.write_reading(entry, hdf5.Reading([], notes=("a remark",)))
    assert entry.exists() and hdf5.read_reading(entry) is None
    hdf5.write_reading(entry, hdf5.Reading([], refusals=("it has no gyro",)))
    refused = hdf5.read_reading(entry)
    assert refused is not None and refused.refusals == ("it has no gyro",)


@pytest.mark.parametrize("name", ["w\0lk", "w\udcfflk"])
def test_a_text_that_hdf5_cannot_store_is_named(tmp_path, name):
    path = tmp_path / "walk.h5"
    with pytest.raises(InputError, match=r"the name 'w\\.*lk' is no text; rename it"):
        write_hdf5(path, circle()._replace(name=name))
    with pytest.raises(InputError, match=r"attribute 'person' is 'w\\.*lk'; attributes are"):
        write_hdf5(path, circle()._replace(attributes={"person": name}))
    with pytest.raises(InputError, match="attribute 'count' is 1180591620717411303424; attrib"):
        write_hdf5(path, circle()._replace(attributes={"count": 2**70}))
    assert list(tmp_path.iterdir()) == []
