"""Tyrex: a known walk in the authors' layout, traps included, must come back as the phone's."""

import numpy as np
import pytest

from gnio_jax.data.dataset import Refusal
from gnio_jax.data.readers import tyrex
from gnio_jax.data.self_check import self_check
from gnio_jax.numerics import rotations
from tests.support import known_walk as walk
from tests.support.tyrex_files import BIAS, IPHONE, LAG, LOST, NEXUS, OFFSET, write

# What the names of the folders and the kind of phone say.
TEXTING = {"subject": "Guillaume", "group": "Guillaume", "device": "Nexus 5", "gait": "walking"}
TEXTING |= {"imu_compensated": "Android's gyro bias", "placement": "texting"}
RUNNING = {"subject": "Thibaud", "group": "Thibaud", "device": "iPhone 4S", "gait": "running"}
RUNNING |= {"imu_compensated": "no", "placement": "running, in the hand"}


@pytest.mark.parametrize(("name", "attributes"), [(NEXUS, TEXTING), (IPHONE, RUNNING)])
def test_a_walk_comes_back_as_the_phones(tmp_path, name, attributes):
    (sequence,) = tyrex.read(write(tmp_path, name))
    assert attributes.items() <= sequence.attributes.items()
    # Times of the walk: the record's.
    time = sequence.time + sequence.attributes["start_time"]
    np.testing.assert_allclose(np.diff(sequence.time), 0.01, rtol=1e-6)
    # The fit finds a delay of the accelerometer of less than a millisecond, and takes it out.
    walk.compare(sequence, time, 4e-3, 0.5, 0.5, imu=0.05, bias=BIAS, edge=30)
    np.testing.assert_allclose(sequence.gyro[30:-30], (walk.rate(time) + BIAS)[30:-30], atol=2e-3)
    speed_error = (sequence.velocity - walk.velocity(time))[sequence.valid]
    assert np.sqrt((speed_error**2).sum(axis=1).mean()) < 0.05
    assert sequence.valid.mean() > 0.95 and self_check(sequence).failures == ()
    assert sequence.attributes["lag"] == pytest.approx(-LAG, abs=2e-3)
    gyro_bias = [sequence.attributes[f"gyro_bias_{axis}"] for axis in "xyz"]
    assert np.linalg.norm(gyro_bias) == pytest.approx(np.linalg.norm(BIAS), abs=2e-3)
    # A sixth of a second without a pose.
    gone = (LOST.start + np.array([2, 6])) / 60.0 - OFFSET - LAG
    assert not sequence.valid[(time > gone[0]) & (time < gone[1])].any()


def test_a_record_that_pauses_is_two_walks(tmp_path):
    folder = write(tmp_path, seconds=46.0)
    for file in ("gyroscope.txt", "accelerometer.txt"):
        rows = (folder / file).read_text().splitlines()
        remaining_rows = (row for row in rows if not 21.0 < float(row.split(" ")[0]) < 24.5)
        (folder / file).write_text("\n".join(remaining_rows))
    with pytest.warns(UserWarning, match=r"'time' has gaps longer than 1 s \(1, up to 3.5 s\)"):
        pieces = tyrex.read(folder)
    assert len(pieces) == 2
    for piece in pieces:
        time = piece.time[piece.valid] + piece.attributes["start_time"]
        error = rotations(piece.orientation[piece.valid]) * walk.attitude(time).inv()
        assert np.degrees(error.magnitude()).max() < 0.5
        assert self_check(piece).failures == ()
    (folder / "timeAlignment.txt").write_text("2.5")  # 3.4 s of the walk away: of another walk
    with pytest.raises(Refusal, match=r"(stays unexplained|impossible values)") as caught:
        tyrex.read(folder)
    assert str(caught.value).startswith(f"{tyrex.walk_of(folder).track} and ")


def test_an_accelerometer_that_clips_says_so(tmp_path, monkeypatch):
    force = walk.force
    monkeypatch.setattr(walk, "force", lambda time: np.minimum(2.2 * force(time), 19.55))
    folder = write(tmp_path, seconds=20.0)
    phone = tyrex.read_phone(tyrex.walk_of(folder))
    share = tyrex.clipped_share(phone.accel.values)
    felt = np.loadtxt(folder / "accelerometer.txt")[:, 1:]
    assert 0.1 < (felt == 19.55).any(axis=1).mean() <= share < 0.6
    assert tyrex.clipped_share(1.2 * phone.accel.values) == 0.0  # of a phone with a wider range
    assert tyrex.clipped_share(0.9 * phone.accel.values) == 0.0
