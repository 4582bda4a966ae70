"""How a central node is: what `ertis status` shows, applications subscribe to, and metrics are made of."""

from collections import deque
from typing import Annotated, Any, Final, Literal, Self

import msgspec

from ertis_numba.errors import DataError

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
    """How long something took, of the latest times that it happened; 0 where it never did."""

    p50_ms: float = 0.0
    p90_ms: float = 0.0
    p99_ms: float = 0.0
    max_ms: float = 0.0


class Latencies:
    """Collects times, of which the latest count.

    Parameters
    ----------
    size : int
        How many count.
    """

    def __init__(self, size: int = 1024) -> None:
        self._times_ms: deque[float] = deque(maxlen=size)

    def add(self, time_ms: float) -> None:
        """Take a time."""
        self._times_ms.append(time_ms)

    def percentiles(self) -> Percentiles:
        """Return what they come to."""
        ordered = sorted(self._times_ms)
        if not ordered:
            return Percentiles()
        last = len(ordered) - 1
        p50, p90, p99 = (round(ordered[round(share * last)], 3) for share in (0.5, 0.9, 0.99))
        return Percentiles(p50_ms=p50, p90_ms=p90, p99_ms=p99, max_ms=round(ordered[-1], 3))


class SensorStatus(msgspec.Struct, kw_only=True):
    """One sensor, since the central node was started.

    ``received`` counts each measurement once, however often it is sent. Where there is processing, each is under way
    or has become something: ``received = published + sum(dropped.values()) + in_flight``, but for those that a mistake
    in this package has cost, which is counted as ``refused["internal"]``.
    """

    connected: bool = False
    session_id: int = 0
    acked_through: int = -1
    rate_hz: float = 0.0
    received: int = 0
    received_bytes: int = 0
    stored: int = 0
    published: int = 0
    in_flight: int = 0
    dropped: dict[str, int] = {}
    missing: dict[str, int] = {}
    """Sequence numbers that the sensor node, or this one, says to be missing, by reason."""
    repeated: int = 0
    """Measurements that came again and were held already."""
    conflicts: int = 0
    """Of those, such that were not the same; both are kept."""
    queue: int = 0
    """Waiting for a worker, or for the disk."""
    image_latency: Percentiles = Percentiles()
    """From its arrival at this node to the image leaving it."""


class ArchiveStatus(msgspec.Struct, kw_only=True):
    """What stores measurements."""

    folder: str
    recording: str = ""
    """That is being written."""
    journal_bytes: int = 0
    free_bytes: int = 0
    room_bytes: int = 0
    """That can still be stored, about."""
    sealed: int = 0
    sealing: int = 0
    sealing_failed: int = 0
    set_aside: int = 0
    """Journals kept under another name, because they are damaged or no recording can hold some of their sensors."""
    commit: Percentiles = Percentiles()
    ack: Percentiles = Percentiles()
    """From the arrival of a measurement to its ack being sent."""


class WorkerStatus(msgspec.Struct, kw_only=True):
    """One worker."""

    pid: int
    state: Literal["starting", "idle", "busy"]
    done: int = 0


class SubscriberStatus(msgspec.Struct, kw_only=True):
    """One application node."""

    name: str
    products: tuple[str, ...]
    sensors: tuple[str, ...] | None = None
    sent: int = 0
    dropped: int = 0


class ProcessingStatus(msgspec.Struct, kw_only=True):
    """What makes images."""

    address: str = ""
    """Where applications subscribe."""
    choice: str = ""
    """How measurements share the cores, and why, in a line."""
    workers: list[WorkerStatus] = []
    respawned: int = 0
    retried: int = 0
    quarantined: int = 0
    publisher_respawned: int = 0
    publisher_pid: int = 0
    """Of the process that serves applications; 0 while there is none."""
    process_time: Percentiles = Percentiles()
    subscribers: list[SubscriberStatus] = []
    groups: dict[str, int] = {}
    """Closed groups: ``complete``, and by flag."""


class Status(msgspec.Struct, kw_only=True):
    """A central node."""

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
    """Whether nodes have to have keys."""
    keys_note: str = ""
    """Why the list of keys cannot be used, so that nobody is let in."""
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
        """Return what was encoded.

        Raises
        ------
        DataError
            It is no status.
        """
        try:
            return msgspec.msgpack.decode(data, type=cls)
        except (msgspec.MsgspecError, UnicodeDecodeError) as error:
            reported = " ".join(str(error).split())
            raise DataError(
                f"a status cannot be read ({reported}); use the same release of ertis-numba on both"
            ) from error


def _encodable(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _encodable(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_encodable(item) for item in value]
    if isinstance(value, str):
        return value.encode(errors="replace").decode()
    return min(value, _MAX) if isinstance(value, int) else value
