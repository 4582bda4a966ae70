"""Publish the sensors of a platform, which send to a central node, with odometry.

Start it with::

    ertis serve &
    ros2 launch ertis_ros platform.launch.py address:=tcp://127.0.0.1:5602 rviz:=true
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

HERE = Path(__file__).parent


def generate_launch_description() -> LaunchDescription:
    """Return the nodes."""
    defaults = {"address": "tcp://127.0.0.1:5602", "mounting": "", "namespace": "", "rviz": "false"}
    names = {"address": "source", "mounting": "mounting"}
    values = {name: ParameterValue(LaunchConfiguration(key), value_type=str) for key, name in names.items()}
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value) for name, value in defaults.items()),
            Node(
                package="ertis_ros",
                executable="sonar",
                namespace=LaunchConfiguration("namespace"),
                parameters=[{**values, "odometry": True}],
                output="screen",
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", str(HERE / "ertis.rviz")],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
