"""Units of quantities, derived from the suffixes of their names, counts, and conversion of levels to pressures."""

import math
from collections.abc import Iterable
from typing import Final

__all__ = ["counted", "runs", "sound_pressure_level_db", "unit_of"]

_REFERENCE_PA: Final = 20e-6
_FULL_SCALE_SINE_DBFS: Final = 20 * math.log10(math.sqrt(0.5))
"""Level of a full-scale sine in this package, where an RMS of 1 has 0 dBFS; data sheets refer to the sine itself."""

# Longer suffixes come first, as "_s" ends "_m_s", too.
_UNITS: Final = {
    "_m_s": "m/s",
    "_dbfs": "dBFS",
    "_percent": "%",
    "_ppm": "ppm",
    "_deg": "°",
    "_khz": "kHz",
    "_hz": "Hz",
    "_db": "dB",
    "_mm": "mm",
    "_ms": "ms",
    "_pa": "Pa",
    "_c": "°C",
    "_m": "m",
    "_s": "s",
}


def unit_of(name: str) -> tuple[str, str]:
    """Return the suffix of a name and its unit; empty texts if the name has no unit."""
    return next(((suffix, unit) for suffix, unit in _UNITS.items() if name.endswith(suffix)), ("", ""))


def runs(numbers: Iterable[int]) -> list[list[int]]:
    """Return the first and the last of each run of successive numbers, for texts."""
    found: list[list[int]] = []
    for number in numbers:
        if found and number == found[-1][1] + 1:
            found[-1][1] = number
        else:
            found.append([number, number])
    return found


def sound_pressure_level_db(dbfs: float, sensitivity_dbfs: float) -> float:
    """Return the sound pressure level of a recorded sound in decibels relative to 20 µPa.

    The level is ``20 log10(1 Pa / 20 µPa) + (L + 3.01) - S``. A data sheet states the sensitivity S relative to a
    full-scale sine (AES17), which has an RMS of -3.01 dBFS in this package.

    Parameters
    ----------
    dbfs : float
        RMS of the sound in dBFS: 20 log10 of the RMS, where samples of full scale are ±1.
    sensitivity_dbfs : float
        Sensitivity of the microphone: level of a sine of 1 Pa RMS, or 94 dB, relative to a full-scale sine.

    Examples
    --------
    >>> from ertis_numba.base.units import sound_pressure_level_db
    >>> round(sound_pressure_level_db(-3.01, -26.0), 1)  # a full-scale sine: the acoustic overload point
    120.0
    """
    pascal_db = 20 * math.log10(1 / _REFERENCE_PA)
    return pascal_db + (dbfs - _FULL_SCALE_SINE_DBFS) - sensitivity_dbfs


def counted(count: int, noun: str) -> str:
    """Return a count and its noun, in the plural unless the count is 1."""
    return f"{count} {noun}{'s' * (count != 1)}"
