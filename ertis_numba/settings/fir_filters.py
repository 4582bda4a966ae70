"""Own FIR filters of the signals, which processing combines with the matched filter."""

import math
from collections.abc import Mapping
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError

__all__ = ["FILTERS", "MAX_FILTER_TAPS", "FirFilters", "check_taps", "delay_of"]

FILTERS: Final = ("pre_filter", "post_filter")
"""Keys of own filters in the order in which they apply."""

MAX_FILTER_TAPS = 1024
"""Limit on the taps of a filter."""
_LARGEST_TAP = 1e6
_ROUNDING = 1e-9  # Largest difference of equal taps, relative to the largest tap.


class FirFilters(NamedTuple):
    """FIR filters that follow one another, without their delay, which is half of their length for symmetric taps."""

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
        """Longest time by which the combined filter extends signals on either side, in seconds."""
        return sum(max(delay_of(each), len(each) - 1 - delay_of(each)) for each in self.taps) / self.rate_hz

    def response(self, frequency_hz: NDArray[np.floating]) -> NDArray[np.complex128]:
        """Return the combined gain: (frequency,).

        ``F(f) = Π Σ_k h_k exp(-2πi f (k − d) / rate)`` over the filters of taps h with the delay d of `delay_of`.
        """
        turn = np.exp(-2j * math.pi * frequency_hz / self.rate_hz)
        gain: NDArray[np.complex128] = np.ones(len(frequency_hz), dtype=np.complex128)
        for taps in self.taps:
            gain *= np.polynomial.polynomial.polyval(turn, np.array(taps)) * turn ** -delay_of(taps)
        return gain


def delay_of(taps: tuple[float, ...]) -> float:
    """Return the delay of a filter in samples: the mean of its group delay, weighted by the power that it passes."""
    given, rounding = np.array(taps), _ROUNDING * np.max(np.abs(taps))
    if min(np.abs(given - given[::-1]).max(), np.abs(given + given[::-1]).max()) <= rounding:
        return (len(taps) - 1) / 2
    power = given**2  # By Parseval's theorem, the mean of the group delay is the centre of these powers.
    return float(np.arange(len(taps)) @ power / power.sum())


def check_taps(name: str, taps: tuple[float, ...]) -> None:
    """Refuse filters that are too long, without sound, or not finite."""
    if len(taps) > MAX_FILTER_TAPS:
        raise ArgumentError(f"{name} has {len(taps)} taps; the limit is {MAX_FILTER_TAPS}")
    for place, tap in enumerate(taps):
        checks.between(f"{name}[{place}]", tap, -_LARGEST_TAP, _LARGEST_TAP)
    if taps and not any(taps):
        raise ArgumentError(f"{name} contains only 0; choose other taps, or leave it out")
