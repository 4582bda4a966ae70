"""What is wanted of a campaign, and what a worker is told to do, as JSON can hold it."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final, Literal, Protocol

from ertis_numba import checks
from ertis_numba.settings import Settings

__all__ = ["MOST_BYTES", "Crew", "News", "Order", "Wanted"]

MOST_BYTES: Final = 256e6
"""Of images that wait to be written, of all workers together."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Wanted:
    """How each recording is to be processed.

    Attributes
    ----------
    settings : callable
        Returns the settings to process by for those of a recording; they are these themselves by default.
    sensor : str, optional
        One only; all of each recording by default.
    dtype : {"float32", "float16"}
    device : {"auto", "cpu", "cuda", "numpy"}
    threads : int, optional
        Of each worker; the workers share the cores by default.
    batch : int
        Measurements worked on at the same time.
    strict : bool
        Refuse recordings with faulty microphones instead of warning.
    overwrite : bool
        Replace energyscape files that were made otherwise. What was made of the same recording by the same settings and
        versions stays as it is in any case.
    examine : str
        ``package.module:function`` that is called in the worker with the pipeline and the first measurement of each
        sensor, ``threads`` and ``examine_with``, before anything is written. It returns what JSON can hold.
    examine_with : mapping
    """

    settings: Callable[[Settings], Settings] = lambda recorded: recorded
    sensor: str | None = None
    dtype: Literal["float32", "float16"] = "float32"
    device: str = "auto"
    threads: int | None = None
    batch: int = 8
    strict: bool = False
    overwrite: bool = False
    examine: str = ""
    examine_with: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        checks.choice("dtype", self.dtype, ("float32", "float16"))
        checks.choice("device", self.device, ("auto", "cpu", "cuda", "numpy"))
        checks.whole("batch", self.batch, 1)


@dataclass(frozen=True, slots=True)
class Order:
    """Something for a worker to do.

    Attributes
    ----------
    number : int
    do : {"look", "plan", "make"}
    about : dict
        As `work` has it.
    """

    number: int
    do: Literal["look", "plan", "make"]
    about: dict[str, Any]


@dataclass(frozen=True, slots=True)
class News:
    """What a worker tells of an order.

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


class Crew(Protocol):
    """Those who follow orders."""

    @property
    def size(self) -> int:
        """How many orders are followed at a time."""

    @property
    def free(self) -> int:
        """How many more may be given now."""

    def limit(self, size: int) -> None:
        """Follow fewer orders at a time from now on."""

    def give(self, order: Order) -> None:
        """Have something done; returns at once."""

    def wait(self, timeout_s: float) -> list[News]:
        """Return what there is to tell, or nothing after a while."""

    def close(self) -> None:
        """End all work at once."""
