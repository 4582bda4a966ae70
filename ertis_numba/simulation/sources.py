"""Sounds that are no echoes: tones, noise, other sonars, and the room itself."""

from ertis_numba import checks
from ertis_numba.documents import TomlTable
from ertis_numba.errors import ArgumentError
from ertis_numba.settings import Call
from ertis_numba.simulation.placed import Placed

__all__ = ["Ambient", "Noise", "Sonar", "Tone"]

_HIGHEST_HZ = 1e6


class Tone(Placed, frozen=True, kw_only=True):
    """A steady tone, as of a switching power supply or a leaking valve.

    Attributes
    ----------
    frequency_hz : float
        Frequency of the tone.
    level_db : float
        Amplitude 1 m from it.
    """

    frequency_hz: float
    level_db: float = -60.0

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.between("tone.frequency_hz", self.frequency_hz, 1.0, _HIGHEST_HZ)
        checks.between("tone.level_db", self.level_db, -300.0, 60.0)


class Noise(Placed, frozen=True, kw_only=True):
    """A source of broadband noise, as of compressed air.

    Attributes
    ----------
    band_hz : (low, high)
        Band of the noise.
    level_db : float
        Root mean square in the band, 1 m from it.
    """

    band_hz: tuple[float, float] = (20_000.0, 80_000.0)
    level_db: float = -60.0

    def __post_init__(self) -> None:
        super().__post_init__()
        _check_band("noise.band_hz", self.band_hz)
        checks.between("noise.level_db", self.level_db, -300.0, 60.0)


class Sonar(Placed, frozen=True, kw_only=True):
    """Another sonar, which nobody has told about the SYNC chain.

    Attributes
    ----------
    call : Call
    level_db : float
        Amplitude of its call 1 m from it.
    period_s : float
        From one call to the next.
    offset_s : float
        Start of its first call after that of the first measurement.
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
    """Noise that comes from everywhere alike.

    Attributes
    ----------
    level_dbfs : float
        Root mean square in the band at each microphone.
    band_hz : (low, high)
        Band of the noise.
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
        raise ArgumentError(f"{name} runs from {band_hz[0]:g} Hz to itself; give two different frequencies")
