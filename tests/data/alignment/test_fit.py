"""The joint fit: its derivatives against differences, its result against a known mounting."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gnio_jax.data import alignment
from gnio_jax.data.alignment import fit as fitting
from gnio_jax.data.alignment import signals, track
from tests.support import known_walk as walk

EXTRINSIC = Rotation.from_euler("ZXY", [-170.0, 3.0, 2.0], degrees=True)
LEVER = np.array([-0.02, 0.08, 0.01])
TILT = np.array([0.02, -0.01])


def samples(late=0.0):
    """An IMU whose accelerometer tells of an event `late` (s)."""
    time = np.arange(-2.0, 42.0, 0.01)
    return time, walk.rate(time), walk.force(time - late)


def tracked():
    """The marker body of that IMU, in a tilted world."""
    time = np.arange(0.0, 40.0, 0.01)
    tilted = alignment_of_up(np.array([*TILT, 1.0]))
    attitude = tilted * walk.attitude(time) * EXTRINSIC.inv()
    position = tilted.apply(walk.position(time)) - attitude.apply(LEVER)
    return alignment.Track(time, position, attitude, np.ones(len(time), dtype=bool))


def alignment_of_up(up):
    """A rotation that turns z onto `up`."""
    return Rotation.align_vectors(up[None] / np.linalg.norm(up), [[0.0, 0.0, 1.0]])[0]


def unknowns_at(lag):
    return fitting.Unknowns(
        extrinsic=EXTRINSIC * Rotation.from_rotvec([0.02, -0.03, 0.01]),
        gyro_bias=np.array([0.01, -0.02, 0.005]),
        accel_bias=np.array([0.1, 0.05, -0.08]),
        lever=LEVER + 0.03,
        tilt=np.zeros(2),
        accel_delay=0.013,
        lag=lag,
    )


def test_the_jacobians_are_the_differences_of_the_errors():
    imu, motion = fitting.imu_samples(*samples()), track.motion(tracked())
    knots = signals.uniform_knots(motion.time, 15.0)
    hats = signals.hat_functions(motion.time, knots)
    unknowns = unknowns_at(np.array([0.01, -0.02, 0.03, 0.0]))
    rows = np.arange(300, len(motion.time) - 300, 7)
    at = fitting._residuals(imu, motion, hats, unknowns)
    gyro = fitting._gyro_jacobian(at, unknowns, hats, rows)
    accel = fitting._accel_jacobian(at, motion, hats, rows)
    count = fitting.LAG.start + len(knots)
    assert gyro.shape == accel.shape == (len(rows), 3, count)
    for column in range(count):
        # A difference of interpolated samples spans several of them, or it sees the kinks.
        step = 1e-2 if column >= fitting.CLOCKS.start else 1e-5
        change = step * np.eye(count)[column]
        after, before = (
            fitting._residuals(imu, motion, hats, fitting._changed(unknowns, sign * change))
            for sign in (1.0, -1.0)
        )
        for found, name in ((gyro, "gyro"), (accel, "accel")):
            expected = (getattr(after, name) - getattr(before, name))[rows] / (2 * step)
            tolerance = 2e-2 * np.abs(expected).max() + 1e-5
            np.testing.assert_allclose(found[:, :, column], expected, atol=tolerance, rtol=0)


def test_the_prior_is_the_sum_of_squares_over_its_deviations():
    unknowns = unknowns_at(np.array([0.01, -0.02, 0.03, 0.0]))

    def half_square(unknowns):
        parts = [
            unknowns.gyro_bias / 0.05,
            unknowns.accel_bias / 0.15,
            unknowns.lever / 0.2,
            unknowns.tilt / 0.05,
            [unknowns.accel_delay / 0.05],
            np.diff(unknowns.lag, 2) / 0.02,
        ]
        return 0.5 * sum(float(np.sum(np.square(part))) for part in parts)

    precision, gradient = fitting._prior(unknowns)
    steps = 1e-4 * np.eye(len(gradient))
    moved = lambda change: half_square(fitting._changed(unknowns, change))  # noqa: E731
    slope = [(moved(step) - moved(-step)) / 2e-4 for step in steps]
    np.testing.assert_allclose(gradient, slope, atol=1e-6)
    curvature = [(moved(step) + moved(-step) - 2 * moved(0 * step)) / 1e-8 for step in steps]
    np.testing.assert_allclose(np.diag(precision), curvature, rtol=1e-3, atol=1e-3)


def test_a_known_mounting_is_found_on_a_late_clock():
    time, gyro, accel = samples(late=0.02)
    bias = np.array([0.01, -0.005, 0.02])
    found = alignment.align(time + 0.7, gyro + bias, accel, tracked())
    assert np.degrees((found.extrinsic * EXTRINSIC.inv()).magnitude()) < 0.1
    np.testing.assert_allclose(found.lever, LEVER, atol=5e-3)
    np.testing.assert_allclose(found.up[:2] / found.up[2], TILT, atol=2e-3)
    np.testing.assert_allclose(found.gyro_bias, bias, atol=1e-3)
    np.testing.assert_allclose(found.lag, 0.7, atol=3e-3)
    assert found.accel_delay == pytest.approx(0.02, abs=3e-3)
    assert found.unexplained < 0.01 and found.runner_up < 0.5 and not found.mismatch.any()
    level = found.levelling().apply(found.up)
    np.testing.assert_allclose(level, [0.0, 0.0, 1.0], atol=1e-12)


def test_too_short_an_overlap_is_refused():
    time, gyro, accel = samples()
    short = slice(0, 900)
    with pytest.raises(alignment.TooLittle, match="less than 10 s of the track overlap"):
        alignment.align(time[short], gyro[short], accel[short], tracked())
