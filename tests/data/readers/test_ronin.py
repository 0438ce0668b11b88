"""RoNIN: a known walk, traps included, must come back as the phone's, not the chest's."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import data
from gnio_jax.data.readers import ronin
from gnio_jax.data.self_check import check_sequence
from gnio_jax.numerics import rotations
from tests.support import known_walk as walk
from tests.support.ronin_files import FIRST, chest, drifting, write, wxyz


def attitude_error(sequence, attitude):
    return np.degrees((rotations(sequence.orientation) * attitude.inv()).magnitude())


def own_time(sequence):
    return sequence.time + (sequence.attributes["start_time"] - FIRST)


def test_the_known_walk_agrees_with_its_own_differences():
    time, h = np.linspace(-2, 40, 2001), 1e-5
    velocity, acceleration = (
        (of(time + h) - of(time - h)) / (2 * h) for of in (walk.position, walk.velocity)
    )
    np.testing.assert_allclose(velocity, walk.velocity(time), atol=1e-7)
    rate = (walk.attitude(time - h).inv() * walk.attitude(time + h)).as_rotvec() / (2 * h)
    np.testing.assert_allclose(rate, walk.rate(time), atol=1e-7)
    force = walk.attitude(time).apply(walk.force(time))
    np.testing.assert_allclose(force, acceleration + np.array([0, 0, 9.81]), atol=1e-6)


@pytest.mark.parametrize("start_frame", [600, None])
def test_a_walk_comes_back_in_the_phones_frame(tmp_path, start_frame):
    (sequence,) = ronin.read(write(tmp_path / "a011_2", start_frame=start_frame))
    time = own_time(sequence)
    assert time[0] == pytest.approx((start_frame or 0) / 200) and sequence.time[0] == 0.0
    np.testing.assert_allclose(np.diff(sequence.time), 1 / 200, rtol=1e-6)
    np.testing.assert_allclose(sequence.gyro, walk.rate(time), atol=1e-6)
    np.testing.assert_allclose(sequence.accel, walk.force(time), atol=1e-6)
    np.testing.assert_allclose(sequence.position, walk.position(time), atol=1e-6)
    np.testing.assert_allclose(sequence.velocity[20:-20], walk.velocity(time)[20:-20], atol=0.01)
    # The orientation is that of the game rotation vector, drift and all, laid onto the Tango world
    # at the first row of the file.
    expected = drifting(time, 4.0, walk.SECONDS - 1 / 200) * walk.attitude(time)
    assert attitude_error(sequence, expected).max() < 0.01
    # Neither the chest's attitude nor one that is laid on it at start_frame would do.
    assert attitude_error(sequence, chest(time)).min() > 30
    assert sequence.valid.all() and data.self_check(sequence).failures == ()
    difference = rotations(sequence.device_orientation) * rotations(sequence.orientation).inv()
    expected = np.broadcast_to([0, 0, 2.1], (len(time), 3))
    np.testing.assert_allclose(difference.as_rotvec(), expected, atol=1e-6)
    a = sequence.attributes
    labels = a["subject"], a["group"], a["device"], a["position_of"]
    assert labels == ("a011", "a011", "asus4", "chest")
    assert a["orientation_source"] == "game_rv"
    assert a["imu_compensated"] == "calibration of the recording's start"


@pytest.mark.parametrize(
    ("errors", "ekf", "chosen"),
    [
        ((1.0, 19.9, 2.0), True, "game_rv"),  # below 20° nothing else is asked
        ((30.0, 20.0, 6.0), True, "ekf"),
        ((5.0, 25.0, 6.0), True, "gyro_integration"),
        ((30.0, 25.0, 6.0), False, "game_rv"),  # its error is known, but it is not in the file
    ],
)
def test_the_source_of_the_orientation(tmp_path, errors, ekf, chosen):
    folder = write(tmp_path / "a011_3", 15.0, drifts=(25.0, 6.0), errors=errors, ekf=ekf)
    (sequence,) = ronin.read(folder, choose=True)
    time = own_time(sequence)
    degrees = {"game_rv": 25.0, "ekf": 6.0, "gyro_integration": 0.0}[chosen]
    expected = drifting(time, degrees, 15.0 - 1 / 200) * walk.attitude(time)
    assert attitude_error(sequence, expected).max() < 0.1
    assert sequence.attributes["orientation_source"] == chosen
    named = {"gyro_integration": errors[0], "game_rv": errors[1], "ekf": errors[2]}
    assert sequence.attributes["orientation_error_degrees"] == named[chosen]
    # In the tests the truth has no say, and may be missing.
    info = json.loads((folder / "info.json").read_text())
    (folder / "info.json").write_text(json.dumps(info | {"grv_ori_error": "unknown"}))
    (sequence,) = ronin.read(folder)
    assert sequence.attributes["orientation_source"] == "game_rv"
    assert "orientation_error_degrees" not in sequence.attributes


def test_a_tilted_reference_fails_the_self_check(tmp_path):
    def tilt(_, info):
        calibration = rotations(np.array(info["start_calibration"]))
        tilted = calibration * Rotation.from_euler("x", 6, degrees=True)
        info["start_calibration"] = list(wxyz(tilted))

    (sequence,) = ronin.read(write(tmp_path / "a019_3", seconds=20.0, spoil=tilt))
    assert "mean of R·accel" in check_sequence(sequence, ronin.DATASET).failures[0]


def test_the_chest_may_move_as_the_phone_does_not(tmp_path):
    """A phone in a swinging hand accelerates otherwise than the chest: that is no reason to leave
    the walk out."""

    def steady(fields, _):
        time = fields["synced/time"] - FIRST
        sway = 0.02 * np.sin(2 * np.pi * 1.3 * time)
        fields["pose/tango_pos"] = np.stack([0.9 * time, sway, 0.0 * time], axis=1)

    (sequence,) = ronin.read(write(tmp_path / "a019_3", seconds=20.0, spoil=steady))
    check = check_sequence(sequence, ronin.DATASET)
    assert check.failures == () and check.accel_correlation_horizontal < 0.3
