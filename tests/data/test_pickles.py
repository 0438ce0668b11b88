"""What would execute when it is loaded is refused unexecuted: pickles in NumPy's files, tags of
YAML. (h5py, pandas and pyarrow execute nothing.)"""

from __future__ import annotations

import io
import os
import pickle

import numpy as np
import pytest

from gnio_jax.errors import InputError
from tests.support.damage import Damage
from tests.support.damaged_recordings import check, written


class Bomb:
    """Whoever unpickles it makes a folder."""

    def __init__(self, folder):
        self.folder = str(folder)

    def __reduce__(self):
        return os.mkdir, (self.folder,)


def of_numpy(bomb):
    out = io.BytesIO()
    np.save(out, np.array([bomb], dtype=object), allow_pickle=True)
    return out.getvalue()


def of_numpy_zip(bomb):
    """The gyro and accelerometer of an otherwise sound piece."""
    (content,), out = written("kitti npz").values(), io.BytesIO()
    with np.load(io.BytesIO(content)) as file:
        arrays = dict(file)
    np.savez(out, allow_pickle=True, **arrays | {"u": np.array([bomb], dtype=object)})
    return out.getvalue()


def of_yaml(bomb):
    return f"T_BS: !!python/object/apply:os.mkdir ['{bomb.folder}']\n".encode()


@pytest.mark.parametrize(
    ("layout", "ending", "make"),
    [
        ("tlio", ".npy", pickle.dumps),
        ("tlio", ".npy", of_numpy),
        ("kitti npz", ".npz", of_numpy_zip),
        ("euroc", "imu0/sensor.yaml", of_yaml),
    ],
)
def test_what_would_execute_is_refused_unexecuted(tmp_path, layout, ending, make):
    (file,) = (file for file in written(layout) if file.endswith(ending))
    content = make(Bomb(tmp_path / "trap"))
    result, said = check(layout, [Damage(file, "content", token=content)])
    assert isinstance(result, InputError) and file in said
    assert not (tmp_path / "trap").exists(), "it was executed"
    if make is not of_yaml:  # were pickles loaded, this would have seen it
        loaded = np.load(io.BytesIO(content), allow_pickle=True)
        _ = loaded["u"] if make is of_numpy_zip else loaded
        assert (tmp_path / "trap").exists()
