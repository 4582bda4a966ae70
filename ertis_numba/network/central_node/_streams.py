"""Greeted sessions with their next numbers and acknowledgements, and the counts of each sensor."""

import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import count, pairwise
from statistics import median
from typing import Final, Literal, NamedTuple

from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.geometry import received_settings
from ertis_numba.journal import JournalSensor
from ertis_numba.network.central_node._received_items import SensorSession
from ertis_numba.network.messages import Ack, Data, Hello, Message
from ertis_numba.network.status import Latencies, SensorStatus
from ertis_numba.settings import Air, Settings

__all__ = ["Acks", "PeerConnection", "SensorTrack", "Sharing", "Stream", "source_of"]

_turns = count()
_RECENT_S: Final = 3.0
_SLOWEST: Final = 4  # Measurements that determine the rate if fewer are recent.
_MISSED: Final = 2.5  # Intervals after which a sensor is silent.
_DROPS_KEPT: Final = 256  # Limit per session.
_REASONS: Final = 32  # Limit on reasons for missing numbers, per sensor.
_NUMBERS_KEPT: Final = 512  # Limit on kept CRC-32 values, per session.
_DROPS: Final = 32  # Limit on the drops in one ack.


def source_of(hello: Hello, text: bytes, *, max_bytes: int) -> JournalSensor:
    """Return the sensor of a hello, from its settings as TOML; max_bytes limits a measurement."""
    return _source(hello.sensor, text, hello.firmware, hello.translation_m, hello.rotation_xyzw, max_bytes)


@lru_cache(maxsize=64)
def _source(
    name: str,
    text: bytes,
    firmware: str,
    translation_m: tuple[float, ...] | None,
    rotation_xyzw: tuple[float, ...] | None,
    max_bytes: int,
) -> JournalSensor:
    if not firmware.isprintable():
        raise ArgumentError(f"firmware of sensor {name} is {firmware!r}; use printable characters")
    settings = received_settings(text, f"settings of sensor {name}")
    source = JournalSensor.from_settings(
        name, settings, firmware=firmware, translation_m=translation_m, rotation_xyzw=rotation_xyzw
    )
    if source.n_bytes > max_bytes:
        raise SettingsError(
            f"a measurement of sensor {name} has {source.n_bytes} bytes, but the limit is {max_bytes}; record "
            "fewer samples, or raise the limit (--max-bytes)"
        )
    return source


class _Times(NamedTuple):
    """Times of a measurement, in seconds: its arrival by this node's clock, and itself by that of its sensor node."""

    session_id: int
    arrived_s: float
    measured_s: float


@dataclass(slots=True)
class SensorTrack:
    """Counts of one sensor's measurements."""

    session_id: int = 0
    acked_through: int = -1
    received: int = 0
    received_bytes: int = 0
    stored: int = 0
    repeated: int = 0
    conflicts: int = 0
    waiting: int = 0
    missing: Counter[str] = field(default_factory=Counter)
    peers: set[bytes] = field(default_factory=set)
    times: deque[_Times] = field(default_factory=lambda: deque(maxlen=128))
    shared_s: float = 0.0  # Time since several peers send it; 0 if none do, or once it was reported.

    def miss(self, reason: str, n_missing: int) -> None:
        """Count missing numbers."""
        known = reason in self.missing or len(self.missing) < _REASONS
        self.missing[reason if known else "another reason"] += n_missing

    def took(self, n_bytes: int, session_id: int, *, arrived_s: float, measured_s: float) -> None:
        """Count a new measurement, and note the times by the clocks of this node and of the sensor node."""
        self.received += 1
        self.received_bytes += n_bytes
        self.times.append(_Times(session_id, arrived_s, measured_s))

    def status(self) -> SensorStatus:
        """Return the counts."""
        return SensorStatus(
            connected=bool(self.peers),
            session_id=self.session_id,
            acked_through=self.acked_through,
            rate_hz=round(self._rate_hz(), 3),
            received=self.received,
            received_bytes=self.received_bytes,
            stored=self.stored,
            missing=dict(self.missing),
            repeated=self.repeated,
            conflicts=self.conflicts,
            queue=self.waiting,
        )

    def _rate_hz(self) -> float:
        """Return the rate of the latest session by its median interval; kept measurements come in bursts."""
        now_s = time.monotonic()
        latest = [each for each in self.times if each.session_id == self.times[-1].session_id]
        recent = [each for each in latest if now_s - each.arrived_s < _RECENT_S]
        recent = max(recent, latest[-_SLOWEST:], key=len)
        if len(recent) <= 1:
            return 0.0
        arrived_s, measured_s = (sorted(times_s) for times_s in zip(*(each[1:] for each in recent), strict=True))
        interval_s = max(_median_interval_s(arrived_s), _median_interval_s(measured_s))
        is_silent = now_s - arrived_s[-1] > max(_RECENT_S, _MISSED * interval_s)
        return 0.0 if is_silent or not interval_s else 1 / interval_s


def _median_interval_s(times_s: Sequence[float]) -> float:
    return median(later_s - earlier_s for earlier_s, later_s in pairwise(times_s))


