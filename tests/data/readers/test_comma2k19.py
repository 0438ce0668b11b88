"""comma2k19: a known motion in the earth's frame must come back level."""

import numpy as np

from gnio_jax import data
from gnio_jax.data.readers import comma2k19
from gnio_jax.data.self_check import self_check
from gnio_jax.errors import InputError
from tests.support import comma_files as files
from tests.support import known_walk


def test_a_minute_comes_back(tmp_path):
    (sequence,) = comma2k19.read(files.write(tmp_path))
    assert sequence.name == "b0c9d2329ad1606b_2018-08-02--08-34-47_40"
    time = sequence.time + (sequence.attributes["start_time"] - files.BOOT)
    origin = known_walk.position(np.array([-0.1]))
    known_walk.compare(sequence, time, speed=2e-2, origin=origin)
    assert self_check(sequence, pedestrian=False).failures == ()
    assert sequence.attributes["group"] == files.DRIVE


def test_east_north_and_up_are_those_of_the_ellipsoid():
    origin, columns = files.home()
    np.testing.assert_allclose(comma2k19.level_axes(origin), columns.T, atol=1e-6)


def test_minutes_of_a_drive_are_in_one_split_and_in_order(tmp_path):
    for minute in ("10", "9", "x"):
        files.write(tmp_path / "Chunk_1", 8.0, minute=minute)
    files.write(tmp_path, 8.0, drive=files.DRIVE.replace("|", "_").replace("08-02", "08-03"))
    (tmp_path / "other" / "1" / "processed_log" / "IMU").mkdir(parents=True)
    names = {split: [x.name for x in sources(tmp_path, split)] for split in comma2k19.SPLITS}
    drive = files.DRIVE.replace("|", "_")
    of_split = [name for name in names[comma2k19.split_of(files.DRIVE)] if drive in name]
    assert [name.rpartition("_")[2] for name in of_split] == ["9", "x", "10"]
    assert sum(map(len, names.values())) == 4


def sources(root, split):
    try:
        return comma2k19.recordings(root, split)
    except InputError:
        return []


def test_it_loads_by_its_name(tmp_path):
    files.write(tmp_path, 12.0)
    (sequence,) = data.load("comma2k19", tmp_path, comma2k19.split_of(files.DRIVE))
    assert sequence.attributes["licence"] == "MIT"
