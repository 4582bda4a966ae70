"""Time between marks on a lane, measured by the GPU's own clock."""

from typing import Any

from numba import cuda

from ertis_numba.kernels._cuda.lane import SIMULATED, current

__all__ = ["Stopwatch"]


class Stopwatch:
    """Marks on the lane that a Python thread has entered; on a simulated GPU they are one millisecond apart."""

    def __init__(self) -> None:
        self._marks: list[tuple[str, Any]] = []

    def start(self) -> None:
        """Remove all marks, and start the measurement."""
        self._marks.clear()
        self.mark("")

    def mark(self, name: str) -> None:
        """Mark the end of the part ``name``, which began at the previous mark."""
        event = cuda.event() if SIMULATED else cuda.event(timing=True)
        event.record(current().stream)
        self._marks.append((name, event))

    def read_ms(self) -> dict[str, float]:
        """Return the time of each part in milliseconds; parts of the same name are added up."""
        self._marks[-1][1].synchronize()
        found: dict[str, float] = {}
        for (_, begin), (name, end) in zip(self._marks, self._marks[1:], strict=False):
            found[name] = found.get(name, 0.0) + (1.0 if SIMULATED else float(begin.elapsed_time(end)))
        return found
