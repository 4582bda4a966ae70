"""Choice between one measurement on all cores and several that share them."""

import itertools
import statistics
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

__all__ = ["Choice", "Load", "Mode"]

_BUSY: Final = 0.8  # Share of busy time above which measurements share the cores, …
_CALM: Final = 0.7  # … and below which each gets all cores.
_OVERLAP: Final = 0.4  # Share of measurements that would wait for others, above which they share the cores, too.
_POLL_INTERVAL_S: Final = 3.0
_KEPT: Final = 32
_RATE_S: Final = 3.0  # Interval over which the load is measured.
_GAIN: Final = 1.05  # Required gain of a change, because times fluctuate.


class Load:
    """Rate of arriving measurements."""

    def __init__(self) -> None:
        self._arrivals_s: deque[float] = deque()
        self._begun_s = time.monotonic()

    def add(self, now_s: float) -> None:
        """Count a measurement; ``now_s`` is a time of `time.monotonic`."""
        self._arrivals_s.append(now_s)

    def rate_hz(self, now_s: float) -> float:
        """Return the recent rate."""
        while self._arrivals_s and now_s - self._arrivals_s[0] > _RATE_S:
            self._arrivals_s.popleft()
        return len(self._arrivals_s) / min(_RATE_S, max(now_s - self._begun_s, 0.5))

    def overlap(self, time_s: float) -> float:
        """Return the share of recent measurements that arrived less than a time after another one.

        Sensors on a common SYNC line measure at the same time, so that their measurements arrive in bursts.
        """
        arrivals_s = list(self._arrivals_s)
        n_close = sum(later_s - earlier_s < time_s for earlier_s, later_s in itertools.pairwise(arrivals_s))
        return n_close / max(1, len(arrivals_s))


@dataclass(frozen=True, slots=True)
class Mode:
    """Number of measurements processed at once, and threads of each."""

    at_once: int
    threads: int


class Choice:
    """Choice by measured times and load.

    One measurement on all cores is done soonest. Several at once, with a share of the cores each, wait less for each
    other and give a higher throughput.

    Parameters
    ----------
    workers : int
    threads : int
        Threads of all workers together.

    Attributes
    ----------
    mode : Mode
    why : str
        Reason in one line.
    """

    def __init__(self, workers: int, threads: int) -> None:
        self.wide, self.many = Mode(1, threads), Mode(workers, max(1, threads // workers))
        self.mode = self.wide
        self._times_s: dict[Mode, deque[float]] = {mode: deque(maxlen=_KEPT) for mode in (self.wide, self.many)}
        self._next_s = 0.0
        self.why = f"{self._named(self.mode)}: no time measured yet"

    def seed(self, wide_s: float, many_s: float) -> None:
        """Add times that were measured before the first job."""
        for mode, time_s in ((self.wide, wide_s), (self.many, many_s)):
            if time_s > 0:
                self._times_s[mode].append(time_s)

    def took(self, mode: Mode, time_s: float) -> None:
        """Add the time of a job."""
        self._times_s[mode].append(time_s)

    def look(self, now_s: float, rate_hz: float, overlap: Callable[[float], float] = lambda _: 0.0) -> bool:
        """Choose again, if due; return True if the mode has changed.

        Parameters
        ----------
        now_s : float
        rate_hz : float
            Measurements per second of all sensors together.
        overlap : callable
            `Load.overlap`; without bursts by default.
        """
        if now_s < self._next_s or not all(self._times_s.values()):
            return False
        self._next_s = now_s + _POLL_INTERVAL_S
        if self.wide == self.many:
            self.why = f"{self._named(self.wide)}: the only mode"
            return False
        before = self.mode
        wide_s, many_s = (statistics.median(self._times_s[mode]) for mode in (self.wide, self.many))
        busy, capacity_hz = rate_hz * wide_s, {self.wide: 1 / wide_s, self.many: self.many.at_once / many_s}
        other = self.many if before == self.wide else self.wide
        waits = overlap(wide_s)
        if busy < (_BUSY if before == self.wide else _CALM) and waits < _OVERLAP:
            self.mode = self.wide
        elif capacity_hz[other] > _GAIN * capacity_hz[before]:
            self.mode = other
        self.why = (
            f"{self._named(self.mode)}: {rate_hz:.0f} measurements/s keep all cores busy {busy:.0%} of the time one by "
            f"one ({1e3 * wide_s:.1f} ms each), {waits:.0%} of them waiting for another; {self.many.at_once} at once "
            f"take {1e3 * many_s:.1f} ms"
        )
        return self.mode != before

    def _named(self, mode: Mode) -> str:
        threads = "1 thread" if mode.threads == 1 else f"{mode.threads} threads"
        return f"{mode.at_once} at once on {threads} each" if mode.at_once > 1 else f"one at a time on {threads}"
