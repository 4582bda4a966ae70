"""Lanes of the GPU: a stream, and arrays that are allocated once."""

import contextlib
import os
import threading
from collections.abc import Callable, Iterator
from typing import Any

import numba
import numpy as np
from numba import cuda
from numpy.typing import DTypeLike, NDArray

from ertis_numba.base.errors import DeviceError
from ertis_numba.kernels._cuda.copies import Copies
from ertis_numba.kernels._cuda.graph import Graph

__all__ = ["SIMULATED", "Lane", "current", "launch", "require_own_process", "workspace"]

SIMULATED = bool(numba.config.ENABLE_CUDASIM)

numba.config.CUDA_LOW_OCCUPANCY_WARNINGS = 0  # a small image needs only a small grid, so a warning would mislead

_PROCESS_ID = os.getpid()
_MAX_BLOCKS = 65_535  # limit of all axes of a grid except the first

Allocate = Callable[[tuple[int, ...], DTypeLike], Any]


class Lane:
    """Lane of the GPU, which also provides kernels with workspace under unique names. See `kernels.Lane`."""

    # Launches on a stream run in order, so that measurements share the workspace. Without `graphs`, a launch takes 50
    # µs.

    def __init__(
        self,
        stream: Any = 0,
        allocate: Allocate = cuda.device_array,
        pin: Allocate = cuda.pinned_array,
        *,
        graphs: bool = False,
    ) -> None:
        self.stream = stream
        self._allocate, self._pin = allocate, pin
        self._rooms: dict[str, Any] = {}
        self._staged: dict[tuple[tuple[int, ...], str], tuple[NDArray[Any], Any]] = {}
        self._targets: dict[tuple[int, ...], Any] = {}
        on_gpu = bool(stream) and not SIMULATED
        self._graph = Graph(stream) if graphs and on_gpu else None
        self._copies = Copies(stream) if on_gpu else None

    @contextlib.contextmanager
    def entered(self) -> Iterator[None]:
        """Run the enclosed kernels of this Python thread on this lane."""
        before = getattr(_HERE, "lane", None)
        _HERE.lane = self
        try:
            yield
        finally:
            _HERE.lane = before

    def send(self, array: NDArray[Any]) -> Any:
        """Start to copy an array of the host to the device, and return the copy."""
        kind = (array.shape, array.dtype.str)
        if kind not in self._staged:
            # Only copies from pinned memory run concurrently with the kernels of other lanes.
            self._staged[kind] = self._pin(array.shape, array.dtype), self._allocate(array.shape, array.dtype)
        staged, here = self._staged[kind]
        np.copyto(staged, array)
        if self._copies is None:
            here.copy_to_device(staged, stream=self.stream)
        else:
            self._copies.to_device(staged, here)
        return here

    def target(self, out: NDArray[np.float32]) -> Any:
        """Return the array of the device that `fetch` copies to ``out``."""
        if out.shape not in self._targets:
            self._targets[out.shape] = self._allocate(out.shape, out.dtype)
        return self._targets[out.shape]

    def run(self, steps: Callable[[], None]) -> None:
        """Start ``steps``, which must use the same arrays at each call; a lane may record and replay them."""
        if self._graph is None:
            steps()
        else:
            self._graph.run(steps)

    def fetch(self, array: Any, out: NDArray[Any]) -> None:
        """Start to copy an array of the device, such as the result of `target`, to ``out``."""
        if self._copies is None or not (out.flags.c_contiguous and array.is_c_contiguous()):
            array.copy_to_host(out, stream=self.stream)
        else:
            self._copies.to_host(array, out)

    def wait(self) -> None:
        """Block until all operations on this lane are complete."""
        if self.stream:
            self.stream.synchronize()
        else:
            cuda.synchronize()

    def launch(self, kernel: Any, grid: tuple[int, ...], block: tuple[int, ...], *arguments: Any) -> None:
        """Run a kernel on the lane's stream."""
        kernel[grid, block, self.stream](*arguments)

    def room(self, name: str, shape: tuple[int, ...], dtype: DTypeLike) -> Any:
        """Return the array of a given name; a new one replaces it if the shape or the type changes."""
        found = self._rooms.get(name)
        if found is None or found.shape != shape or found.dtype != np.dtype(dtype):
            found = self._rooms[name] = self._allocate(shape, dtype)
        return found


_HERE = threading.local()


def require_own_process() -> None:
    """Raise DeviceError in a forked process, which cannot use the GPU of its parent."""
    if os.getpid() != _PROCESS_ID:
        raise DeviceError(
            "device 'cuda' cannot be used in a process that was forked from one that uses it; create workers with "
            "multiprocessing.get_context('spawn'), and data loaders with multiprocessing_context='spawn'"
        )


def current() -> Lane:
    """Return the lane that this Python thread has entered, or a temporary one on the default stream."""
    return getattr(_HERE, "lane", None) or Lane()


def launch(kernel: Any, grid: tuple[int, ...], block: tuple[int, ...], *arguments: Any) -> None:
    """Launch ``kernel`` with ``grid`` blocks of ``block`` threads, after all earlier launches on this lane."""
    if max(grid[1:], default=0) > _MAX_BLOCKS:
        raise DeviceError(
            f"device 'cuda' would need a grid of {max(grid[1:]):,} blocks; the limit is {_MAX_BLOCKS:,}. "
            "Use a shorter processing.range_m or fewer microphones, or use device 'cpu'"
        )
    if all(grid):  # launching an empty grid would be an error
        current().launch(kernel, grid, block, *arguments)


def workspace(name: str, shape: tuple[int, ...], dtype: DTypeLike) -> Any:
    """Return an uninitialised array of the current lane; see `Lane.room`."""
    return current().room(name, shape, dtype)
