"""Bearings: directions of sources of sound."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from ertis_numba.base.angles import RadiansFromDegrees
from ertis_numba.base.units import counted
from ertis_numba.frames._level_reference import LEVEL_UNITS, LevelUnit

__all__ = ["Bearing", "doubt_notes"]


@dataclass(frozen=True, slots=True, kw_only=True)
class Bearing(RadiansFromDegrees):
    """Direction of a source in a band of frequencies.

    The properties ``azimuth_rad`` and ``elevation_rad`` are the angles in radians.

    Attributes
    ----------
    azimuth_deg, elevation_deg : float
        Direction in the sensor frame in degrees. A flat array sees a source behind it as its mirror image in front.
    sideways_deg, upwards_deg : float
        Standard deviations of the direction along the sphere, horizontally and vertically, in degrees. They include
        noise only, not errors of the array. They are infinite if they are unknown: ``upwards_deg`` for directions of
        one elevation, which bearings then keep, and both for an array that cannot resolve the direction.
    correlation : float
        Correlation of the two errors.
    band_hz : (low, high)
        Edges of the band in hertz.
    level_dbfs : float
        Level of the source in the band at the array, without noise, in dBFS.
    snr_db : float
        Power of the source relative to the noise of a microphone in the band, in decibels.
    level_db : float, optional
        Sound pressure level of the source at the array in dB re 20 µPa; None, the default, if the sensitivity of the
        microphones is unknown.
    source_level_db : float, optional
        Level of the source in dB re 20 µPa at 1 m, as in `AcousticMap`; None, the default, if it is unknown.
    may_be_crosstalk : bool
        A signal that is equal in all channels fits as well as this direction: electrical crosstalk cannot be told from
        a source straight ahead of a flat array. No sound is equal in all channels of an array that is not flat. False
        by default.
    may_be_interference : bool
        The source may be interference of the electronics: a tone with random phases at the microphones would fit a
        direction as well with more than the requested probability of a false alarm. Arrays of up to about six
        microphones cannot tell such tones from sources. False by default.

    Examples
    --------
    >>> from ertis_numba.frames import Bearing
    >>> found = Bearing(azimuth_deg=90.0, elevation_deg=0.0, sideways_deg=0.1, upwards_deg=0.2, correlation=0.0,
    ...                 band_hz=(30e3, 40e3), level_dbfs=-70.0, snr_db=3.0)
    >>> round(found.azimuth_rad, 4)
    1.5708
    """

    azimuth_deg: float
    elevation_deg: float
    sideways_deg: float
    upwards_deg: float
    correlation: float
    band_hz: tuple[float, float]
    level_dbfs: float
    snr_db: float
    level_db: float | None = None
    source_level_db: float | None = None
    may_be_crosstalk: bool = False
    may_be_interference: bool = False

    @property
    def doubts(self) -> tuple[str, ...]:
        """Causes other than sound that the bearing may have: ``"crosstalk"``, ``"interference"``, or both."""
        every = {"crosstalk": self.may_be_crosstalk, "interference": self.may_be_interference}
        return tuple(name for name, may_be in every.items() if may_be)

    @property
    def level(self) -> tuple[float, LevelUnit]:
        """Most informative level that is known, and its unit."""
        levels = ((getattr(self, name), unit) for name, unit in LEVEL_UNITS.items())
        return next((level, unit) for level, unit in levels if level is not None)

    def as_dict(self) -> dict[str, Any]:
        """Return the bearing for JSON; unknown numbers, such as angles that the array cannot observe, are null."""
        is_known = math.isfinite(self.sideways_deg), math.isfinite(self.upwards_deg)
        angles = ("azimuth_deg", "sideways_deg"), ("elevation_deg", "upwards_deg")
        return {
            "band_hz": [round(edge_hz, 3) for edge_hz in self.band_hz],
            **{
                name: round(getattr(self, name), 4) if known else None
                for names, known in zip(angles, is_known, strict=True)
                for name in names
            },
            **{name: _rounded(getattr(self, name)) for name in reversed(LEVEL_UNITS)},
            "snr_db": round(self.snr_db, 3),
            "may_be_crosstalk": self.may_be_crosstalk,
            "may_be_interference": self.may_be_interference,
        }

    @property
    def center_hz(self) -> float:
        """Geometric centre of the band in hertz."""
        return math.sqrt(self.band_hz[0] * self.band_hz[1])


def doubt_notes(bearings: Iterable[Bearing]) -> list[str]:
    """Return notes on bearings that may not be those of sound, or are unknown."""
    listed = list(bearings)
    doubts = {name for each in listed for name in each.doubts}
    n_unknown = sum(math.isinf(each.sideways_deg) and math.isinf(each.upwards_deg) for each in listed)
    notes = {
        f"the direction of {counted(n_unknown, 'source')} is unknown; a channel without sound may be the cause: see "
        "'ertis info --health'": n_unknown > 0,
        "a source marked as possible crosstalk has the same signal in all channels, as electrical crosstalk has; cover "
        "the microphones: crosstalk remains, and sound does not": "crosstalk" in doubts,
        "a source marked as possible interference fits its direction no better than electrical interference with "
        "random phases may by chance; cover the microphones: interference remains, and sound does not": (
            "interference" in doubts
        ),
    }
    return [text for text, applies in notes.items() if applies]


def _rounded(level_db: float | None) -> float | None:
    return None if level_db is None else round(level_db, 3)
