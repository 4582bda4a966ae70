"""Energyscapes as an MCAP file of ROS 2 messages.

The files follow the MCAP specification and registry (profile ``ros2``). Frames follow REP 103 (x forward, y left, z up,
in metres and radians) and REP 105 (``base_link`` for the platform).
"""

import math
import re
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, Final

import numpy as np

from ertis_numba import checks
from ertis_numba.air import sound_speed_m_s
from ertis_numba.analysis.point_finder import same_directions
from ertis_numba.errors import ArgumentError
from ertis_numba.extras import extra
from ertis_numba.frames import Energyscape, Stamp
from ertis_numba.geometry import self_contained, unit_vectors
from ertis_numba.interop._grey_image import GreyImage
from ertis_numba.interop._messages import encoder, schema
from ertis_numba.interop._mountings import PLATFORM, Mountings
from ertis_numba.interop._points import FindPoints, ros_time

__all__ = ["TOPICS", "write_mcap"]

TOPICS: Final = {
    "points": "sensor_msgs/msg/PointCloud2",
    "image": "sensor_msgs/msg/Image",
    "sonar_image": "marine_acoustic_msgs/msg/ProjectedSonarImage",
}
"""Topics of a sensor, and their messages."""
_STATIC, _STATIC_TYPE = "/tf_static", "tf2_msgs/msg/TFMessage"
_SONAR_SUFFIX = "_sonar"
_SQRT_HALF = math.sqrt(0.5)
_SONAR_TURN = (_SQRT_HALF, 0.0, _SQRT_HALF, 0.0)
"""Frame of marine_acoustic_msgs relative to that of the sensor: z forward, x up, y right.

The rotation is 180° about the bisector of the x and z axes.
"""
_FLOAT32, _DTYPE_FLOAT32 = 7, 8  # Constants of PointField and of SonarImageData.
_POINT_STEP = 16
_PROFILE = """- history: 1
  depth: {depth}
  reliability: 1
  durability: {durability}
  deadline: {forever}
  lifespan: {forever}
  liveliness: 1
  liveliness_lease_duration: {forever}
  avoid_ros_namespace_conventions: false
"""
_FOREVER = "{sec: 9223372036, nsec: 854775807}"
_TRANSIENT_LOCAL, _VOLATILE = 1, 2  # Constants of rmw_qos_durability_policy_t.
_INVALID_TOPIC_CHARACTERS = re.compile(r"[^A-Za-z0-9]+")


def write_mcap(
    path: Path, images: Iterable[Energyscape], find: FindPoints, mountings: Mountings, *, topics: Collection[str]
) -> None:
    """Write the messages of images as they arrive.

    Raises
    ------
    ArgumentError
        The packages for MCAP are not installed, two sensors would share a topic, the name of a sensor is invalid, or a
        time is outside the range of ROS 2.
    """
    with extra("ros", "format 'mcap' needs mcap and mcap-ros2-support"):
        from mcap.writer import Writer  # noqa: PLC0415  an extra
        from mcap_ros2 import _dynamic  # noqa: F401, PLC0415  an extra
    with path.open("wb") as file:
        writer: Any = Writer(file)  # The annotations of mcap are partial.
        writer.start(profile="ros2", library="ertis-numba")
        _McapWriter(writer, find, mountings, topics).write(images)
        writer.finish()


