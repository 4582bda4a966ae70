"""Admission of messages, sensors and measurements: decoding, roles, handlers, and validation of Hello and Data."""

import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import zmq

from ertis_numba.base.errors import ArgumentError, DataError, FormatVersionError
from ertis_numba.frames import Measurement
from ertis_numba.journal import JournalEntry, JournalSensor
from ertis_numba.network import messages
from ertis_numba.network.allow_list import Permission
from ertis_numba.network.central_node._received_items import SensorSession
from ertis_numba.network.central_node._streams import PeerConnection, SensorTrack, Stream, source_of
from ertis_numba.network.central_node._volumes import same
from ertis_numba.network.message_fields import as_line
from ertis_numba.network.messages import (
    MESSAGES,
    AskStatus,
    Configure,
    Data,
    Gap,
    Hello,
    Message,
    Ping,
    PlatformPose,
    Refused,
    Subscribe,
)
from ertis_numba.settings import Settings

__all__ = [
    "ReceivedMessage",
    "Unwanted",
    "entry_in",
    "handlers_of",
    "read",
    "require_role",
    "require_room",
    "require_same",
    "source_in",
]


ACCEPTED: Final = tuple(kind for kind in MESSAGES if kind.senders_to("central"))
"""Messages that the central node accepts, by their declarations."""

_ACTIONS: Final = {
    AskStatus: "request the status",
    Configure: "change settings",
    PlatformPose: "send poses",
    Ping: "send measurements or poses",
} | dict.fromkeys((Hello, Data, Gap), "send measurements")
_STREAMS: Final = 64  # Limit per peer.
_SENSORS: Final = 1024
_PEERS: Final = 1024
_PEERS_OF_KEY: Final = 64


class Unwanted(Exception):  # noqa: N818  it is an answer
    """Refused message: code of `Refused`, one line for the sender, and the category in the counts."""

    def __init__(self, code: Any, reason: str, kind: str) -> None:
        super().__init__(reason)
        self.code, self.kind = code, kind

    def answer(self, about: Message) -> Refused:
        """Return the answer to the sender."""
        sensor, session_id = getattr(about, "sensor", ""), getattr(about, "session_id", 0)
        return Refused(code=self.code, reason=as_line(str(self)), sensor=sensor, session_id=session_id)


@dataclass(slots=True, eq=False)
class ReceivedMessage:
    """Sender and frames of a message."""

    frames: list[zmq.Frame]  # sender, header and payload
    who: Permission
    arrived_ns: int  # by time.monotonic_ns

    @property
    def sender(self) -> bytes:
        """Identifier of the sender."""
        return self.frames[0].bytes

    @property
    def payload(self) -> list[zmq.Frame]:
        """Frames after the header."""
        return self.frames[2:]


def handlers_of(node: object) -> dict[type[Message], Callable[[Any, ReceivedMessage], None]]:
    """Return the handlers of all messages to the central node: its methods ``_on_KIND``."""
    missing = [kind.kind() for kind in ACCEPTED if not hasattr(node, f"_on_{kind.kind()}")]
    if missing:
        raise TypeError(
            f"{type(node).__name__} has no handler of {', '.join(missing)}; define _on_{missing[0]}, or remove the "
            "route to the central node from the declaration"
        )
    return {kind: getattr(node, f"_on_{kind.kind()}") for kind in ACCEPTED}


def read(frames: list[zmq.Frame]) -> Message:
    """Return the message in frames, or refuse invalid ones."""
    if len(frames) < 2:
        raise Unwanted("message", "a message is empty; send a header", "message")
    try:
        message: Message = messages.decode(frames[1].buffer, (*ACCEPTED, Subscribe))
    except FormatVersionError as error:
        raise Unwanted("version", str(error), "version") from error
    except DataError as error:
        raise Unwanted("message", str(error), "message") from error
    if isinstance(message, Subscribe):
        raise Unwanted(
            "message",
            "this address is for sensor nodes; applications use the address that 'ertis serve' prints as publish",
            "message",
        )
    return message


