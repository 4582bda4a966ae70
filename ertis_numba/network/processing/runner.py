"""Interface to the executors of jobs: local workers, or a cluster."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ertis_numba.network.messages import Data
from ertis_numba.network.processing.parallelism import Load
from ertis_numba.network.processing.pipe_messages import Prepared
from ertis_numba.network.processing.shared_slots import Slot
from ertis_numba.network.status import WorkerStatus

__all__ = ["Event", "FinishedJob", "Job", "JobKind", "KindFailed", "KindReady", "Lost", "Runner", "bytes_of"]


@dataclass(frozen=True, slots=True)
class JobKind:
    """Measurements that one pipeline can process, or measurements of which no image is made.

    ``settings`` are those of the pipeline as TOML; empty without one.
    """

    number: int
    settings: str
    words_bytes: int


@dataclass(slots=True, eq=False)
class Job:
    """A measurement to process.

    ``words`` are contiguous bytes, kept until the image is done for a second try. ``arrived_ns`` is by a monotonic
    clock. ``points`` are made if an application subscribes to them, and ``tries`` counts failed tries. ``predict``
    warns if images may exceed the error budget; ``check_sound`` warns if the sound contradicts the settings. ``slot``
    has samples and image once it is `FinishedJob`; release it afterwards.
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
    check_sound: bool = False


@dataclass(frozen=True, slots=True)
class FinishedJob:
    """A job whose image is in its slot."""

    job: Job
    took_s: float


@dataclass(frozen=True, slots=True)
class Lost:
    """A job without an image. With ``again`` it may be tried again: its worker died, hung or failed."""

    job: Job
    text: str
    again: bool


@dataclass(frozen=True, slots=True)
class KindReady:
    """Jobs of a kind can run from now on; with their axes and chosen settings."""

    prepared: Prepared


@dataclass(frozen=True, slots=True)
class KindFailed:
    """Jobs of a kind cannot run, unless another `Runner.prepare` succeeds."""

    kind: int
    text: str


def bytes_of(words: NDArray[np.unsignedinteger[Any]]) -> memoryview:
    """Return the bytes of a measurement, as they are sent and stored."""
    return np.ascontiguousarray(words).reshape(-1).view(np.uint8).data


Event: TypeAlias = FinishedJob | Lost | KindReady | KindFailed


class Runner(Protocol):
    """Executor of jobs.

    No method blocks, except `close`: calls take the copy of a measurement, or the start of a process. ``respawned``
    counts replaced workers.
    """

    respawned: int

    @property
    def choice(self) -> str:
        """Distribution of jobs over the machine, with its reason, in one line."""
        ...

    def prepare(self, kind: JobKind) -> None:
        """Prepare for jobs of a kind; `KindReady` or `KindFailed` follows."""
        ...

    def forget(self, kind: JobKind) -> None:
        """Release a kind, because no more jobs of it will come."""
        ...

    def takes(self, kind: JobKind) -> bool:
        """Return True if a job of a kind can run now."""
        ...

    def submit(self, job: Job) -> None:
        """Run a job that `takes` accepts; `FinishedJob` or `Lost` follows."""
        ...

    def release(self, slot: Slot) -> None:
        """Release the slot of a finished job."""
        ...

    def fds(self) -> Iterable[int]:
        """Return the descriptors to poll now."""
        ...

    def ready(self, fd: int) -> Sequence[Event]:
        """Return new events, after a descriptor became readable."""
        ...

    def tick(self, now_s: float, load: Load) -> Sequence[Event]:
        """Return new events; call it ten times a second with the load."""
        ...

    def status(self) -> list[WorkerStatus]:
        """Return the status of the workers."""
        ...

    def close(self) -> None:
        """Close everything."""
        ...
