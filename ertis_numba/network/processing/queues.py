"""Queues of measurements for workers, whose drops are counted, and the order of finished images."""

import itertools
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Final

from ertis_numba.network.messages import Data
from ertis_numba.network.processing.runner import Job
from ertis_numba.network.status import Latencies, Percentiles

__all__ = ["SUPERSEDED", "CircuitBreaker", "ProcessingCounts", "Queues", "ReorderBuffer"]

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


class ReorderBuffer:
    """Jobs under way by sensor; a failed one leaves its place, and is published once it is done."""

    def __init__(self) -> None:
        self._jobs: dict[str, deque[Job]] = {}
        self._done: set[int] = set()  # Jobs that wait for an older one, or for the publisher.

    def add(self, job: Job) -> None:
        """Add a job whose first try begins."""
        if not job.tries:
            self._jobs.setdefault(job.data.sensor, deque()).append(job)

    def leave(self, job: Job) -> None:
        """Release the place of a failed job, so that it delays no others."""
        jobs = self._jobs.get(job.data.sensor, deque())
        if job in jobs:
            jobs.remove(job)

    def done(self, job: Job) -> None:
        """Mark a job with an image."""
        if not job.tries:
            self._done.add(job.number)

    def take(self, sensor: str) -> Job | None:
        """Remove and return the next image of a sensor; None if it is not done."""
        jobs = self._jobs.get(sensor)
        if not jobs or jobs[0].number not in self._done:
            return None
        self._done.discard(jobs[0].number)
        return jobs.popleft()

    @property
    def sensors(self) -> list[str]:
        """Sensors with jobs so far."""
        return list(self._jobs)

    @property
    def jobs(self) -> Iterable[Job]:
        """All jobs under way."""
        return itertools.chain.from_iterable(self._jobs.values())


_IN_A_ROW: Final = 3  # Number of successive measurements of a sensor that fail twice, after which it is suspended …
_PAUSE_S: Final = 10.0  # … for this time, doubled at each further suspension.
_LONGEST_PAUSE_S: Final = 640.0


@dataclass(slots=True)
class _Failing:
    in_a_row: int = 0
    pause_s: float = 0.0
    until_s: float = 0.0


class CircuitBreaker:
    """Sensors with successive failures."""

    def __init__(self) -> None:
        self._failing: dict[str, _Failing] = {}

    def holds(self, sensor: str, now_s: float) -> bool:
        """Return True if a sensor is suspended; ``now_s`` is a time of `time.monotonic`."""
        failing = self._failing.get(sensor)
        return failing is not None and now_s < failing.until_s

    def failed(self, sensor: str) -> float:
        """Count a measurement that has failed twice; return the suspension of its sensor in s, 0 if there is none."""
        failing = self._failing.setdefault(sensor, _Failing())
        failing.in_a_row += 1
        if failing.in_a_row < _IN_A_ROW:
            return 0.0
        failing.pause_s = min(2 * failing.pause_s, _LONGEST_PAUSE_S) or _PAUSE_S
        failing.until_s = time.monotonic() + failing.pause_s
        return failing.pause_s

    def succeeded(self, sensor: str) -> None:
        """Reset the failures of a sensor."""
        self._failing.pop(sensor, None)
