"""The wire format: what nodes say to each other, as a table of messages with a version.

A message is a list of frames. The first is the header: `MAGIC`, one byte for the `VERSION`, and a MessagePack map of at
most `HEADER_BYTES` in all, whose ``kind`` names the message. What follows it are its payloads, raw bytes. Nothing on
the wire is code, and nothing in a header is as long as its sender likes.
"""

from collections.abc import Sequence
from typing import Annotated, Any, Final, Literal

import msgspec
from msgspec import Meta

from ertis_numba.errors import DataError, FormatVersionError
from ertis_numba.network.fields import (
    MAX_SEQUENCE,
    AckedThrough,
    Count,
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
    "PRODUCTS",
    "VERSION",
    "Ack",
    "AskStatus",
    "Bye",
    "Data",
    "Description",
    "Gap",
    "Group",
    "Hello",
    "Image",
    "Message",
    "Ping",
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
VERSION: Final = 1
HEADER_BYTES: Final = 4096


class Hello(Message, frozen=True, kw_only=True):
    """A sensor node has measurements of a sensor. Payload: the sensor's settings as TOML.

    Attributes
    ----------
    sensor : str
    session_id : int
        Run of the sensor: with its sequence numbers, the identity of a measurement.
    next_sequence : int
        The oldest number that the node still has, or the next that it will have.
    settings_crc32 : int
        Of the payload.
    firmware : str
    translation_m, rotation_xyzw
        Where the sensor is on its platform; None if its mounting is unknown.
    """

    sensor: Name
    session_id: Count
    next_sequence: Number
    settings_crc32: Uint32
    firmware: Annotated[str, Meta(max_length=64)] = ""
    translation_m: Position | None = None
    rotation_xyzw: Quaternion | None = None


class Welcome(Message, frozen=True, kw_only=True):
    """The central node takes measurements of a sensor.

    Attributes
    ----------
    sensor, session_id
    state : {"storage", "processing", "fault", "closing"}
    acks : {"stored", "accepted"}
        What an `Ack` will mean: on the disk, or in memory.
    window : int
        Measurements that may be under way without an ack.
    acked_through : int
        The highest number up to which every one is stored, or known to be missing; -1 if there is none.
    """

    sensor: Name
    session_id: Count
    state: State
    acks: Literal["stored", "accepted"]
    window: Annotated[int, Meta(ge=1, le=1024)]
    acked_through: AckedThrough


class Data(OfMeasurement, frozen=True, kw_only=True):
    """A measurement. Payload: its words, little-endian.

    Attributes
    ----------
    temperature_c, humidity_percent, pressure_pa : float
        The air.
    crc32 : int
        Of the payload.
    """

    temperature_c: float
    humidity_percent: float
    pressure_pa: float
    crc32: Uint32

    @property
    def air(self) -> Air:
        """The air; raises an `ArgumentError` where there is none like it."""
        return Air(
            temperature_c=self.temperature_c, humidity_percent=self.humidity_percent, pressure_pa=self.pressure_pa
        )


class Gap(Message, frozen=True, kw_only=True):
    """Sequence numbers that no measurement has, ``first`` and ``last`` included, and why."""

    sensor: Name
    session_id: Count
    first: Number
    last: Number
    reason: Reason


class Ack(Message, frozen=True, kw_only=True):
    """What the central node has of a sensor's run; it can be said again and come late, and does no harm.

    Attributes
    ----------
    sensor, session_id
    acked_through : int
        As in `Welcome`.
    status : {"stored", "accepted"}
        What is settled is on the disk, or in memory.
    dropped : tuple of (sequence, reason)
        Those that the node has thrown away since the ack before.
    """

    sensor: Name
    session_id: Count
    acked_through: AckedThrough
    status: Literal["stored", "accepted"]
    dropped: Annotated[tuple[tuple[Number, Reason], ...], Meta(max_length=32)] = ()


class Ping(Message, frozen=True, kw_only=True):
    """A node is alive; sent each second. The answer is a `Pong`, and an `Ack` of every run that was greeted."""


class Pong(Message, frozen=True, kw_only=True):
    """The central node is alive, and how it is."""

    state: State
    text: Line = ""


class Bye(Message, frozen=True, kw_only=True):
    """A node leaves, and nothing is wrong."""


class Refused(Message, frozen=True, kw_only=True):
    """A message was not taken.

    Attributes
    ----------
    code : {"version", "message", "role", "serial", "hello", "settings", "size"}
        For programs. ``hello``: the node is not known (any more), and should greet.
    reason : str
        A line for people: what came, what was wanted, the remedy.
    sensor : str
        Which it is about, if one.
    session_id : int
    """

    code: Literal["version", "message", "role", "serial", "hello", "settings", "size"]
    reason: Line
    sensor: Annotated[str, Meta(max_length=64)] = ""
    session_id: Count = 0


class AskStatus(Message, frozen=True, kw_only=True):
    """Asks for a `Report`."""


_MESSAGES = (
    Hello | Welcome | Data | Gap | Ack | Ping | Pong | Bye | Refused | Subscribe | Description | Image | Points | Raw
    | Group | AskStatus | Report
)  # fmt: skip
_encoder = msgspec.msgpack.Encoder()
_decoder: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder(_MESSAGES)
_BEGINNING: Final = MAGIC + bytes([VERSION])


def encode(message: Message) -> bytes:
    """Return the header frame of a message."""
    return _BEGINNING + _encoder.encode(message)


def decode(header: "bytes | memoryview", wanted: Sequence[type[Message]] | None = None) -> Any:
    """Return the message of a header frame.

    Parameters
    ----------
    header : bytes or memoryview
    wanted : sequence of type, optional
        Those that are expected here; any by default.

    Raises
    ------
    FormatVersionError
        It was sent by another version.
    DataError
        It is no header of this protocol, or not one that is expected.
    """
    if len(header) > HEADER_BYTES:
        raise DataError(f"a header has {len(header)} bytes; send {HEADER_BYTES} at most")
    beginning = bytes(header[: len(_BEGINNING)])
    if beginning[:-1] != MAGIC:
        raise DataError(f"a header begins with {beginning[:4]!r}; send {MAGIC!r}, which begins all of this protocol")
    if beginning != _BEGINNING:
        raise FormatVersionError(
            f"a header has version {beginning[-1]} of the protocol, this node speaks {VERSION}; use the same release "
            "of ertis-numba on both"
        )
    try:
        message = _decoder.decode(header[len(_BEGINNING) :])
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
        raise DataError(
            f"a header cannot be read ({' '.join(str(error).split())[:200]}); send one of this protocol"
        ) from error
    if wanted is not None and not isinstance(message, tuple(wanted)):
        raise DataError(
            f"a message is {type(message).__name__.lower()!r}; send one of "
            f"{', '.join(kind.__name__.lower() for kind in wanted)}"
        )
    return message
