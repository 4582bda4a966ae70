"""Sweeps as curves of group delay over frequency, independent of the settings of a call."""

import math
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from ertis_numba.settings import Call

__all__ = ["MODULATIONS", "Curve", "Modulation", "Sweep", "curve_of"]

Modulation = Literal["linear", "exponential", "hyperbolic"]
MODULATIONS: Final[tuple[Modulation, ...]] = ("linear", "exponential", "hyperbolic")
_MIN_PRODUCT: Final = 3.0  # Product of bandwidth and duration of a sweep; a pulse of a tone has about 1.
_MAX_TONE_HZ: Final = 4e3  # Bandwidth of a pulse of a tone.


@dataclass(frozen=True, slots=True)
class Curve:
    """Group delay of a sweep, whose frequency, its logarithm or its inverse is linear in time."""

    modulation: Modulation
    slope_s_hz: float
    pivot_hz: float

    def delay_s(self, frequency_hz: NDArray[np.float64] | float) -> NDArray[np.float64]:
        """Return the group delay in seconds: same shape as the frequencies."""
        frequency_hz, pivot_hz = np.asarray(frequency_hz, dtype=np.float64), self.pivot_hz
        if self.modulation == "linear":
            return np.asarray(self.slope_s_hz * (frequency_hz - pivot_hz))
        if self.modulation == "exponential":
            return np.asarray(self.slope_s_hz * pivot_hz * np.log(frequency_hz / pivot_hz))
        return np.asarray(self.slope_s_hz * pivot_hz * (1 - pivot_hz / frequency_hz))

    def phase_rad(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the phase of the matched filter, which is 2π times the integral of the group delay."""
        span_hz, ratio = frequency_hz - self.pivot_hz, frequency_hz / self.pivot_hz
        if self.modulation == "linear":
            return np.asarray(math.pi * self.slope_s_hz * span_hz**2)
        scale = 2 * math.pi * self.slope_s_hz * self.pivot_hz
        if self.modulation == "exponential":
            return np.asarray(scale * (frequency_hz * np.log(ratio) - span_hz))
        return np.asarray(scale * (span_hz - self.pivot_hz * np.log(ratio)))

    def slopes_s_hz(self, frequency_hz: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the derivative of the group delay at each frequency."""
        power = MODULATIONS.index(self.modulation)
        return np.asarray(self.slope_s_hz * (self.pivot_hz / frequency_hz) ** power)


@dataclass(frozen=True, slots=True)
class Sweep:
    """Sweep in a record, without its ramps."""

    modulation: Modulation
    start_hz: float
    stop_hz: float
    duration_s: float

    @classmethod
    def of_curve(cls, curve: Curve, low_hz: float, high_hz: float) -> "Sweep":
        """Return the sweep that follows a curve between two frequencies."""
        delay_s = float(curve.delay_s(high_hz) - curve.delay_s(low_hz))
        ends = (low_hz, high_hz) if delay_s >= 0 else (high_hz, low_hz)
        return cls(curve.modulation, *ends, abs(delay_s))

    @classmethod
    def of_call(cls, call: Call) -> "Sweep":
        """Return a call as a sweep."""
        return cls(call.modulation, call.start_frequency_hz, call.stop_frequency_hz, call.duration_s)

    @property
    def low_hz(self) -> float:
        """Lowest frequency in hertz."""
        return min(self.start_hz, self.stop_hz)

    @property
    def high_hz(self) -> float:
        """Highest frequency in hertz."""
        return max(self.start_hz, self.stop_hz)

    @property
    def is_compressible(self) -> bool:
        """False for pulses of a tone and for clicks, which have no curve."""
        return abs(self.stop_hz - self.start_hz) * self.duration_s > _MIN_PRODUCT

    @property
    def is_tone(self) -> bool:
        """True for a pulse of a tone."""
        return not self.is_compressible and self.high_hz - self.low_hz < _MAX_TONE_HZ

    @property
    def band(self) -> str:
        """Text of the band, such as ``20 to 80 kHz``."""
        return f"{self.low_hz / 1e3:.0f} to {self.high_hz / 1e3:.0f} kHz"

    def __str__(self) -> str:
        if self.is_tone:
            return f"pulses of a tone of about {(self.low_hz + self.high_hz) / 2e3:.0f} kHz"
        article = "a" if self.modulation != "exponential" else "an"
        ends = f"{self.start_hz / 1e3:.0f} to {self.stop_hz / 1e3:.0f} kHz"
        return f"{article} {self.modulation} sweep from about {ends} in {1e3 * self.duration_s:.2g} ms"


def curve_of(call: Call) -> Curve | None:
    """Return the curve of a call; None for a custom waveform."""
    if call.waveform is not None:
        return None
    pivot_hz = math.sqrt(call.start_frequency_hz * call.stop_frequency_hz)
    modulation: Modulation = call.modulation
    unit = Curve(modulation, 1.0, pivot_hz)
    extent_s = float(unit.delay_s(call.stop_frequency_hz) - unit.delay_s(call.start_frequency_hz))
    return Curve(modulation, call.duration_s / extent_s, pivot_hz)
