"""Comparison of echoes with the image around them, without tables of all echoes by all others."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Surroundings", "change_db", "envelope", "greatest", "parts"]

Floats = NDArray[np.float64]
_TABLE_SIZE = 2**21  # elements of a paths × paths table that are in memory at a time
_FEW, _MANY = 32, 1024  # numbers that are computed at a time, first and later
_ROUNDED = 1 + 1e-9  # rounding of bounds


@dataclass(frozen=True, slots=True, eq=False)
class Surroundings:
    """Highest amplitudes of an image over all directions, with side lobes of echoes inside and outside the window."""

    # `floor` is that of the weakest reflector, `level` (path,) that of louder echoes; `lobe` is at a lag or beyond.

    floor: float
    level: Floats
    delay_s: Floats
    window_s: tuple[float, float]
    same_s: float
    lobe: Callable[[Floats], Floats]

    def at(self, delay_s: Floats) -> Floats:
        """Return the highest amplitude at the ranges of some delays, at least the floor: (path,) float64."""
        inside_s = np.clip(delay_s, *self.window_s)
        strongest = np.full(len(delay_s), self.floor)
        for part in parts(len(delay_s), len(self.level)):
            apart_s = np.maximum(np.abs(inside_s[part, None] - self.delay_s) - self.same_s, 0.0)
            strongest[part] = np.max(self.level * self.lobe(apart_s), axis=1, initial=self.floor)
        return strongest


def change_db(part: Floats, beside: Floats) -> float:
    """Return the greatest change in decibels of the amplitudes ``beside`` if ``part`` is added; 0 if empty."""
    return float(20 * np.log10(1 + np.max(part / beside, initial=0.0)))


def greatest(bounds: Floats, exact: Callable[[NDArray[np.intp]], Floats]) -> tuple[int, float]:
    """Return index and value of the greatest number, computed only where bounds allow; 0 and 0 if none is positive."""
    order = np.argsort(-bounds, kind="stable")
    bounds = bounds[order] * _ROUNDED
    numbers, first, step = np.zeros(len(order)), 0, _FEW
    while first < len(order) and bounds[first] > 0 and bounds[first] >= numbers.max():
        part = order[first : first + step]
        numbers[part] = exact(part)
        first, step = first + step, min(2 * step, _MANY)
    return (int(np.argmax(numbers)), float(numbers.max())) if len(order) else (0, 0.0)


def envelope(spectra: NDArray[np.inexact[Any]], turns: NDArray[np.complex128]) -> Floats:
    """Return the envelopes of pulses, ``|spectra @ turns|``: (path, time) float64."""
    if np.iscomplexobj(spectra):
        pulses = spectra @ turns
        return np.sqrt(pulses.real**2 + pulses.imag**2)
    return np.sqrt((spectra @ turns.real) ** 2 + (spectra @ turns.imag) ** 2)


def parts(n_rows: int, n_columns: int) -> Iterator[slice]:
    """Yield slices of a table's rows that fit into memory."""
    rows = max(1, _TABLE_SIZE // max(1, n_columns))
    return (slice(first, first + rows) for first in range(0, n_rows, rows))
