"""Status of a central node, for `ertis sensors status`, applications and metrics."""

from collections import deque
from typing import Annotated, Any, Final, Literal, Self

import msgspec

from ertis_numba.base.errors import DataError

__all__ = [
    "ArchiveStatus",
    "Latencies",
    "Percentiles",
    "ProcessingStatus",
    "SensorStatus",
    "Status",
    "SubscriberStatus",
    "WorkerStatus",
]


_MAX: Final = 2**63 - 1


class Percentiles(msgspec.Struct, frozen=True, kw_only=True):
    """Percentiles of recent durations; 0 if there are none."""

    p50_ms: float = 0.0
    p90_ms: float = 0.0
    p99_ms: float = 0.0
    max_ms: float = 0.0


class Latencies:
    """Collector of recent durations."""

    def __init__(self) -> None:
        self._times_ms: deque[float] = deque(maxlen=1024)

    def add(self, time_ms: float) -> None:
        """Add a duration."""
        self._times_ms.append(time_ms)

    def percentiles(self) -> Percentiles:
        """Return the percentiles."""
        ordered = sorted(self._times_ms)
        if not ordered:
            return Percentiles()
        last = len(ordered) - 1
        p50, p90, p99 = (round(ordered[round(share * last)], 3) for share in (0.5, 0.9, 0.99))
        return Percentiles(p50_ms=p50, p90_ms=p90, p99_ms=p99, max_ms=round(ordered[-1], 3))


class SensorStatus(msgspec.Struct, kw_only=True):
    """Status of one sensor, since the start of the central node.

    ``received`` counts each measurement once, however often it is sent. With processing, ``received = published +
    sum(dropped.values()) + in_flight``, except for those lost to internal errors: ``refused["internal"]``.
    """

    connected: bool = False
    session_id: int = 0
    acked_through: int = -1
    rate_hz: float = 0.0
    received: int = 0
    received_bytes: int = 0
    stored: int = 0
    published: int = 0
    passive: int = 0
    """Published measurements without a call, of which no image was made."""
    in_flight: int = 0
    dropped: dict[str, int] = {}
    missing: dict[str, int] = {}
    """Sequence numbers reported as missing by the sensor node or this node, by reason."""
    repeated: int = 0
    """Duplicates of stored measurements."""
    conflicts: int = 0
    """Duplicates with other content; both are kept."""
    queue: int = 0
    """Measurements that wait for a worker or for the disk."""
    image_latency: Percentiles = Percentiles()
    """Time from the arrival at this node to the departure of the image."""


class ArchiveStatus(msgspec.Struct, kw_only=True):
    """Status of the storage."""

    folder: str
    recording: str = ""
    """Name of the recording in progress."""
    journal_bytes: int = 0
    free_bytes: int = 0
    room_bytes: int = 0
    """Approximate remaining capacity."""
    sealed: int = 0
    sealing: int = 0
    sealing_failed: int = 0
    poses: int = 0
    """Accepted poses of platforms."""
    set_aside: int = 0
    """Journals kept under another name, because they are damaged or a recording cannot hold some of their sensors."""
    commit: Percentiles = Percentiles()
    ack: Percentiles = Percentiles()
    """Time from the arrival of a measurement to its ack."""


class WorkerStatus(msgspec.Struct, kw_only=True):
    """Status of one worker."""

    pid: int
    state: Literal["starting", "idle", "busy"]
    done: int = 0


class SubscriberStatus(msgspec.Struct, kw_only=True):
    """Status of one application node."""

    name: str
    products: tuple[str, ...]
    sensors: tuple[str, ...] | None = None
    sent: int = 0
    dropped: int = 0


class ProcessingStatus(msgspec.Struct, kw_only=True):
    """Status of image processing."""

    address: str = ""
    """Address for applications."""
    choice: str = ""
    """Description of the distribution of measurements over cores, with its reason."""
    workers: list[WorkerStatus] = []
    respawned: int = 0
    retried: int = 0
    quarantined: int = 0
    publisher_respawned: int = 0
    publisher_pid: int = 0
    """Identifier of the process that serves applications; 0 while there is none."""
    process_time: Percentiles = Percentiles()
    subscribers: list[SubscriberStatus] = []
    groups: dict[str, int] = {}
    """Closed groups: ``complete``, and counts by flag."""


class Status(msgspec.Struct, kw_only=True):
    """Status of a central node."""

    version: str
    pid: int
    host: str
    address: str
    state: Literal["storage", "processing", "fault", "closing"]
    fault: str = ""
    uptime_s: float = 0.0
    time_ns: int = 0
    memory_bytes: int = 0
    peers: int = 0
    keys: bool = False
    """True if nodes need keys."""
    keys_note: str = ""
    """Error of the allow list, which keeps all nodes out; empty if there is none."""
    refused: Annotated[dict[str, int], "by reason"] = {}
    sensors: dict[str, SensorStatus] = {}
    archive: ArchiveStatus | None = None
    processing: ProcessingStatus | None = None

    def encode(self) -> bytes:
        """Return MessagePack; counts beyond 64 bits become the highest count, surrogates become '?'."""
        try:
            return msgspec.msgpack.encode(self)
        except (OverflowError, UnicodeEncodeError):
            return msgspec.msgpack.encode(_encodable(msgspec.to_builtins(self)))

    @classmethod
    def decode(cls, data: bytes) -> Self:
        """Return the status from MessagePack."""
        try:
            return msgspec.msgpack.decode(data, type=cls)
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            reported = " ".join(str(error).split())
            raise DataError(
                f"a status cannot be decoded ({reported}); use the same release of ertis-numba on both"
            ) from error


def _encodable(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _encodable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_encodable(item) for item in value]
    if isinstance(value, str):
        return value.encode(errors="replace").decode()
    return min(value, _MAX) if isinstance(value, int) else value
