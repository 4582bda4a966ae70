"""What goes from the loop to the archive, and what comes back."""

from dataclasses import dataclass
from typing import Final, NamedTuple, TypeAlias

from ertis_numba.journal import Entry, JournalGap, JournalSensor, Sealed

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
    "Twin",
]

_OVERHEAD: Final = 2048  # of an item and what belongs to it, beside the words


class SensorSession(NamedTuple):
    """A sensor's run, whose numbers settle in order."""

    sensor: str
    session_id: int


@dataclass(slots=True, eq=False)
class ReceivedItem:
    """Something to be stored.

    Attributes
    ----------
    run : Run
    first, last : int
        Numbers that are settled once it is stored.
    what : Entry or Gap
    source : Sensor
        As the journal is to know it.
    arrived_s : float
        By `time.monotonic`.
    owner : bytes
        Peer that sent it.
    turn : int
        Rises where a run has to be sent again; what was taken before is none of it any more.
    again : bool
        The number was settled before: stored only if it is another measurement than that.
    done : bool
        It was told what has become of it.
    """

    run: SensorSession
    first: int
    last: int
    what: Entry | JournalGap
    source: JournalSensor
    arrived_s: float
    owner: bytes
    turn: int = 0
    again: bool = False
    done: bool = False

    @property
    def n_bytes(self) -> int:
        """Memory that it takes, about."""
        return _OVERHEAD + (self.what.measurement.data.nbytes if isinstance(self.what, Entry) else 0)


@dataclass(slots=True)
class Stored:
    """Items that are durable."""

    items: list[ReceivedItem]
    took_ms: float


@dataclass(slots=True)
class Forgotten:
    """An item that was not stored; its sender has to send it again."""

    item: ReceivedItem
    reason: str = ""


@dataclass(slots=True)
class Twin:
    """An item whose number was settled before; whether it was another measurement, which is kept, too."""

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

    sealed: Sealed


@dataclass(slots=True)
class SealingFailed:
    """A journal has not become a recording yet."""

    text: str


@dataclass(slots=True)
class Remark:
    """Damage that was found when a folder was opened; storing continues."""

    text: str


Event: TypeAlias = Stored | Forgotten | Twin | StorageFault | Resumed | SealedOne | SealingFailed | Remark
