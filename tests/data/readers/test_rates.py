"""Recordings at 40 Hz are read; what no IMU does is one line."""

from __future__ import annotations

import numpy as np
import pytest

from gnio_jax.data.readers import kitti, ronin, tlio
from gnio_jax.errors import InputError
from tests.support import kitti_files, ronin_files, tlio_files


def thinned(rate):
    """Leaves as many rows of every field of 200 Hz as there are at a lower rate."""

    def thin(fields):
        rows = max(map(len, fields.values()))
        for name, values in fields.items():
            if len(values) == rows:
                fields[name] = values[np.arange(0, rows, 200 / rate).astype(int)]

    return thin


WRITERS = {
    ronin.read: lambda r, hz: ronin_files.write(r / "a", start_frame=100, spoil=thinned(hz)),
    tlio.read: lambda r, hz: tlio_files.write_sequence(r / "a", spoil=thinned(hz)),
    kitti.read_packets: lambda r, hz: kitti_files.write_drive(
        r, "2011_09_26_drive_0014", 6.0, rate=hz
    ),
}


@pytest.mark.parametrize("read", WRITERS)
def test_a_slow_recording_comes_back_at_the_rate_of_the_others_unless_it_is_of_no_imu(
    tmp_path, read
):
    (sequence,) = read(WRITERS[read](tmp_path / "slow", 40.0))
    native = 100 if read is kitti.read_packets else 200
    np.testing.assert_allclose(np.diff(sequence.time), 1 / native, rtol=1e-3)
    assert sequence.valid.mean() > 0.9
    with pytest.raises(InputError, match=r"^[^\n]* runs at 5 Hz, [^\n]*$"):
        read(WRITERS[read](tmp_path / "slower", 5.0))
