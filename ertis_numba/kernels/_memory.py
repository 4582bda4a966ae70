"""What a device offers besides kernels: memory for a pipeline, and lanes for its measurements."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

__all__ = ["Array", "Lane", "Memory", "NewMemory", "Threads"]

Array = TypeVar("Array", bound=NDArray[Any])


class Lane(Protocol):
    """The way of one measurement after the other through the device: words in, kernels, image out.

    What is begun on one lane runs in order. Lanes run beside each other where the device can.
    """

    stream: Any
    """What libraries call a lane: a stream of the GPU; None on the host."""

    def entered(self) -> AbstractContextManager[None]:
        """Run the enclosed kernels of this Python thread on this lane."""
        ...

    def send(self, array: Array) -> Array:
        """Begin to bring an array of the host to where kernels read it; a later one of its kind takes its place."""
        ...

    def target(self, out: Array) -> Array:
        """Return where kernels write what `fetch` brings to ``out``; another of its kind gets the same place."""
        ...

    def run(self, steps: Callable[[], None]) -> None:
        """Begin ``steps``, which use the same arrays each time: a lane may record them once and play them again."""
        ...

    def fetch(self, array: Array, out: Array) -> None:
        """Begin to bring what `target` returned, or any array of the device, to ``out``."""
        ...

    def wait(self) -> None:
        """Return when all that was begun is done."""
        ...


class Memory(Protocol):
    """What one pipeline keeps where its kernels run.

    Raises
    ------
    DeviceError
        From any of its methods: the device has too little memory.
    """

    n_lanes: int
    """Lanes that keep the device busy; 1 where more would not."""

    def table(self, array: Array) -> Array:
        """Return ``array`` where kernels read it. It is not to be changed from now on."""
        ...

    def zeros(self, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        """Return a new array where kernels read and write it."""
        ...

    def image(self, shape: tuple[int, int]) -> NDArray[np.float32]:
        """Return an array of the host that nobody else looks at, into which `Lane.fetch` is fast; it holds anything."""
        ...

    def lane(self) -> Lane:
        """Return a new lane."""
        ...

    def close(self) -> None:
        """Give back at once what nothing refers to any more."""
        ...


class NewMemory(Protocol):
    """Makes the memory of a pipeline; with ``graphs`` its lanes record what they run.

    Raises
    ------
    ArgumentError
        The device has no graphs.
    """

    def __call__(self, *, graphs: bool = False) -> Memory: ...


class Threads(Protocol):
    """Run the enclosed kernels of this Python thread on ``count`` threads.

    Raises
    ------
    ArgumentError
        There are fewer.
    """

    def __call__(self, count: int) -> AbstractContextManager[None]: ...
