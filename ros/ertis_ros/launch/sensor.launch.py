"""Publish one or more sensors on serial ports, which need no central node.

Start it with::

    ros2 launch ertis_ros sensor.launch.py ports:="/dev/ttyACM0 /dev/ttyACM1" preset:=short_25_50
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Return the node."""
    defaults = {"ports": "/dev/ttyACM0", "preset": "default_25_50", "mounting": "", "namespace": ""}
    names = {"ports": "source", "preset": "preset", "mounting": "mounting"}
    values = {name: ParameterValue(LaunchConfiguration(key), value_type=str) for key, name in names.items()}
    return LaunchDescription(
        [
            *(DeclareLaunchArgument(name, default_value=value) for name, value in defaults.items()),
            Node(
                package="ertis_ros",
                executable="sonar",
                namespace=LaunchConfiguration("namespace"),
                parameters=[values],
                output="screen",
            ),
        ]
    )
