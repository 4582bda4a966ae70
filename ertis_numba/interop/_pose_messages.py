"""Poses in messages of ROS 2 in MCAP."""

import errno
import io
import struct
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, BinaryIO, Final, NamedTuple

import numpy as np

from ertis_numba.base.errors import ArgumentError, DataError, ErtisError
from ertis_numba.base.extras import extra
from ertis_numba.interop._pose_rows import PoseRows

__all__ = ["read_messages"]

_POSES: Final = (
    "nav_msgs/msg/Odometry",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/PoseStamped",
)
_PATH: Final = "nav_msgs/msg/Path"
_TRANSFORMS: Final = "tf2_msgs/msg/TFMessage"
_NS: Final = 10**9
_OF_DAMAGE: Final = (struct.error, EOFError, MemoryError, OSError, UnicodeDecodeError)  # A length may be damaged, too.
_DAMAGED: Final = "the file is damaged or cut short; record it again, or repair it with 'mcap recover'"
_FOOTER: Final = struct.Struct("<9xQQI8s")  # Start of the summary, and of its offsets; checksum; after them, the magic.
_AFTER_CHECKED: Final = 12  # Bytes at the end of a file that the checksum does not cover: itself and the magic.
_PLATFORM_FRAMES: Final = ("", "base_link", "base_footprint")


class _StampedPose(NamedTuple):
    """Pose of a message, with its header and the time of the recording."""

    header: Any
    log_ns: int
    position: Any
    rotation: Any
    covariance: Any = None
    child: str = ""


def read_messages(path: Path, topic: str | None) -> PoseRows:
    """Return the poses of a topic."""
    with extra("ros", "trajectories in .mcap files need mcap and mcap-ros2-support"):
        from mcap.exceptions import DecoderNotFoundError, McapError, UnsupportedCompressionError  # noqa: PLC0415  an extra
        from mcap.reader import make_reader  # noqa: PLC0415  an extra
        from mcap.stream_reader import CRCValidationError  # noqa: PLC0415  an extra
        from mcap_ros2.decoder import DecoderFactory  # noqa: PLC0415  an extra
    with path.open("rb") as file:
        try:
            _check_summary(file)
            reader: Any = make_reader(file, validate_crcs=True, decoder_factories=[DecoderFactory()])
            summary = reader.get_summary()
            kinds = {} if summary is None else _kinds(summary)
            wanted, _, edge = (topic or "").partition(":")
            chosen = _topic(kinds, wanted or None, edge, lambda each: _edges(reader, each))
            found = reader.iter_decoded_messages(topics=[chosen], log_time_order=True)
            poses = _poses(kinds[chosen], ((raw.log_time, message) for _, _, raw, message in found), edge)
            return _rows(poses)
        except ErtisError:
            raise
        except Exception as error:  # The libraries raise errors of any type.
            if isinstance(error, OSError) and error.errno != errno.EINVAL:  # EINVAL is a wrong place in the file.
                raise
            is_foreign = isinstance(error, DecoderNotFoundError | UnsupportedCompressionError)
            is_of_damage = isinstance(error, (McapError, CRCValidationError, *_OF_DAMAGE)) and not is_foreign
            if is_of_damage or _is_of_compression(error):
                fault = _DAMAGED
            else:
                reason = " ".join(f"{type(error).__name__}: {error}".split())
                fault = f"its messages cannot be read ({reason}); save the poses as .tum or .csv"
            raise DataError(fault) from error


def _check_summary(file: BinaryIO) -> None:
    """Raise DataError if the checksum of the summary, which the library ignores, does not match."""
    size = file.seek(0, io.SEEK_END)
    file.seek(max(0, size - _FOOTER.size))
    footer = file.read()
    file.seek(0)
    if len(footer) < _FOOTER.size:
        return
    start, _, checksum, _ = _FOOTER.unpack(footer)
    if not checksum or start >= size:
        return
    file.seek(start)
    summary = file.read()[:-_AFTER_CHECKED]
    file.seek(0)
    if zlib.crc32(summary) != checksum:
        raise DataError(_DAMAGED)


def _is_of_compression(error: Exception) -> bool:
    """Return True for an error of LZ4 or Zstandard, whose types depend on the package that is installed."""
    return type(error) is RuntimeError or "zstd" in f"{type(error).__module__}.{type(error).__name__}".lower()


def _kinds(summary: Any) -> dict[str, str]:
    """Return the topics with poses or transforms, and the type of their messages."""
    schemas = {number: schema.name for number, schema in summary.schemas.items()}
    found = {channel.topic: schemas.get(channel.schema_id, "") for channel in summary.channels.values()}
    if any(channel.message_encoding == "ros1" for channel in summary.channels.values()):
        raise DataError(
            "the messages are those of ROS 1; convert the file with 'pip install rosbags' and 'rosbags-convert'"
        )
    return {topic: kind for topic, kind in found.items() if kind in {*_POSES, _PATH, _TRANSFORMS}}


