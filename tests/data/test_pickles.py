"""No file of any layout is unpickled: what would execute is refused unexecuted."""

from __future__ import annotations

import io
import os
import pickle
from collections.abc import Callable, Iterator
from pathlib import Path, PurePosixPath
from typing import Any

import h5py
import numpy as np
import pytest

from gnio_jax.errors import InputError
from tests.support.damage import Damage
from tests.support.damaged_recordings import check, remove_copies, written


@pytest.fixture(scope="module", autouse=True)
def _copies_are_removed() -> Iterator[None]:
    yield
    remove_copies()


class Bomb:
    """Whoever unpickles it makes a folder."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.folder),)


def objects(bomb: Bomb, count: int = 1) -> np.ndarray:
    array = np.empty(count, dtype=object)
    array[:] = [bomb] * count
    return array


def of_numpy(bomb: Bomb) -> bytes:
    out = io.BytesIO()
    np.save(out, objects(bomb), allow_pickle=True)
    return out.getvalue()


def of_numpy_zip(bomb: Bomb) -> bytes:
    """The gyro and accelerometer of an otherwise sound piece."""
    out = io.BytesIO()
    with np.load(io.BytesIO(next(iter(written("kitti npz").values())))) as file:
        arrays = {field: file[field] for field in file.files}
    arrays["u"] = objects(bomb, len(arrays["t"]))
    np.savez(out, allow_pickle=True, **arrays)
    return out.getvalue()


def of_hdf5(bomb: Bomb, name: str, field: str) -> bytes:
    """Pickled bytes in place of a field, and as its attribute: what PyTables and pandas load."""
    content = next(
        content for file, content in written(name).items() if file.endswith((".h5", ".hdf5"))
    )
    out = io.BytesIO(content)
    with h5py.File(out, "r+") as file:
        del file[field]
        file[field] = np.void(pickle.dumps(bomb))
        file[field].attrs["TITLE"] = np.void(pickle.dumps(bomb))
        file.attrs["pandas_type"] = np.void(pickle.dumps(bomb))
    return out.getvalue()


def of_feather(bomb: Bomb) -> bytes:
    """A column of the extension type that old versions of pyarrow unpickled."""
    pyarrow, feather = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.feather")
    table = feather.read_table(io.BytesIO(written("idol")["building1/known/3.feather"]))
    about = {
        "ARROW:extension:name": "arrow.py_extension_type",
        "ARROW:extension:metadata": pickle.dumps(bomb),
    }
    field = pyarrow.field("timestamp", table["timestamp"].type, metadata=about)
    table = table.set_column(table.column_names.index("timestamp"), field, table["timestamp"])
    out = io.BytesIO()
    feather.write_feather(table, out)
    return out.getvalue()


PICKLES: dict[str, tuple[str, str, Callable[[Bomb], bytes]]] = {
    "npy of objects": ("tlio", "walk/imu0_resampled.npy", of_numpy),
    "npy": ("tlio", "walk/imu0_resampled.npy", pickle.dumps),
    "npz of objects": ("kitti npz", "train__2011_09_26_drive_0014_extract0.npz", of_numpy_zip),
    "npz": ("kitti npz", "train__2011_09_26_drive_0014_extract0.npz", pickle.dumps),
    "field of RoNIN": (
        "ronin",
        "a011_2/data.hdf5",
        lambda bomb: of_hdf5(bomb, "ronin", "synced/acce"),
    ),
    "RoNIN": ("ronin", "a011_2/data.hdf5", pickle.dumps),
    "field of Blackbird": (
        "blackbird",
        "clover/yawForward/maxSpeed5p0/test/data.hdf5",
        lambda bomb: of_hdf5(bomb, "blackbird", "traj_target"),
    ),
    "field of our own": ("hdf5", "walk.h5", lambda bomb: of_hdf5(bomb, "hdf5", "gyro")),
    "device of our own": (
        "hdf5",
        "walk.h5",
        lambda bomb: of_hdf5(bomb, "hdf5", "device_orientation"),
    ),
    "our own": ("hdf5", "walk.h5", pickle.dumps),
    "feather": ("idol", "building1/known/3.feather", pickle.dumps),
    "table of text": ("csv", "walk.csv", pickle.dumps),
    "JSON": ("ronin", "a011_2/info.json", pickle.dumps),
    "YAML": (
        "euroc",
        "MH_04_difficult/mav0/imu0/sensor.yaml",
        lambda bomb: f"T_BS: !!python/object/apply:os.mkdir ['{bomb.folder}']\n".encode(),
    ),
}


@pytest.mark.parametrize("kind", PICKLES)
def test_what_would_execute_is_refused_unexecuted(tmp_path, kind):
    name, file, make = PICKLES[kind]
    trap = tmp_path / "trap"
    content = make(Bomb(trap))
    assert not trap.exists() and content != written(name)[file]
    result, said = check(name, [Damage(file, "content", token=content)])
    assert not trap.exists(), "it was executed"
    assert isinstance(result, InputError) and PurePosixPath(file).name in said


def test_an_extension_type_of_feather_is_not_unpickled(tmp_path):
    trap = tmp_path / "trap"
    check("idol", [Damage("building1/known/3.feather", "content", token=of_feather(Bomb(trap)))])
    assert not trap.exists()


def test_the_trap_works(tmp_path):
    """Were pickles loaded, the tests above would see it."""
    with np.load(io.BytesIO(of_numpy_zip(Bomb(tmp_path / "zip"))), allow_pickle=True) as file:
        assert file["u"].dtype == object
    np.load(io.BytesIO(of_numpy(Bomb(tmp_path / "npy"))), allow_pickle=True)
    pickle.loads(pickle.dumps(Bomb(tmp_path / "raw")))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["npy", "raw", "zip"]
