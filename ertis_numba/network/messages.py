"""Wire format: versioned messages between nodes.

A message is a list of frames. The first is the header: `MAGIC`, one byte for the `VERSION`, and a MessagePack map of at
most `HEADER_BYTES` in all, whose ``kind`` names the message. The payloads follow as raw bytes. Messages contain no
code, and every field of a header has a maximum length.
"""

from collections.abc import Sequence
from functools import reduce
from operator import or_
from typing import Annotated, Any, Final, Literal

import msgspec
import numpy as np
from msgspec import Meta

from ertis_numba.base.errors import DataError, FormatVersionError
from ertis_numba.frames import Trajectory
from ertis_numba.network.message_fields import (
    MAX_SEQUENCE,
    AckedThrough,
    Count,
    Int64,
    Line,
    Message,
    Name,
    Number,
    OfMeasurement,
    Position,
    Quaternion,
    Reason,
    State,
    Uint32,
)
from ertis_numba.network.product_messages import (
    PRODUCT_MESSAGES,
    PRODUCTS,
    Description,
    Group,
    Image,
    Points,
    Product,
    Raw,
    Report,
    Subscribe,
)
from ertis_numba.settings import Air

__all__ = [
    "HEADER_BYTES",
    "MAGIC",
    "MAX_SEQUENCE",
    "MESSAGES",
    "PING_INTERVAL_S",
    "PRODUCTS",
    "SILENCE_LIMIT_S",
    "VERSION",
    "Ack",
    "AskStatus",
    "Bye",
    "Configure",
    "Configured",
    "Data",
    "Description",
    "Gap",
    "Group",
    "Hello",
    "Image",
    "Message",
    "Ping",
    "PlatformPose",
    "Points",
    "Pong",
    "Product",
    "Raw",
    "Refused",
    "Report",
    "Subscribe",
    "Welcome",
    "decode",
    "encode",
]

MAGIC: Final = b"eRTN"
VERSION: Final = 2
HEADER_BYTES: Final = 4096
PING_INTERVAL_S: Final = 1.0
"""Interval between signs of life of a node: the `Ping` of a sensor node, the `Subscribe` of an application."""

SILENCE_LIMIT_S: Final = 3.0
"""Silence after which a peer is taken for dead: nodes connect again, and a publisher removes an application."""


class Hello(Message, frozen=True, kw_only=True):
    """A sensor node has measurements of a sensor. Payload: the sensor's settings as TOML."""

    routes = (("sensor", "central"),)
    payload = "settings (TOML)"

    sensor: Name
    session_id: Count  # with the sequence number, the identity of a measurement
    next_sequence: Number  # oldest number that the node still has, or the next one
    settings_crc32: Uint32
    firmware: Annotated[str, Meta(max_length=64)] = ""
    translation_m: Position | None = None  # on the platform; None if unknown
    rotation_xyzw: Quaternion | None = None


class Welcome(Message, frozen=True, kw_only=True):
    """The central node accepts measurements of a sensor."""

    routes = (("central", "sensor"),)

    sensor: Name
    session_id: Count
    state: State
    acks: Literal["stored", "accepted"]  # stored on disk, or accepted in memory
    window: Annotated[int, Meta(ge=1, le=1024)]  # limit on unacknowledged measurements
    acked_through: AckedThrough  # each up to here is stored or known to be missing; -1: none


class Data(OfMeasurement, frozen=True, kw_only=True):
    """A measurement. Payload: its samples, little-endian, with this CRC-32."""

    routes = (("sensor", "central"),)
    payload = "samples"

    temperature_c: float
    humidity_percent: float
    pressure_pa: float
    crc32: Uint32

    @property
    def air(self) -> Air:
        """Air of the measurement; raises an `ArgumentError` for impossible values."""
        return Air(
            temperature_c=self.temperature_c, humidity_percent=self.humidity_percent, pressure_pa=self.pressure_pa
        )


class Gap(Message, frozen=True, kw_only=True):
    """Missing sequence numbers, ``first`` and ``last`` included, and the reason."""

    routes = (("sensor", "central"),)

    sensor: Name
    session_id: Count
    first: Number
    last: Number
    reason: Reason


class Ack(Message, frozen=True, kw_only=True):
    """Cumulative acknowledgement of a sensor's session; a repeated or late one is harmless.

    ``acked_through`` and ``status`` are as ``acked_through`` and ``acks`` of `Welcome`. ``dropped`` has the (sequence,
    reason) of measurements discarded since the previous ack.
    """

    routes = (("central", "sensor"),)

    sensor: Name
    session_id: Count
    acked_through: AckedThrough
    status: Literal["stored", "accepted"]
    dropped: Annotated[tuple[tuple[Number, Reason], ...], Meta(max_length=32)] = ()


