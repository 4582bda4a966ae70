"""Options of a campaign, and orders to workers, in the form of JSON."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal, Protocol

from ertis_numba import checks
from ertis_numba.settings import Settings
from ertis_numba.stages.costs import PLAN_COSTS, PlanCosts
from ertis_numba.storage.recording import Mounting

__all__ = ["HOW", "MAX_BYTES", "CampaignOptions", "Do", "News", "WorkOrder", "WorkerPool"]

MAX_BYTES: Final = 256e6
"""Limit on images that wait to be written, of all workers together."""


@dataclass(frozen=True, slots=True, kw_only=True)
class CampaignOptions:
    """Options for processing each recording.

    Attributes
    ----------
    settings : callable
        Returns the settings to process by for those of a recording; they are these themselves by default.
    sensor : str, optional
        One only; all of each recording by default.
    dtype : {"float32", "float16"}
    device : {"auto", "cpu", "cuda", "numpy"}
    plan : {"nominal", "measured"}
        Costs by which plans are chosen, as for `Pipeline`.
    threads : int, optional
        Of each worker; the workers share the cores by default.
    batch : int
        Measurements worked on at the same time.
    strict : bool
        Refuse recordings with faulty microphones instead of warning.
    overwrite : bool
        Replace energyscape files that were made otherwise or are damaged. What is whole, and was made of the same
        recording by the same settings and versions, stays as it is in any case.
    mounting : mapping of str to (translation_m, rotation_xyzw), optional
        Mountings of sensors by name, in place of those in the recording.
    explain : bool
        Tell the plan of each sensor, its predicted error and time, as ``plan`` of what was made.
    verify : bool
        Measure the error of each sensor's first measurement, ``verified`` of what was made; a recording fails if it is
        beyond the budget.
    """

    settings: Callable[[Settings], Settings] = lambda recorded: recorded
    sensor: str | None = None
    dtype: Literal["float32", "float16"] = "float32"
    device: str = "auto"
    plan: PlanCosts = "nominal"
    threads: int | None = None
    batch: int = 8
    strict: bool = False
    overwrite: bool = False
    mounting: Mapping[str, Mounting] | None = None
    explain: bool = False
    verify: bool = False

    def __post_init__(self) -> None:
        checks.choice("dtype", self.dtype, ("float32", "float16"))
        checks.choice("plan", self.plan, PLAN_COSTS)
        checks.choice("device", self.device, ("auto", "cpu", "cuda", "numpy"))
        checks.integer("batch", self.batch, 1)

    @property
    def is_thorough(self) -> bool:
        """True if the options need more than the image of a recording, even for an existing output."""
        return self.strict or self.explain or self.verify


HOW: Final = ("dtype", "batch", "strict", "overwrite", "mounting", "explain", "verify")
"""Fields of `CampaignOptions` that an order contains unchanged."""


Do = Literal["look", "plan", "make", "check"]


@dataclass(frozen=True, slots=True)
class WorkOrder:
    """Order to a worker.

    Attributes
    ----------
    number : int
    do : {"look", "plan", "make", "check"}
    about : dict
        As `work` has it.
    """

    number: int
    do: Do
    about: dict[str, Any]


@dataclass(frozen=True, slots=True)
class News:
    """Message of a worker about an order.

    Attributes
    ----------
    number : int
        Of the order.
    done : int
        Measurements that are done so far, where that is all there is to tell.
    result : dict or None
        What came of it; ``error`` in it is why nothing did, and ``by_chance`` whether that need not be so another time.
    """

    number: int
    done: int = 0
    result: dict[str, Any] | None = None


class WorkerPool(Protocol):
    """Executors of orders."""

    @property
    def size(self) -> int:
        """Number of orders in progress at once."""

    @property
    def free(self) -> int:
        """Number of orders that can be given now; zero if more are in progress than allowed."""

    def limit(self, size: int) -> None:
        """Reduce the number of orders in progress; those given are finished."""

    def give(self, order: WorkOrder) -> None:
        """Run an order; never blocks."""

    def wait(self, timeout_s: float) -> list[News]:
        """Return news, or nothing after a while."""

    def close(self) -> None:
        """End all work at once."""
