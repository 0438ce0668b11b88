"""A phone and tracked positions, against a walk in closed form."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax import numerics
from gnio_jax.data.alignment import positions
from gnio_jax.data.assembly import Samples, Streams
from tests.support import known_walk as walk


def phone(seconds, lag=0.0, drift=0.0, tilt=(0.0, 0.0)):
    """A phone whose clock is `lag` (s) ahead, and whose own attitude is tilted and drifts in yaw
    (rad/s)."""
    time = np.arange(0.0, seconds, 0.01)
    yaw = np.multiply.outer(-0.5 - drift * time, [0.0, 0.0, 1.0])
    world_rotation = Rotation.from_rotvec(yaw) * Rotation.from_euler("xy", tilt)
    device = numerics.quaternions(world_rotation * walk.attitude(time))
    gyro = walk.rate(time) + np.array([0.004, -0.002, 0.003])
    return Streams(
        "walk",
        "walk",
        Samples(time + lag, gyro, "gyro"),
        Samples(time + lag, walk.force(time), "accel"),
        device=Samples(time + lag, device, "attitude"),
    )


def test_clock_and_attitude_are_found_and_a_relocalisation_does_not_matter():
    """Nor what the tracker lost; each of its rows is there twice."""
    time = np.arange(3.0, 80.0, 0.01)
    time = np.repeat(time[(time < 55.0) | (time > 70.0)], 2)
    position = walk.position(time)
    position[time > 53.0] += [2.0, -1.0, 0.3]  # the tracker relocalised
    streams = phone(85.0, lag=1.3, drift=0.003, tilt=(0.05, -0.03))
    fit = positions.align_positions(streams, Samples(time, position, "track"))
    np.testing.assert_allclose(fit.lag, 1.3, atol=0.01)
    assert fit.correlation > 0.95 and fit.runner_up < 1.0
    assert fit.yaw_drift == pytest.approx(0.003 * 80, abs=0.1)
    poses = fit.poses
    event = poses.time - 1.3
    error = (poses.attitude * walk.attitude(event).inv()).as_rotvec()
    inner = (event > 6.0) & (event < 77.0) & (np.abs(event - 61.5) > 10.5)
    assert np.degrees(np.linalg.norm(error[inner, :2], axis=1)).max() < 0.05
    assert np.degrees(np.abs(error[inner, 2])).max() < 2.0
    inner &= event < 50.0
    assert np.abs(poses.position - walk.position(event))[inner].max() < 0.02
    # Its steps, 1.8 Hz, are beyond the smoother's cutoff in part.
    assert np.abs(poses.velocity - walk.velocity(event))[inner].max() < 0.2


@pytest.mark.parametrize(
    ("seconds", "lag", "device", "gain", "problem"),
    [
        (19.0, 0.0, 0.0, 1.0, "less than 20 s are recorded"),
        (40.0, 0.0, 0.0, 0.0, "less than 20 s of moving positions overlap"),
        (40.0, 0.0, 35.0, 1.0, "gyro, accelerometer and attitude share less than 20 s"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_too_little_is_refused(seconds, lag, device, gain, problem):
    time = np.arange(0.0, seconds, 0.01)
    streams = phone(seconds, lag)
    attitude = streams.device._replace(time=streams.device.time + device)
    track = Samples(time, gain * walk.position(time), "track")
    with pytest.raises(positions.TooLittle, match=problem):
        positions.align_positions(streams._replace(device=attitude), track)
