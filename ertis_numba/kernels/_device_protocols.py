"""Protocols of a device besides its kernels: memory for a pipeline, and lanes for its measurements."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

__all__ = ["Array", "Lane", "Memory", "NewMemory", "Threads"]

Array = TypeVar("Array", bound=NDArray[Any])


class Lane(Protocol):
    """Queue that processes one measurement at a time, in order: copy samples in, run kernels, copy the image out."""

    stream: Any
    """Stream of the GPU; None on the host."""

    def entered(self) -> AbstractContextManager[None]:
        """Run the enclosed kernels of this Python thread on this lane."""
        ...

    def send(self, array: Array) -> Array:
        """Start to copy an array to the device; a later array of the same shape and type overwrites the copy."""
        ...

    def target(self, out: Array) -> Array:
        """Return the device array that `fetch` copies to ``out``, shared by arrays of the same shape and type."""
        ...

    def run(self, steps: Callable[[], None]) -> None:
        """Start ``steps``, which must use the same arrays at each call; a lane may record and replay them."""
        ...

    def fetch(self, array: Array, out: Array) -> None:
        """Start to copy an array of the device, such as the result of `target`, to ``out``."""
        ...

    def wait(self) -> None:
        """Block until all operations on this lane are complete."""
        ...


class Memory(Protocol):
    """Memory of one pipeline on the device; any method raises DeviceError if the device has too little."""

    n_lanes: int
    """Number of lanes that keep the device busy; 1 if more are not faster."""

    def table(self, array: Array) -> Array:
        """Return ``array`` on the device. Callers must not modify it afterwards."""
        ...

    def zeros(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return a new array of zeros on the device."""
        ...

    def image(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return an unused, uninitialised array of the host to which `Lane.fetch` is fast."""
        ...

    def lane(self) -> Lane:
        """Return a new lane."""
        ...

    def close(self) -> None:
        """Free all unreferenced memory immediately."""
        ...


class NewMemory(Protocol):
    """Creates the memory of a pipeline."""

    # With `graphs`, `Lane.run` records its steps and replays them; an ArgumentError on devices without graphs.

    def __call__(self, *, graphs: bool | None = None) -> Memory: ...


class Threads(Protocol):
    """Run the enclosed kernels of this Python thread on ``count`` threads, at most `KernelSet.max_threads`."""

    def __call__(self, count: int) -> AbstractContextManager[None]: ...
