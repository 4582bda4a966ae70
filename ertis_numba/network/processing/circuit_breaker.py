"""Circuit breaker that suspends sensors whose measurements make workers fail."""

import time
from dataclasses import dataclass
from typing import Final

__all__ = ["CircuitBreaker"]

_IN_A_ROW: Final = 3  # Number of successive measurements of a sensor that fail twice, after which it is suspended …
_PAUSE_S: Final = 10.0  # … for this time, doubled at each further suspension.
_LONGEST_PAUSE_S: Final = 640.0


@dataclass(slots=True)
class _Failing:
    in_a_row: int = 0
    pause_s: float = 0.0
    until_s: float = 0.0


class CircuitBreaker:
    """Sensors with successive failures."""

    def __init__(self) -> None:
        self._failing: dict[str, _Failing] = {}

    def holds(self, sensor: str, now_s: float) -> bool:
        """Return True if a sensor is suspended; ``now_s`` is a time of `time.monotonic`."""
        failing = self._failing.get(sensor)
        return failing is not None and now_s < failing.until_s

    def failed(self, sensor: str) -> float:
        """Count a measurement that has failed twice; return the suspension of its sensor in s, 0 if there is none."""
        failing = self._failing.setdefault(sensor, _Failing())
        failing.in_a_row += 1
        if failing.in_a_row < _IN_A_ROW:
            return 0.0
        failing.pause_s = min(2 * failing.pause_s, _LONGEST_PAUSE_S) or _PAUSE_S
        failing.until_s = time.monotonic() + failing.pause_s
        return failing.pause_s

    def succeeded(self, sensor: str) -> None:
        """Reset the failures of a sensor."""
        self._failing.pop(sensor, None)
