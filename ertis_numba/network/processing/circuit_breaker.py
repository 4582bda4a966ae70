"""Which sensors have to pause: workers fail with their measurements, which costs the others of their time."""

import time
from dataclasses import dataclass
from typing import Final

__all__ = ["CircuitBreaker"]

_IN_A_ROW: Final = 3  # measurements of a sensor that have failed twice, after which it has to pause …
_PAUSE_S: Final = 10.0  # … for that long, and twice as long each further time
_LONGEST_PAUSE_S: Final = 640.0


@dataclass(slots=True)
class _Failing:
    in_a_row: int = 0
    pause_s: float = 0.0
    until_s: float = 0.0


class CircuitBreaker:
    """Sensors whose measurements have failed, until one has not."""

    def __init__(self) -> None:
        self._failing: dict[str, _Failing] = {}

    def holds(self, sensor: str, now_s: float) -> bool:
        """Whether a sensor has to pause; ``now_s`` is that of `time.monotonic`."""
        failing = self._failing.get(sensor)
        return failing is not None and now_s < failing.until_s

    def failed(self, sensor: str) -> float:
        """Count a measurement that has failed twice; return how long its sensor has to pause now, in s, if at all."""
        failing = self._failing.setdefault(sensor, _Failing())
        failing.in_a_row += 1
        if failing.in_a_row < _IN_A_ROW:
            return 0.0
        failing.pause_s = min(2 * failing.pause_s, _LONGEST_PAUSE_S) or _PAUSE_S
        failing.until_s = time.monotonic() + failing.pause_s
        return failing.pause_s

    def succeeded(self, sensor: str) -> None:
        """Forget what has failed of a sensor."""
        self._failing.pop(sensor, None)