def require_role(who: Permission, message: Message) -> None:
    """Refuse a message that its sender's role does not allow."""
    if who.role not in ("admin", *message.senders_to("central")):
        action = _ACTIONS.get(type(message), f"send {message.kind()} messages")
        raise Unwanted("role", f"key {who.name} has the role {who.role}, which may not {action}", "role")
    sensor = getattr(message, "sensor", None)
    if sensor is not None and not who.may_send(sensor):
        raise Unwanted(
            "serial", f"key {who.name} may not send for sensor {sensor}; allow it with 'ertis keys allow'", "serial"
        )


def source_in(hello: Hello, payload: list[bytes], *, max_bytes: int) -> JournalSensor:
    """Return the sensor of a hello, or refuse the hello."""
    if len(payload) != 1 or len(payload[0]) > Settings.max_bytes:
        raise Unwanted(
            "settings",
            f"a hello lacks settings, or they exceed {Settings.max_bytes} bytes; send one settings text",
            "size",
        )
    if zlib.crc32(payload[0]) != hello.settings_crc32:
        raise Unwanted("settings", "settings do not match the CRC-32 in their hello; send them again", "crc")
    try:
        return source_of(hello, payload[0], max_bytes=max_bytes)
    except (ArgumentError, OSError) as error:
        raise Unwanted("settings", " ".join(str(error).split()), "settings") from error


def require_room(
    peers: Mapping[bytes, PeerConnection],
    tracks: Mapping[str, SensorTrack],
    peer: PeerConnection | None,
    run: SensorSession,
    key: str,
) -> None:
    """Refuse a peer (None before hello), session or sensor beyond the limits; key is empty without keys."""
    if peer is None and len(peers) >= _PEERS:
        raise Unwanted("size", f"this central node already has {_PEERS} sensor nodes; use another", "too many")
    if peer is None and key and sum(each.key == key for each in peers.values()) >= _PEERS_OF_KEY:
        raise Unwanted(
            "size", f"{_PEERS_OF_KEY} sensor nodes already use this key; use a different one for each", "too many"
        )
    if peer is not None and run not in peer.streams and len(peer.streams) >= _STREAMS:
        raise Unwanted("size", f"a sensor node already has {_STREAMS} sessions; send bye for finished ones", "too many")
    if run.sensor not in tracks and len(tracks) >= _SENSORS:
        raise Unwanted("size", f"this central node already has {_SENSORS} sensors; use another", "too many")


def require_same(
    peers: Mapping[bytes, PeerConnection], tracks: Mapping[str, SensorTrack], peer_id: bytes, source: JournalSensor
) -> None:
    """Refuse a sensor that another node sends with other settings: each measurement would begin a recording."""
    track = tracks.get(source.name)
    for other in track.peers - {peer_id} if track is not None else ():
        for stream in peers[other].streams.values():
            if stream.run.sensor == source.name and not same(stream.source, source):
                raise Unwanted(
                    "settings",
                    f"another sensor node sends sensor {source.name}, with other settings; use a different "
                    "name for each, or end the other node",
                    "settings",
                )


def entry_in(stream: Stream, data: Data, payload: Sequence[memoryview]) -> JournalEntry:
    """Return the measurement of a message, or refuse the message."""
    source = stream.source
    if len(payload) != 1 or len(payload[0]) != source.n_bytes:
        sizes = ", ".join(str(len(part)) for part in payload[:4]) or "no"
        raise Unwanted(
            "message",
            f"a measurement has {sizes} bytes, but its settings give {source.n_bytes}; send matching data",
            "size",
        )
    if zlib.crc32(payload[0]) != data.crc32:
        raise Unwanted("message", f"measurement {data.sequence} does not match its CRC-32; send it again", "crc")
    try:
        settings = stream.settings(data)
    except ArgumentError as error:
        raise Unwanted("message", str(error), "message") from error
    words = np.frombuffer(payload[0], dtype=source.dtype).reshape(source.shape)
    return JournalEntry(Measurement(words, settings, data.stamp), data.monotonic_ns, data.crc32)
