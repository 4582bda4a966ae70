"""Frames of this package as ROS 2 messages, each a dict of the fields in `ros_definitions`.

Coordinate frames follow REP 103 (x forward, y left, z up, in metres and radians) and REP 105 (``base_link`` for the
platform). Ranges of scans follow REP 117: infinity if there is no echo.
"""

import math
import re
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.point_finder import same_directions
from ertis_numba.base import checks
from ertis_numba.frames import Energyscape, OccupancyMap, PointCloud, Stamp
from ertis_numba.geometry import unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.interop._grey_image import GreyImage
from ertis_numba.interop._mountings import PLATFORM, Mounting
from ertis_numba.interop._points import ros_time
from ertis_numba.motion.flow import MAX_SPEED_M_S, MAX_YAW_RATE_RAD_S
from ertis_numba.motion.planar_pose import PlanarPose
from ertis_numba.motion.velocity import EgoVelocity

__all__ = [
    "MAP_TYPE",
    "MESSAGES",
    "ImageMessages",
    "TopicNames",
    "header",
    "mounting_message",
    "occupancy_message",
    "occupancy_values",
    "odometry_message",
    "odometry_transform",
    "points_message",
    "sonar_frame_message",
    "sonar_image_message",
]

MESSAGES: Final[Mapping[str, str]] = {
    "points": "sensor_msgs/msg/PointCloud2",
    "scan": "sensor_msgs/msg/LaserScan",
    "image": "sensor_msgs/msg/Image",
    "sonar_image": "marine_acoustic_msgs/msg/ProjectedSonarImage",
}
"""Topics of a sensor, and their messages."""
MAP_TYPE: Final = "nav_msgs/msg/OccupancyGrid"
_MAP_FRAME = "map"
_OCCUPIED, _FREE, _UNKNOWN = 100, 0, -1  # Values of nav_msgs/msg/OccupancyGrid.
_ODOM: Final = "odom"
"""Frame in which the pose of the platform is continuous, by REP 105."""
_PLANAR: Final = np.ix_((0, 1, 5), (0, 1, 5))
"""Rows and columns of x, y and yaw in a covariance of x, y, z, and the rotations about them."""
_UNKNOWN_TWIST: Final = np.diag([MAX_SPEED_M_S, MAX_SPEED_M_S, MAX_YAW_RATE_RAD_S]) ** 2
_SONAR_SUFFIX = "_sonar"
_FUSED = "fused"
_SQRT_HALF = math.sqrt(0.5)
_SONAR_TURN = (_SQRT_HALF, 0.0, _SQRT_HALF, 0.0)
"""Frame of marine_acoustic_msgs relative to that of the sensor: z forward, x up, y right.

The rotation is 180° about the bisector of the x and z axes.
"""
_FLOAT32, _DTYPE_FLOAT32 = 7, 8  # Constants of PointField and of SonarImageData.
_POINT_FIELDS = ("x", "y", "z", "intensity", "uncertainty_range", "uncertainty_across")
_INVALID_CHARACTERS = re.compile(r"[^A-Za-z0-9]+")


class TopicNames(dict[str, str]):
    """Name of each sensor in topics; characters that ROS does not allow become ``_``."""

    # A later sensor of the same name gets a number, such as `a_b_2`.

    def __missing__(self, sensor: str) -> str:
        name = _INVALID_CHARACTERS.sub("_", checks.sensor_name(sensor)).strip("_")
        name = f"sensor_{name}" if not name[:1].isalpha() else name
        taken = {*self.values(), _FUSED}
        names = (name, *(f"{name}_{number}" for number in range(2, len(taken) + 3)))
        name = _FUSED if sensor == PLATFORM else next(each for each in names if each not in taken)
        self[sensor] = name
        return name


def header(stamp: Stamp, *, frame: str | None = None) -> dict[str, Any]:
    """Return the header: time of the emission, from 1970 to 2038, and the frame of the sensor or another one."""
    sec, nanosec = ros_time(stamp)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": frame or stamp.sensor}


