"""A ROS 2 node around `gnio_jax.filtering.Tracker`: sensor_msgs/Imu in, nav_msgs/Odometry and TF
out."""

import jax
import rclpy
from geometry_msgs.msg import TransformStamped
from nav_msgs.msg import Odometry
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import Imu
from tf2_ros import TransformBroadcaster

from gnio_jax import filtering, networks
from gnio_jax.apps.live.tracking import create_tracker
from gnio_odometry.bridge import Bridge

SENSOR_DATA = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Matches publishers of either reliability. The profile of that name keeps five messages: a clone
step takes longer than those, and every message that is lost is a hole."""


class GnioOdometry(Node):
    """Parameters: network (name, package or run folder), imu_rate (Hz; 0: the network's),
    rest_seconds (the device lies still so long at the start), odom_frame, imu_frame (of messages
    that name none), publish_tf (odom -> the IMU's frame; off where that frame has a parent)."""

    def __init__(self):
        super().__init__("gnio_odometry")
        network = self.declare_parameter("network", "pedestrian").value
        rate = self.declare_parameter("imu_rate", 0.0).value
        rest_seconds = self.declare_parameter("rest_seconds", 1.0).value
        self._advice = f"keep the device still for {rest_seconds:g} s"
        self._odom = self.declare_parameter("odom_frame", "odom").value
        self._imu = self.declare_parameter("imu_frame", "imu_link").value
        publish_tf = self.declare_parameter("publish_tf", True).value
        run = networks.load(network)
        tracker = create_tracker(run, rate or None, rest_seconds)
        ekf = filtering.make_filter(run.config.data, run.config.filter)
        self._bridge = Bridge(tracker, ekf.config.invariant)
        self._publisher = self.create_publisher(Odometry, "odometry", 10)
        self._transforms = TransformBroadcaster(self) if publish_tf else None
        self.create_subscription(Imu, "imu", self._take, SENSOR_DATA)
        self.get_logger().info(f"ready with {network}; {self._advice}")

    def _take(self, message: Imu) -> None:
        restarts, refusals = self._bridge.restarts, self._bridge.refused
        estimate = self._bridge.take(message)
        if self._bridge.restarts > restarts:
            self.get_logger().warning(f"{self._bridge.reason}; {self._advice}")
        elif self._bridge.refused > refusals:
            self.get_logger().warning(self._bridge.reason, throttle_duration_sec=5.0)
        if estimate is None:
            return
        odometry = Odometry()
        odometry.header.stamp.sec, odometry.header.stamp.nanosec = estimate.stamp
        odometry.header.frame_id = self._odom
        odometry.child_frame_id = message.header.frame_id or self._imu
        position, turn = odometry.pose.pose.position, odometry.pose.pose.orientation
        position.x, position.y, position.z = estimate.position
        turn.x, turn.y, turn.z, turn.w = estimate.orientation
        speed = odometry.twist.twist.linear
        speed.x, speed.y, speed.z = estimate.velocity
        rate = odometry.twist.twist.angular
        rate.x, rate.y, rate.z = estimate.rate
        odometry.pose.covariance = estimate.pose_covariance
        odometry.twist.covariance = estimate.twist_covariance
        self._publisher.publish(odometry)
        if self._transforms is not None:
            self._send_transform(odometry)

    def _send_transform(self, odometry: Odometry) -> None:
        """Send the transform from the IMU's frame to `odom`."""
        transform = TransformStamped()
        transform.header, transform.child_frame_id = odometry.header, odometry.child_frame_id
        position, move = odometry.pose.pose.position, transform.transform.translation
        move.x, move.y, move.z = position.x, position.y, position.z
        transform.transform.rotation = odometry.pose.pose.orientation
        self._transforms.sendTransform(transform)


def main() -> None:
    jax.config.update("jax_enable_x64", True)  # for the filter
    rclpy.init()
    node = GnioOdometry()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass  # Ctrl-C, or SIGTERM of the launch
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
