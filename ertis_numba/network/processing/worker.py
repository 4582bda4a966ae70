"""A local worker as its pool manages it: process, memory and current job."""

from typing import TYPE_CHECKING, Final, Literal

from ertis_numba.network.processing.pipe_messages import FromWorker, SlotMemory
from ertis_numba.network.processing.shared_slots import Slot
from ertis_numba.processes import SupervisedProcess

if TYPE_CHECKING:
    from ertis_numba.network.processing.parallelism import Mode
    from ertis_numba.network.processing.runner import Job, JobKind

__all__ = ["SLOTS", "Worker"]

SLOTS: Final = 2
"""Slots of each worker: one is processed while the publisher reads the other."""


_MODULE: Final = "ertis_numba.network.processing.worker_process"
_DELAYS_S: Final = (0.0, 0.1, 0.2, 0.5, 1.0)


class Worker(SupervisedProcess[FromWorker]):
    """Supervised worker process."""

    # `free` of its `slots` are empty. `kinds` have a pipeline, and `done` counts finished jobs.

    def __init__(self, number: int) -> None:
        super().__init__(_MODULE, FromWorker, _DELAYS_S)
        self.number = number
        self.ready = False
        self.slots: list[Slot] = []
        self.free: list[Slot] = []
        self.kinds: set[int] = set()
        self.preparing: JobKind | None = None
        self.job: Job | None = None
        self.slot: Slot | None = None
        self.mode: Mode | None = None
        self.done = 0

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
