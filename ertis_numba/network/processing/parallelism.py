"""Choice between one measurement on all cores and several that share them."""

import heapq
import math
import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from ertis_numba.base.units import counted

__all__ = ["Choice", "Load", "Mode"]

_BUSY: Final = 0.8  # Share of busy time above which more measurements share the cores, …
_CALM: Final = 0.7  # … and below which fewer may share them again.
_POLL_INTERVAL_S: Final = 3.0
_KEPT: Final = 32
_RATE_S: Final = 3.0  # Interval over which the load is measured.
_GAIN: Final = 1.15  # Required gain of a change, because times fluctuate.
_WEIGHT: Final = 0.2  # Weight of the latest interval, because the arrivals of independent sensors fluctuate.


class Load:
    """Arrivals of measurements within the last seconds."""

    def __init__(self) -> None:
        self._arrivals_s: deque[float] = deque()
        self._begun_s: float | None = None

    def add(self, now_s: float) -> None:
        """Count a measurement; ``now_s`` is a time of `time.monotonic`."""
        self._begun_s = now_s if self._begun_s is None else self._begun_s
        self._arrivals_s.append(now_s)
        self._forget(now_s)

    def recent(self, now_s: float) -> tuple[float, Sequence[float]]:
        """Return measurements per second, and times of arrival; none until observed as long as arrivals are kept."""
        self._forget(now_s)
        if self._begun_s is None or now_s - self._begun_s < _RATE_S:
            return 0.0, ()
        return len(self._arrivals_s) / _RATE_S, tuple(self._arrivals_s)

    def _forget(self, now_s: float) -> None:
        while self._arrivals_s and now_s - self._arrivals_s[0] > _RATE_S:
            self._arrivals_s.popleft()


@dataclass(frozen=True, slots=True)
class Mode:
    """Number of measurements processed at once, and threads of each."""

    at_once: int
    threads: int

    def __str__(self) -> str:
        threads = counted(self.threads, "thread")
        return f"{self.at_once} at once on {threads} each" if self.at_once > 1 else f"one at a time on {threads}"


class Choice:
    """Choice of one measurement on all cores, or several at once, by measured times and load."""

    # One on all cores is done soonest; several at once have a higher throughput, and suit bursts. `modes` are one at a
    # time, then 2, 4, 8 and so on.

    def __init__(self, workers: int, threads: int) -> None:
        powers = [2**power for power in range(workers.bit_length())]
        self.modes = tuple(Mode(n, max(1, threads // n)) for n in sorted({*powers, workers}))
        self.mode = self.modes[0]
        self._times_s: dict[Mode, deque[float]] = {mode: deque(maxlen=_KEPT) for mode in self.modes}
        self._rate_hz: float | None = None  # Smoothed, as are the delays of the last image of a burst.
        self._delays_s: dict[Mode, float] = {}
        self._next_s = -math.inf
        self.why = f"{self.mode}: no load measured yet"

    def seed(self, wide_s: float, many_s: float) -> None:
        """Add times that were measured before the first job, in the first and in the last mode."""
        for mode, time_s in ((self.modes[0], wide_s), (self.modes[-1], many_s)):
            if time_s > 0:
                self._times_s[mode].append(time_s)

    def took(self, mode: Mode, time_s: float) -> None:
        """Add the time of a job, unless its mode is a former one."""
        if mode in self._times_s:
            self._times_s[mode].append(time_s)

    def update(self, now_s: float, load: Load) -> bool:
        """Choose again, if due; return True if the mode has changed."""
        wide, many = self.modes[0], self.modes[-1]
        if now_s < self._next_s or not (self._times_s[wide] and self._times_s[many]):
            return False
        if wide == many:
            self.why = f"{wide}: the only mode"
            return False
        rate_hz, arrivals_s = load.recent(now_s)
        if not arrivals_s:
            return False
        self._next_s = now_s + _POLL_INTERVAL_S
        times_s = {mode: self._time_s(mode) for mode in self.modes}
        self._rate_hz = _smoothed(self._rate_hz, rate_hz)
        for mode, time_s in times_s.items():
            delay_s = _delay_s(arrivals_s, mode.at_once, time_s, apart_s=times_s[wide])
            self._delays_s[mode] = _smoothed(self._delays_s.get(mode), delay_s)
        before, self.mode = self.mode, self._best(self._rate_hz, times_s)
        busy = self._rate_hz * times_s[wide]
        self.why = (
            f"{self.mode}: {self._rate_hz:.0f} measurements/s keep all cores busy {busy:.0%} of the time one by one "
            f"({1e3 * times_s[wide]:.1f} ms each); delay of the last image of a burst: "
            + ", ".join(f"{1e3 * self._delays_s[mode]:.1f} ms {mode}" for mode in self.modes)
        )
        return self.mode != before

    def _best(self, rate_hz: float, times_s: dict[Mode, float]) -> Mode:
        """Return the mode that delivers the last image of a burst soonest, of those that can keep up with the load."""

        def keeps_up(mode: Mode) -> bool:
            limit = _CALM if mode.at_once < self.mode.at_once else _BUSY
            return rate_hz * times_s[mode] < limit * mode.at_once

        able = [mode for mode in self.modes if keeps_up(mode)]
        if not able:
            slowness_s = {mode: times_s[mode] / mode.at_once for mode in self.modes}
        elif self.mode in able:
            slowness_s = {mode: self._delays_s[mode] for mode in able}
        else:
            return min(able, key=self._delays_s.__getitem__)
        best = min(slowness_s, key=slowness_s.__getitem__)
        return best if _GAIN * slowness_s[best] < slowness_s[self.mode] else self.mode

    def _time_s(self, mode: Mode) -> float:
        """Return the median time of a job in a mode, by Amdahl's law if there was none."""
        if self._times_s[mode]:
            return statistics.median(self._times_s[mode])
        wide, many = self.modes[0], self.modes[-1]
        wide_s, many_s = (statistics.median(self._times_s[each]) for each in (wide, many))
        if wide.threads == many.threads:
            return many_s
        return wide_s + (many_s - wide_s) * (1 / mode.threads - 1 / wide.threads) / (
            1 / many.threads - 1 / wide.threads
        )


def _smoothed(before: float | None, now: float) -> float:
    return now if before is None else before + _WEIGHT * (now - before)


def _delay_s(arrivals_s: Sequence[float], at_once: int, time_s: float, *, apart_s: float) -> float:
    """Return the mean delay of the last image of bursts more than apart_s apart, by a replay of arrivals."""
    free_s = [-math.inf] * at_once
    total_s = slowest_s = 0.0
    n_burst, previous_s = 0, -math.inf
    for arrival_s in arrivals_s:
        if arrival_s - previous_s > apart_s:
            total_s += n_burst * slowest_s
            n_burst, slowest_s = 0, 0.0
        done_s = max(arrival_s, free_s[0]) + time_s
        heapq.heapreplace(free_s, done_s)
        n_burst, slowest_s, previous_s = n_burst + 1, max(slowest_s, done_s - arrival_s), arrival_s
    return (total_s + n_burst * slowest_s) / len(arrivals_s)
