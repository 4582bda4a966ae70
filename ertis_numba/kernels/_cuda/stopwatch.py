"""Time between places of a lane, taken by the GPU's own clock.

Only benchmarks use this; it is no part of the signal chain.
"""

from typing import Any

from numba import cuda

from ertis_numba.kernels._cuda.lane import SIMULATED, current

__all__ = ["Stopwatch"]


class Stopwatch:
    """Marks on the lane that a Python thread has entered; simulated ones take a millisecond from each to the next."""

    def __init__(self) -> None:
        self._marks: list[tuple[str, Any]] = []

    def start(self) -> None:
        """Forget all marks and begin here."""
        self._marks.clear()
        self.mark("")

    def mark(self, name: str) -> None:
        """Say that what is called ``name`` ends here; it begins at the mark before."""
        event = cuda.event() if SIMULATED else cuda.event(timing=True)
        event.record(current().stream)
        self._marks.append((name, event))

    def read_ms(self) -> dict[str, float]:
        """Return how long everything took; parts of the same name are added up."""
        self._marks[-1][1].synchronize()
        found: dict[str, float] = {}
        for (_, begin), (name, end) in zip(self._marks, self._marks[1:], strict=False):
            found[name] = found.get(name, 0.0) + (1.0 if SIMULATED else float(begin.elapsed_time(end)))
        return found
