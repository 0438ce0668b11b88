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


def of_euroc(root, rate):
    asl_files.write_imu(root / "V1_01_easy" / "mav0", seconds=12.0, step=1 / rate)
    asl_files.write_estimate(root / "V1_01_easy" / "mav0", step=1 / 50)
    return root / "V1_01_easy"


def of_idol(root, rate):
    table = idol_files.frame()
    rows = np.arange(0, len(table), 100 / rate).astype(int)
    return idol_files.write(root, table.iloc[rows])


READERS = {
    "blackbird": (
        100,
        blackbird.read,
        lambda r, hz: blackbird_files.write(r / "a", text=0, spoil=thinned(hz, 100)),
    ),
    "euroc": (200, euroc.read, of_euroc),
    "idol": (100, idol.read, of_idol),
    "kitti": (
        100,
        kitti.read_packets,
        lambda r, hz: kitti_files.write_drive(r, "2011_09_26_drive_0014", 6.0, rate=hz),
    ),
    "ridi": (
        200,
        lambda table: ridi.read(table.parents[1]),
        lambda r, hz: ridi_files.write_table(r, "dan_bag1", np.arange(round(36 * hz)) / hz),
    ),
    "ronin": (
        200,
        ronin.read,
        lambda r, hz: ronin_files.write(r / "a", start_frame=100, spoil=thinned(hz, 200)),
    ),
    "tlio": (
        200,
        tlio.read,
        lambda r, hz: tlio_files.write_sequence(r / "a", spoil=thinned(hz, 200)),
    ),
}
"""The rate (Hz) that each gives, how it reads, and what writes a recording of another rate."""


@pytest.mark.parametrize("name", READERS)
def test_a_slow_recording_comes_back_at_the_rate_of_the_others_unless_it_is_of_no_imu(
    tmp_path, name
):
    native, read, write = READERS[name]
    (sequence,) = read(write(tmp_path / "slow", 40.0))
    np.testing.assert_allclose(np.diff(sequence.time), 1 / native, rtol=1e-3)
    assert sequence.valid.mean() > 0.9
    with pytest.raises(InputError, match=r"^[^\n]* runs at 5 Hz, [^\n]*$"):
        read(write(tmp_path / "slower", 5.0))
