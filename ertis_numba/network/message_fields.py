"""Field types of messages, with limits on length and size, and the fields of each measurement."""

from typing import Annotated, ClassVar, Final, Literal

import msgspec
from msgspec import Meta

from ertis_numba.frames import Behaviour, Stamp

__all__ = [
    "MAX_SEQUENCE",
    "AckedThrough",
    "Count",
    "Int64",
    "Line",
    "Message",
    "Name",
    "Number",
    "OfMeasurement",
    "Party",
    "Position",
    "Quaternion",
    "Reason",
    "State",
    "Uint32",
    "as_line",
]

Name = Annotated[str, Meta(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_][A-Za-z0-9_.@+-]*\Z")]
MAX_LINE_LENGTH: Final = 512
Line = Annotated[str, Meta(max_length=MAX_LINE_LENGTH)]
Reason = Annotated[str, Meta(min_length=1, max_length=64, pattern=r"^[^\x00-\x1f\x7f-\x9f\u2028\u2029]*\Z")]
"""Text on one line without control characters, which terminals would obey."""
Count = Annotated[int, Meta(ge=0, le=2**63 - 1)]
MAX_SEQUENCE = 2**48  # Half a million years at 20 Hz; sums of many still fit into 64 bits.
Number = Annotated[int, Meta(ge=0, le=MAX_SEQUENCE)]
AckedThrough = Annotated[int, Meta(ge=-1, le=MAX_SEQUENCE)]
Int64 = Annotated[int, Meta(ge=-(2**63), le=2**63 - 1)]
Uint32 = Annotated[int, Meta(ge=0, le=2**32 - 1)]
State = Literal["storage", "processing", "fault", "closing"]
Party = Literal["sensor", "application", "admin", "central", "publisher"]
Position = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


def as_line(text: str) -> str:
    """Return text that fits a `Line`: cut to its length, without surrogates of names that are not UTF-8."""
    return text.encode(errors="replace").decode()[:MAX_LINE_LENGTH]


class Message(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="kind", tag=str.lower):
    """Header of a message, declared once: tables, checks of roles and handlers derive from its class."""

    routes: ClassVar[tuple[tuple[Party, Party], ...]] = ()  # (sender, receiver)
    payload: ClassVar[str] = ""  # description of the payload frames, for the documentation
    product: ClassVar[str] = ""  # that it brings to applications

    @classmethod
    def kind(cls) -> str:
        """Return the name of the message in its header."""
        return cls.__name__.lower()

    @classmethod
    def senders_to(cls, receiver: Party) -> tuple[Party, ...]:
        """Return the nodes that may send the message to a receiver."""
        return tuple(sender for sender, other in cls.routes if other == receiver)


class OfMeasurement(Message, frozen=True, kw_only=True):
    """Header fields of a message about a measurement; unexplained ones are as in `ertis_numba.frames.Stamp`."""

    sensor: Name
    session_id: Count
    sequence: Number
    sync_count: Int64
    timestamp_ns: Int64  # start of the emission since 1970-01-01 UTC, by the node's clock
    uncertainty_ns: Uint32
    monotonic_ns: Int64  # complete arrival, by the node's monotonic clock
    behaviour: Behaviour = "unknown"

    @property
    def stamp(self) -> Stamp:
        """Stamp of the measurement."""
        return Stamp(
            sensor=self.sensor,
            sequence=self.sequence,
            sync_count=self.sync_count,
            timestamp_ns=self.timestamp_ns,
            timestamp_uncertainty_ns=self.uncertainty_ns,
            session_id=self.session_id,
            behaviour=self.behaviour,
        )
