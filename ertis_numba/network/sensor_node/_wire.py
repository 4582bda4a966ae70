"""Conversion between items and wire messages."""

import zlib
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, TypeAlias, cast

from ertis_numba.journal import JournalEntry
from ertis_numba.network import messages
from ertis_numba.network.sensor_node._outgoing_sessions import OutgoingSession, UnackedItem

if TYPE_CHECKING:
    from ertis_numba.network.message_fields import Position, Quaternion

__all__ = ["Acknowledged", "Frames", "crc32_of", "frames_of", "greeting"]

Frames: TypeAlias = "list[bytes | memoryview]"

_FIRMWARE_CHARACTERS = 64


@dataclass(frozen=True, slots=True)
class Acknowledged:
    """Acknowledgement by the central node, as `ertis_numba.network.messages.Ack`."""

    sensor: str
    session_id: int
    acked_through: int  # all up to here is stored, accepted, or known to be missing
    status: Literal["stored", "accepted"]
    dropped: tuple[tuple[int, str], ...] = ()


def greeting(run: OutgoingSession) -> Frames:
    """Return the hello of a session with items."""
    settings = run.sensor.settings.to_toml().encode()
    hello = messages.Hello(
        sensor=run.sensor.name,
        session_id=run.session_id,
        next_sequence=run.items[0].first,
        settings_crc32=zlib.crc32(settings),
        firmware=run.sensor.firmware[:_FIRMWARE_CHARACTERS],
        translation_m=cast("Position | None", run.sensor.translation_m),
        rotation_xyzw=cast("Quaternion | None", run.sensor.rotation_xyzw),
    )
    return [messages.encode(hello), settings]


def crc32_of(entry: JournalEntry) -> int:
    """Return the CRC-32 of a kept measurement, filled in if it is None; two threads may do that at once."""
    if entry.crc32 is None:
        entry.crc32 = zlib.crc32(entry.measurement.data.data)
    return entry.crc32


def frames_of(run: OutgoingSession, item: UnackedItem, entry: JournalEntry | None) -> tuple[Frames, int]:
    """Return the frames of an item, and its last number at that time."""
    if entry is None:
        first, last = item.first, item.last
        gap = messages.Gap(
            sensor=run.sensor.name, session_id=run.session_id, first=first, last=max(first, last), reason=item.reason
        )
        return [messages.encode(gap)], last
    stamp, air = entry.measurement.stamp, entry.measurement.settings.air
    data = messages.Data(
        sensor=run.sensor.name,
        session_id=run.session_id,
        sequence=stamp.sequence,
        sync_count=stamp.sync_count,
        timestamp_ns=stamp.timestamp_ns,
        uncertainty_ns=stamp.timestamp_uncertainty_ns,
        monotonic_ns=entry.monotonic_ns,
        temperature_c=float(air.temperature_c),
        humidity_percent=float(air.humidity_percent),
        pressure_pa=float(air.pressure_pa),
        crc32=crc32_of(entry),
        behaviour=stamp.behaviour,
    )
    return [messages.encode(data), entry.measurement.data.data.cast("B")], stamp.sequence
