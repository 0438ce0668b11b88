"""The mounting of an IMU in a car: of simulated drives, and drives that do not show it."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import filtering
from gnio_jax.errors import InputError
from gnio_jax.filtering.mounting import find_mounting
from gnio_jax.filtering.nonholonomic import NonHolonomic
from tests.support.cars import drive
from tests.support.checks import unchecked

RATE = 50.0
NOISE = filtering.NoiseModel(3e-4, 3e-3, 1e-5, 1e-4)
STD = filtering.InitialStd(gyro_bias=1e-3, accel_bias=0.05)


def recording(seed, angles, seconds=100):
    constraint = NonHolonomic(yaw=angles[0], pitch=angles[1], roll=angles[2])
    intervals = round(seconds * RATE / 5)
    ride = drive(seed, 1, intervals, 5, 1 / RATE, NOISE, STD, constraint, 0.05, 0.05)
    return ride.gyro[0], ride.accel[0]


@pytest.mark.parametrize(
    "degrees", [(0, 0, 0), (170, -20, 5), (-90, 10, 180), (45, 60, -100), (120, -80, 30)]
)
def test_the_mounting_is_that_of_the_drive(degrees):
    angles = np.radians(degrees)
    mounting = find_mounting(*recording(1, angles), RATE, "drive")
    turn = Rotation.from_euler("ZYX", angles).inv() * Rotation.from_euler("ZYX", mounting[:3])
    roll, *ahead = turn.as_rotvec(degrees=True)
    assert np.hypot(*ahead) < 1.5 and abs(roll) < 2.0
    assert mounting.std < np.radians(2.0)


@pytest.mark.parametrize("angles", [(0.0, 0.0, 0.0), (0.5, -0.2, 0.1)])
def test_bends_to_one_side_are_no_roll(angles):
    """A roundabout at 8 to 12 m/s: the mean force leans by 6° towards its middle."""
    time = np.arange(4000) / 100
    speed, rate = 10 + 2 * np.sin(0.5 * time), np.full(len(time), 0.1)
    force = np.stack([np.cos(0.5 * time), rate * speed, np.full(len(time), 9.81)], axis=1)
    body = Rotation.from_euler("ZYX", angles).as_matrix()
    mounting = find_mounting(rate[:, None] * body[:, 2], force @ body.T, 100.0, "drive")
    np.testing.assert_allclose(mounting[:3], angles, atol=np.radians(0.5))


def test_the_standard_deviation_is_that_of_the_errors():
    errors, stds = [], []
    for seed in range(12):
        mounting = find_mounting(*recording(seed, (0.3, 0.1, 0.0), 40), RATE, "drive")
        errors.append(max(abs(mounting.yaw - 0.3), abs(mounting.pitch - 0.1)))
        stds.append(mounting.std)
    assert np.sqrt(np.mean(np.square(errors))) < 1.5 * np.sqrt(np.mean(np.square(stds)))


def test_a_drive_that_slides_more_is_less_certain():
    """The standard deviation grows with the velocities across that no mounting explains."""
    constraint, stds = NonHolonomic(yaw=0.3, pitch=0.1), []
    for across in (0.05, 0.5):
        ride = drive(2, 1, 500, 5, 1 / RATE, NOISE, STD, constraint, across, across)
        mounting = find_mounting(ride.gyro[0], ride.accel[0], RATE, "drive")
        stds.append(mounting.std)
    assert stds[1] > 4 * stds[0]


@pytest.mark.parametrize(
    "change, problem",
    [
        (lambda gyro, accel: (gyro[:900], accel[:900]), "18 s are too short to find the mounting"),
        (
            lambda gyro, accel: (0 * gyro, 0 * accel + [0.0, 0.0, 9.81]),
            "drives at 0.0 m/s in the mean, too slowly",
        ),
        (
            # A motorway: the speed is constant, and there is no turn.
            lambda gyro, accel: (
                0 * gyro,
                0.02 * np.random.default_rng(0).normal(size=accel.shape) + [0.0, 0.0, 9.81],
            ),
            "in the mean, too slowly|turns and brakes too little",
        ),
    ],
)
def test_a_drive_that_does_not_show_the_mounting_is_refused(change, problem):
    signals = change(*recording(1, (0.0, 0.0, 0.0), 60))
    with pytest.raises(InputError, match=rf"^drive: .*({problem}).*; state yaw, pitch and roll"):
        find_mounting(*signals, RATE, "drive")


def test_a_drive_that_is_none_is_refused():
    gyro, accel = np.zeros((3000, 3)), np.tile([0.0, 0.0, 9.81], (3000, 1))
    for arguments, words in (
        ((gyro[:10], accel, RATE), r"must be \(n, 3\), found \(10, 3\) and \(3000, 3\)"),
        ((gyro[:, 0], accel[:, 0], RATE), r"must be \(n, 3\), found \(3000,\)"),
        ((gyro + np.nan, accel, RATE), "gyro or accel is not finite"),
        ((gyro, accel, 0.0), "rate: found 0"),
        ((gyro, accel, np.nan), "rate: found nan"),
    ):
        with unchecked(), pytest.raises(InputError, match=f"^drive: .*{words}"):
            find_mounting(*arguments, "drive")
