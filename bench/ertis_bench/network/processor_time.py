"""Processor time of processes by kind of thread; Linux only, and zero elsewhere."""

import sys
import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

__all__ = ["ProcessorTime"]

_OTHERS = "other threads"
_SCHEDULER = 2  # Kind of clock, in nanoseconds.
_ZMQ = "ZMQbg"  # Beginning of the names of ZeroMQ's threads, which encrypt, decrypt, send and receive.


class ProcessorTime:
    """Processor time that processes use from now on."""

    def __init__(self, processes: Mapping[str, Sequence[int]]) -> None:
        self._processes = processes
        self._begun = {name: _times_ns(pids) for name, pids in processes.items()}
        self._begun_s = time.monotonic()

    def percent(self) -> dict[str, float]:
        """Return the share of a core that each process has used since the start, in percent."""
        lasted_ns = 1e9 * (time.monotonic() - self._begun_s)
        return {name: 100 * sum(times.values()) / lasted_ns for name, times in self._since().items()}

    def rows(self, n_measurements: float) -> list[tuple[str, str, float]]:
        """Return process, kind of thread, and processor time in ms per measurement."""
        return [
            (name, kind, time_ns / 1e6 / max(1, n_measurements))
            for name, times in self._since().items()
            for kind, time_ns in times.items()
        ]

    def _since(self) -> dict[str, dict[str, int]]:
        return {
            name: {kind: time_ns - self._begun[name].get(kind, 0) for kind, time_ns in _times_ns(pids).items()}
            for name, pids in self._processes.items()
        }


def _times_ns(pids: Sequence[int]) -> dict[str, int]:
    """Return the processor time of all threads of some processes, by kind of thread; other threads may have ended."""
    found: dict[str, int] = defaultdict(int)
    for pid in pids:
        known_ns = 0
        for thread in Path(f"/proc/{pid}/task").glob("[0-9]*"):
            try:
                name = (thread / "comm").read_text("utf-8")
                used_ns = int((thread / "schedstat").read_text("ascii").split()[0])
            except (OSError, IndexError):  # The thread has ended meanwhile.
                continue
            kind = _kind(name, is_main=thread.name == str(pid))
            if kind != _OTHERS:
                found[kind] += used_ns
                known_ns += used_ns
        with suppress(OSError):  # The process has ended meanwhile, or the system has no such times.
            found[_OTHERS] += max(0, _used_ns(pid) - known_ns)
    return dict(found)


def _used_ns(pid: int) -> int:
    """Return the processor time of a process, including its threads that have ended."""
    return time.clock_gettime_ns(~pid << 3 | _SCHEDULER) if sys.platform == "linux" else 0  # clock_getcpuclockid(3)


def _kind(name: str, *, is_main: bool) -> str:
    if is_main:
        return "main thread"
    return "ZeroMQ threads" if name.startswith(_ZMQ) else _OTHERS
