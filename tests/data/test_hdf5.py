"""What is written comes back to the bit; what is damaged is named."""

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
    with h5py.File(path, "w") as file:
        file["synced"] = 1.0
    fails("format")
    path.unlink()
    fails("no such file")


def test_a_mistake_of_ours_and_a_lack_of_memory_are_no_damage(tmp_path, monkeypatch):
    path = tmp_path / "walk.h5"
    write_hdf5(path, circle())
    for place, error, told, words in (
        ("Sequence", TypeError("ours"), TypeError, "ours"),
        ("hdf5_field", NameError("ours"), NameError, "ours"),
        ("hdf5_field", MemoryError(), InputError, "does not fit into memory"),
    ):

        def fails(*_, error=error, **__):
            raise error

        with monkeypatch.context() as patch, pytest.raises(told, match=words):
            patch.setattr(hdf5, place, fails)
            read_hdf5(path)


def test_a_failed_write_leaves_the_old_file(tmp_path):
    path = tmp_path / "walk.h5"
    write_hdf5(path, circle())
    before = path.read_bytes()
    with pytest.raises(InputError, match="'shape' is list"):
        write_hdf5(path, circle()._replace(attributes={"shape": [1, 2]}))
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
