"""KITTI: a known motion written as OXTS packets and as npz pieces, traps included, must come back;
real drives must be physical."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from gnio_jax import data
from gnio_jax.data.readers import kitti
from gnio_jax.data.self_check import self_check
from gnio_jax.errors import InputError
from gnio_jax.numerics import rotations
from tests.support import kitti_files as files
from tests.support import known_walk
from tests.support.changes import one, put
from tests.support.refusals import refused

TRAIN, VAL, TEST = "2011_09_26_drive_0014", "2011_09_26_drive_0009", "2011_09_26_drive_0018"


def compare(sequence, time, origin):
    """The sequence tells of the known walk at `time` s, its positions from the walk's `origin`."""
    known_walk.compare(sequence, time, speed=2e-3, origin=origin)


def test_packets_with_every_trap_come_back(tmp_path):
    oxts, pieces = files.write_published(tmp_path, TRAIN)
    with pytest.warns(
        UserWarning, match="1 pieces between missing packets are shorter than 3 s; left out"
    ):
        first, second = kitti.read_packets(oxts)
    assert [first.name, second.name] == [f"{TRAIN}_extract0", f"{TRAIN}_extract1"]
    for sequence, start, end in ((first, *pieces[:2]), (second, *pieces[2:])):
        time = sequence.time + (sequence.attributes["start_time"] - 1317042145.594360375)
        assert sequence.time[0] == 0.0 and time[0] == pytest.approx(start, abs=1e-6)
        assert time[-1] == pytest.approx(end, abs=0.011)
        np.testing.assert_allclose(np.diff(sequence.time), 0.01, atol=1e-9)
        # Both pieces are of one world: from the drive's first packet.
        compare(sequence, time, known_walk.position(np.zeros(1)))
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
    compare(sequence, sequence.time + sequence.attributes["start_time"], np.zeros(3))


def test_a_drive_in_both_layouts_is_read_once_and_the_slow_export_is_named(tmp_path):
    files.write_drive(tmp_path, TRAIN)
    files.write_piece(tmp_path / f"train__{TRAIN}_extract0.npz")
    files.write_piece(tmp_path / f"train__{VAL}_extract0.npz")
    files.write_drive(tmp_path, TRAIN, export="sync", rate=10.0)
    files.write_drive(tmp_path, TEST, export="sync", rate=10.0)
    with pytest.warns(
        UserWarning, match=rf"1 drives are there only as the 10 Hz export \(_sync\): {TEST}"
    ):
        (sequence,) = data.load("kitti", tmp_path, "train")
    assert "start_time" in sequence.attributes  # of the packets
    with (
        pytest.warns(UserWarning, match="10 Hz"),
        pytest.raises(InputError, match="none of its drives falls into split 'test'"),
    ):
        data.load("kitti", tmp_path, "test")


def test_splits_are_by_name_alone_and_never_divide_a_drive(tmp_path):
    for name in (f"{TRAIN}_extract0", f"{TRAIN}_extract1", f"{VAL}_extract0", f"{TEST}_extract3"):
        files.write_piece(tmp_path / f"train__{name}.npz")
    assert [s.name for s in data.load("kitti", tmp_path, "train")] == [
        f"{TRAIN}_extract0",
        f"{TRAIN}_extract1",
    ]
    assert [s.name for s in data.load("kitti", tmp_path, "val")] == [f"{VAL}_extract0"]
    assert [s.name for s in data.load("kitti", tmp_path, "test")] == [f"{TEST}_extract3"]
    names = [
        f"2011_{month:02d}_26_drive_{number:04d}" for month in (9, 10) for number in range(500)
    ]
    shares = [kitti.share_of(name) for name in names]
    for split, share in (("train", 0.7), ("val", 0.1), ("test", 0.2)):
        assert shares.count(split) / len(names) == pytest.approx(share, abs=0.04)
    with pytest.raises(InputError, match="unknown split 'seen'"):
        data.load("kitti", tmp_path, "seen")


def test_positions_that_jump_are_not_valid(tmp_path):
    def jump(arrays):
        arrays["p_gt"][700:] += np.float32([1.5, -1.0, 0.0])

    path = files.write_piece(tmp_path / f"train__{TRAIN}_extract0.npz", jump)
    (sequence,) = kitti.read_piece(path)
    assert not sequence.valid[650:750].any()
    assert sequence.valid[:590].all() and sequence.valid[810:].all()


def test_what_lies_in_a_gap_of_a_piece_is_not_valid(tmp_path):
    """Half a second of rows is missing, which is too short to divide the drive."""

    def lose(arrays):
        for name in [name for name in arrays if arrays[name].ndim]:
            arrays[name] = np.delete(arrays[name], np.s_[500:550], axis=0)

    path = files.write_piece(tmp_path / f"train__{TRAIN}_extract0.npz", lose)
    (sequence,) = kitti.read_piece(path)
    inside = np.zeros(1200, dtype=bool)
    inside[500:550] = True
    np.testing.assert_array_equal(sequence.valid, ~inside)
    np.testing.assert_array_equal(sequence.imu_valid, ~inside)


