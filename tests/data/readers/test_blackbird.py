"""Blackbird: a known flight, in a z-up and in a z-down world, must come back."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.data.readers import blackbird
from gnio_jax.data.self_check import self_check
from gnio_jax.data.splits import group
from gnio_jax.numerics import rotations
from tests.support import known_walk
from tests.support.blackbird_files import FLIP, START, write


@pytest.mark.parametrize(("down", "text"), [(False, 11), (True, 8), (True, 0)])
def test_a_flight_comes_back_in_a_world_whose_z_points_up(tmp_path, down, text):
    (sequence,) = blackbird.read(write(tmp_path / "flight", down, text))
    time = sequence.time
    np.testing.assert_allclose(time, np.arange(1200) / 100, atol=1e-6)
    # The body stays as it is; which way is up is told by the orientation.
    np.testing.assert_allclose(sequence.gyro, known_walk.rate(time) @ FLIP, atol=1e-5)
    np.testing.assert_allclose(sequence.accel, known_walk.force(time) @ FLIP, atol=1e-5)
    attitude = Rotation.from_matrix(known_walk.attitude(time).as_matrix() @ FLIP)
    assert np.degrees((rotations(sequence.orientation) * attitude.inv()).magnitude()).max() < 1e-3
    np.testing.assert_allclose(sequence.position, known_walk.position(time), atol=1e-6)
    np.testing.assert_allclose(
        sequence.velocity, known_walk.velocity(time), atol=1e-6 if text == 11 else 0.01
    )
    assert sequence.valid.all() and self_check(sequence, pedestrian=False).failures == ()
    assert sequence.attributes["native_world"] == ("z-down, turned" if down else "z-up")
    assert sequence.attributes["start_time"] == pytest.approx(START, abs=1e-6)


@pytest.mark.parametrize("inner", ["", "imo/"])
def test_pieces_of_one_flight_are_a_group_and_flights_at_one_speed_are_not(tmp_path, inner):
    """The authors list five flights, of which two pairs have the same speed; their program writes
    the pieces of each into a folder `imo`."""
    flights = ["clover/yawForward/maxSpeed5p0", "star/yawForward/maxSpeed5p0"]
    for split in ("train", "test"):
        entries = [f"{flight}/{inner}{split}" for flight in flights]
        (tmp_path / f"{split}.txt").write_text("".join(f"{entry}\n" for entry in entries))
        for entry in entries:
            write(tmp_path / entry, seconds=2.0)
    train, test = (
        [sequence for source in blackbird.recordings(tmp_path, split) for sequence in source.read()]
        for split in ("train", "test")
    )
    groups = [group(sequence) for sequence in train]
    assert [group(sequence) for sequence in test] == groups
    assert len(set(groups)) == 2
    assert len({sequence.name for sequence in (*train, *test)}) == 4
    if not inner:
        assert groups == flights
        assert train[0].name == "clover_yawForward_maxSpeed5p0_train"