def _topic(kinds: dict[str, str], wanted: str | None, edge: str, edges: Callable[[str], list[str]]) -> str:
    """Return the topic to read; the only one with poses if none is wanted."""
    poses = sorted(topic for topic, kind in kinds.items() if kind != _TRANSFORMS)
    listed = ", ".join(poses) or "none"
    if wanted is None and len(poses) == 1:
        return poses[0]
    if wanted is None and poses:
        raise ArgumentError(f"topics with poses: {listed}; choose one of them (topic)")
    transforms = [topic for topic, kind in kinds.items() if kind == _TRANSFORMS]
    if wanted is None or (wanted in transforms and not edge):
        moving = [topic for topic in transforms if not topic.endswith("_static")]
        choices = [f"{topic}:{each}" for topic in moving for each in edges(topic)]
        if choices:
            raise ArgumentError(f"topics with poses: {listed}; choose a transform (topic): {', '.join(choices)}")
        raise ArgumentError(f"topics with poses: {listed}; record a topic of type {', '.join(_POSES)}")
    if wanted not in kinds:
        raise ArgumentError(
            f"topic {wanted!r} does not exist or contains no poses; choose a topic with poses: {listed}"
        )
    if edge and wanted in poses:
        raise ArgumentError(f"topic {wanted!r} contains poses instead of transforms; remove ':{edge}'")
    if edge and edge not in edges(wanted):
        raise ArgumentError(
            f"topic {wanted!r} contains no transform {edge!r}; choose one of {', '.join(edges(wanted))}"
        )
    return wanted


def _edges(reader: Any, topic: str) -> list[str]:
    """Return the transforms of a topic, as PARENT.CHILD."""
    found = {
        f"{each.header.frame_id}.{each.child_frame_id}"
        for *_, message in reader.iter_decoded_messages(topics=[topic])
        for each in message.transforms
    }
    return sorted(found)


def _poses(kind: str, messages: Iterable[tuple[int, Any]], edge: str) -> list[_StampedPose]:
    """Return the poses of messages of one type, in the order of the file."""
    if kind == _PATH:
        last: list[_StampedPose] = []
        for log_ns, message in messages:  # Each message repeats the path so far.
            last = [
                _StampedPose(each.header, log_ns, each.pose.position, each.pose.orientation) for each in message.poses
            ]
        return last
    if kind == _TRANSFORMS:
        return [
            _StampedPose(
                each.header, log_ns, each.transform.translation, each.transform.rotation, None, each.child_frame_id
            )
            for log_ns, message in messages
            for each in message.transforms
            if f"{each.header.frame_id}.{each.child_frame_id}" == edge
        ]
    return [_pose(log_ns, message) for log_ns, message in messages]


def _pose(log_ns: int, message: Any) -> _StampedPose:
    # Odometry and PoseWithCovarianceStamped hold a pose with covariance in their field "pose".
    holder = message.pose
    pose = getattr(holder, "pose", holder)
    child = getattr(message, "child_frame_id", "")
    return _StampedPose(
        message.header, log_ns, pose.position, pose.orientation, getattr(holder, "covariance", None), child
    )


def _rows(poses: list[_StampedPose]) -> PoseRows:
    if not poses:
        raise DataError("the topic contains no poses; choose another topic (topic)")
    frames = sorted({(pose.header.frame_id, pose.child) for pose in poses})
    if len(frames) > 1:
        named = ", ".join(f"{child or 'a platform'} in {frame!r}" for frame, child in frames)
        raise DataError(f"poses are in several frames ({named}); record poses in one frame")
    notes = []
    if frames[0][1] not in _PLATFORM_FRAMES:
        notes.append(
            f"poses are those of the frame {frames[0][1]!r}; the mountings of sensors must be relative to this frame"
        )
    stamps_ns = np.array([pose.header.stamp.sec * _NS + pose.header.stamp.nanosec for pose in poses], np.int64)
    if not stamps_ns.any() and len({pose.log_ns for pose in poses}) == len(poses):
        stamps_ns = np.array([pose.log_ns for pose in poses], np.int64)
        notes.append("the messages contain no times (0), so the times at which they were recorded are used")
    covariances = [pose.covariance for pose in poses if pose.covariance is not None]
    turns = [pose.rotation for pose in poses]
    return PoseRows(
        "message",
        np.arange(1, len(poses) + 1),
        stamps_ns,
        np.array([(pose.position.x, pose.position.y, pose.position.z) for pose in poses]).reshape(-1, 3),
        np.array([(turn.x, turn.y, turn.z, turn.w) for turn in turns]).reshape(-1, 4),
        np.array(covariances, np.float64).reshape(-1, 6, 6) if covariances else None,
        tuple(notes),
    )