def test_packets_whose_names_have_no_leading_zeros_come_back(tmp_path):
    oxts = files.write_drive(tmp_path, TRAIN, seconds=4.0)
    for packet in (oxts / "data").iterdir():
        packet.rename(packet.with_name(f"{int(packet.stem)}.txt"))
    (sequence,) = kitti.read_packets(oxts)
    assert len(sequence.time) == 400 and sequence.valid.all()


# --- errors


def test_damaged_packets_are_refused_by_file_and_field(tmp_path):
    def spoil(column, value, row=5):
        def change(time, values):
            values[row, column] = value

        return change

    for number, (change, field) in enumerate(
        [(spoil(17, np.nan), "'wx'"), (spoil(13, np.inf), "'az'"), (spoil(0, np.nan), "'lat'")]
    ):
        oxts = files.write_drive(tmp_path / str(number), TRAIN, change, seconds=4.0)
        refused(lambda oxts=oxts: kitti.read_packets(oxts), oxts / "data" / "0000000005.txt", field)
    unused = files.write_drive(tmp_path / "unused", TRAIN, spoil(25, np.nan), seconds=4.0)
    assert len(kitti.read_packets(unused)) == 1

    oxts = files.write_drive(tmp_path / "files", TRAIN, seconds=4.0)
    packet = oxts / "data" / "0000000007.txt"
    whole = packet.read_text()
    packet.write_text(whole[: len(whole) // 2])
    refused(lambda: kitti.read_packets(oxts), packet, "expected 30", "cut short")
    packet.write_text(whole.replace(" ", " x", 1))
    refused(lambda: kitti.read_packets(oxts), packet, "no number")
    packet.write_text(whole)
    stamps = oxts / "timestamps.txt"
    lines = stamps.read_text().splitlines()
    stamps.write_text("\n".join(lines[:-3]))
    refused(lambda: kitti.read_packets(oxts), stamps, "holds 397 stamps, but there is a packet 399")
    stamps.write_text("\n".join([*lines[:4], "26.9.2011 13:02", *lines[5:]]))
    refused(lambda: kitti.read_packets(oxts), stamps, "line 5", "no stamp")
    stamps.write_text("\n" * 399 + lines[0])
    refused(lambda: kitti.read_packets(oxts), stamps, "gives 1 packets a stamp")
    stamps.unlink()
    refused(lambda: kitti.read_packets(oxts), stamps, "cannot be read")
    (tmp_path / "empty" / "data").mkdir(parents=True)
    refused(
        lambda: kitti.read_packets(tmp_path / "empty"),
        tmp_path / "empty" / "data",
        "holds no packets",
    )


def test_wrong_rates_are_refused(tmp_path):
    slow = files.write_drive(tmp_path / "slow", TRAIN, rate=10.0)
    refused(
        lambda: kitti.read_packets(slow), slow / "timestamps.txt", "'time'", "10 Hz", "_extract"
    )
    odd = files.write_drive(tmp_path / "odd", TRAIN, rate=50.0)
    refused(lambda: kitti.read_packets(odd), odd, "'time'", "50 Hz, expected about 100 Hz")


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (put("t", one(9, 0.0)), ("field 'time'", "does not increase", "row 10")),
        (put("t", lambda t: t * 2), ("field 'time'", "50 Hz")),
        (put("t", lambda t: t.astype(object)), ("cannot be read as npz",)),
    ],
)
def test_a_bad_piece_is_refused_by_file_and_field(tmp_path, change, words):
    path = files.write_piece(tmp_path / f"train__{TRAIN}_extract0.npz", change)
    refused(lambda: kitti.read_piece(path), path, *words)


def test_a_root_without_drives_is_refused(tmp_path):
    refused(
        lambda: kitti.find_drives(tmp_path), tmp_path, "holds no drive of KITTI", "expected layout"
    )
    files.write_drive(tmp_path, TRAIN, export="sync", rate=10.0)
    refused(
        lambda: data.load("kitti", tmp_path, "train"),
        tmp_path,
        "only as the 10 Hz export (_sync)",
        TRAIN,
        "_extract",
    )


@pytest.mark.recordings
def test_real_drives_are_physical(recordings):
    root = recordings / "kitti"
    if not root.is_dir():
        pytest.skip("real recordings: no kitti/")
    seen: dict[str, str] = {}
    for split in kitti.SPLITS:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            sequences = data.load("kitti", root, split)
        for sequence in sequences:
            assert seen.setdefault(sequence.attributes["group"], split) == split
            check = self_check(sequence, pedestrian=False)
            assert check.rate == pytest.approx(100.0, rel=1e-3)
            assert (
                check.gyro_consistency_degrees < 1.0 or check.duration < 15.0
            )  # one window of 10 s says nothing
            # A strapdown of a good INS: what is left of R·accel is what the velocity changed by.
            first, last = sequence.velocity[0], sequence.velocity[-1]
            known = np.isfinite(sequence.orientation).all(axis=1)
            if not known.all():
                continue
            mean = rotations(sequence.orientation).apply(sequence.accel).mean(axis=0)
            np.testing.assert_allclose(
                mean, [0, 0, 9.81] + (last - first) / check.duration, atol=0.03
            )
    assert len(seen) >= 15
