"""A local worker, as who feeds it sees it: its process, its memory, and what it does."""

from dataclasses import dataclass, field
from typing import Final, Literal

from ertis_numba.network.processing.child import Child
from ertis_numba.network.processing.choice import Mode
from ertis_numba.network.processing.pipe_messages import FromWorker, SlotMemory
from ertis_numba.network.processing.runner import Job, JobKind
from ertis_numba.network.processing.slots import Slot

__all__ = ["SLOTS", "Worker"]

SLOTS: Final = 2
"""Of each worker: one is processed while the publisher reads the other."""


@dataclass(slots=True, eq=False)
class Worker:
    """A process, started again whenever it has died.

    Attributes
    ----------
    number : int
    child : Child or None
        None while there is no process.
    ready : bool
        Whether it has told that it is.
    slots, free : list of Slot
        All of them, and those that nothing is in.
    kinds : set of int
        That it has a pipeline for.
    preparing : Kind or None
        That it gets ready for.
    job : Job or None
    slot : Slot or None
        That the job is in.
    mode : Mode or None
        In which the job runs.
    deadline_s, start_s : float
        When it is killed, and may be started again, by `time.monotonic`.
    deaths : int
        Since it has finished a job.
    done : int
        Jobs that it has finished.
    """

    number: int
    child: Child[FromWorker] | None = None
    ready: bool = False
    slots: list[Slot] = field(default_factory=list)
    free: list[Slot] = field(default_factory=list)
    kinds: set[int] = field(default_factory=set)
    preparing: JobKind | None = None
    job: Job | None = None
    slot: Slot | None = None
    mode: Mode | None = None
    deadline_s: float = float("inf")
    deaths: int = 0
    start_s: float = 0.0
    done: int = 0

    @property
    def state(self) -> Literal["starting", "idle", "busy"]:
        """What it does at present."""
        if not self.ready or self.preparing is not None:
            return "starting"
        return "idle" if self.job is None else "busy"

    def attach_memory(self, words_bytes: int, image_bytes: int) -> None:
        """See to it that it has slots that are large enough; those that are read elsewhere are given later."""
        if self.child is None:
            return
        if not self.slots:
            numbers = range(SLOTS * self.number, SLOTS * (self.number + 1))
            self.slots = [Slot(number, words_bytes, image_bytes) for number in numbers]
            self.free = list(self.slots)
        elif not all(slot.holds(words_bytes, image_bytes) for slot in self.slots):
            # What the publisher reads of the old ones, it has as long as it needs it.
            largest = max(words_bytes, self.slots[0].words_bytes), max(image_bytes, self.slots[0].image_bytes)
            for slot in self.slots:
                slot.close()
            self.slots = [Slot(slot.number, *largest) for slot in self.slots]
            self.free = list(self.slots)
        for slot in self.slots:
            note = SlotMemory(slot=slot.number, words_bytes=slot.words_bytes, image_bytes=slot.image_bytes)
            self.child.pipe.send(note, files=(slot.descriptor,))
