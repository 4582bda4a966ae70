"""Supervision of the publisher process."""

import time
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, Final

from ertis_numba.base.errors import NetworkError
from ertis_numba.network.log import EventLog
from ertis_numba.network.messages import Description, Group
from ertis_numba.network.processing import pipe_messages
from ertis_numba.network.processing.options import ProcessingOptions
from ertis_numba.network.processing.pipe_messages import FromPublisher
from ertis_numba.network.processing.runner import Job
from ertis_numba.network.processing.subscribers import DESCRIPTIONS
from ertis_numba.network.status import Status, SubscriberStatus
from ertis_numba.processes import SupervisedProcess

if TYPE_CHECKING:
    from ertis_numba.network.processing.shared_slots import Slot

__all__ = ["Publisher"]

_MODULE: Final = "ertis_numba.network.processing.publisher_process"
_STARTED_S: Final = 60.0
_HUNG_S: Final = 10.0  # Limit on silence; it sends a message each second.
_DELAYS_S: Final = (0.0, 0.2, 0.5, 1.0, 2.0, 5.0)
_CLOSED_S: Final = 2.0


class Publisher:
    """Process that sends products to applications, at a lasting address; refused counts messages and keys."""

    def __init__(self, options: ProcessingOptions, log: EventLog) -> None:
        self._options, self._log = options, log
        self.address = options.publish
        self.subscribers: tuple[SubscriberStatus, ...] = ()
        self.refused: dict[str, int] = {}
        self._refused_before: dict[str, int] = {}
        self._process = SupervisedProcess[FromPublisher](_MODULE, FromPublisher, _DELAYS_S)
        self._serves = False
        self._points: tuple[str, ...] | None = ()
        self._jobs: dict[int, Job] = {}
        self._slots: dict[int, Slot] = {}
        self._descriptions: dict[str, dict[int, tuple[Description, tuple[bytes, ...]]]] = {}  # By sensor.
        self._reported: set[int] = set()
        self._keys_note = ""
        self._reports_sent = self._reports_taken = 0

    def start(self, stopping: Callable[[], bool] = lambda: False) -> None:
        """Start the process, and wait until it listens or ``stopping`` returns True."""
        self._begin()
        end_s = time.monotonic() + _STARTED_S
        while (child := self._process.child) is not None and not self._serves and not stopping():
            if time.monotonic() > end_s or child.pipe.closed:
                raise NetworkError(f"cannot listen at {self.address}: the publisher has ended or hangs; try again")
            child.pipe.wait(0.2)
            for note in child.pipe.receive():
                if isinstance(note, pipe_messages.Started) and note.error:
                    raise NetworkError(note.error)
                self._take(note)

    @property
    def pid(self) -> int:
        """Identifier of the process; 0 while there is none."""
        return self._process.pid

    @property
    def respawned(self) -> int:
        """Number of replaced processes."""
        return self._process.restarts

    @property
    def serves(self) -> bool:
        """True if it accepts products now."""
        return self._serves

    def wants_points(self, sensor: str) -> bool:
        """Return True if an application subscribes to the points of a sensor."""
        return self._points is None or sensor in self._points

    def describe(self, description: Description, payloads: tuple[bytes, ...]) -> None:
        """Send the description of products before the first of them."""
        kept = self._descriptions.setdefault(description.sensor, {})
        kept[description.number] = description, payloads
        while len(kept) > DESCRIPTIONS:
            self._reported.discard(stale := min(kept))
            del kept[stale]

    def publish(self, job: Job, publish: pipe_messages.Publish) -> bool:
        """Send a finished job, until `ProductsQueued` or the end of the process; return False without a description."""
        child, slot = self._process.child, job.slot
        if child is None or slot is None:
            raise AssertionError("nothing can be published now; check serves first")
        described = self._descriptions.get(job.data.sensor, {})
        needed = [each for each in (publish.description, publish.raw_description) if each is not None]
        if not described.keys() >= set(needed):
            return False
        if self._slots.get(slot.number) is not slot:
            self._slots[slot.number] = slot
            note = pipe_messages.SlotMemory(
                slot=slot.number, words_bytes=slot.words_bytes, image_bytes=slot.image_bytes
            )
            child.pipe.send(note, files=(slot.descriptor,))
        for number in needed:
            if number not in self._reported:
                self._reported.add(number)
                description, payloads = described[number]
                child.pipe.send(pipe_messages.Describe(description=description, payloads=payloads))
        self._jobs[job.number] = job
        child.pipe.send(publish)
        return True

    def group(self, group: Group) -> None:
        """Send a closed group, unless the process does not listen."""
        child = self._process.child
        if child is not None and self._serves and not child.pipe.waiting:
            child.pipe.send(pipe_messages.Grouped(group=group))

    def report(self, status: Status) -> None:
        """Send the status of the central node, if the previous one was accepted."""
        child = self._process.child
        if child is not None and self._serves and self._reports_sent - self._reports_taken < 3:
            self._reports_sent += 1
            child.pipe.send(pipe_messages.StatusNote(status=status.encode()))

    def fds(self) -> Iterable[int]:
        """Return the descriptors to poll now."""
        return self._process.fds

    def ready(self) -> Sequence[tuple[Job, int]]:
        """Return published jobs, with the time."""
        taken = [found for note in self._process.receive() if (found := self._take(note)) is not None]
        self._serves = self._serves and bool(self._process.fds)  # `tick` cleans up once the process is gone.
        return taken

    def tick(self, now_s: float) -> tuple[Sequence[tuple[Job, int]], Sequence[Job]]:
        """Do as `ready`, return jobs lost with the process, and restart it or kill a hanging one."""
        match self._process.check(now_s):
            case "due":
                self._begin()
            case "late":
                self._log.warning("publisher_killed", pid=self.pid, text="it hangs")
            case "ended":
                return self.ready(), self._died()
        return (), ()

    def close(self) -> None:
        """Close it."""
        self._process.close(_CLOSED_S if self._serves else 0.0)
        self._serves = False

    def _begin(self) -> None:
        keys = self._options.keys
        child = self._process.start(_STARTED_S)
        given: dict[str, Any] = {}
        if keys is not None:
            given = {
                "name": keys.pair.name,
                "public": keys.pair.public,
                "secret": keys.pair.secret,
                "allow": str(keys.allow),
            }
        # It listens at the previous port and the given host, which may have several addresses.
        address = f"{self._options.publish.rpartition(':')[0]}:{self.address.rpartition(':')[2]}"
        child.pipe.send(pipe_messages.Begin(address=address, **given))

    def _take(self, note: FromPublisher) -> tuple[Job, int] | None:
        self._process.expect(_HUNG_S if self._serves else _STARTED_S)
        match note:
            case pipe_messages.Started(address=address, error=error):
                if error:
                    self._log.error("publisher_silent", text=error)
                else:
                    self.address, self._serves = address, True
                    self._process.expect(_HUNG_S)
            case pipe_messages.Wanted(points=points):
                self._points = points
            case pipe_messages.Served():
                self.subscribers = note.subscribers
                self._process.succeeded()
                self._reports_taken = note.reports
                if note.keys_note not in {self._keys_note, ""}:
                    self._log.error("keys", text=note.keys_note)
                self._keys_note = note.keys_note
                names = {*self._refused_before, *note.refused}
                self.refused = {name: self._refused_before.get(name, 0) + note.refused.get(name, 0) for name in names}
            case pipe_messages.ProductsQueued(job=number, published_ns=published_ns):
                job = self._jobs.pop(number, None)
                return None if job is None else (job, published_ns)
        return None

    def _died(self) -> list[Job]:
        """Clean up after the process, and return the jobs lost with it."""
        self._log.warning("publisher_died", pid=self.pid, text="another takes its place")
        self._process.clear()
        self._serves = False
        self.subscribers, self._points = (), ()
        self._refused_before = self.refused
        self._reports_sent = self._reports_taken = 0
        self._slots.clear()
        self._reported.clear()
        lost = list(self._jobs.values())
        self._jobs.clear()
        return lost
