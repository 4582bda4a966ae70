"""One call on a compute device: its kernels, memory and lane."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks, kernels
from ertis_numba.stages.window import TimeWindow

__all__ = ["DeviceCall", "on_device", "window_from_start"]


class DeviceCall(NamedTuple):
    """Kernels, memory and lane of one call."""

    kernels: kernels.KernelSet
    memory: kernels.Memory
    lane: kernels.Lane
    threads: int

    def fetched(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return a copy of an array of the device on the host."""
        out = np.empty(array.shape, array.dtype)
        self.lane.fetch(array, out)
        self.lane.wait()
        return out


@contextmanager
def on_device(device: str, threads: int | None) -> Iterator[DeviceCall]:
    """Yield a device for one call, and free its memory afterwards."""
    kernel_set = kernels.load(device)
    count = kernel_set.max_threads if threads is None else checks.integer("threads", threads, 1)
    memory = kernel_set.memory()
    try:
        lane = memory.lane()
        with kernel_set.threads(count), lane.entered():
            yield DeviceCall(kernel_set, memory, lane, count)
    finally:
        memory.close()


def window_from_start(*, n_samples: int, n_fft: int, n_outputs: int) -> TimeWindow:
    """Return a window that begins at sample 0."""
    return TimeWindow(
        range_m=np.zeros(0),
        first_sample=0,
        n_samples=n_samples,
        n_fft=n_fft,
        n_outputs=n_outputs,
        lead=0,
        start_s=0.0,
    )
