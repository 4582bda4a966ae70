"""What waits for a worker, and what became of all that came: the latest wins, and nothing is lost uncounted."""

from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Final

from ertis_numba.network.messages import Data
from ertis_numba.network.processing.runner import Job
from ertis_numba.network.status import Latencies, Percentiles

__all__ = ["SUPERSEDED", "Queues", "SensorCounts"]

_QUEUE: Final = 2  # measurements of a sensor that wait; the oldest gives way to a new one
_REPORTED: Final = 4096  # of those that were dropped, until somebody asks
SUPERSEDED: Final = "superseded"


@dataclass(slots=True)
class SensorCounts:
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


class Queues:
    """Measurements that wait, two of each sensor at most, served in turn.

    Attributes
    ----------
    counts : dict of str to Counts
        By sensor.
    dropped : deque of (sensor, epoch, sequence, reason)
        The latest that were dropped; whoever tells of them takes them out.
    """

    def __init__(self) -> None:
        self.counts: dict[str, SensorCounts] = {}
        self.dropped: deque[tuple[str, int, int, str]] = deque(maxlen=_REPORTED)
        self._waiting: dict[str, deque[Job]] = {}
        self._again: deque[Job] = deque()  # jobs that get another try, before all others

    def counts_of(self, sensor: str) -> SensorCounts:
        """Return the counts of a sensor, which begin with 0."""
        return self.counts.setdefault(sensor, SensorCounts())

    def take_in(self, data: Data) -> SensorCounts:
        """Count a measurement that has come; return the counts of its sensor."""
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
        """Let a measurement wait; the oldest of its sensor is dropped, for a reason, if there are too many."""
        sensor = job.data.sensor
        counts = self.take_in(job.data)
        waiting = self._waiting.setdefault(sensor, deque())
        if len(waiting) == _QUEUE:
            self.drop(waiting.popleft().data, reason)
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
        self._drop(lambda job: job.kind.number == kind, reason)

    def drop_sensor(self, sensor: str, reason: str) -> None:
        """Drop all that waits of a sensor."""
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
