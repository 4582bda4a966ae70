"""Definitions of ROS 2 messages, and their encoder.

They are those of ROS, and of ``marine_msgs`` 2.1.0 of the University of Washington. A file contains the definitions of
its messages, so that neither writer nor file needs ROS.
"""

import functools
from collections.abc import Callable
from typing import Any, Final

__all__ = ["DEFINITIONS", "encoder", "fields", "schema"]

DEFINITIONS: Final = {
    "builtin_interfaces/msg/Time": """
int32 sec
uint32 nanosec
""",
    "std_msgs/msg/Header": """
builtin_interfaces/Time stamp
string frame_id
""",
    "geometry_msgs/msg/Vector3": """
float64 x
float64 y
float64 z
""",
    "geometry_msgs/msg/Point": """
float64 x
float64 y
float64 z
""",
    "geometry_msgs/msg/Quaternion": """
float64 x 0
float64 y 0
float64 z 0
float64 w 1
""",
    "geometry_msgs/msg/Pose": """
geometry_msgs/Point position
geometry_msgs/Quaternion orientation
""",
    "geometry_msgs/msg/Transform": """
geometry_msgs/Vector3 translation
geometry_msgs/Quaternion rotation
""",
    "geometry_msgs/msg/TransformStamped": """
std_msgs/Header header
string child_frame_id
geometry_msgs/Transform transform
""",
    "geometry_msgs/msg/PoseWithCovariance": """
geometry_msgs/Pose pose
float64[36] covariance
""",
    "geometry_msgs/msg/Twist": """
geometry_msgs/Vector3 linear
geometry_msgs/Vector3 angular
""",
    "geometry_msgs/msg/TwistWithCovariance": """
geometry_msgs/Twist twist
float64[36] covariance
""",
    "nav_msgs/msg/Odometry": """
std_msgs/Header header
string child_frame_id
geometry_msgs/PoseWithCovariance pose
geometry_msgs/TwistWithCovariance twist
""",
    "tf2_msgs/msg/TFMessage": """
geometry_msgs/TransformStamped[] transforms
""",
    "sensor_msgs/msg/PointField": """
uint8 INT8=1
uint8 UINT8=2
uint8 INT16=3
uint8 UINT16=4
uint8 INT32=5
uint8 UINT32=6
uint8 FLOAT32=7
uint8 FLOAT64=8
string name
uint32 offset
uint8 datatype
uint32 count
""",
    "sensor_msgs/msg/PointCloud2": """
std_msgs/Header header
uint32 height
uint32 width
sensor_msgs/PointField[] fields
bool is_bigendian
uint32 point_step
uint32 row_step
uint8[] data
bool is_dense
""",
    "sensor_msgs/msg/Image": """
std_msgs/Header header
uint32 height
uint32 width
string encoding
uint8 is_bigendian
uint32 step
uint8[] data
""",
    "sensor_msgs/msg/LaserScan": """
std_msgs/Header header
float32 angle_min
float32 angle_max
float32 angle_increment
float32 time_increment
float32 scan_time
float32 range_min
float32 range_max
float32[] ranges
float32[] intensities
""",
    "diagnostic_msgs/msg/KeyValue": """
string key
string value
""",
    "diagnostic_msgs/msg/DiagnosticStatus": """
byte OK=0
byte WARN=1
byte ERROR=2
byte STALE=3
byte level
string name
string message
string hardware_id
diagnostic_msgs/KeyValue[] values
""",
    "diagnostic_msgs/msg/DiagnosticArray": """
std_msgs/Header header
diagnostic_msgs/DiagnosticStatus[] status
""",
    "nav_msgs/msg/MapMetaData": """
builtin_interfaces/Time map_load_time
float32 resolution
uint32 width
uint32 height
geometry_msgs/Pose origin
""",
    "nav_msgs/msg/OccupancyGrid": """
std_msgs/Header header
nav_msgs/MapMetaData info
int8[] data
""",
    "rosgraph_msgs/msg/Clock": """
builtin_interfaces/Time clock
""",
    "marine_acoustic_msgs/msg/PingInfo": """
float32 frequency
float32 sound_speed
float32[] tx_beamwidths
float32[] rx_beamwidths
""",
    "marine_acoustic_msgs/msg/SonarImageData": """
uint32 DTYPE_UINT8=0
uint32 DTYPE_INT8=1
uint32 DTYPE_UINT16=2
uint32 DTYPE_INT16=3
uint32 DTYPE_UINT32=4
uint32 DTYPE_INT32=5
uint32 DTYPE_UINT64=6
uint32 DTYPE_INT64=7
uint32 DTYPE_FLOAT32=8
uint32 DTYPE_FLOAT64=9
bool is_bigendian
uint32 dtype
uint32 beam_count
uint8[] data
""",
    "marine_acoustic_msgs/msg/ProjectedSonarImage": """
std_msgs/Header header
marine_acoustic_msgs/PingInfo ping_info
geometry_msgs/Vector3[] beam_directions
float32[] ranges
marine_acoustic_msgs/SonarImageData image
""",
}
"""Definition of each message; nested messages have the name of their package."""
_RULE = "=" * 80


def schema(name: str) -> str:
    """Return the definition of a message with all nested ones, as MCAP requires (``ros2msg`` in its registry)."""
    first, *others = _with_dependencies(name)
    parts = [DEFINITIONS[first].lstrip()]
    parts += [f"MSG: {other.replace('/msg/', '/')}{DEFINITIONS[other]}" for other in others]
    return f"{_RULE}\n".join(parts)


def fields(name: str) -> dict[str, str]:
    """Return the type of each field of a message, without constants and default values."""
    lines = (line.split() for line in DEFINITIONS[name].strip().split("\n"))
    return {words[1]: words[0] for words in lines if "=" not in words[1]}


def _with_dependencies(name: str) -> list[str]:
    """Return a message with its nested ones, each once."""
    found = [name]
    for each in found:  # The list grows meanwhile.
        for line in DEFINITIONS[each].split("\n"):
            package, slash, message = line.partition(" ")[0].removesuffix("[]").partition("/")
            needed = f"{package}/msg/{message}"
            if slash and needed not in found:
                found.append(needed)
    return found


@functools.cache
def encoder(name: str) -> Callable[[dict[str, Any]], bytes]:
    """Return the encoder of a message to CDR, as in ROS 2; each message is a dict."""
    # The writer of mcap-ros2-support cannot set the metadata of a topic that the ros2 profile requires, and its
    # encoder has no public name.
    from mcap_ros2._dynamic import serialize_dynamic  # noqa: PLC0415  an extra

    return serialize_dynamic(name, schema(name))[name]
