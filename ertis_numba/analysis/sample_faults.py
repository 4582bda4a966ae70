"""Faults of samples that a program can count in passing: dropouts, and measurements that repeat the one before."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.dropouts import Parts, describe_dropouts, dropouts
from ertis_numba.frames import Measurement

__all__ = ["LINK", "SampleFaults", "are_copies"]

LINK = "check the link to the sensor, and record again"
"""Remedy."""
_FEW = 64  # Samples that are compared first.


class SampleFaults:
    """Count of the faults of samples over the measurements of one sensor; ``copies`` are not counted if False."""

    def __init__(self, *, copies: bool = True) -> None:
        self._copies = copies
        self._n_measurements = self._n_dropouts = self._n_copies = 0
        self._first: tuple[int, Parts] = 0, []
        self._last: NDArray[Any] | None = None

    def add(self, measurement: Measurement) -> None:
        """Examine the next measurement."""
        parts = dropouts(measurement)
        if parts and not self._n_dropouts:
            self._first = self._n_measurements, parts
        self._n_dropouts += bool(parts)
        self._n_copies += self._last is not None and are_copies(self._last, measurement.data)
        self._n_measurements += 1
        self._last = measurement.data if self._copies else None

    @property
    def is_first_only(self) -> bool:
        """True if only the first measurement has a fault, which its health report names."""
        return self._n_dropouts == 1 and self._first[0] == self._n_copies == 0

    def note(self, consequence: str = "echoes may be missing or too wide") -> str:
        """Return a line on the faults; empty if there are none."""
        found = []
        if self._n_dropouts:
            index, parts = self._first
            found.append(
                f"{self._n_dropouts} of {self._n_measurements} measurements "
                f"{'has' if self._n_dropouts == 1 else 'have'} dropouts (measurement {index}: "
                f"{describe_dropouts(parts)}), so {consequence}"
            )
        if self._n_copies:
            found.append(
                f"{self._n_copies} of {self._n_measurements} measurements "
                f"{'is a copy' if self._n_copies == 1 else 'are copies'} of the one before in every sample, which "
                "recorded sound never is"
            )
        return f"{'; '.join(found)}; {LINK}" if found else ""


def are_copies(first: NDArray[Any], second: NDArray[Any]) -> bool:
    """Return True if two measurements are equal in every sample, and not silent."""
    if first.shape != second.shape or not np.array_equal(first[:_FEW], second[:_FEW]):
        return False
    return np.array_equal(first, second) and bool((second != second[:1]).any())
