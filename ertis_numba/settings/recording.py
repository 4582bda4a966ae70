"""Record of a measurement, and the air that it is taken in."""

from typing import Annotated, Literal

from ertis_numba.base.constants import (
    ERTIS_PDM_RATE_HZ,
    STANDARD_HUMIDITY_PERCENT,
    STANDARD_PRESSURE_PA,
    STANDARD_TEMPERATURE_C,
)
from ertis_numba.settings.documents import TomlTable
from ertis_numba.settings.limits import Limits

__all__ = ["DEFAULT_SAMPLES", "ENCODINGS", "Air", "Recording"]

_MAX_SAMPLES = 2**28  # a minute of ultrasound; indices stay within 32 bits
DEFAULT_SAMPLES = 163_840
"""Samples of one measurement in RTIS."""

ENCODINGS = ("pdm", "int16", "float32")
"""Encodings of microphone data: one-bit PDM, or PCM of two types."""


class Recording(TomlTable, frozen=True, kw_only=True):
    """Record of one measurement: rate, length and encoding.

    Attributes
    ----------
    sample_rate_hz : float, default 4500000
        PDM clock or PCM rate in hertz.
    n_samples : int, default 163840
        Samples of each microphone in one measurement.
    encoding : {"pdm", "int16", "float32"}, default "pdm"
        ``pdm``: one bit per microphone and sample, packed into words. ``int16`` and ``float32``: PCM, one number per
        microphone and sample; full scale is 32768 or 1.
    """

    sample_rate_hz: Annotated[float, Limits(1e3, 1e9)] = ERTIS_PDM_RATE_HZ
    n_samples: Annotated[int, Limits(1, _MAX_SAMPLES)] = DEFAULT_SAMPLES
    encoding: Literal["pdm", "int16", "float32"] = "pdm"

    @property
    def duration_s(self) -> float:
        """Duration of one measurement in seconds."""
        return self.n_samples / self.sample_rate_hz

    @property
    def full_scale(self) -> float:
        """Value of the data that becomes 1 in signals: 32768 for int16, otherwise 1."""
        return 32_768.0 if self.encoding == "int16" else 1.0

    @property
    def is_pdm(self) -> bool:
        """True if the data are one-bit PDM."""
        return self.encoding == "pdm"


class Air(TomlTable, frozen=True, kw_only=True):
    """Air, which determines the speed of sound.

    Attributes
    ----------
    temperature_c : float, default 20
        Temperature in degrees Celsius.
    humidity_percent : float, default 50
        Relative humidity in percent.
    pressure_pa : float, default 101325
        Air pressure in pascals.
    """

    temperature_c: Annotated[float, Limits(-40.0, 60.0)] = STANDARD_TEMPERATURE_C
    humidity_percent: Annotated[float, Limits(0.0, 100.0)] = STANDARD_HUMIDITY_PERCENT
    pressure_pa: Annotated[float, Limits(10_000.0, 200_000.0)] = STANDARD_PRESSURE_PA
