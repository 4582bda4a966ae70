"""In which order images are published: of each sensor in that in which its measurements came."""

import itertools
from collections import deque
from collections.abc import Iterable

from ertis_numba.network.processing.runner import Job

__all__ = ["ReorderBuffer"]


class ReorderBuffer:
    """Jobs that are under way, by sensor; one that has failed leaves, and is published whenever it is done."""

    def __init__(self) -> None:
        self._jobs: dict[str, deque[Job]] = {}
        self._done: set[int] = set()  # those that wait for an older one, or for the publisher

    def add(self, job: Job) -> None:
        """Take a job whose first try begins."""
        if not job.tries:
            self._jobs.setdefault(job.data.sensor, deque()).append(job)

    def leave(self, job: Job) -> None:
        """Let a job that has failed hold up no others."""
        jobs = self._jobs.get(job.data.sensor, deque())
        if job in jobs:
            jobs.remove(job)

    def done(self, job: Job) -> None:
        """Note that a job has an image."""
        if not job.tries:
            self._done.add(job.number)

    def take(self, sensor: str) -> Job | None:
        """Take out what is to be published next of a sensor; None if that is not done."""
        jobs = self._jobs.get(sensor)
        if not jobs or jobs[0].number not in self._done:
            return None
        self._done.discard(jobs[0].number)
        return jobs.popleft()

    @property
    def sensors(self) -> list[str]:
        """Those of which there was something."""
        return list(self._jobs)

    @property
    def jobs(self) -> Iterable[Job]:
        """All that are under way."""
        return itertools.chain.from_iterable(self._jobs.values())
