"""Sound sources other than echoes: tones, noise, other sonars and ambient noise."""

from ertis_numba import checks
from ertis_numba.documents import TomlTable
from ertis_numba.errors import ArgumentError
from ertis_numba.settings import Call
from ertis_numba.simulation.trajectory import Placed

__all__ = ["Ambient", "Noise", "Sonar", "Tone"]

_HIGHEST_HZ = 1e6


class Tone(Placed, frozen=True, kw_only=True):
    """Steady tone, for example of a switching power supply or a leaking valve.

    Attributes
    ----------
    frequency_hz : float
        Frequency in hertz.
    level_db : float
        Amplitude at 1 m in decibels relative to full scale; −60 by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Tone
    >>> Tone(frequency_hz=40e3, range_m=2.0).level_db
    -60.0
    """

    frequency_hz: float
    level_db: float = -60.0

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.between("tone.frequency_hz", self.frequency_hz, 1.0, _HIGHEST_HZ)
        checks.between("tone.level_db", self.level_db, -300.0, 60.0)


class Noise(Placed, frozen=True, kw_only=True):
    """Source of broadband noise, for example of compressed air.

    Attributes
    ----------
    band_hz : (low, high)
        Band of the noise in hertz; 20 to 80 kHz by default.
    level_db : float
        RMS in the band at 1 m, in decibels relative to full scale; −60 by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Noise
    >>> Noise(range_m=2.0).band_hz
    (20000.0, 80000.0)
    """

    band_hz: tuple[float, float] = (20_000.0, 80_000.0)
    level_db: float = -60.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_band("noise.band_hz", self.band_hz)
        checks.between("noise.level_db", self.level_db, -300.0, 60.0)


class Sonar(Placed, frozen=True, kw_only=True):
    """Another sonar, not synchronised with the sensors of the scene.

    Attributes
    ----------
    call : Call
        Call of the sonar; the call of eRTIS by default.
    level_db : float
        Amplitude of its call at 1 m in decibels relative to full scale; −20 by default.
    period_s : float
        Time from one call to the next in seconds; 0.05 by default.
    offset_s : float
        Start of its first call in seconds after the start of the first measurement; 0 by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Sonar
    >>> Sonar(range_m=3.0).period_s
    0.05
    """

    call: Call = Call()
    level_db: float = -20.0
    period_s: float = 0.05
    offset_s: float = 0.0

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.between("sonar.level_db", self.level_db, -300.0, 60.0)
        checks.between("sonar.period_s", self.period_s, self.call.duration_s, 1e3)
        checks.between("sonar.offset_s", self.offset_s, 0.0, 1e3)


class Ambient(TomlTable, frozen=True, kw_only=True):
    """Diffuse noise, equally strong from all directions.

    Attributes
    ----------
    level_dbfs : float
        RMS in the band at each microphone, in dBFS; −80 by default.
    band_hz : (low, high)
        Band of the noise in hertz; 20 to 80 kHz by default.

    Examples
    --------
    >>> from ertis_numba.simulation import Ambient
    >>> Ambient().level_dbfs
    -80.0
    """

    level_dbfs: float = -80.0
    band_hz: tuple[float, float] = (20_000.0, 80_000.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.between("ambient.level_dbfs", self.level_dbfs, -300.0, 0.0)
        _check_band("ambient.band_hz", self.band_hz)


def _check_band(name: str, band_hz: tuple[float, float]) -> None:
    checks.interval(name, band_hz, 1.0, _HIGHEST_HZ)
    if band_hz[0] == band_hz[1]:
        raise ArgumentError(f"{name} starts and ends at {band_hz[0]:g} Hz; give two different frequencies")
