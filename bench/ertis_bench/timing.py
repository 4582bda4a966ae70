"""Fair timing of several functions."""

import gc
import time
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

__all__ = ["BURST", "in_words", "round_robin", "summary"]

_WARM_UP = 3  # minimum number of warm-up calls
# Minimum time of warm-up calls. After other work, threads need about a hundred short calls to settle on cores.
_WARM_UP_S = 0.2
BURST = 100  # consecutive calls, as in a stream


def round_robin(
    subjects: Mapping[str, Callable[[], object]], *, count: int, burst: int = BURST
) -> dict[str, NDArray[np.float64]]:
    """Return the times of ``count`` calls of each subject in milliseconds: (call,) float64 each.

    Subjects take turns of ``burst`` calls, so that temporary slowdowns of the machine affect all of them. The first
    calls of each turn are not counted, and the garbage collector is off.
    """
    times_ms: dict[str, list[float]] = {name: [] for name in subjects}
    collecting = gc.isenabled()
    gc.disable()
    try:
        for begin in range(0, count, burst):
            for name, subject in subjects.items():
                _warm_up(subject)
                for _ in range(begin, min(begin + burst, count)):
                    start_ns = time.perf_counter_ns()
                    subject()
                    times_ms[name].append((time.perf_counter_ns() - start_ns) / 1e6)
    finally:
        if collecting:
            gc.enable()
    return {name: np.asarray(times) for name, times in times_ms.items()}


def _warm_up(subject: Callable[[], object]) -> None:
    end_s = time.perf_counter() + _WARM_UP_S
    done = 0
    while done < _WARM_UP or time.perf_counter() < end_s:
        subject()
        done += 1


def summary(times_ms: NDArray[np.float64]) -> dict[str, float]:
    """Return mean, standard deviation and median, rounded to microseconds."""
    return {
        "mean_ms": round(float(np.mean(times_ms)), 3),
        "std_ms": round(float(np.std(times_ms)), 3),
        "median_ms": round(float(np.median(times_ms)), 3),
    }


def in_words(*, mean_ms: float, std_ms: float, median_ms: float, **_: object) -> str:
    """Return the statistics of `summary` as text."""
    return f"{mean_ms:.2f} ± {std_ms:.2f} ({median_ms:.2f})"
