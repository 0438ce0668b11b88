"""From sensor_msgs/Imu to nav_msgs/Odometry, without ROS: what the node does with each message."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from gnio_jax.apps.live.clock import AGREEING, LATEST
from gnio_jax.filtering.resampler import LONGEST_GAP, LONGEST_TRUSTED
from gnio_jax.filtering.state import arc_covariance

NANOSECONDS = 1_000_000_000


class Odometry(NamedTuple):
    """The fields of nav_msgs/Odometry and of the transform, of one clone step."""

    stamp: tuple[int, int]
    """(sec, nanosec) of the pose."""
    position: tuple[float, float, float]
    """Position in the frame `odom`, m."""
    orientation: tuple[float, float, float, float]
    """x, y, z, w: from the IMU to `odom`."""
    velocity: tuple[float, float, float]
    """Velocity in the IMU's frame, as nav_msgs/Odometry wants it, m/s."""
    rate: tuple[float, float, float]
    """Angular rate in the IMU's frame, rad/s: that of the message, without the gyro's bias."""
    pose_covariance: list[float]
    """36 numbers, row by row: x, y, z, and rotation about the fixed axes x, y, z of `odom`."""
    twist_covariance: list[float]
    """36 numbers, row by row, in the IMU's frame; that of the angular rate is unknown (-1)."""


class Bridge:
    """Feeds a `gnio_jax.filtering.Tracker`, whose filter has the `invariant` error or not, with
    messages. Stamps are counted from the first one, in whole nanoseconds, so that no digit is lost
    in float64.

    A message whose stamp is far behind the tracker's newest one, or further ahead than the tracker
    takes, is refused. When `AGREEING` of them in a row continue each other, the clock was set, a
    recording plays again, or the messages have paused: then the tracker starts anew.
    """

    def __init__(self, tracker: Any, invariant: bool = True):
        self._tracker, self._invariant = tracker, invariant
        self._first: int | None = None
        self._strays = list[int]()
        """Stamps of the newest messages, which continue each other but not that stamp, ns."""
        self.restarts = 0
        """How many times the tracker has started anew."""
        self.refused = 0
        """Messages that the tracker could not take, and clone steps of a filter that diverged."""
        self.reason = ""
        """Why the newest of them was refused, or why the tracker has started anew after it."""

    def take(self, message: Any) -> Odometry | None:
        """Take one message, and return the odometry of a clone step, if it made one.

        `linear_acceleration` must contain gravity, as REP 145 wants it of raw data.
        """
        stamp = message.header.stamp
        now = stamp.sec * NANOSECONDS + stamp.nanosec
        self._first = now if self._first is None else self._first
        gyro, accel = message.angular_velocity, message.linear_acceleration
        try:
            pose = self._tracker.push(
                (now - self._first) / NANOSECONDS,
                (gyro.x, gyro.y, gyro.z),
                (accel.x, accel.y, accel.z),
            )
        except ValueError as error:
            self.refused += 1
            self.reason = str(error)
            self._note_stray(now)
            return None
        self._strays.clear()
        if pose is not None and not pose.healthy:
            self.refused += 1
            self.reason = "the filter diverged: start the node again"
            return None
        return None if pose is None else self._odometry(pose, np.array([gyro.x, gyro.y, gyro.z]))

    def _note_stray(self, now: int) -> None:
        """Start anew if this refused message is the last of a run on another clock."""
        assert self._first is not None
        ahead = (now - self._first) / NANOSECONDS - self._tracker.newest
        if not (ahead < -LATEST or ahead > LONGEST_GAP):  # NaN before the first message
            self._strays.clear()
            return
        side = "after" if ahead > 0 else "before"
        words = f"{abs(ahead):.3g} s {side} that of the newest message"
        self.reason = f"its stamp is {words}"
        if self._strays and not 0 < now - self._strays[-1] <= LONGEST_TRUSTED * NANOSECONDS:
            self._strays.clear()
        self._strays.append(now)
        if len(self._strays) < AGREEING:
            return
        self._tracker.restart()
        self._first = None
        self._strays.clear()
        self.restarts += 1
        self.reason = f"the stamps go on {words}: the filter starts anew, and so does the path"

    def _odometry(self, pose: Any, gyro: np.ndarray) -> Odometry:
        assert self._first is not None
        sec, nanosec = divmod(self._first + round(pose.time * NANOSECONDS), NANOSECONDS)
        covariance = np.asarray(pose.covariance)
        of_pose, of_twist = np.zeros((6, 6)), np.zeros((6, 6))
        # The filter's error is (θ, v, p, ...), θ in the world frame.
        order = [6, 7, 8, 0, 1, 2]
        of_pose[:] = covariance[np.ix_(order, order)]
        rotation, velocity = np.asarray(pose.rotation), np.asarray(pose.velocity)
        # The error of Rᵀ v: one of the yaw, which turns attitude and velocity, is none of it. So
        # neither is the second order of such an error, which is in the covariance of v.
        by_error = rotation.T @ np.hstack([np.cross(np.eye(3), velocity), np.eye(3)])
        arc = np.asarray(arc_covariance(covariance)) if self._invariant else 0.0
        of_twist[:3, :3] = by_error @ (covariance - arc)[:6, :6] @ by_error.T
        of_twist[3:, 3:] = -np.eye(3)
        return Odometry(
            (sec, nanosec),
            tuple(np.asarray(pose.position).tolist()),
            tuple(Rotation.from_matrix(rotation).as_quat().tolist()),
            tuple((rotation.T @ velocity).tolist()),
            tuple((gyro - np.asarray(pose.gyro_bias)).tolist()),
            of_pose.ravel().tolist(),
            of_twist.ravel().tolist(),
        )
