"""Interface of signal chains, the imaging methods of a pipeline."""

from collections.abc import Iterable
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.geometry import Grid

__all__ = ["Chain"]


class Chain(Protocol):
    """Signal chain. It computes its tables once, and several threads may use it at the same time."""

    @property
    def grid(self) -> Grid:
        """Direction axis of the image."""
        ...

    @property
    def range_m(self) -> NDArray[np.float64]:
        """Range axis of the image in metres: (range,) float64."""
        ...

    def process(
        self,
        words: NDArray[np.unsignedinteger[Any]],
        out: NDArray[np.float32],
        *,
        threads: int | None = None,
        grid: Grid | None = None,
    ) -> None:
        """Compute the image ``out`` (direction, range) of ``words``; ``grid`` has as many directions for level ones."""
        ...

    def process_batch(
        self, words: Iterable[NDArray[np.unsignedinteger[Any]]], outs: Iterable[NDArray[np.float32]]
    ) -> None:
        """Compute the images of several measurements, in parallel if that is faster; parameters as for `process`."""
        ...

    def warm_up(self, words: NDArray[np.unsignedinteger[Any]]) -> None:
        """Compile or load kernels and allocate buffers before a stream starts; ``words`` hold silence."""
        ...

    def new_image(self) -> NDArray[np.float32]:
        """Return an uninitialised array for an image: (direction, range) float32."""
        ...

    def close(self) -> None:
        """Free the memory of the chain on its device."""
        ...
