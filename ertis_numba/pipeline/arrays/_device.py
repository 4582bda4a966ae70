"""One call: conversions of its arguments, and kernels, memory and lane of its device."""

import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ertis_numba import kernels
from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError

__all__ = ["DeviceCall", "band_of", "numbers_of", "on_device", "require_no_integers"]


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


def band_of(name: str, band_hz: tuple[float, float], rate_hz: float = math.inf) -> tuple[float, float]:
    low_hz, high_hz = numbers_of(name, band_hz, (2,)).tolist()
    if not 0 <= low_hz < high_hz:
        raise ArgumentError(f"{name} is {low_hz:g} to {high_hz:g} Hz; use 0 <= low < high")
    if high_hz > rate_hz / 2:
        raise ArgumentError(
            f"{name} ends at {high_hz:g} Hz, above half of sample_rate_hz, {rate_hz / 2:g} Hz; correct one of them"
        )
    return low_hz, high_hz


def numbers_of(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    try:
        given = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"{name} holds no array of numbers ({error}); pass numbers of shape {shape}") from error
    checks.shape(name, given.shape, shape)
    checks.finite_array(name, given)
    return given


def require_no_integers(name: str, given: NDArray[Any]) -> None:
    """Refuse integer samples, whose full scale is unknown."""
    if given.dtype.kind in "iu":
        raise ArgumentError(
            f"{name} holds {given.dtype}, whose full scale is unknown; divide by it, as in samples / 32768 for 16 bits"
        )
