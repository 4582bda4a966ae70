"""Publish a recording or an image file with its recorded times, and the times on /clock.

Start it with::

    ros2 launch ertis_ros replay.launch.py file:=REC.h5 speed:=0.5
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description() -> LaunchDescription:
    """Return the node; other nodes follow its clock with use_sim_time."""
    defaults = {"speed": "1.0", "loop": "false", "mounting": "", "namespace": ""}
    types = {"file": str, "mounting": str, "speed": float, "loop": bool}
    values = {
        "source" if name == "file" else name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, kind in types.items()
    }
    return LaunchDescription(
        [
            DeclareLaunchArgument("file"),
            *(DeclareLaunchArgument(name, default_value=value) for name, value in defaults.items()),
            Node(
                package="ertis_ros",
                executable="sonar",
                namespace=LaunchConfiguration("namespace"),
                parameters=[{**values, "publish_clock": True}],
                output="screen",
            ),
        ]
    )