@dataclass(slots=True, eq=False)
class Stream:
    """A greeted session."""

    run: SensorSession
    source: JournalSensor
    track: SensorTrack
    acked_through: int  # all up to here is acknowledged
    taken: int  # will be acknowledged once the waiting items are stored
    begins: int  # oldest number that the node has
    owner: bytes  # peer that sent the latest hello
    shown: int = -1  # counted and shown up to here
    turn: int = field(default_factory=_turns.__next__)  # as in ReceivedItem
    dropped: deque[tuple[int, str]] = field(default_factory=lambda: deque(maxlen=_DROPS_KEPT))  # drops not yet reported
    recent: OrderedDict[int, int] = field(default_factory=OrderedDict)
    _air: tuple[tuple[float, float, float], Settings] | None = None

    def remember(self, sequence: int, crc32: int) -> None:
        """Keep the CRC-32 of a measurement for a while."""
        self.recent[sequence] = crc32
        if len(self.recent) > _NUMBERS_KEPT:
            self.recent.popitem(last=False)

    def settings(self, data: Data) -> Settings:
        """Return the settings of a measurement."""
        air = (data.temperature_c, data.humidity_percent, data.pressure_pa)
        if self._air is None or self._air[0] != air:
            temperature_c, humidity_percent, pressure_pa = air
            made = Air(temperature_c=temperature_c, humidity_percent=humidity_percent, pressure_pa=pressure_pa)
            settings = self.source.settings
            self._air = air, settings if settings.air == made else settings.replace(air=made)
        return self._air[1]

    def go_back(self) -> None:
        """Accept unacknowledged numbers again."""
        self.taken, self.turn = self.acked_through, next(_turns)

    def use(self, source: JournalSensor) -> None:
        """Use other settings from now on."""
        if source is not self.source:
            self.source, self._air = source, None


@dataclass(slots=True, eq=False)
class PeerConnection:
    """Connection of a sensor node."""

    streams: dict[SensorSession, Stream] = field(default_factory=dict)
    heard_s: float = 0.0  # latest message, by time.monotonic
    waiting_bytes: int = 0  # waiting for the disk
    key: str = ""


class Acks:
    """Pending acks, one per session; status as in `Ack`, latencies from the arrival of a measurement to its ack."""

    def __init__(self, send: Callable[[bytes, Message], object], status: Literal["stored", "accepted"]) -> None:
        self._send: Final = send
        self._status: Final = status
        self._due: dict[tuple[str, int], Stream] = {}  # By sensor and session.
        self._arrived_s: list[float] = []
        self.latencies = Latencies()

    def owe(self, stream: Stream) -> None:
        """Schedule an ack of a session."""
        self._due[stream.run] = stream

    def acked_through(self, arrived_s: float) -> None:
        """Count a measurement that the next ack acknowledges."""
        self._arrived_s.append(arrived_s)

    def forget(self, stream: Stream) -> None:
        """Send no more acks for a session."""
        self._due.pop(stream.run, None)

    def send(self) -> None:
        """Send pending acks."""
        for (sensor, session_id), stream in self._due.items():
            if not stream.owner:
                continue
            dropped = tuple(stream.dropped.popleft() for _ in range(min(_DROPS, len(stream.dropped))))
            ack = Ack(
                sensor=sensor,
                session_id=session_id,
                acked_through=stream.acked_through,
                status=self._status,
                dropped=dropped,
            )
            self._send(stream.owner, ack)
        self._due.clear()
        if self._arrived_s:
            now_s = time.monotonic()
            for arrived_s in self._arrived_s:
                self.latencies.add(1e3 * (now_s - arrived_s))
            self._arrived_s.clear()


class Sharing:
    """Detector of sensors that several nodes send; reports each once."""

    def __init__(self, notify: Callable[..., None]) -> None:
        self._emit_event = notify
        self._sensors: set[str] = set()

    @staticmethod
    def joins(track: SensorTrack, peer_id: bytes, now_s: float) -> None:
        """Register that a node sends a sensor."""
        if track.peers - {peer_id} and peer_id not in track.peers:
            track.shared_s = now_s
        track.peers.add(peer_id)

    def leaves(self, track: SensorTrack, sensor: str, peer_id: bytes) -> None:
        """Register that a node no longer sends a sensor."""
        track.peers.discard(peer_id)
        if len(track.peers) < 2:
            self._sensors.discard(sensor)

    def tick(self, tracks: Mapping[str, SensorTrack], peers: Mapping[bytes, PeerConnection]) -> None:
        """Report new ones."""
        for sensor, track in tracks.items():
            # A reconnected node may be noticed as gone only seconds later.
            if track.shared_s and all(peers[each].heard_s > track.shared_s for each in track.peers):
                track.shared_s = 0.0
                if len(track.peers) > 1:
                    self._sensors.add(sensor)
                    self._emit_event(
                        "shared", sensor=sensor, text="several sensor nodes send it; use a different name for each"
                    )

    def remark(self, peer: PeerConnection | None) -> str:
        """Return a remark for a node, one line; empty if there is none."""
        shared = () if peer is None else sorted(self._sensors & {run.sensor for run in peer.streams})
        if not shared:
            return ""
        return f"another sensor node sends sensor {shared[0]}, too; use a different name for each (--name), or end one"
