"""Start Nav2 with the scans, odometry and map of a platform with several sensors.

The sensors send to a central node, `ertis serve`. The file starts `ertis ros`, a map server and Nav2::

    ertis map REC.h5 -o place.pgm
    ros2 launch ./nav2.launch.py map:=place.yaml params:=my_nav2_params.yaml

`params` is a parameter file of Nav2; by default, the nav2.yaml beside this file.
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

HERE = Path(__file__).parent


def generate_launch_description() -> LaunchDescription:
    """Return the programs to start."""
    address, params = LaunchConfiguration("address"), LaunchConfiguration("params")
    navigation = PythonLaunchDescriptionSource([FindPackageShare("nav2_bringup"), "/launch/navigation_launch.py"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("address", default_value="tcp://127.0.0.1:5602"),
            DeclareLaunchArgument("map", default_value="place.yaml"),
            DeclareLaunchArgument("params", default_value=str(HERE / "nav2.yaml")),
            ExecuteProcess(cmd=["ertis", "ros", address, "--odometry", "--topic", "points", "--topic", "scan"]),
            # The map begins where the odometry begins. Replace this transform by a localisation for longer drives.
            Node(
                package="tf2_ros",
                executable="static_transform_publisher",
                arguments=["--frame-id", "map", "--child-frame-id", "odom"],
            ),
            Node(
                package="nav2_map_server",
                executable="map_server",
                parameters=[params, {"yaml_filename": LaunchConfiguration("map")}],
            ),
            Node(
                package="nav2_lifecycle_manager",
                executable="lifecycle_manager",
                name="lifecycle_manager_map",
                parameters=[{"autostart": True, "node_names": ["map_server"]}],
            ),
            IncludeLaunchDescription(navigation, launch_arguments={"params_file": params}.items()),
            Node(package="rviz2", executable="rviz2", arguments=["-d", str(HERE / "nav2.rviz")]),
        ]
    )