def points_message(cloud: PointCloud) -> dict[str, Any]:
    """Return points in the sensor frame, as sensor_msgs/msg/PointCloud2."""
    # Fields are x, y, z in m, intensity in dBFS, and standard deviations along and across range in m; NaN if unknown.
    rows = np.full((len(cloud), len(_POINT_FIELDS)), np.nan, dtype="<f4")
    rows[:, :3] = cloud.position_m
    with np.errstate(divide="ignore"):
        rows[:, 3] = 20 * np.log10(cloud.amplitude)
    if cloud.uncertainty_m is not None:
        rows[:, 4:] = cloud.uncertainty_m
    step = rows.itemsize * len(_POINT_FIELDS)
    return {
        "header": header(cloud.stamp),
        "height": 1,
        "width": len(cloud),
        "fields": [
            {"name": name, "offset": rows.itemsize * number, "datatype": _FLOAT32, "count": 1}
            for number, name in enumerate(_POINT_FIELDS)
        ],
        "is_bigendian": False,
        "point_step": step,
        "row_step": step * len(cloud),
        "data": rows.tobytes(),
        "is_dense": cloud.uncertainty_m is not None,
    }


class ImageMessages:
    """Converter of images to sensor_msgs/msg/Image (mono8); computes the tables of a sensor once."""

    def __init__(self) -> None:
        self._pictures: dict[str, tuple[Energyscape, GreyImage]] = {}

    def __call__(self, image: Energyscape) -> dict[str, Any]:
        """Return the picture of an image; 255 is the strongest level, and 0 is 40 dB below it."""
        sensor = image.stamp.sensor
        known = self._pictures.get(sensor)
        if known is None or not same_directions(known[0], image):
            known = self._pictures[sensor] = image, GreyImage(image)
        pixels = known[1](image.amplitude)
        height, width = pixels.shape
        return {
            "header": header(image.stamp),
            "height": height,
            "width": width,
            "encoding": "mono8",
            "is_bigendian": 0,
            "step": width,
            "data": pixels.tobytes(),
        }


def sonar_image_message(image: Energyscape) -> dict[str, Any]:
    """Return all amplitudes of an image, as marine_acoustic_msgs/msg/ProjectedSonarImage."""
    call = image.settings.call
    forward, left, up = unit_vectors(image.azimuth_rad, image.elevation_rad).T.tolist()
    return {
        "header": header(image.stamp, frame=image.stamp.sensor + _SONAR_SUFFIX),
        "ping_info": {
            "frequency": (call.low_frequency_hz + call.high_frequency_hz) / 2,
            "sound_speed": sound_speed_m_s(image.settings.air),
            "tx_beamwidths": [],
            "rx_beamwidths": [],
        },
        "beam_directions": [{"x": x, "y": -y, "z": z} for z, y, x in zip(forward, left, up, strict=True)],
        "ranges": image.range_m.tolist(),
        "image": {
            "is_bigendian": False,
            "dtype": _DTYPE_FLOAT32,
            "beam_count": len(image.azimuth_rad),
            "data": np.ascontiguousarray(image.amplitude.T, dtype="<f4").tobytes(),
        },
    }


def occupancy_values(occupancy: OccupancyMap, *, probabilities: bool = False) -> NDArray[np.int8]:
    """Return the cells in the values of nav_msgs/msg/OccupancyGrid: (row, column).

    Occupied cells hold 100, free ones 0, and all others −1, as gmapping and slam_toolbox publish them: Nav2 takes only
    100 for an obstacle, and every other value except −1 for free space. With ``probabilities``, cells hold the
    probability of occupation in percent, and −1 where nothing is known.
    """
    if probabilities:
        values = np.rint(100 * occupancy.probability).astype(np.int8)
        values[occupancy.log_odds == 0] = _UNKNOWN
        return values
    values = np.full(occupancy.log_odds.shape, _UNKNOWN, np.int8)
    values[occupancy.is_free] = _FREE
    values[occupancy.is_occupied] = _OCCUPIED
    return values


