"""Interface to the executors of jobs: local workers, or a cluster."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ertis_numba.frames.level_codes import LevelCodes
from ertis_numba.network.messages import Data
from ertis_numba.network.processing.parallelism import Load
from ertis_numba.network.processing.pipe_messages import Prepared
from ertis_numba.network.processing.shared_slots import Slot
from ertis_numba.network.status import WorkerStatus

__all__ = ["Event", "FinishedJob", "Job", "JobKind", "KindFailed", "KindReady", "Lost", "Runner", "bytes_of"]


@dataclass(frozen=True, slots=True)
class JobKind:
    """Measurements that one pipeline can process, or measurements of which no image is made."""

    number: int
    settings: str  # of the pipeline as TOML; empty without one
    words_bytes: int


@dataclass(slots=True, eq=False)
class Job:
    """A measurement to process."""

    number: int
    data: Data
    words: NDArray[np.unsignedinteger[Any]]  # contiguous bytes, kept until the image is done for a second try
    kind: JobKind
    arrived_ns: int  # by a monotonic clock
    points: bool = False  # an application subscribes to them
    tries: int = 0  # failed ones
    slot: Slot | None = None  # has samples and image once finished; release it afterwards
    n_points: int = 0
    levels: LevelCodes | None = None  # of an image of 8-bit levels
    predict: bool = False  # warn if images may exceed the error budget
    check_sound: bool = False  # warn if the sound contradicts the settings


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
    """Executor of jobs. Only `close` blocks: other calls copy a measurement or start a process at most."""

    respawned: int  # replaced workers

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
