"""ros2 launch gnio_odometry gnio.launch.py imu:=/camera/imu network:=pedestrian"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def typed(name, kind):
    """An argument as a parameter of this type: imu_rate:=200 would be a whole number otherwise,
    which a node that wants a float refuses."""
    return ParameterValue(LaunchConfiguration(name), value_type=kind)


def generate_launch_description():
    return LaunchDescription(
        [
            DeclareLaunchArgument("imu", default_value="/imu"),
            DeclareLaunchArgument("network", default_value="pedestrian"),
            DeclareLaunchArgument("imu_rate", default_value="0.0"),
            DeclareLaunchArgument("publish_tf", default_value="true"),
            Node(
                package="gnio_odometry",
                executable="gnio_odometry",
                remappings=[("imu", LaunchConfiguration("imu"))],
                parameters=[
                    {
                        "network": typed("network", str),
                        "imu_rate": typed("imu_rate", float),
                        "publish_tf": typed("publish_tf", bool),
                    }
                ],
            ),
        ]
    )
