"""Admission of sensors and measurements: validation of Hello and Data messages."""

import zlib
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from ertis_numba.errors import ArgumentError
from ertis_numba.frames import Measurement
from ertis_numba.journal import JournalEntry, JournalSensor
from ertis_numba.network.central_node._received_items import SensorSession
from ertis_numba.network.central_node._roles import Unwanted
from ertis_numba.network.central_node._streams import PeerConnection, SensorTrack, Stream, source_of
from ertis_numba.network.central_node._volumes import same
from ertis_numba.network.messages import Data, Hello
from ertis_numba.settings import Settings

__all__ = ["entry_in", "require_room", "require_same", "source_in"]

_STREAMS: Final = 64  # Limit per peer.
_SENSORS: Final = 1024
_PEERS: Final = 1024
_PEERS_OF_KEY: Final = 64


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
    """Refuse a peer, session or sensor beyond the limits.

    ``peer`` is None before its hello, ``key`` empty without keys.
    """
    if peer is None and len(peers) >= _PEERS:
        raise Unwanted("size", f"this central node already has {_PEERS} sensor nodes; use another", "too many")
    if peer is None and key and sum(each.key == key for each in peers.values()) >= _PEERS_OF_KEY:
        raise Unwanted("size", f"{_PEERS_OF_KEY} sensor nodes already use this key; give each its own", "too many")
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
                    f"another sensor node sends sensor {source.name}, with other settings; give each sensor its "
                    "own name, or end the other node",
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
