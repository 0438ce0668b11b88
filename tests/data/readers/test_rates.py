"""Recordings at 40 to 60 Hz are read by every reader; what no IMU does is one line."""

from __future__ import annotations

import numpy as np
import pytest

from gnio_jax.data.readers import blackbird, euroc, idol, kitti, ridi, ronin, tlio
from gnio_jax.errors import InputError
from tests.support import (
    asl_files,
    blackbird_files,
    idol_files,
    kitti_files,
    known_walk,
    ridi_files,
    ronin_files,
    tlio_files,
)


def thinned(rate, native):
    """Leaves as many rows of every field as there are at a lower rate."""

    def thin(fields):
        rows = max(map(len, fields.values()))
        for name, values in fields.items():
            if len(values) == rows:
                fields[name] = values[np.arange(0, rows, native / rate).astype(int)]

    return thin


def of_blackbird(root, rate):
    folder = blackbird_files.write(root / "fast" / "test", text=0, spoil=thinned(rate, 100))
    return blackbird.read(folder)


def of_euroc(root, rate):
    mav = root / "V1_01_easy" / "mav0"
    asl_files.write_imu(mav, seconds=12.0, step=1 / rate)
    asl_files.write_estimate(mav, step=1 / 50)
    return euroc.read(mav.parent)


def of_idol(root, rate):
    table = idol_files.frame()
    rows = np.arange(0, len(table), 100 / rate).astype(int)
    return idol.read(idol_files.write(root, table.iloc[rows]))


def of_kitti(root, rate):
    drive = kitti_files.write_drive(root, "2011_09_26_drive_0014", seconds=6.0, rate=rate)
    return kitti.read_packets(drive)


def of_ridi(root, rate):
    time = np.arange(round(known_walk.SECONDS * rate)) / rate
    return ridi.read(ridi_files.write_table(root, "dan_bag1", time).parents[1])


def of_ronin(root, rate):
    folder = ronin_files.write(root / "a001_1", start_frame=100, spoil=thinned(rate, 200))
    return ronin.read(folder)


def of_tlio(root, rate):
    return tlio.read(tlio_files.write_sequence(root / "walk", spoil=thinned(rate, 200)))


READERS = [of_blackbird, of_euroc, of_idol, of_kitti, of_ridi, of_ronin, of_tlio]


@pytest.mark.parametrize("rate", [40.0, 50.0])
@pytest.mark.parametrize("read", READERS)
def test_a_slow_recording_comes_back_at_the_rate_of_the_others(tmp_path, read, rate):
    (sequence,) = read(tmp_path, rate)
    native = {of_euroc: 200, of_ridi: 200, of_ronin: 200, of_tlio: 200}.get(read, 100)
    np.testing.assert_allclose(np.diff(sequence.time), 1 / native, rtol=1e-3)
    assert sequence.valid.mean() > 0.9


@pytest.mark.parametrize("read", READERS)
def test_what_is_slower_than_an_imu_is_refused_in_one_line(tmp_path, read):
    with pytest.raises(InputError, match=r"^[^\n]* runs at 5 Hz, [^\n]*$"):
        read(tmp_path, 5.0)