class PlatformPose(Message, frozen=True, kw_only=True):
    """Pose of a platform, as in `ertis_numba.frames.Trajectory`, to be stored with its sensors' measurements.

    The key must be allowed to send for all ``sensors`` on the platform. The sender keeps ``session_id`` when it
    connects again. ``timestamp_ns`` counts from 1970-01-01 UTC. ``covariance`` has its rows; None if it is unknown.
    """

    routes = (("sensor", "central"),)

    sensors: Annotated[tuple[Name, ...], Meta(min_length=1, max_length=32)]
    session_id: Count
    timestamp_ns: Int64
    position_m: Position
    rotation_xyzw: Quaternion
    covariance: Annotated[tuple[float, ...], Meta(min_length=36, max_length=36)] | None = None
    source: Reason = "application"

    @property
    def trajectory(self) -> Trajectory:
        """Trajectory of this pose alone; raises an `ArgumentError` for impossible numbers."""
        return Trajectory(
            np.array([self.timestamp_ns]),
            np.array([self.position_m]),
            np.array([self.rotation_xyzw]),
            None if self.covariance is None else np.reshape(self.covariance, (1, 6, 6)),
            self.source,
        )


class Ping(Message, frozen=True, kw_only=True):
    """Sign of life of a node, sent each second; answered by a `Pong`, and by an `Ack` of every greeted session."""

    routes = (("sensor", "central"), ("application", "publisher"))


class Pong(Message, frozen=True, kw_only=True):
    """Sign of life of the central node, with its state."""

    routes = (("central", "sensor"), ("publisher", "application"))

    state: State
    text: Line = ""


class Bye(Message, frozen=True, kw_only=True):
    """A node disconnects normally."""

    routes = (("sensor", "central"), ("application", "publisher"))


class Refused(Message, frozen=True, kw_only=True):
    """The central node refused a message.

    The code ``hello`` means that the session is unknown: the node should send `Hello` again. ``sensor`` means that no
    node sends the sensor. ``reason`` is for people: what was got, what is accepted, the remedy.
    """

    routes = (("central", "sensor"), ("central", "application"), ("publisher", "application"))

    code: Literal["version", "message", "role", "serial", "hello", "settings", "size", "sensor"]
    reason: Line
    sensor: Annotated[str, Meta(max_length=64)] = ""
    session_id: Count = 0


class Configure(Message, frozen=True, kw_only=True):
    """Request for new settings of a sensor, which the central node forwards. Payload: the settings as TOML."""

    routes = (("admin", "central"), ("central", "sensor"))
    payload = "settings (TOML)"

    sensor: Name
    request_id: Count  # random; identifies the answer
    max_bytes: Count = 0  # limit on a measurement, filled in by the central node; 0 from an admin


class Configured(Message, frozen=True, kw_only=True):
    """Answer to a `Configure`."""

    routes = (("sensor", "central"), ("central", "admin"))

    sensor: Name
    request_id: Count
    sensors: Annotated[tuple[Name, ...], Meta(max_length=32)] = ()  # of the node, if they have the new settings
    error: Line = ""  # reason why the former ones are still in use; otherwise empty


class AskStatus(Message, frozen=True, kw_only=True):
    """Request for a `Report`."""

    routes = (("application", "central"), ("application", "publisher"))


MESSAGES: Final[tuple[type[Message], ...]] = (
    Hello, Welcome, Data, Gap, Ack, PlatformPose, Ping, Pong, Bye, Refused, Configure, Configured, Subscribe,
    AskStatus, Description, *PRODUCT_MESSAGES,
)  # fmt: skip
"""All messages of the network."""

_encoder = msgspec.msgpack.Encoder()
_decoder: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder(reduce(or_, MESSAGES))
_BEGINNING: Final = MAGIC + bytes([VERSION])


def encode(message: Message) -> bytes:
    """Return the header frame of a message."""
    return _BEGINNING + _encoder.encode(message)


def decode(header: "bytes | memoryview", wanted: Sequence[type[Message]] | None = None) -> Any:
    """Return the message of a header frame; wanted are the accepted messages, any by default."""
    if len(header) > HEADER_BYTES:
        raise DataError(f"a header has {len(header)} bytes; the limit is {HEADER_BYTES}")
    beginning = bytes(header[: len(_BEGINNING)])
    if beginning[:-1] != MAGIC:
        raise DataError(f"a header begins with {beginning[:4]!r}; messages of this protocol begin with {MAGIC!r}")
    if beginning != _BEGINNING:
        raise FormatVersionError(
            f"a header has protocol version {beginning[-1]}, but this node uses {VERSION}; use the same release "
            "of ertis-numba on both"
        )
    try:
        message = _decoder.decode(header[len(_BEGINNING) :])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(
            f"a header cannot be decoded ({' '.join(str(error).split())[:200]}); send a header of this protocol"
        ) from error
    if wanted is not None and not isinstance(message, tuple(wanted)):
        raise DataError(
            f"a message is {type(message).__name__.lower()!r}; send one of "
            f"{', '.join(kind.__name__.lower() for kind in wanted)}"
        )
    return message
