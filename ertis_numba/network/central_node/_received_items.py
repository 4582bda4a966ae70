"""Items that the event loop sends to the archive, and the archive's results."""

from dataclasses import dataclass
from typing import Final, NamedTuple, TypeAlias

from ertis_numba.frames import SequenceGap
from ertis_numba.journal import JournalEntry, JournalSensor, SealingResult

__all__ = [
    "Event",
    "Forgotten",
    "ReceivedItem",
    "Remark",
    "Resumed",
    "SealedOne",
    "SealingFailed",
    "SensorSession",
    "StorageFault",
    "Stored",
    "StoredDuplicate",
]

_OVERHEAD: Final = 2048  # Memory of an item in addition to its data.


class SensorSession(NamedTuple):
    """Session of a sensor, whose numbers are acknowledged in order."""

    sensor: str
    session_id: int


@dataclass(slots=True, eq=False)
class ReceivedItem:
    """Item to store."""

    run: SensorSession
    first: int  # acknowledged through last once stored
    last: int
    content: JournalEntry | SequenceGap
    source: JournalSensor
    arrived_s: float  # by time.monotonic
    owner: bytes  # peer that sent it
    turn: int = 0  # number of the transmission; a session that is sent again invalidates earlier items
    again: bool = False  # acknowledged before: store it only if the measurement differs
    done: bool = False  # the result was reported

    @property
    def n_bytes(self) -> int:
        """Approximate memory of the item."""
        return _OVERHEAD + (self.content.measurement.data.nbytes if isinstance(self.content, JournalEntry) else 0)


@dataclass(slots=True)
class Stored:
    """Items stored durably."""

    items: list[ReceivedItem]
    took_ms: float


@dataclass(slots=True)
class Forgotten:
    """Item that was not stored; its sender has to send it again."""

    item: ReceivedItem
    reason: str = ""


@dataclass(slots=True)
class StoredDuplicate:
    """Duplicate of an acknowledged number; ``True`` if its content differs and is kept, too."""

    item: ReceivedItem
    differs: bool


@dataclass(slots=True)
class StorageFault:
    """Nothing can be stored at present."""

    text: str


@dataclass(slots=True)
class Resumed:
    """Storing works again."""


@dataclass(slots=True)
class SealedOne:
    """A journal has become a recording."""

    sealed: SealingResult


@dataclass(slots=True)
class SealingFailed:
    """A journal could not be sealed yet."""

    text: str


@dataclass(slots=True)
class Remark:
    """Damage that was found when a folder was opened; storing continues."""

    text: str


Event: TypeAlias = Stored | Forgotten | StoredDuplicate | StorageFault | Resumed | SealedOne | SealingFailed | Remark
