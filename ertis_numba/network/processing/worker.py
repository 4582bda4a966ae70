"""A local worker as its pool manages it: process, memory and current job."""

from dataclasses import dataclass, field
from typing import Final, Literal

from ertis_numba.network.processing.child import Child
from ertis_numba.network.processing.choice import Mode
from ertis_numba.network.processing.pipe_messages import FromWorker, SlotMemory
from ertis_numba.network.processing.runner import Job, JobKind
from ertis_numba.network.processing.slots import Slot

__all__ = ["SLOTS", "Worker"]

SLOTS: Final = 2
"""Slots of each worker: one is processed while the publisher reads the other."""


@dataclass(slots=True, eq=False)
class Worker:
    """A process that is restarted whenever it has died.

    Attributes
    ----------
    number : int
    child : Child or None
        None while there is no process.
    ready : bool
        True once it has reported that it is ready.
    slots, free : list of Slot
        All slots, and the empty ones.
    kinds : set of int
        Kinds with a pipeline.
    preparing : JobKind or None
        Kind that it prepares for.
    job : Job or None
    slot : Slot or None
        Slot of the job.
    mode : Mode or None
        Mode of the job.
    deadline_s, start_s : float
        Times at which it is killed, and may be restarted, by `time.monotonic`.
    deaths : int
        Number of deaths since its last finished job.
    done : int
        Number of finished jobs.
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
        """Current state."""
        if not self.ready or self.preparing is not None:
            return "starting"
        return "idle" if self.job is None else "busy"

    def attach_memory(self, words_bytes: int, image_bytes: int) -> None:
        """Ensure that it has slots of sufficient size; slots in use elsewhere are replaced later."""
        if self.child is None:
            return
        if not self.slots:
            numbers = range(SLOTS * self.number, SLOTS * (self.number + 1))
            self.slots = [Slot(number, words_bytes, image_bytes) for number in numbers]
            self.free = list(self.slots)
        elif not all(slot.holds(words_bytes, image_bytes) for slot in self.slots):
            # The publisher keeps its access to old slots as long as necessary.
            largest = max(words_bytes, self.slots[0].words_bytes), max(image_bytes, self.slots[0].image_bytes)
            for slot in self.slots:
                slot.close()
            self.slots = [Slot(slot.number, *largest) for slot in self.slots]
            self.free = list(self.slots)
        for slot in self.slots:
            note = SlotMemory(slot=slot.number, words_bytes=slot.words_bytes, image_bytes=slot.image_bytes)
            self.child.pipe.send(note, files=(slot.descriptor,))
