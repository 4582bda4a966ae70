"""What runs jobs, as `Processing` sees it: local workers, or a cluster."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ertis_numba.network.messages import Data
from ertis_numba.network.processing.pipe_messages import Prepared
from ertis_numba.network.processing.slots import Slot
from ertis_numba.network.status import WorkerStatus

__all__ = ["Event", "FinishedJob", "Job", "JobKind", "KindFailed", "KindReady", "Lost", "Runner", "bytes_of"]


@dataclass(frozen=True, slots=True)
class JobKind:
    """Measurements that one pipeline can process.

    Attributes
    ----------
    number : int
    settings : str
        As TOML.
    words_bytes : int
        Size of a measurement.
    """

    number: int
    settings: str
    words_bytes: int


@dataclass(slots=True, eq=False)
class Job:
    """A measurement on its way to an image.

    Attributes
    ----------
    number : int
    data : Data
    words : array
        Contiguous bytes; kept until the image is made, so that it can be tried again.
    kind : Kind
    arrived_ns : int
        By a clock that nobody sets.
    points : bool
        Whether somebody wants the points, too.
    tries : int
        That have failed.
    predict : bool
        Predict the error of the image, and log a warning if images may exceed the budget.
    slot : Slot, optional
        Where words and image are, once it is `FinishedJob`; to be given back.
    """

    number: int
    data: Data
    words: NDArray[np.unsignedinteger[Any]]
    kind: JobKind
    arrived_ns: int
    points: bool = False
    tries: int = 0
    slot: Slot | None = None
    n_points: int = 0
    predict: bool = False


@dataclass(frozen=True, slots=True)
class FinishedJob:
    """A job's image is in its slot."""

    job: Job
    took_s: float


@dataclass(frozen=True, slots=True)
class Lost:
    """A job has no image. With ``again`` it may be given another try: who ran it died, hung or made a mistake."""

    job: Job
    text: str
    again: bool


@dataclass(frozen=True, slots=True)
class KindReady:
    """Jobs of a kind can be run from now on; its axes and the settings that were chosen."""

    prepared: Prepared


@dataclass(frozen=True, slots=True)
class KindFailed:
    """Jobs of a kind cannot be run, unless another `Runner.prepare` succeeds."""

    kind: int
    text: str


def bytes_of(words: NDArray[np.unsignedinteger[Any]]) -> memoryview:
    """Return the bytes of a measurement, as they are sent and stored."""
    return np.ascontiguousarray(words).reshape(-1).view(np.uint8).data


Event: TypeAlias = FinishedJob | Lost | KindReady | KindFailed


class Runner(Protocol):
    """Runs jobs, and waits for none: calls take the copy of a measurement, or the start of a process, until `close`.

    Attributes
    ----------
    respawned : int
        Workers that were replaced.
    """

    respawned: int

    @property
    def choice(self) -> str:
        """How jobs share the machine, and why, in a line."""
        ...

    def prepare(self, kind: JobKind) -> None:
        """Get ready for a kind of which jobs will come; `KindReady` or `KindFailed` follows."""
        ...

    def forget(self, kind: JobKind) -> None:
        """Know that no more jobs of a kind will come."""
        ...

    def takes(self, kind: JobKind) -> bool:
        """Whether a job of a kind can be run now."""
        ...

    def submit(self, job: Job) -> None:
        """Run a job, when `takes` has said so; `FinishedJob` or `Lost` follows."""
        ...

    def release(self, slot: Slot) -> None:
        """Take back the slot of a job that was done."""
        ...

    def fds(self) -> Iterable[int]:
        """Return what is to be polled now."""
        ...

    def ready(self, fd: int) -> Sequence[Event]:
        """Return what has happened, when something that is polled can be read."""
        ...

    def tick(self, now_s: float, rate_hz: float) -> Sequence[Event]:
        """Return what has happened; to be called ten times a second with the rate at which measurements arrive."""
        ...

    def status(self) -> list[WorkerStatus]:
        """Return how the workers are."""
        ...

    def close(self) -> None:
        """End all of it."""
        ...