def occupancy_message(occupancy: OccupancyMap, *, probabilities: bool = False) -> dict[str, Any]:
    """Return a map in the frame ``map``, as nav_msgs/msg/OccupancyGrid with the values of `occupancy_values`."""
    stamp = Stamp(timestamp_ns=occupancy.time_ns)
    values = occupancy_values(occupancy, probabilities=probabilities)
    n_rows, n_columns = values.shape
    x_m, y_m = occupancy.origin_m
    named = header(stamp, frame=_MAP_FRAME)
    return {
        "header": named,
        "info": {
            "map_load_time": named["stamp"],
            "resolution": occupancy.cell_m,
            "width": n_columns,
            "height": n_rows,
            "origin": {
                "position": {"x": x_m, "y": y_m, "z": 0.0},
                "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0},
            },
        },
        "data": values.ravel().tolist(),
    }


def mounting_message(stamp: Stamp, place: Mounting) -> dict[str, Any]:
    """Return the pose of a sensor on its platform, as geometry_msgs/msg/TransformStamped."""
    return _transform(header(stamp, frame=PLATFORM), stamp.sensor, place)


def sonar_frame_message(stamp: Stamp) -> dict[str, Any]:
    """Return the pose of the frame of sonar images relative to the sensor, as geometry_msgs/msg/TransformStamped."""
    return _transform(header(stamp), stamp.sensor + _SONAR_SUFFIX, ((0.0, 0.0, 0.0), _SONAR_TURN))


def odometry_message(pose: PlanarPose, velocity: EgoVelocity | None) -> dict[str, Any]:
    """Return the pose in ``odom`` and the velocity in the platform frame, as nav_msgs/msg/Odometry."""
    # Height, roll and pitch are 0. An unknown velocity is 0, with the largest measurable speeds as standard deviations.
    speed_m_s, yaw_rate_rad_s, covariance = (0.0, 0.0), 0.0, _UNKNOWN_TWIST
    if velocity is not None:
        speed_m_s, yaw_rate_rad_s = velocity.velocity_m_s.tolist(), velocity.yaw_rate_rad_s
        covariance = velocity.covariance
    transform = odometry_transform(pose)
    return {
        "header": transform["header"],
        "child_frame_id": PLATFORM,
        "pose": {
            "pose": {
                "position": transform["transform"]["translation"],
                "orientation": transform["transform"]["rotation"],
            },
            "covariance": _spatial(pose.covariance),
        },
        "twist": {
            "twist": {
                "linear": {"x": speed_m_s[0], "y": speed_m_s[1], "z": 0.0},
                "angular": {"x": 0.0, "y": 0.0, "z": yaw_rate_rad_s},
            },
            "covariance": _spatial(covariance),
        },
    }


def odometry_transform(pose: PlanarPose) -> dict[str, Any]:
    """Return the pose of the platform in the frame ``odom``, as geometry_msgs/msg/TransformStamped."""
    stamp = Stamp(timestamp_ns=pose.timestamp_ns)
    rotation_xyzw = (0.0, 0.0, math.sin(pose.yaw_rad / 2), math.cos(pose.yaw_rad / 2))
    return _transform(header(stamp, frame=_ODOM), PLATFORM, ((pose.x_m, pose.y_m, 0.0), rotation_xyzw))


def _spatial(covariance: NDArray[np.float64]) -> list[float]:
    """Return a covariance of x, y and yaw as the 36 numbers of one in space."""
    found = np.zeros((6, 6))
    found[_PLANAR] = covariance
    return [*map(float, found.flat)]


def _transform(parent: dict[str, Any], child: str, place: Mounting) -> dict[str, Any]:
    translation_m, rotation_xyzw = place
    return {
        "header": parent,
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", translation_m, strict=True)),
            "rotation": dict(zip("xyzw", rotation_xyzw, strict=True)),
        },
    }
