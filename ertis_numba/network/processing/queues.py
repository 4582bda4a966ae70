"""What waits for a worker, and what became of all that came: the latest wins, and nothing is lost uncounted."""

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final

from ertis_numba.network.processing.runner import Job
from ertis_numba.network.status import Latencies, Percentiles

__all__ = ["SUPERSEDED", "Counts", "Queues"]

_QUEUE: Final = 2  # measurements of a sensor that wait; the oldest gives way to a new one
SUPERSEDED: Final = "superseded"


@dataclass(slots=True)
class Counts:
    """What became of one sensor's measurements.

    ``received = published + sum(dropped.values()) + in_flight`` at any moment.

    Attributes
    ----------
    received, published : int
    dropped : Counter of str
        By reason.
    in_flight : int
        Waiting, being processed, or with the publisher.
    queue : int
        Of those, the ones that wait for a worker.
    times : Latencies
        From the arrival of a measurement to its image being published.
    """

    received: int = 0
    published: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    in_flight: int = 0
    queue: int = 0
    times: Latencies = field(default_factory=Latencies)

    @property
    def latency(self) -> Percentiles:
        """What those times come to."""
        return self.times.percentiles()

    def drop(self, reason: str) -> None:
        """Count a measurement that ends without an image."""
        self.dropped[reason] += 1
        self.in_flight -= 1


class Queues:
    """Measurements that wait, two of each sensor at most, served in turn."""

    def __init__(self) -> None:
        self.counts: dict[str, Counts] = {}
        self._waiting: dict[str, deque[Job]] = {}
        self._again: deque[Job] = deque()  # jobs that get another try, before all others

    def counts_of(self, sensor: str) -> Counts:
        """Return the counts of a sensor, which begin with 0."""
        return self.counts.setdefault(sensor, Counts())

    def add(self, job: Job, reason: str = SUPERSEDED) -> None:
        """Let a measurement wait; the oldest of its sensor is dropped, for a reason, if there are too many."""
        sensor = job.data.sensor
        counts = self.counts_of(sensor)
        counts.received += 1
        counts.in_flight += 1
        waiting = self._waiting.setdefault(sensor, deque())
        if len(waiting) == _QUEUE:
            waiting.popleft()
            counts.drop(reason)
        waiting.append(job)
        counts.queue = len(waiting)

    def again(self, job: Job) -> None:
        """Let a measurement that was taken out wait again, for its other try."""
        self._again.append(job)

    def turns(self) -> Iterator[Job]:
        """Yield what is next of each sensor, those that have waited longest for their turn first."""
        yield from list(self._again)
        for waiting in list(self._waiting.values()):
            if waiting:
                yield waiting[0]

    def take(self, job: Job) -> None:
        """Take out a measurement that `turns` has told."""
        if job in self._again:
            self._again.remove(job)
            return
        sensor = job.data.sensor
        waiting = self._waiting.pop(sensor)
        waiting.popleft()
        self._waiting[sensor] = waiting  # it is at the end now
        self.counts[sensor].queue = len(waiting)

    def drop_kind(self, kind: int, reason: str) -> None:
        """Drop all that waits of a kind."""
        for job in [job for job in self._again if job.kind.number == kind]:
            self._again.remove(job)
            self.counts[job.data.sensor].drop(reason)
        for sensor, waiting in self._waiting.items():
            for job in [job for job in waiting if job.kind.number == kind]:
                waiting.remove(job)
                self.counts[sensor].drop(reason)
            self.counts[sensor].queue = len(waiting)

    def drop_all(self, reason: str) -> None:
        """Drop all that waits."""
        for kind in {job.kind.number for job in [*self._again, *(j for each in self._waiting.values() for j in each)]}:
            self.drop_kind(kind, reason)
