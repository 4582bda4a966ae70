"""Checks and conversions of arguments that several functions share."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError

__all__ = ["band_of", "numbers_of"]


def band_of(name: str, band_hz: tuple[float, float]) -> tuple[float, float]:
    low_hz, high_hz = numbers_of(name, band_hz, (2,)).tolist()
    if not 0 <= low_hz < high_hz:
        raise ArgumentError(f"{name} is {low_hz:g} to {high_hz:g} Hz; use 0 <= low < high")
    return low_hz, high_hz


def numbers_of(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float64]:
    try:
        given = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ArgumentError(f"{name} holds no array of numbers ({error}); pass numbers of shape {shape}") from error
    checks.shape(name, given.shape, shape)
    checks.finite_array(name, given)
    return given
