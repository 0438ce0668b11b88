"""ros2 launch gnio_odometry gnio.launch.py imu:=/camera/imu weights:=pedestrian"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument("imu", default_value="/imu"),
            DeclareLaunchArgument("weights", default_value="pedestrian"),
            DeclareLaunchArgument("imu_rate", default_value="0.0"),
            Node(
                package="gnio_odometry",
                executable="gnio_odometry",
                remappings=[("imu", LaunchConfiguration("imu"))],
                parameters=[
                    {
                        "weights": LaunchConfiguration("weights"),
                        "imu_rate": LaunchConfiguration("imu_rate"),
                    }
                ],
            ),
        ]
    )
