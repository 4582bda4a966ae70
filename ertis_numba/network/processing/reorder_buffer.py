"""Reorder buffer: publishes the images of each sensor in the order of their measurements."""

import itertools
from collections import deque
from collections.abc import Iterable

from ertis_numba.network.processing.runner import Job

__all__ = ["ReorderBuffer"]


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
