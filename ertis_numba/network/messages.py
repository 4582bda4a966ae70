"""The wire format: what nodes say to each other, as a table of messages with a version.

A message is a list of frames. The first is the header: `MAGIC`, one byte for the `VERSION`, and a MessagePack map of at
most `HEADER_BYTES` in all, whose ``kind`` names the message. What follows it are its payloads, raw bytes. Nothing on
the wire is code, and nothing in a header is as long as its sender likes.
"""

from collections.abc import Sequence
from typing import Annotated, Any, Final, Literal, TypeAlias, get_args

import msgspec
from msgspec import Meta

from ertis_numba.errors import DataError, FormatVersionError

__all__ = [
    "HEADER_BYTES",
    "MAGIC",
    "MOST_SEQUENCE",
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

Product: TypeAlias = Literal["energyscape", "points", "raw", "group", "status"]
PRODUCTS: Final[tuple[Product, ...]] = get_args(Product)
"""What applications can ask for."""

Name = Annotated[str, Meta(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.@+-]*\Z")]
Line = Annotated[str, Meta(max_length=512)]
Reason = Annotated[str, Meta(min_length=1, max_length=64)]
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
MOST_SEQUENCE = 2**48  # half a million years at 20 Hz; sums of many still fit into 64 bits
Number = Annotated[int, Meta(ge=0, le=MOST_SEQUENCE)]
Settled = Annotated[int, Meta(ge=-1, le=MOST_SEQUENCE)]
Int64 = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Uint32 = Annotated[int, Meta(ge=0, le=2**32 - 1)]
State = Literal["storage", "processing", "fault", "closing"]
Position = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Message(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag=str.lower):
    """The header of any message."""


class Hello(Message, frozen=True, kw_only=True):
    """A sensor node has measurements of a sensor. Payload: the sensor's settings as TOML.

    Attributes
    ----------
    sensor : str
    epoch : int
        Run of the sensor: with its sequence numbers, the identity of a measurement.
    next_sequence : int
        The oldest number that the node still has, or the next that it will have.
    settings_crc32 : int
        Of the payload.
    firmware : str
    translation_m, rotation_xyzw
        Where the sensor is on its platform.
    """

    sensor: Name
    epoch: Count
    next_sequence: Number
    settings_crc32: Uint32
    firmware: Annotated[str, Meta(max_length=64)] = ""
    translation_m: Position = (0.0, 0.0, 0.0)
    rotation_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)


class Welcome(Message, frozen=True, kw_only=True):
    """The central node takes measurements of a sensor.

    Attributes
    ----------
    sensor, epoch
    state : {"storage", "processing", "fault", "closing"}
    acks : {"stored", "accepted"}
        What an `Ack` will mean: on the disk, or in memory.
    window : int
        Measurements that may be under way without an ack.
    settled : int
        The highest number up to which every one is stored, or known to be missing; -1 if there is none.
    """

    sensor: Name
    epoch: Count
    state: State
    acks: Literal["stored", "accepted"]
    window: Annotated[int, Meta(ge=1, le=1024)]
    settled: Settled


class Data(Message, frozen=True, kw_only=True):
    """A measurement. Payload: its words, little-endian.

    Attributes
    ----------
    sensor, epoch, sequence, sync_count
        As in `ertis_numba.frames.Stamp`.
    timestamp_ns, uncertainty_ns : int
        When the emission began, since 1970-01-01 UTC by the sensor node's clock.
    monotonic_ns : int
        When all of it had arrived at the sensor node, by its clock that nobody sets.
    temperature_c, humidity_percent, pressure_pa : float
        The air.
    crc32 : int
        Of the payload.
    """

    sensor: Name
    epoch: Count
    sequence: Number
    sync_count: Int64
    timestamp_ns: Int64
    uncertainty_ns: Uint32
    monotonic_ns: Int64
    temperature_c: float
    humidity_percent: float
    pressure_pa: float
    crc32: Uint32


class Gap(Message, frozen=True, kw_only=True):
    """Sequence numbers that no measurement has, ``first`` and ``last`` included, and why."""

    sensor: Name
    epoch: Count
    first: Number
    last: Number
    reason: Reason


class Ack(Message, frozen=True, kw_only=True):
    """What the central node has of a sensor's run; it can be said again and come late, and does no harm.

    Attributes
    ----------
    sensor, epoch
    settled : int
        As in `Welcome`.
    status : {"stored", "accepted"}
        What is settled is on the disk, or in memory.
    dropped : tuple of (sequence, reason)
        Those that the node has thrown away since the ack before.
    """

    sensor: Name
    epoch: Count
    settled: Settled
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
    epoch : int
    """

    code: Literal["version", "message", "role", "serial", "hello", "settings", "size"]
    reason: Line
    sensor: Annotated[str, Meta(max_length=64)] = ""
    epoch: Count = 0


class Subscribe(Message, frozen=True, kw_only=True):
    """An application wants products; sent each second, and whenever it has consumed something.

    Attributes
    ----------
    sensors : tuple of str, optional
        All by default.
    products : tuple of {"energyscape", "points", "raw", "group", "status"}
    consumed : int
        Products received since the connection was made, that the application has taken.
    credit : int
        How many more may be sent unasked.
    """

    sensors: Annotated[tuple[Name, ...], Meta(max_length=32)] | None = None
    products: Annotated[tuple[Product, ...], Meta(min_length=1, max_length=8)]
    consumed: Count = 0
    credit: Annotated[int, Meta(ge=1, le=64)] = 2


class Description(Message, frozen=True, kw_only=True):
    """What products of a sensor are about, sent before the first that refers to it.

    Payloads: settings as TOML, then azimuth, elevation and range as little-endian float64, which are empty for
    products that have no such axes.

    Attributes
    ----------
    number : int
        By which products refer to it, until the connection ends.
    sensor, translation_m, rotation_xyzw
    """

    number: Count
    sensor: Name
    translation_m: Position = (0.0, 0.0, 0.0)
    rotation_xyzw: Quaternion = (0.0, 0.0, 0.0, 1.0)


class _OfMeasurement(Message, frozen=True, kw_only=True):
    number: Count
    """Of the product, among all that this subscriber has asked for since it connected, from 0; it skips what was
    dropped."""
    dropped: Count
    """How many were dropped for this subscriber, for want of credit."""
    description: Count
    sensor: Name
    epoch: Count
    sequence: Number
    sync_count: Int64
    timestamp_ns: Int64
    uncertainty_ns: Uint32
    monotonic_ns: Int64
    """As in `Data`."""


class Image(_OfMeasurement, frozen=True, kw_only=True):
    """An energyscape. Payloads: its energy, little-endian, cut into frames.

    Attributes
    ----------
    shape : (direction, range)
    dtype : {"float32", "float16"}
    received_ns, published_ns : int
        When the measurement reached the central node, and the image left it, by a clock there that nobody sets.
    """

    shape: tuple[Count, Count]
    dtype: Literal["float32", "float16"]
    received_ns: Int64
    published_ns: Int64


class Points(_OfMeasurement, frozen=True, kw_only=True):
    """A point cloud. Payload: ``(point, 4)`` little-endian float32, each x, y, z in m and the energy.

    Attributes
    ----------
    n_points : int
    received_ns, published_ns : int
        As in `Image`.
    """

    n_points: Count
    received_ns: Int64
    published_ns: Int64


class Raw(_OfMeasurement, frozen=True, kw_only=True):
    """A measurement as it came. Payload: its words, little-endian.

    Attributes
    ----------
    temperature_c, humidity_percent, pressure_pa : float
    crc32 : int
    """

    temperature_c: float
    humidity_percent: float
    pressure_pa: float
    crc32: Uint32


class Group(Message, frozen=True, kw_only=True):
    """Measurements that were emitted together, when all have come or no more will.

    Attributes
    ----------
    number, dropped
        As in `Image`.
    group : int
        Pulse of the SYNC chain, as all sensors count it.
    members : tuple of (sensor, epoch, sequence)
        Those that have come.
    missing : tuple of str
        Those that have not.
    spread_ns : int
        Between the first and the last timestamp.
    flags : tuple of {"incomplete", "clock", "pulse"}
        What is wrong with it: sensors are missing; timestamps disagree although counters agree; a sensor has lost
        a pulse or seen one twice.
    """

    number: Count
    dropped: Count
    group: Int64
    members: Annotated[tuple[tuple[Name, Count, Number], ...], Meta(max_length=32)]
    missing: Annotated[tuple[Name, ...], Meta(max_length=32)]
    spread_ns: Count
    flags: tuple[Literal["incomplete", "clock", "pulse"], ...] = ()

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of those that have come."""
        return tuple(sensor for sensor, _, _ in self.members)


class AskStatus(Message, frozen=True, kw_only=True):
    """Asks for a `Report`."""


class Report(Message, frozen=True, kw_only=True):
    """How the central node is. Payload: `ertis_numba.network.status.Status` as MessagePack.

    Attributes
    ----------
    number, dropped
        As in `Image`; 0 where it was asked for by `AskStatus`.
    """

    number: Count = 0
    dropped: Count = 0


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
