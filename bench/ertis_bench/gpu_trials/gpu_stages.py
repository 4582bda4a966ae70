"""Duration of each stage of the chain on a GPU, measured with the GPU's own clock."""

import dataclasses
import functools
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_bench.plans import BEAMFORMING_KERNELS
from ertis_numba import kernels
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.kernels import KernelSet, Lane, Memory
from ertis_numba.kernels.benchmarks.ceilings_of_cuda import occupy
from ertis_numba.kernels.benchmarks.stopwatch import Stopwatch
from ertis_numba.settings import Settings

__all__ = ["STAGES", "TRANSFERS", "stages"]

TRANSFERS = ("upload", "download")
STAGES = (
    "upload",
    "demodulate",
    "forward transforms",
    "multiply and fold",
    "inverse transforms",
    "delay-and-sum with envelope",
    "download",
)


def stages(settings: Settings, words: NDArray[Any], *, count: int) -> dict[str, Any]:
    """Return the median duration of each stage, for one measurement at a time on an otherwise idle GPU.

    All launches wait behind a kernel that keeps the GPU busy for milliseconds. The times therefore exclude the
    processor's time for the launches.

    Parameters
    ----------
    settings : Settings
        Settings with a complete plan.
    words : (sample, word)
    count : int
        Number of measurements. The first two are not counted.

    Returns
    -------
    dict
        ``stages_ms`` by name; their sums with and without ``TRANSFERS``; and ``queued``, True if in every measurement
        all launches were queued while the GPU was still busy.
    """
    watch = _LaunchStopwatch()
    chain = FastChain(settings, _watched(kernels.load("cuda"), watch), threads=1, graphs=False)
    image = chain.new_image()
    times_ms: list[dict[str, float]] = []
    queued = True
    for number in range(count + 2):
        chain.process(words, image)
        found = watch.read_ms()
        busy_ms = found.pop("busy")
        if number >= 2:
            times_ms.append(found)
            queued = queued and watch.launched_ms < busy_ms
    chain.close()
    medians_ms = {name: float(np.median([found.get(name, 0.0) for found in times_ms])) for name in STAGES}
    total_ms = sum(medians_ms.values())
    moved_ms = sum(medians_ms[name] for name in TRANSFERS)
    return {
        "stages_ms": {name: round(value, 4) for name, value in medians_ms.items()},
        "sum_ms": round(total_ms, 4),
        "without_transfers_ms": round(total_ms - moved_ms, 4),
        "queued": queued,
    }


class _LaunchStopwatch(Stopwatch):
    """Stopwatch that also measures the processor's time for all launches."""

    def __init__(self) -> None:
        super().__init__()
        self._begin_s = self._end_s = 0.0

    def start(self) -> None:
        """Remove all marks, and start the measurement."""
        self._begin_s = time.perf_counter()
        super().start()

    def mark(self, name: str) -> None:
        """Mark the end of the part ``name``, which began at the previous mark."""
        super().mark(name)
        self._end_s = time.perf_counter()

    @property
    def launched_ms(self) -> float:
        """Time from the start to the last mark, measured with the processor's clock."""
        return 1e3 * (self._end_s - self._begin_s)


def _watched(kernel_set: KernelSet, watch: _LaunchStopwatch) -> KernelSet:
    """Return kernels that set marks at the end of each stage."""
    before = {"multiply_and_fold": "forward transforms", **dict.fromkeys(BEAMFORMING_KERNELS, "inverse transforms")}
    after = {"demodulate_words": "demodulate", "multiply_and_fold": "multiply and fold"}
    after |= dict.fromkeys(BEAMFORMING_KERNELS, "delay-and-sum with envelope")
    changes: dict[str, Any] = {
        name: functools.partial(_run, getattr(kernel_set, name), watch, before.get(name), end)
        for name, end in after.items()
    }
    return dataclasses.replace(kernel_set, memory=functools.partial(_TimedMemory, kernel_set.memory, watch), **changes)


def _run(kernel: Callable[..., None], watch: _LaunchStopwatch, before: str | None, after: str, *arguments: Any) -> None:
    if before:
        watch.mark(before)
    kernel(*arguments)
    watch.mark(after)


class _TimedMemory:
    """Memory of the device whose lanes set marks."""

    def __init__(self, make: Callable[..., Memory], watch: _LaunchStopwatch, *, graphs: bool | None = None) -> None:
        self._memory, self._watch = make(graphs=graphs), watch

    def __getattr__(self, name: str) -> Any:
        return getattr(self._memory, name)

    def lane(self) -> Any:
        return _TimedLane(self._memory.lane(), self._watch, self._memory.zeros((32,), np.float32))


class _TimedLane:
    """Lane that is kept busy before the words are sent, and that sets marks at both transfers."""

    def __init__(self, lane: Lane, watch: _LaunchStopwatch, sums: NDArray[np.float32]) -> None:
        self._lane, self._watch, self._sums = lane, watch, sums

    def __getattr__(self, name: str) -> Any:
        return getattr(self._lane, name)

    def send(self, array: NDArray[Any]) -> NDArray[Any]:
        self._watch.start()
        occupy(self._sums)
        self._watch.mark("busy")
        here = self._lane.send(array)
        self._watch.mark("upload")
        return here

    def fetch(self, array: NDArray[Any], out: NDArray[Any]) -> None:
        self._lane.fetch(array, out)
        self._watch.mark("download")
