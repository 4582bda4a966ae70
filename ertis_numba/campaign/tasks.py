"""Options of a campaign, and tasks to workers, which JSON can represent."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal, Protocol, TypeAlias

import msgspec

from ertis_numba.base import checks
from ertis_numba.base.constants import IMAGE_DTYPES, ImageDtype
from ertis_numba.base.errors import ArgumentError
from ertis_numba.campaign.recordings import RESULT_SUFFIXES, ResultKind
from ertis_numba.chain.costs import PLAN_COSTS, PlanCosts
from ertis_numba.settings import ExcludedChannels, Settings
from ertis_numba.storage.recording import Mounting

__all__ = [
    "MAX_WAITING_BYTES",
    "TASK_OPTIONS",
    "CampaignOptions",
    "FromWorkerProcess",
    "RunTask",
    "Task",
    "TaskAction",
    "TaskReport",
    "TaskUpdate",
    "WorkerPool",
    "WorkerReady",
]

MAX_WAITING_BYTES: Final = 256e6
"""Limit on images that wait to be written, of all workers together."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignOptions:
    """Options for processing each recording.

    Attributes
    ----------
    settings : callable
        Function that returns the settings for processing, given the recorded settings. By default, they are the same.
    without : ExcludedChannels
        Channels to exclude from processing, of all sensors or of some; none by default.
    sensor : str, optional
        Name of the only sensor to process; all sensors by default.
    dtype : {"float32", "float16", "uint8"}
        Type of the stored amplitudes of images, by default float32.
    device : {"auto", "cpu", "cuda", "numpy"}
        Compute device, by default ``auto``.
    plan : {"nominal", "measured"}
        Costs by which plans are chosen, as for `Pipeline`.
    threads : int, optional
        Number of threads per worker; by default, the workers share the cores.
    batch : int
        Number of measurements per batch of images, by default 8.
    strict : bool
        Refuse recordings with faulty microphones instead of warning.
    overwrite : bool
        Replace existing outputs that are damaged, or that come from another recording, other settings or
        other versions. A complete file from the same recording, settings and versions is always kept.
    mounting : mapping of str to (translation_m, rotation_xyzw), optional
        Mountings by name of the sensor, instead of those in the recording.
    explain : bool
        Report the plan of each sensor with its predicted error and time, under the key ``plan``.
    verify : bool
        Measure the error of each sensor's first image, and report it under the key ``verified``. A recording fails if
        the error exceeds the budget.
    result : {"energyscape", "acoustic_map"}
        Images of the measurements that are not passive, by default; or acoustic maps of all measurements, which have
        the mode ``passive`` and no ``dtype``, ``explain`` or ``verify``.
    """

    settings: Callable[[Settings], Settings] = lambda recorded: recorded
    without: ExcludedChannels = field(default_factory=ExcludedChannels)
    sensor: str | None = None
    dtype: ImageDtype = "float32"
    device: str = "auto"
    plan: PlanCosts = "nominal"
    threads: int | None = None
    batch: int = 8
    strict: bool = False
    overwrite: bool = False
    mounting: Mapping[str, Mounting] | None = None
    explain: bool = False
    verify: bool = False
    result: ResultKind = "energyscape"

    def __post_init__(self) -> None:
        checks.choice("dtype", self.dtype, IMAGE_DTYPES)
        checks.choice("plan", self.plan, PLAN_COSTS)
        checks.choice("device", self.device, ("auto", "cpu", "cuda", "numpy"))
        checks.integer("batch", self.batch, 1)
        checks.choice("result", self.result, RESULT_SUFFIXES)
        if self.result == "acoustic_map" and (self.dtype != "float32" or self.explain or self.verify):
            raise ArgumentError("dtype, explain and verify are for images, but result is 'acoustic_map'; omit them")

    def settings_of(self, sensor: str, recorded: Settings) -> Settings:
        """Return the settings for processing a sensor, given the recorded ones, without its excluded channels."""
        settings = self.settings(recorded)
        if self.result == "acoustic_map":
            settings = settings.replace("processing.mode", "passive")
        return self.without.applied(settings, sensor)

    @property
    def examines_existing(self) -> bool:
        """True if an existing output has to be examined as well."""
        return self.strict or self.explain or self.verify


TASK_OPTIONS: Final = ("dtype", "batch", "strict", "overwrite", "mounting", "explain", "verify")
"""Fields of `CampaignOptions` that a task contains unchanged."""


TaskAction = Literal["look", "plan", "make", "check"]


@dataclass(frozen=True, slots=True)
class Task:
    """Task of a worker: an action of `ertis_numba.campaign.task_actions`, and its arguments."""

    number: int
    action: TaskAction
    arguments: dict[str, Any]


@dataclass(frozen=True, slots=True)
class TaskUpdate:
    """Message of a worker: measurements done, then the result; ``by_chance`` marks errors that may be temporary."""

    number: int
    done: int = 0
    result: dict[str, Any] | None = None


class RunTask(msgspec.Struct, frozen=True, tag=True):
    """Request to a worker process to run a `Task`, with its arguments as JSON."""

    number: int
    action: TaskAction
    arguments: str


class WorkerReady(msgspec.Struct, frozen=True, tag=True):
    """A worker process has loaded its modules."""


class TaskReport(msgspec.Struct, frozen=True, tag=True):
    """`TaskUpdate` of a worker process, with the result as JSON; the first one reports the beginning of a task."""

    number: int
    done: int = 0
    result: str = ""


FromWorkerProcess: TypeAlias = WorkerReady | TaskReport


class WorkerPool(Protocol):
    """Workers that run tasks."""

    @property
    def size(self) -> int:
        """Number of tasks in progress at once."""

    @property
    def free(self) -> int:
        """Number of tasks that can be given now; zero if more are in progress than allowed."""

    def limit(self, size: int) -> None:
        """Reduce the number of tasks in progress at once; running tasks finish."""

    def submit(self, task: Task) -> None:
        """Run a task; never blocks."""

    def wait(self, timeout_s: float) -> list[TaskUpdate]:
        """Return messages of workers, or an empty list after a timeout."""

    def close(self) -> None:
        """Cancel all tasks."""
