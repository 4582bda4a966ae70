"""Reference of the levels of sound: full scale, a sound pressure, or a sound pressure at 1 m from the source."""

from typing import Final, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.units import sound_pressure_level_db
from ertis_numba.geometry.air import absorption_db_m, transmission_loss_db
from ertis_numba.settings import Settings

__all__ = ["LEVEL_UNITS", "LevelReference", "LevelUnit", "known_levels", "level_offset_db"]

LevelUnit: TypeAlias = Literal["dBFS", "dB re 20 µPa", "dB re 20 µPa at 1 m"]

LEVEL_UNITS: Final[dict[str, LevelUnit]] = {
    "source_level_db": "dB re 20 µPa at 1 m",
    "level_db": "dB re 20 µPa",
    "level_dbfs": "dBFS",
}
"""Units of levels by the name of a field, the most informative first."""

# ISO 9613-1 (7.1) states the absorption to ±10 %, so that beyond this limit, a source level is off by 6 dB and more.
_MAX_ABSORPTION_DB: Final = 60.0


def level_offset_db(
    settings: Settings, frequency_hz: NDArray[np.float64], unit: LevelUnit
) -> NDArray[np.float64] | None:
    """Return the level of a mean square of 1 at the array in a unit: (frequency,).

    None if ``array.sensitivity_dbfs``, or for the source level ``passive.focus_m``, is unknown. NaN for source levels
    at frequencies of which the air absorbs more than 60 dB over the distance.
    """
    sensitivity_dbfs, focus_m = settings.array.sensitivity_dbfs, settings.passive.focus_m
    if unit == "dBFS":
        return np.zeros(len(frequency_hz))
    if sensitivity_dbfs is None:
        return None
    pressure_db = np.full(len(frequency_hz), sound_pressure_level_db(0.0, sensitivity_dbfs))
    if unit == "dB re 20 µPa":
        return pressure_db
    if focus_m is None:
        return None
    is_heard = focus_m * absorption_db_m(settings.air, frequency_hz) <= _MAX_ABSORPTION_DB
    return np.where(is_heard, pressure_db + transmission_loss_db(settings.air, focus_m, frequency_hz), np.nan)


def known_levels(settings: Settings, centre_hz: float, level_dbfs: float) -> dict[str, float | None]:
    """Return the level of sound at a frequency in each unit of `LEVEL_UNITS`; None where it is unknown."""
    offsets = {name: level_offset_db(settings, np.array([centre_hz]), unit) for name, unit in LEVEL_UNITS.items()}
    return {
        name: None if offset_db is None or np.isnan(offset_db[0]) else level_dbfs + float(offset_db[0])
        for name, offset_db in offsets.items()
    }


class LevelReference(NamedTuple):
    """Unit of levels, and the level of a mean square of 1 at the array."""

    unit: LevelUnit
    offset_db: NDArray[np.float64]  # (frequency,), NaN where it is unknown

    @classmethod
    def of(
        cls, settings: Settings, frequency_hz: NDArray[np.float64], *, is_complete: bool = False
    ) -> "LevelReference":
        """Return the most informative reference that the settings allow at some frequencies, or at all."""
        enough = np.all if is_complete else np.any
        found = ((unit, level_offset_db(settings, frequency_hz, unit)) for unit in LEVEL_UNITS.values())
        return next(
            cls(unit, offset_db)
            for unit, offset_db in found
            if offset_db is not None and enough(np.isfinite(offset_db))
        )
