"""Units of quantities, derived from the suffixes of their names."""

from typing import Final

__all__ = ["unit_of"]

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
