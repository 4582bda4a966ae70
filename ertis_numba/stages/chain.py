"""What every method of making an image offers to the pipeline."""

from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry import Grid

__all__ = ["Chain"]


class Chain(Protocol):
    """A signal chain with tables made once, which several threads may use at a time."""

    @property
    def grid(self) -> Grid:
        """The direction axis of the image."""
        ...

    @property
    def range_m(self) -> NDArray[np.float64]:
        """The range axis of the image: (range,) float64."""
        ...

    def process(
        self, words: NDArray[np.unsignedinteger[Any]], out: NDArray[np.float32], *, threads: int | None = None
    ) -> None:
        """Fill ``out``, (direction, range) float32, from ``words``, (sample, word), on as many threads or the usual."""
        ...

    def process_batch(
        self, words: Iterable[NDArray[np.unsignedinteger[Any]]], outs: Iterable[NDArray[np.float32]]
    ) -> None:
        """Do as `process` for several measurements, at the same time where that is faster."""
        ...

    def warm_up(self, words: NDArray[np.unsignedinteger[Any]]) -> None:
        """Compile or load kernels and make buffers now rather than amid a stream; ``words`` are of silence."""
        ...

    def new_image(self) -> NDArray[np.float32]:
        """Return an array for an image, (direction, range), that holds anything."""
        ...

    def close(self) -> None:
        """Give back what the chain keeps on its device."""
        ...
