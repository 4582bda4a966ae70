"""The emitted sweep."""

from typing import Literal

from ertis_numba import checks
from ertis_numba.documents import Table
from ertis_numba.errors import ArgumentError

__all__ = ["MAX_CALL_SAMPLES", "Call"]

MAX_CALL_SAMPLES = 2**20
"""Limit on the samples of a call, about one second at 1 MHz: files store them, and filters make several copies."""


class Call(Table, frozen=True, kw_only=True):
    """The emitted sweep, with a Hann ramp at both ends.

    Attributes
    ----------
    start_frequency_hz, stop_frequency_hz : float
        First and last instantaneous frequency; eRTIS sweeps downwards.
    duration_s : float
        Length of the call, at least 16 samples and one period of its lowest frequency, at most 1 s.
    sample_rate_hz : float
        Rate of the converter that plays the call.
    ramp_fraction : float
        Share of the call under the Hann ramp at each end, 0 to 0.5.
    modulation : {"hyperbolic", "linear"}
        Whether its period or its frequency goes evenly from first to last. eRTIS is hyperbolic: motion only shifts such
        echoes, where it blurs those of a linear sweep.
    """

    start_frequency_hz: float = 50_000.0
    stop_frequency_hz: float = 25_000.0
    duration_s: float = 2.5e-3
    sample_rate_hz: float = 450_000.0
    ramp_fraction: float = 0.1
    modulation: Literal["hyperbolic", "linear"] = "hyperbolic"

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.positive("call.sample_rate_hz", self.sample_rate_hz)
        for name in ("start_frequency_hz", "stop_frequency_hz"):
            frequency_hz = checks.positive(f"call.{name}", getattr(self, name))
            if frequency_hz >= self.sample_rate_hz / 2:
                raise ArgumentError(
                    f"call.{name} is {frequency_hz:g}; give less than half of call.sample_rate_hz "
                    f"({self.sample_rate_hz:g})"
                )
        if self.start_frequency_hz == self.stop_frequency_hz:
            raise ArgumentError(
                f"call sweeps from {self.start_frequency_hz:g} Hz to itself; give two different frequencies"
            )
        checks.between("call.duration_s", self.duration_s, 16 / self.sample_rate_hz, 1.0)
        if self.duration_s * self.sample_rate_hz > MAX_CALL_SAMPLES:
            raise ArgumentError(
                f"call has {self.duration_s * self.sample_rate_hz:.0f} samples ({self.duration_s:g} s at "
                f"{self.sample_rate_hz:g} Hz); the limit is {MAX_CALL_SAMPLES}. Shorten call.duration_s or lower "
                "call.sample_rate_hz"
            )
        if self.duration_s * self.low_frequency_hz < 1:
            raise ArgumentError(
                f"call.duration_s is {self.duration_s:g}, less than a period of {self.low_frequency_hz:g} Hz; "
                f"give {1 / self.low_frequency_hz:g} or more"
            )
        checks.between("call.ramp_fraction", self.ramp_fraction, 0.0, 0.5)
        checks.choice("call.modulation", self.modulation, ("hyperbolic", "linear"))

    @property
    def low_frequency_hz(self) -> float:
        """Lower edge of the band."""
        return min(self.start_frequency_hz, self.stop_frequency_hz)

    @property
    def high_frequency_hz(self) -> float:
        """Upper edge of the band."""
        return max(self.start_frequency_hz, self.stop_frequency_hz)
