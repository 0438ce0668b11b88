"""KITTI: a known motion as OXTS packets and as npz pieces, traps included, must come back."""

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.readers import kitti
from gnio_jax.data.self_check import self_check
from tests.support import kitti_files as files
from tests.support import known_walk
from tests.support.refusals import refused

TRAIN, TEST = "2011_09_26_drive_0014", "2011_09_26_drive_0018"


def test_packets_with_every_trap_come_back(tmp_path):
    oxts, pieces = files.write_published(tmp_path, TRAIN)
    short = "1 pieces between missing packets are shorter than 3 s; left out"
    with pytest.warns(UserWarning, match=short):
        first, second = kitti.read_packets(oxts)
    assert [first.name, second.name] == [f"{TRAIN}_extract0", f"{TRAIN}_extract1"]
    for sequence, start, end in ((first, *pieces[:2]), (second, *pieces[2:])):
        time = sequence.time + (sequence.attributes["start_time"] - 1317042145.594360375)
        assert sequence.time[0] == 0.0 and time[0] == pytest.approx(start, abs=1e-6)
        assert time[-1] == pytest.approx(end, abs=0.011)
        np.testing.assert_allclose(np.diff(sequence.time), 0.01, atol=1e-9)
        # Both pieces are of one world: from the drive's first packet.
        origin = known_walk.position(np.zeros(1))
        known_walk.compare(sequence, time, speed=2e-3, origin=origin)
        assert sequence.valid.all() and self_check(sequence, pedestrian=False).failures == ()
    a = first.attributes
    assert a["group"] == TRAIN
    assert a["imu_compensated"] == "reference"
    assert a["rows_repeated"] == 2
    assert a["rows_sorted"] > 10


def test_npz_pieces_come_back(tmp_path):
    path = files.write_piece(tmp_path / f"train__{TRAIN}_extract2.npz")
    (sequence,) = kitti.read_piece(path)
    assert sequence.name == f"{TRAIN}_extract2"
    assert sequence.time.dtype == np.float64
    assert sequence.attributes["group"] == TRAIN
    time = sequence.time + sequence.attributes["start_time"]
    known_walk.compare(sequence, time, speed=2e-3)


def test_a_drive_in_both_layouts_is_read_once_and_the_slow_export_is_named(tmp_path):
    files.write_drive(tmp_path, TRAIN, seconds=4.0)
    files.write_piece(tmp_path / f"train__{TRAIN}_extract0.npz")
    for drive in (TRAIN, TEST):
        files.write_drive(tmp_path, drive, seconds=1.0, export="sync", rate=10.0)
    slow = rf"1 drives are there only as the 10 Hz export \(_sync\): {TEST}"
    with pytest.warns(UserWarning, match=slow):
        (sequence,) = data.load("kitti", tmp_path, "train")
    assert "start_time" in sequence.attributes  # of the packets


def test_all_is_every_drive_and_has_folds_of_whole_drives(tmp_path):
    for drive in (TRAIN, TEST):
        for piece in (0, 1):
            files.write_piece(tmp_path / f"train__{drive}_extract{piece}.npz")
    names = {sequence.name[:21] for sequence in data.load("kitti", tmp_path, "all")}
    assert names == {TRAIN, TEST}
    parts = [data.load("kitti", tmp_path, f"all+{number}of2") for number in (0, 1)]
    assert {sequence.name[:21] for part in parts for sequence in part} == names
    assert [len({sequence.name[:21] for sequence in part}) for part in parts] == [1, 1]


def test_what_lies_in_a_gap_of_a_piece_or_near_a_jump_is_not_valid(tmp_path):
    """Half a second of rows is missing, which is too short to divide the drive."""

    def spoil(arrays):
        arrays["p_gt"][900:] += np.float32([1.5, -1.0, 0.0])
        for name in [name for name in arrays if arrays[name].ndim]:
            arrays[name] = np.delete(arrays[name], np.s_[300:350], axis=0)

    path = files.write_piece(tmp_path / f"train__{TRAIN}_extract0.npz", spoil)
    (sequence,) = kitti.read_piece(path)
    inside = np.zeros(1200, dtype=bool)
    inside[300:350] = True
    np.testing.assert_array_equal(sequence.imu_valid, ~inside)
    assert not sequence.valid[inside].any() and not sequence.valid[850:950].any()
    assert sequence.valid[:790][~inside[:790]].all() and sequence.valid[1010:].all()


def test_packets_are_counted_by_their_names_and_ten_hertz_are_refused(tmp_path):
    """Names may have no leading zeros."""
    oxts = files.write_drive(tmp_path, TRAIN, seconds=4.0)
    for packet in (oxts / "data").iterdir():
        packet.rename(packet.with_name(f"{int(packet.stem)}.txt"))
    (sequence,) = kitti.read_packets(oxts)
    assert len(sequence.time) == 400 and sequence.valid.all()
    # By their names the last is 99.txt, which has a stamp.
    stamps = oxts / "timestamps.txt"
    stamps.write_text("\n".join(stamps.read_text().splitlines()[:120]))
    refused(lambda: kitti.read_packets(oxts), stamps, "holds 120 stamps", "a packet 399")
    empty = tmp_path / "empty"
    (empty / "data").mkdir(parents=True)
    refused(lambda: kitti.read_packets(empty), empty / "data", "holds no packets")
    slow = files.write_drive(empty, TRAIN, seconds=4.0, export="sync", rate=10.0)
    words = "'time'", "10 Hz", "_extract"
    refused(lambda: kitti.read_packets(slow), slow / "timestamps.txt", *words)
    words = "only as the 10 Hz export (_sync)", TRAIN, "_extract"
    refused(lambda: data.load("kitti", empty, "train"), empty, *words)
