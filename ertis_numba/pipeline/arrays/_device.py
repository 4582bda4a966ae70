"""One call on a compute device: its kernels, memory and lane."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.base import checks

__all__ = ["DeviceCall", "on_device"]


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
