"""Damaged files are read, or refused in one line: nothing else may come of them."""

from __future__ import annotations

import numpy as np
import pytest

from gnio_jax.errors import InputError
from tests.support import bag_files, logger_files
from tests.support.importing import import_recording

KINDS = ("walk.zip", "walk.xlsx", "walk.xls", "rosbag1", "mcap", "db3")


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Kind -> a path of it."""
    folder = tmp_path_factory.mktemp("whole")
    logger_files.workbooks(folder, logger_files.phyphox_sets(seconds=2.0))
    found = {name: folder / name for name in ("walk.xlsx", "walk.xls")}
    members = logger_files.sensor_logger("ios", seconds=2.0)
    found["walk.zip"] = logger_files.zipped(folder / "walk.zip", members)
    for kind in ("rosbag1", "mcap", "db3"):
        (folder / kind).mkdir()
        entries = bag_files.imu(bag_files.Maker(kind), seconds=2.0)
        found[kind] = bag_files.write(folder / kind, kind, entries)
    return found


def damaged(data, seed):
    """64 bytes anywhere, or 4 near the beginning or the end, are others."""
    random = np.random.default_rng(seed)
    width = (64, 4, 4)[seed % 3]
    near = (random.integers(len(data) - 64), random.integers(400), len(data) - 8 - seed * 9)
    start = int(near[seed % 3])
    noise = random.integers(0, 256, width, dtype=np.uint8).tobytes()
    return data[:start] + noise + data[start + width :]


@pytest.mark.parametrize("kind", KINDS)
def test_a_damaged_file(tmp_path, whole, kind, capfd):
    data, path = whole[kind].read_bytes(), tmp_path / whole[kind].name
    refused = 0
    for seed in range(9):
        path.write_bytes(damaged(data, seed))
        try:
            import_recording(path)
        except InputError as error:
            assert "\n" not in str(error)
            refused += 1
    assert refused > 0
    assert capfd.readouterr() == ("", "")
