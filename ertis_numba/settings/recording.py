"""Record of a measurement, and the air that it is taken in."""

from typing import Literal

from ertis_numba.base import checks
from ertis_numba.base.constants import (
    ERTIS_PDM_RATE_HZ,
    STANDARD_HUMIDITY_PERCENT,
    STANDARD_PRESSURE_PA,
    STANDARD_TEMPERATURE_C,
)
from ertis_numba.settings.documents import TomlTable

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
        PDM clock or PCM rate in hertz, 1000 to 1e9.
    n_samples : int, default 163840
        Samples of each microphone in one measurement.
    encoding : {"pdm", "int16", "float32"}, default "pdm"
        ``pdm``: one bit per microphone and sample, packed into words. ``int16`` and ``float32``: PCM, one number per
        microphone and sample; full scale is 32768 or 1.
    """

    sample_rate_hz: float = ERTIS_PDM_RATE_HZ
    n_samples: int = DEFAULT_SAMPLES
    encoding: Literal["pdm", "int16", "float32"] = "pdm"

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.choice("recording.encoding", self.encoding, ENCODINGS)
        checks.between("recording.sample_rate_hz", self.sample_rate_hz, 1e3, 1e9)
        checks.integer("recording.n_samples", self.n_samples, 1, _MAX_SAMPLES)

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
        Temperature in degrees Celsius, -40 to 60.
    humidity_percent : float, default 50
        Relative humidity in percent, 0 to 100.
    pressure_pa : float, default 101325
        Air pressure in pascals, 10000 to 200000.
    """

    temperature_c: float = STANDARD_TEMPERATURE_C
    humidity_percent: float = STANDARD_HUMIDITY_PERCENT
    pressure_pa: float = STANDARD_PRESSURE_PA

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.between("air.temperature_c", self.temperature_c, -40.0, 60.0)
        checks.between("air.humidity_percent", self.humidity_percent, 0.0, 100.0)
        checks.between("air.pressure_pa", self.pressure_pa, 10_000.0, 200_000.0)
