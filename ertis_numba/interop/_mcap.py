"""Energyscapes and maps as MCAP files of ROS 2 messages, after the specification of MCAP (profile ``ros2``)."""

import io
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

from ertis_numba.base.extras import extra
from ertis_numba.frames import BEHAVIOURS, Behaviour, Energyscape, OccupancyMap, Stamp
from ertis_numba.geometry import self_contained
from ertis_numba.interop._mountings import PLATFORM, Mountings
from ertis_numba.interop._points import FindPoints
from ertis_numba.interop.ros_definitions import encoder, schema
from ertis_numba.interop.ros_messages import (
    MAP_TYPE,
    MESSAGES,
    ImageMessages,
    TopicNames,
    mounting_message,
    occupancy_message,
    points_message,
    sonar_frame_message,
    sonar_image_message,
)
from ertis_numba.interop.scans import scan_message

__all__ = ["map_mcap", "require_mcap", "write_mcap"]

_STATIC, _STATIC_TYPE = "/tf_static", "tf2_msgs/msg/TFMessage"
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


def write_mcap(
    path: Path, images: Iterable[Energyscape], find: FindPoints, mountings: Mountings, *, topics: Collection[str]
) -> None:
    """Write images as they arrive; refuse invalid names, times that ROS 2 cannot hold, and levelled directions."""
    with path.open("wb") as file, _started(file) as writer:
        _McapWriter(writer, find, mountings, topics).write(images)


def map_mcap(occupancy: OccupancyMap, *, probabilities: bool = False) -> bytes:
    """Return a file with a map as latched OccupancyGrid on /map, its cells as in `occupancy_values`."""
    file = io.BytesIO()
    with _started(file) as writer:
        message = occupancy_message(occupancy, probabilities=probabilities)
        _McapTopics(writer).add("/map", MAP_TYPE, message, occupancy.time_ns, is_latched=True)
    return file.getvalue()


def require_mcap() -> None:
    """Raise ArgumentError if the packages for MCAP are not installed."""
    with extra("ros", "format 'mcap' needs mcap and mcap-ros2-support"):
        import mcap.writer  # noqa: F401, PLC0415  an extra
        from mcap_ros2 import _dynamic  # noqa: F401, PLC0415  an extra


@contextmanager
def _started(file: IO[bytes]) -> Iterator[Any]:
    """Yield the writer of a file, and finish the file."""
    require_mcap()
    from mcap.writer import Writer  # noqa: PLC0415  an extra

    writer: Any = Writer(file)  # The annotations of mcap are partial.
    writer.start(profile="ros2", library="ertis-numba")
    yield writer
    writer.finish()


class _McapTopics:
    """Topics of a file in progress."""

    def __init__(self, writer: Any) -> None:
        self._writer = writer
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}

    def add(
        self,
        topic: str,
        kind: str,
        message: dict[str, Any],
        time_ns: int,
        sequence: int = 0,
        *,
        is_latched: bool = False,
    ) -> None:
        """Add a message; late subscribers of a latched topic receive its last one (transient local)."""
        if kind not in self._schemas:
            self._schemas[kind] = self._writer.register_schema(kind, "ros2msg", schema(kind).encode())
        if topic not in self._channels:
            depth, durability = (1, _TRANSIENT_LOCAL) if is_latched else (10, _VOLATILE)
            profile = _PROFILE.format(depth=depth, durability=durability, forever=_FOREVER)
            self._channels[topic] = self._writer.register_channel(
                topic, "cdr", self._schemas[kind], {"offered_qos_profiles": profile}
            )
        self._writer.add_message(
            self._channels[topic],
            log_time=time_ns,
            publish_time=time_ns,
            sequence=sequence % 2**32,
            data=encoder(kind)(message),
        )


class _McapWriter:
    """MCAP file in progress: its topics and sensors."""

    def __init__(self, writer: Any, find: FindPoints, mountings: Mountings, topics: Collection[str]) -> None:
        self._writer, self._find, self._mountings = writer, find, mountings
        self._topics = [topic for topic in MESSAGES if topic in topics]
        self._added = _McapTopics(writer)
        self._names = TopicNames()
        self._image = ImageMessages()

    def write(self, images: Iterable[Energyscape]) -> None:
        """Write all messages; transforms and metadata come last, because only then are all sensors known."""
        earliest: Stamp | None = None
        behaviours: dict[str, Counter[Behaviour]] = {}
        metadata: dict[str, dict[str, str]] = {}
        for image in images:
            stamp, sensor = image.stamp, image.stamp.sensor
            if earliest is None or stamp.timestamp_ns < earliest.timestamp_ns:
                earliest = stamp
            if sensor not in metadata:
                image.settings.processing.require_sensor_frame("messages of ROS are in the frame of the sensor")
                metadata[sensor] = {"sensor": sensor, "settings": self_contained(image.settings).to_toml()}
                behaviours[sensor] = Counter()
            behaviours[sensor][stamp.behaviour] += 1
            for topic in self._topics:
                message = self._message(topic, image)
                if message is not None:
                    name = f"/{self._names[sensor]}/{topic}"
                    self._added.add(name, MESSAGES[topic], message, stamp.timestamp_ns, stamp.sequence)
        transforms = [] if earliest is None else self._transforms(earliest)
        if earliest is not None and (transforms or self._names.keys() != {PLATFORM}):
            self._added.add(
                _STATIC,
                _STATIC_TYPE,
                {"transforms": transforms},
                earliest.timestamp_ns,
                earliest.sequence,
                is_latched=True,
            )
        for sensor, counts in behaviours.items():
            numbers = {f"n_{behaviour}": str(counts[behaviour]) for behaviour in BEHAVIOURS}
            self._writer.add_metadata(f"ertis_numba/{sensor}", metadata[sensor] | numbers)

    def _message(self, topic: str, image: Energyscape) -> dict[str, Any] | None:
        if topic == "points":
            return points_message(self._find(image))
        if topic == "scan":
            return scan_message(image)
        return self._image(image) if topic == "image" else sonar_image_message(image)

    def _transforms(self, stamp: Stamp) -> list[dict[str, Any]]:
        found = []
        for sensor in self._names:
            own = replace(stamp, sensor=sensor)
            if sensor in self._mountings and sensor != PLATFORM:  # A frame has no transform to itself.
                found.append(mounting_message(own, self._mountings[sensor]))
            if "sonar_image" in self._topics:
                found.append(sonar_frame_message(own))
        return found
