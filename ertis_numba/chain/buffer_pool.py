"""Buffers of the measurements that a chain processes at the same time."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.base.forks import call_in_forks
from ertis_numba.chain.beamform import Buffers
from ertis_numba.kernels import Lane, fft

__all__ = ["BufferPool", "MeasurementBuffers"]


class MeasurementBuffers(NamedTuple):
    """Buffers of one measurement in progress."""

    lane: Lane
    room: tuple[NDArray[np.float32], ...]
    signals: NDArray[np.float32]
    analytic: NDArray[np.complex64]
    transforms: fft.Transforms
    beamform: Buffers


class BufferPool:
    """Pool of buffers; it grows to the largest number of measurements in progress at the same time."""

    def __init__(self) -> None:
        self._spare: list[MeasurementBuffers] = []
        self._closed = False
        self._forget_threads()
        call_in_forks(self._forget_threads)

    def _forget_threads(self) -> None:
        self._change = threading.Condition()
        self._n_busy = 0

    @contextmanager
    def acquired(self, make: Callable[[], MeasurementBuffers]) -> Iterator[MeasurementBuffers]:
        """Run the enclosed code with buffers that no other thread uses; call `release` after the lane has finished."""
        with self._change:
            if self._closed:
                raise ArgumentError("the pipeline is closed; create another one")
            buffers = self._spare.pop() if self._spare else None
            self._n_busy += 1
        try:
            yield make() if buffers is None else buffers
        except BaseException:
            self.release(None)
            raise

    def release(self, buffers: MeasurementBuffers | None) -> None:
        """Release acquired buffers to the pool; None stands for discarded ones."""
        with self._change:
            if buffers is not None:
                self._spare.append(buffers)
            self._n_busy -= 1
            self._change.notify_all()

    def close(self) -> None:
        """Wait until no buffers are in use, then free all."""
        with self._change:
            self._closed = True
            self._change.wait_for(lambda: not self._n_busy)
            self._spare.clear()