class _McapWriter:
    """MCAP file in progress: its topics and sensors."""

    def __init__(self, writer: Any, find: FindPoints, mountings: Mountings, topics: Collection[str]) -> None:
        self._writer, self._find, self._mountings = writer, find, mountings
        self._topics = [topic for topic in TOPICS if topic in topics]
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._names: dict[str, str] = {}
        self._pictures: dict[str, tuple[Energyscape, GreyImage]] = {}

    def write(self, images: Iterable[Energyscape]) -> None:
        """Write all messages; the transforms come last, because only then are all sensors known."""
        earliest: Stamp | None = None
        for image in images:
            stamp, sensor = image.stamp, image.stamp.sensor
            if earliest is None or stamp.timestamp_ns < earliest.timestamp_ns:
                earliest = stamp
            if sensor not in self._names:
                self._register_sensor(image)
            for topic in self._topics:
                message = getattr(self, f"_{topic}")(image)
                self._add(f"/{self._names[sensor]}/{topic}", TOPICS[topic], message, stamp)
        if earliest is not None:
            self._add(_STATIC, _STATIC_TYPE, self._transforms(earliest), earliest)

    def _register_sensor(self, image: Energyscape) -> None:
        """Choose a name for the topics of a sensor, and keep its settings."""
        sensor = checks.sensor_name(image.stamp.sensor)
        name = _INVALID_TOPIC_CHARACTERS.sub("_", sensor).strip("_")
        name = f"sensor_{name}" if not name[:1].isalpha() else name
        for other, taken in self._names.items():
            if taken == name:
                raise ArgumentError(f"sensors {other} and {sensor} would share topics /{name}; choose one (--sensor)")
        self._names[sensor] = name
        settings = self_contained(image.settings).to_toml()
        self._writer.add_metadata(f"ertis_numba/{sensor}", {"sensor": sensor, "settings": settings})

    def _add(self, topic: str, kind: str, message: dict[str, Any], stamp: Stamp) -> None:
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", schema(kind).encode())
        if topic not in self._channels:
            # Late subscribers of /tf_static need messages that the player keeps (transient local).
            depth, durability = (1, _TRANSIENT_LOCAL) if topic == _STATIC else (10, _VOLATILE)
            profile = _PROFILE.format(depth=depth, durability=durability, forever=_FOREVER)
            self._channels[topic] = self._writer.register_channel(
                topic, "cdr", self._schemas[kind], {"offered_qos_profiles": profile}
            )
        self._writer.add_message(
            self._channels[topic],
            log_time=stamp.timestamp_ns,
            publish_time=stamp.timestamp_ns,
            sequence=stamp.sequence % 2**32,
            data=encoder(kind)(message),
        )

    def _points(self, image: Energyscape) -> dict[str, Any]:
        cloud = self._find(image)
        rows = np.column_stack([cloud.position_m, cloud.amplitude]).astype("<f4")
        fields = [
            {"name": name, "offset": 4 * number, "datatype": _FLOAT32, "count": 1}
            for number, name in enumerate(("x", "y", "z", "intensity"))
        ]
        return {
            "header": _header(image.stamp),
            "height": 1,
            "width": len(cloud),
            "fields": fields,
            "is_bigendian": False,
            "point_step": _POINT_STEP,
            "row_step": _POINT_STEP * len(cloud),
            "data": rows.tobytes(),
            "is_dense": True,
        }

    def _image(self, image: Energyscape) -> dict[str, Any]:
        sensor = image.stamp.sensor
        known = self._pictures.get(sensor)
        if known is None or not same_directions(known[0], image):
            known = self._pictures[sensor] = image, GreyImage(image)
        pixels = known[1](image.amplitude)
        height, width = pixels.shape
        return {
            "header": _header(image.stamp),
            "height": height,
            "width": width,
            "encoding": "mono8",
            "is_bigendian": 0,
            "step": width,
            "data": pixels.tobytes(),
        }

    def _sonar_image(self, image: Energyscape) -> dict[str, Any]:
        call = image.settings.call
        forward, left, up = unit_vectors(image.azimuth_rad, image.elevation_rad).T.tolist()
        return {
            "header": _header(image.stamp, suffix=_SONAR_SUFFIX),
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

    def _transforms(self, stamp: Stamp) -> dict[str, Any]:
        found = []
        for sensor in self._names:
            if sensor in self._mountings:
                found.append(_transform(stamp, PLATFORM, sensor, *self._mountings[sensor]))
            if "sonar_image" in self._topics:
                found.append(_transform(stamp, sensor, sensor + _SONAR_SUFFIX, (0.0, 0.0, 0.0), _SONAR_TURN))
        return {"transforms": found}


def _header(stamp: Stamp, *, frame: str | None = None, suffix: str = "") -> dict[str, Any]:
    sec, nanosec = ros_time(stamp)
    return {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": (frame or stamp.sensor) + suffix}


def _transform(
    stamp: Stamp,
    parent: str,
    child: str,
    translation_m: tuple[float, float, float],
    rotation_xyzw: tuple[float, float, float, float],
) -> dict[str, Any]:
    return {
        "header": _header(stamp, frame=parent),
        "child_frame_id": child,
        "transform": {
            "translation": dict(zip("xyz", translation_m, strict=True)),
            "rotation": dict(zip("xyzw", rotation_xyzw, strict=True)),
        },
    }
