"""Publisher of images, points and status as ROS 2 topics."""

import math
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, Self

import numpy as np

from ertis_numba.analysis.point_finder import PointFinder
from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Energyscape, PointCloud, Stamp
from ertis_numba.interop._mountings import PLATFORM, Mounting, validated
from ertis_numba.interop.ros_messages import (
    MESSAGES,
    ImageMessages,
    TopicNames,
    mounting_message,
    points_message,
    sonar_frame_message,
    sonar_image_message,
)
from ertis_numba.interop.scans import reflectors_ahead, scan_message
from ertis_numba.network.status import Status
from ertis_numba.ros.diagnostics import diagnostics_message
from ertis_numba.ros.fused_points import LOCAL_FRAME, FusedImages, FusedPoints
from ertis_numba.ros.odometry_publisher import OdometryPublisher
from ertis_numba.ros.participant import Participant, Topic
from ertis_numba.ros.publishing_settings import PublishingSettings

__all__ = ["RosPublisher"]

_TRANSFORMS: Final = ("/tf_static", "tf2_msgs/msg/TFMessage")
_ODOMETRY: Final = "nav_msgs/msg/Odometry"
_DIAGNOSTICS: Final = ("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
_ALL_SENSORS: Final = "of all mounted sensors"  # No sensor can have this name.
_CLOCK: Final = ("/clock", "rosgraph_msgs/msg/Clock")


class RosPublisher:
    """Publisher of the topics of all sensors.

    The topics of a sensor lie in ``NAMESPACE/SENSOR/``; their frame is the sensor's name. ``NAMESPACE/fused/points``
    holds the reflectors that all sensors of a SYNC pulse have located, and ``NAMESPACE/fused/scan`` their scan, if the
    mounting of two or more is known. Without images, ``fused/points`` holds the points of each sensor instead.
    ``docs/how-to/ros.md`` lists the topics and their messages. With ``odometry``, use the publisher in a
    ``with`` statement, or close it.

    Parameters
    ----------
    participant : Participant
    topics : sequence of str
        Topics of each sensor, of `ertis_numba.interop.ros_messages.MESSAGES`; ``points`` and ``scan`` by default.
    namespace : str
        Prefix of the topics of sensors, such as ``robot1``.
    mounting : mapping of str to (translation_m, rotation_xyzw), optional
        Poses of sensors on their platform, in place of those of the images.
    top : int
        Largest number of points per image.
    settings : PublishingSettings
        Limits of points and echoes, and rates.
    odometry : bool
        Publish the pose and velocity of the platform on ``NAMESPACE/odom``, and the transform from ``odom`` to
        ``base_link`` on ``/tf``. A thread computes them from the images of all sensors with a known mounting.
    alone : bool, optional
        True if no sensor emits except those with images, as for `Odometry`.
    on_note : callable, optional
        Called with a line for each sensor or pulse that fusion or odometry leaves out.

    Attributes
    ----------
    settings : PublishingSettings
        They may be replaced at any time.
    topics : dict of str to Topic
        Topics in use, by name.
    published : int
        Number of images and clouds of which at least one message was published.
    left_out : int
        Number of messages left out because of ``max_rate_hz``, or because publishing was paused.

    Raises
    ------
    ArgumentError
        A topic, the namespace, a mounting or a limit is invalid.

    Examples
    --------
    Publish the points and the scans of a recording, on this machine only::

        from ertis_numba.ros import Participant, RosPublisher

        with ertis.open_recording("reflectors.h5") as recording, Participant() as participant:
            pipeline, ros = ertis.Pipeline(recording.settings), RosPublisher(participant)
            for measurement in recording:
                ros.publish(pipeline.process(measurement))
    """

    def __init__(
        self,
        participant: Participant,
        *,
        topics: Collection[str] = ("points", "scan"),
        namespace: str = "",
        mounting: Mapping[str, tuple[Sequence[float], Sequence[float]]] | None = None,
        top: int = 256,
        settings: PublishingSettings = PublishingSettings(),  # noqa: B008  it cannot change
        odometry: bool = False,
        alone: bool | None = None,
        on_note: Callable[[str], None] | None = None,
    ) -> None:
        for topic in topics:
            checks.choice("topic", topic, MESSAGES)
        self.topics: dict[str, Topic] = {}
        self.published = self.left_out = 0
        self._wanted = [topic for topic in MESSAGES if topic in topics]
        self._base = _namespace(namespace)
        self._participant, self._given, self._top = participant, validated(mounting), top
        self.settings = settings
        self._image = ImageMessages()
        self._names = TopicNames()
        self._frames: dict[str, Mounting | None] = {}
        on_note = on_note or (lambda _: None)
        self._fused, self._fused_images = FusedPoints(on_note), FusedImages(on_note)
        self._due_ns: dict[tuple[str, str], int] = {}  # By sensor and topic.
        self._odometry: OdometryPublisher | None = None
        if odometry:
            self._odometry = OdometryPublisher(
                self._topic(f"{self._base}/odom", _ODOMETRY),
                self._topic("/tf", _TRANSFORMS[1]),
                on_note=on_note,
                is_paused=lambda: self._settings.paused,
                alone=alone,
            )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Publish the poses of all images, if there is odometry; publish nothing afterwards.

        Raises
        ------
        ErtisError
            The odometry has failed.
        """
        if self._odometry is not None:
            self._odometry.close()

    @property
    def skipped(self) -> int:
        """Number of pulses without odometry, because the computer was too slow."""
        return self._odometry.n_skipped if self._odometry is not None else 0

    @property
    def settings(self) -> PublishingSettings:
        """Limits of points and echoes, and rates."""
        return self._settings

    @settings.setter
    def settings(self, settings: PublishingSettings) -> None:
        self._settings = settings
        self._find = PointFinder(top=self._top, min_level_db=settings.min_level_db)

    @property
    def dropped(self) -> int:
        """Number of messages dropped because a reliable subscriber did not keep up."""
        return sum(topic.dropped for topic in self.topics.values())

    def publish(self, item: Energyscape | PointCloud, mounting: Mounting | None = None) -> None:
        """Publish the topics that follow from an image, or the points of one.

        The time of all messages is that of the emission, or the present if the clock of the sensor was never set.

        Parameters
        ----------
        item : Energyscape or PointCloud
        mounting : (translation_m, rotation_xyzw), optional
            Pose of the sensor on its platform.

        Raises
        ------
        ArgumentError
            The time is outside the range of ROS 2, or directions are levelled.
        """
        item.settings.processing.require_sensor_frame("messages of ROS are in the frame of the sensor")
        if not item.stamp.is_timed:
            item = item.replace(stamp=replace(item.stamp, timestamp_ns=time.time_ns()))
        stamp = item.stamp
        self._announce(stamp, mounting)
        if self._odometry is not None:
            self._odometry.add(item, self._frames[stamp.sensor])
        wanted = [topic for topic in self._wanted if topic == "points" or isinstance(item, Energyscape)]
        if self._settings.paused:
            self.left_out += len(wanted)
            return
        is_fused = isinstance(item, Energyscape) and self._is_fused(stamp.sensor)
        counts = [
            self._publish_points(item) if topic == "points" else self._publish_topic(topic, item)
            for topic in wanted
            if topic != "scan" or not is_fused  # Its scan needs the attribution of the fusion.
        ]
        if is_fused and isinstance(item, Energyscape):
            counts.append(self._publish_fused(item))
        self.published += any(counts)

    def _publish_topic(self, topic: str, item: Any) -> int:
        """Publish a topic of an image; return the number of published messages."""
        stamp = item.stamp
        if not self._is_due(topic, stamp.sensor, stamp.timestamp_ns):
            return 0
        message = self._message(topic, item)
        if message is None:
            return 0
        self._topic(f"{self._base}/{self._names[stamp.sensor]}/{topic}", MESSAGES[topic]).publish(message)
        return 1

    def _publish_points(self, item: Energyscape | PointCloud) -> int:
        """Publish the points of a sensor; return the number of published messages."""
        stamp, place = item.stamp, self._frames[item.stamp.sensor]
        is_due = self._is_due("points", stamp.sensor, stamp.timestamp_ns)
        is_joined = isinstance(item, PointCloud) and len(self._known_mountings) > 1 and place is not None
        if not (is_due or is_joined):
            return 0
        cloud = self._within_limits(item if isinstance(item, PointCloud) else self._find(item))
        if is_due:
            self._topic(f"{self._base}/{self._names[stamp.sensor]}/points", MESSAGES["points"]).publish(
                points_message(cloud)
            )
        if place is None or not isinstance(item, PointCloud):
            return int(is_due)
        groups = self._fused.add(cloud.replace(translation_m=place[0], rotation_xyzw=place[1]))
        return int(is_due) + sum(self._publish_fused_points(group) for group in groups if is_joined)

    @property
    def _known_mountings(self) -> dict[str, Mounting]:
        return {name: place for name, place in self._frames.items() if place is not None and name != LOCAL_FRAME}

    def _is_fused(self, sensor: str) -> bool:
        """Return True if the images of a sensor are fused with those of others."""
        mountings = self._known_mountings
        return sensor in mountings and len(mountings) > 1 and not {"points", "scan"}.isdisjoint(self._wanted)

    def _publish_fused(self, image: Energyscape) -> int:
        """Publish the fused points and the scans of each pulse that is complete now; return the number of messages."""
        mountings, count = self._known_mountings, 0
        for fused, images in self._fused_images.add(image, mountings):
            if fused.points is None:
                continue
            if "points" in self._wanted:
                count += self._publish_fused_points(self._within_limits(self._find(fused)))
            if "scan" in self._wanted:
                count += self._publish_fused_scans(fused, fused.points, images)
        return count

    def _publish_fused_scans(self, fused: Energyscape, cloud: PointCloud, images: Mapping[str, Energyscape]) -> int:
        """Publish the scans of a platform and of its sensors; return the number of messages."""
        origin_m = np.array(cloud.translation_m or (0.0, 0.0, 0.0))
        count = 0
        for name, image in images.items():
            translation_m, rotation_xyzw = self._known_mountings[name]
            near = tuple((np.array(translation_m) - origin_m).tolist()), rotation_xyzw
            count += self._publish_topic("scan", image.replace(points=reflectors_ahead(cloud, image, near)))
        if self._is_due("scan", _ALL_SENSORS, fused.stamp.timestamp_ns):
            message = self._scan(fused)
            if message is not None:
                self._topic(f"{self._base}/fused/scan", MESSAGES["scan"]).publish(message)
                count += 1
        return count

    def _publish_fused_points(self, cloud: PointCloud) -> int:
        """Publish points of all sensors, if they are due; return the number of published messages."""
        if not self._is_due("points", _ALL_SENSORS, cloud.stamp.timestamp_ns):
            return 0
        if cloud.stamp.sensor == LOCAL_FRAME and cloud.translation_m and cloud.rotation_xyzw:
            self._announce(cloud.stamp, (cloud.translation_m, cloud.rotation_xyzw))
        self._topic(f"{self._base}/fused/points", MESSAGES["points"]).publish(points_message(cloud))
        return 1

    def _within_limits(self, cloud: PointCloud) -> PointCloud:
        limits_m = self._settings.range_m
        if limits_m is None:
            return cloud
        return cloud.only((cloud.range_m >= limits_m[0]) & (cloud.range_m <= limits_m[1]))

    def publish_status(self, status: Status) -> None:
        """Publish the status of a central node and its sensors on ``/diagnostics``."""
        self._topic(*_DIAGNOSTICS).publish(diagnostics_message(status))

    def publish_clock(self, time_ns: int) -> None:
        """Publish a time in nanoseconds since 1970 on ``/clock``, for nodes with ``use_sim_time``."""
        sec, nanosec = divmod(time_ns, 1_000_000_000)
        self._topic(*_CLOCK).publish({"clock": {"sec": sec, "nanosec": nanosec}})

    def _message(self, topic: str, item: Energyscape) -> dict[str, Any] | None:
        if topic == "scan":
            return self._scan(item)
        return self._image(item) if topic == "image" else sonar_image_message(item)

    def _scan(self, item: Energyscape) -> dict[str, Any] | None:
        settings = self._settings
        floor_dbfs = -math.inf if settings.floor_dbfs is None else settings.floor_dbfs
        if settings.range_m is not None:
            try:
                item = item.select(range_m=settings.range_m)
            except ArgumentError:  # No range is within the limits.
                return None
        return scan_message(item, min_level_db=settings.min_level_db, floor_dbfs=floor_dbfs)

    def _is_due(self, topic: str, sensor: str, time_ns: int) -> bool:
        """Return False, and count the message as left out, if it would exceed the rate of its topic."""
        rate_hz = self._settings.max_rate_hz.get(topic)
        if rate_hz is None:
            return True
        key, interval_ns = (sensor, topic), round(1e9 / rate_hz)
        due_ns = self._due_ns.get(key, time_ns)
        # Steady messages at a higher rate give the exact rate on average; after a pause, or a clock that was set, the
        # count starts again.
        if not -interval_ns <= time_ns - due_ns <= interval_ns:
            due_ns = time_ns
        if time_ns < due_ns:
            self.left_out += 1
            return False
        self._due_ns[key] = due_ns + interval_ns
        return True

    def _announce(self, stamp: Stamp, mounting: Mounting | None) -> None:
        """Publish the transforms of all sensors, if the sensor is new or was moved."""
        place = self._given.get(stamp.sensor, mounting)
        if stamp.sensor in self._frames and self._frames[stamp.sensor] == place:
            return
        self._frames[stamp.sensor] = place
        transforms = []
        for sensor, known in self._frames.items():
            own = replace(stamp, sensor=sensor)
            if known is not None and sensor != PLATFORM:  # A frame has no transform to itself.
                transforms.append(mounting_message(own, known))
            if "sonar_image" in self._wanted and sensor != LOCAL_FRAME:
                transforms.append(sonar_frame_message(own))
        if transforms:
            self._topic(*_TRANSFORMS, latched=True).publish({"transforms": transforms})

    def _topic(self, name: str, message: str, *, latched: bool = False) -> Topic:
        if name not in self.topics:
            self.topics[name] = self._participant.topic(name, message, latched=latched)
        return self.topics[name]


def _namespace(given: str) -> str:
    """Return a namespace with its leading slash, or an empty one."""
    parts = given.strip("/").split("/") if given.strip("/") else []
    for part in parts:
        if not part.isidentifier() or not part.isascii() or "__" in part:
            raise ArgumentError(
                f"namespace {given!r} is not allowed in ROS; choose names of letters, digits and single underscores "
                "that do not begin with a digit, separated by /"
            )
    return "".join(f"/{part}" for part in parts)
