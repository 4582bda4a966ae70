"""Queues of measurements for workers: the latest has priority, and each drop is counted."""

from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

from ertis_numba.network.messages import Data
from ertis_numba.network.processing.runner import Job
from ertis_numba.network.status import Latencies, Percentiles

__all__ = ["SUPERSEDED", "ProcessingCounts", "Queues"]

_QUEUE: Final = 2  # Limit on waiting measurements of a sensor; a new one replaces the oldest.
_REPORTED: Final = 4096  # Limit on kept drops, until they are reported.
SUPERSEDED: Final = "superseded"


@dataclass(slots=True)
class ProcessingCounts:
    """Counts of one sensor's measurements: ``received = published + sum(dropped.values()) + in_flight``."""

    received: int = 0
    published: int = 0
    passive: int = 0  # published without a call and an image
    dropped: Counter[str] = field(default_factory=Counter)  # by reason
    in_flight: int = 0  # includes the queue
    queue: int = 0  # waiting for a worker
    times: Latencies = field(default_factory=Latencies)  # from arrival to publication

    @property
    def latency(self) -> Percentiles:
        """Percentiles of these times."""
        return self.times.percentiles()


class Queues:
    """Waiting measurements, at most two per sensor, in turn; latest drops as (sensor, session_id, sequence, reason)."""

    def __init__(self) -> None:
        self.counts: dict[str, ProcessingCounts] = {}
        self.dropped: deque[tuple[str, int, int, str]] = deque(maxlen=_REPORTED)
        self._waiting: dict[str, deque[Job]] = {}
        self._again: deque[Job] = deque()  # Jobs for a second try, before all others.

    def counts_of(self, sensor: str) -> ProcessingCounts:
        """Return the counts of a sensor, which begin at 0."""
        counts = self.counts.get(sensor)
        if counts is None:
            counts = self.counts[sensor] = ProcessingCounts()
        return counts

    @property
    def is_empty(self) -> bool:
        """True if no measurement waits."""
        return not (self._again or any(self._waiting.values()))

    def take_in(self, data: Data) -> ProcessingCounts:
        """Count a received measurement; return the counts of its sensor."""
        counts = self.counts_of(data.sensor)
        counts.received += 1
        counts.in_flight += 1
        return counts

    def drop(self, data: Data, reason: str) -> None:
        """Count a measurement that ends without an image."""
        counts = self.counts_of(data.sensor)
        counts.dropped[reason] += 1
        counts.in_flight -= 1
        self.dropped.append((data.sensor, data.session_id, data.sequence, reason))

    def add(self, job: Job, reason: str = SUPERSEDED) -> None:
        """Add a measurement; if there are too many, drop the oldest of its sensor for a reason."""
        sensor = job.data.sensor
        counts = self.take_in(job.data)
        waiting = self._waiting.setdefault(sensor, deque())
        if len(waiting) == _QUEUE:
            self.drop(waiting.popleft().data, reason)
        waiting.append(job)
        counts.queue = len(waiting)

    def again(self, job: Job) -> None:
        """Add a measurement again for its second try."""
        self._again.append(job)

    def turns(self) -> Iterator[Job]:
        """Yield the next measurement of each sensor, beginning with the sensor that has waited longest."""
        yield from list(self._again)
        for waiting in list(self._waiting.values()):
            if waiting:
                yield waiting[0]

    def take(self, job: Job) -> None:
        """Remove a measurement that `turns` has yielded."""
        if job in self._again:
            self._again.remove(job)
            return
        sensor = job.data.sensor
        waiting = self._waiting.pop(sensor)
        waiting.popleft()
        self._waiting[sensor] = waiting  # The sensor goes to the end of the queue.
        self.counts[sensor].queue = len(waiting)

    def drop_kind(self, kind: int, reason: str) -> None:
        """Drop all waiting measurements of a kind."""
        self._drop(lambda job: job.kind.number == kind, reason)

    def drop_sensor(self, sensor: str, reason: str) -> None:
        """Drop all waiting measurements of a sensor."""
        self._drop(lambda job: job.data.sensor == sensor, reason)

    def _drop(self, condition: Callable[[Job], bool], reason: str) -> None:
        for job in list(filter(condition, self._again)):
            self._again.remove(job)
            self.drop(job.data, reason)
        for sensor, waiting in self._waiting.items():
            for job in list(filter(condition, waiting)):
                waiting.remove(job)
                self.drop(job.data, reason)
            self.counts[sensor].queue = len(waiting)
