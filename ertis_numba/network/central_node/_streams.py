"""Greeted sessions with their next numbers, and the counts of each sensor."""

import time
from collections import Counter, OrderedDict, deque
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import count
from typing import Final

from ertis_numba.errors import ArgumentError, SettingsError
from ertis_numba.geometry import received_settings
from ertis_numba.journal import JournalSensor
from ertis_numba.network.central_node._received_items import SensorSession
from ertis_numba.network.messages import Data, Hello
from ertis_numba.network.status import SensorStatus
from ertis_numba.settings import Air, Settings

__all__ = ["PeerConnection", "SensorTrack", "Stream", "source_of"]

_turns = count()
_RECENT_S: Final = 3.0
_DROPS_KEPT: Final = 256  # Limit per session.
_REASONS: Final = 32  # Limit on reasons for missing numbers, per sensor.
_NUMBERS_KEPT: Final = 512  # Limit on kept CRC-32 values, per session.


def source_of(hello: Hello, text: bytes, *, max_bytes: int) -> JournalSensor:
    """Return the sensor of a hello.

    Parameters
    ----------
    hello : Hello
    text : bytes
        Settings as TOML.
    max_bytes : int
        Size of the largest accepted measurement.

    Raises
    ------
    ArgumentError
        The settings cannot be used.
    """
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
        raise ArgumentError(f"firmware of sensor {name} is {firmware!r}; give printable characters")
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
    times_s: deque[float] = field(default_factory=lambda: deque(maxlen=128))
    shared_s: float = 0.0  # Time since several peers send it; 0 if none do, or once it was reported.

    def miss(self, reason: str, n_missing: int) -> None:
        """Count missing numbers."""
        known = reason in self.missing or len(self.missing) < _REASONS
        self.missing[reason if known else "another reason"] += n_missing

    def took(self, n_bytes: int, arrived_s: float) -> None:
        """Count a new measurement."""
        self.received += 1
        self.received_bytes += n_bytes
        self.times_s.append(arrived_s)

    def status(self) -> SensorStatus:
        """Return the counts."""
        now_s = time.monotonic()
        recent_s = [time_s for time_s in self.times_s if now_s - time_s < _RECENT_S]
        span_s = recent_s[-1] - recent_s[0] if len(recent_s) > 1 else 0.0
        return SensorStatus(
            connected=bool(self.peers),
            session_id=self.session_id,
            acked_through=self.acked_through,
            rate_hz=round((len(recent_s) - 1) / span_s, 3) if span_s else 0.0,
            received=self.received,
            received_bytes=self.received_bytes,
            stored=self.stored,
            missing=dict(self.missing),
            repeated=self.repeated,
            conflicts=self.conflicts,
            queue=self.waiting,
        )


@dataclass(slots=True, eq=False)
class Stream:
    """A greeted session.

    Attributes
    ----------
    run : SensorSession
    source : JournalSensor
    track : SensorTrack
    acked_through, taken : int
        Number up to which everything is acknowledged, and will be once the waiting items are stored.
    begins : int
        Oldest number that the node has.
    owner : bytes
        Peer that sent the latest hello.
    shown : int
        Number up to which measurements were counted and shown; repeated ones are not shown again.
    turn : int
        Number of the current transmission; see `ReceivedItem`.
    dropped : deque of (sequence, reason)
        Latest measurements discarded by processing and not yet reported to the node.
    """

    run: SensorSession
    source: JournalSensor
    track: SensorTrack
    acked_through: int
    taken: int
    begins: int
    owner: bytes
    shown: int = -1
    turn: int = field(default_factory=_turns.__next__)
    dropped: deque[tuple[int, str]] = field(default_factory=lambda: deque(maxlen=_DROPS_KEPT))
    recent: OrderedDict[int, int] = field(default_factory=OrderedDict)
    _air: tuple[tuple[float, float, float], Settings] | None = None

    def remember(self, sequence: int, crc32: int) -> None:
        """Keep the CRC-32 of a measurement for a while."""
        self.recent[sequence] = crc32
        if len(self.recent) > _NUMBERS_KEPT:
            self.recent.popitem(last=False)

    def settings(self, data: Data) -> Settings:
        """Return the settings of a measurement.

        Raises
        ------
        ArgumentError
            The air is impossible.
        """
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
    """Connection of a sensor node.

    Attributes
    ----------
    streams : dict of SensorSession to Stream
    heard_s : float
        Time of its last message, by `time.monotonic`.
    waiting_bytes : int
        Bytes from it that wait for the disk.
    key : str
        Its key; empty without keys.
    """

    streams: dict[SensorSession, Stream] = field(default_factory=dict)
    heard_s: float = 0.0
    waiting_bytes: int = 0
    key: str = ""
