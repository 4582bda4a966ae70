"""Measurements as they come from a sensor, and when."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Block", "Instant"]


@dataclass(frozen=True, slots=True)
class Instant:
    """When something arrived.

    Attributes
    ----------
    realtime_ns : int
        Nanoseconds since 1970-01-01 UTC.
    monotonic_ns : int
        By a clock that nobody sets.
    uncertainty_ns : int
        How long it may have lain there before.
    """

    realtime_ns: int
    monotonic_ns: int
    uncertainty_ns: int


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """One measurement as a sensor sent it.

    Attributes
    ----------
    counter : int
        As the sensor sent it.
    words : (sample,) uint32
        Memory of its own, not to be written.
    arrived : Instant
        Of its first byte.
    """

    counter: int
    words: NDArray[np.uint32]
    arrived: Instant
