"""No file of any layout is unpickled: what would execute is refused unexecuted."""

from __future__ import annotations

import io
import os
import pickle
from pathlib import Path, PurePosixPath

import h5py
import numpy as np
import pytest

from gnio_jax.errors import InputError
from tests.support.damage import Damage
from tests.support.damaged_recordings import check, written


class Bomb:
    """Whoever unpickles it makes a folder."""

    def __init__(self, folder: Path):
        self.folder = folder

    def __reduce__(self):
        return os.mkdir, (str(self.folder),)


def file_of(layout: str, ending: str) -> str:
    return next(file for file in written(layout) if file.endswith(ending))


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
    with np.load(io.BytesIO(written("kitti npz")[file_of("kitti npz", ".npz")])) as file:
        arrays = dict(file)
    arrays["u"] = objects(bomb, len(arrays["t"]))
    np.savez(out, allow_pickle=True, **arrays)
    return out.getvalue()


def of_hdf5(layout: str, ending: str, field: str):
    """Pickled bytes in place of a field, and as its attribute: what PyTables and pandas load."""

    def make(bomb: Bomb) -> bytes:
        out = io.BytesIO(written(layout)[file_of(layout, ending)])
        with h5py.File(out, "r+") as file:
            del file[field]
            file[field] = np.void(pickle.dumps(bomb))
            file[field].attrs["TITLE"] = np.void(pickle.dumps(bomb))
            file.attrs["pandas_type"] = np.void(pickle.dumps(bomb))
        return out.getvalue()

    return layout, ending, make


def of_yaml(bomb: Bomb) -> bytes:
    return f"T_BS: !!python/object/apply:os.mkdir ['{bomb.folder}']\n".encode()


def of_feather(bomb: Bomb) -> bytes:
    """A column of the extension type that old versions of pyarrow unpickled."""
    pyarrow, feather = pytest.importorskip("pyarrow"), pytest.importorskip("pyarrow.feather")
    table = feather.read_table(io.BytesIO(written("idol")[file_of("idol", ".feather")]))
    about = {
        "ARROW:extension:name": "arrow.py_extension_type",
        "ARROW:extension:metadata": pickle.dumps(bomb),
    }
    field = pyarrow.field("timestamp", table["timestamp"].type, metadata=about)
    table = table.set_column(table.column_names.index("timestamp"), field, table["timestamp"])
    out = io.BytesIO()
    feather.write_feather(table, out)
    return out.getvalue()


WHOLE = [("tlio", ".npy"), ("kitti npz", ".npz"), ("ronin", ".hdf5"), ("ronin", ".json")]
WHOLE += [("hdf5", ".h5"), ("idol", ".feather"), ("csv", ".csv")]
PICKLES = [
    *((*place, pickle.dumps) for place in WHOLE),
    ("tlio", ".npy", of_numpy),
    ("kitti npz", ".npz", of_numpy_zip),
    ("euroc", "imu0/sensor.yaml", of_yaml),
    of_hdf5("ronin", ".hdf5", "synced/acce"),
    of_hdf5("blackbird", ".hdf5", "traj_target"),
    of_hdf5("hdf5", ".h5", "gyro"),
    of_hdf5("hdf5", ".h5", "device_orientation"),
]


@pytest.mark.parametrize(("layout", "ending", "make"), PICKLES)
def test_what_would_execute_is_refused_unexecuted(tmp_path, layout, ending, make):
    file, trap = file_of(layout, ending), tmp_path / "trap"
    content = make(Bomb(trap))
    assert not trap.exists() and content != written(layout)[file]
    result, said = check(layout, [Damage(file, "content", token=content)])
    assert not trap.exists(), "it was executed"
    assert isinstance(result, InputError) and PurePosixPath(file).name in said


def test_an_extension_type_of_feather_is_not_unpickled(tmp_path):
    content, file = of_feather(Bomb(tmp_path / "trap")), file_of("idol", ".feather")
    check("idol", [Damage(file, "content", token=content)])
    assert not (tmp_path / "trap").exists()


def test_the_trap_works(tmp_path):
    """Were pickles loaded, the tests above would see it."""
    with np.load(io.BytesIO(of_numpy_zip(Bomb(tmp_path / "zip"))), allow_pickle=True) as file:
        assert file["u"].dtype == object
    np.load(io.BytesIO(of_numpy(Bomb(tmp_path / "npy"))), allow_pickle=True)
    pickle.loads(pickle.dumps(Bomb(tmp_path / "raw")))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["npy", "raw", "zip"]
