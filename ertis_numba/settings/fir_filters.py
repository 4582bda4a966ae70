"""Own FIR filters of the signals, which processing combines with the matched filter."""

import math
from collections.abc import Mapping
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError

__all__ = ["FILTERS", "MAX_FILTER_TAPS", "FirFilters", "check_taps"]

FILTERS: Final = ("pre_filter", "post_filter")
"""Keys of own filters in the order in which they apply."""

MAX_FILTER_TAPS = 1024
"""Limit on the taps of a filter."""
_LARGEST_TAP = 1e6


class FirFilters(NamedTuple):
    """FIR filters that follow one another, without the delay of half of their length."""

    rate_hz: float
    taps: tuple[tuple[float, ...], ...]

    @classmethod
    def of(cls, given: Mapping[str, str | tuple[float, ...]], *, rate_hz: float) -> Self | None:
        """Return the filters of some keys; None if all are empty; raise if the file of one has not been read."""
        taps: list[tuple[float, ...]] = []
        for name, value in given.items():
            if isinstance(value, str):
                raise ArgumentError(
                    f"processing.{name} is the file {value!r}, which has not been read; set its taps, or read the "
                    "settings by Settings.load"
                )
            taps += [value] if value else []
        return cls(rate_hz, tuple(taps)) if taps else None

    @property
    def half_length_s(self) -> float:
        """Half of the duration of the combined filter in seconds, by which it extends signals on either side."""
        return sum(len(each) - 1 for each in self.taps) / (2 * self.rate_hz)

    def response(self, frequency_hz: NDArray[np.floating]) -> NDArray[np.complex128]:
        """Return the combined gain: (frequency,).

        ``F(f) = Π Σ_k h_k exp(-2πi f (k − (n − 1) / 2) / rate)`` over the filters of n taps h.
        """
        turn = np.exp(-2j * math.pi * frequency_hz / self.rate_hz)
        gain: NDArray[np.complex128] = np.ones(len(frequency_hz), dtype=np.complex128)
        for taps in self.taps:
            gain *= np.polynomial.polynomial.polyval(turn, np.array(taps)) * turn ** (-(len(taps) - 1) / 2)
        return gain


def check_taps(name: str, taps: tuple[float, ...]) -> None:
    """Refuse filters that are too long, without sound, or not finite."""
    if len(taps) > MAX_FILTER_TAPS:
        raise ArgumentError(f"{name} has {len(taps)} taps; the limit is {MAX_FILTER_TAPS}")
    for place, tap in enumerate(taps):
        checks.between(f"{name}[{place}]", tap, -_LARGEST_TAP, _LARGEST_TAP)
    if taps and not any(taps):
        raise ArgumentError(f"{name} contains only 0; choose other taps, or leave it out")
