"""What is recorded, and in which air."""

from typing import Literal

from ertis_numba import checks
from ertis_numba.constants import (
    ERTIS_PDM_RATE_HZ,
    STANDARD_HUMIDITY_PERCENT,
    STANDARD_PRESSURE_PA,
    STANDARD_TEMPERATURE_C,
)
from ertis_numba.documents import TomlTable

__all__ = ["DEFAULT_SAMPLES", "ENCODINGS", "Air", "Recording"]

_MAX_SAMPLES = 2**28  # a minute of ultrasound; positions stay within 32 bits
DEFAULT_SAMPLES = 163_840
"""Of one measurement, as RTIS has it."""

ENCODINGS = ("pdm", "int16", "float32")
"""Forms of what microphones give: bits, or numbers of PCM."""


class Recording(TomlTable, frozen=True, kw_only=True):
    """What is recorded of one measurement: how fast, how much, and in which form.

    Attributes
    ----------
    sample_rate_hz : float
        The PDM clock, or the rate of PCM.
    n_samples : int
        Samples of each microphone in one measurement, in which a word of PDM counts as one.
    encoding : {"pdm", "int16", "float32"}
        ``pdm``: a bit per microphone, packed into words. ``int16`` and ``float32``: PCM, a number per microphone;
        full scale is 32768, or 1.
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
        """Length of one measurement."""
        return self.n_samples / self.sample_rate_hz

    @property
    def full_scale(self) -> float:
        """The number of PCM, or what bits are taken as, that is 1 in signals."""
        return 32_768.0 if self.encoding == "int16" else 1.0

    @property
    def is_pdm(self) -> bool:
        """Whether microphones give bits, which are to be demodulated first."""
        return self.encoding == "pdm"


class Air(TomlTable, frozen=True, kw_only=True):
    """The medium, which sets the speed of sound.

    Attributes
    ----------
    temperature_c : float
        Temperature, -40 to 60.
    humidity_percent : float
        Relative humidity.
    pressure_pa : float
        Air pressure.
    """

    temperature_c: float = STANDARD_TEMPERATURE_C
    humidity_percent: float = STANDARD_HUMIDITY_PERCENT
    pressure_pa: float = STANDARD_PRESSURE_PA

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.between("air.temperature_c", self.temperature_c, -40.0, 60.0)
        checks.between("air.humidity_percent", self.humidity_percent, 0.0, 100.0)
        checks.between("air.pressure_pa", self.pressure_pa, 10_000.0, 200_000.0)
