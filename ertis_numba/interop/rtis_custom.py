"""Directions, delays and ranges in CSV files of RTIS Dev."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["CUSTOM_KEYS", "with_custom_files"]

CUSTOM_KEYS: Final = {
    "directionsCustom": "set processing.directions instead",
    "delayMatrixCustom": "process with the delays of plane waves",
    "rangesCustom": "set processing.range_m instead",
}
"""Keys that name files, with the remedy if a file cannot be used."""

_SIGNALS_PER_SAMPLE: Final = 10  # RTIS Dev decimates the bits by this factor, and counts delays in these samples.
_UNEVEN: Final = 0.1  # Largest distance of a range from an even spacing, relative to the spacing.


def with_custom_files(folder: Path, reported: Mapping[str, Any], settings: Settings) -> Settings:
    """Return settings with directions, delays and ranges of the CSV files that RTIS Dev settings name."""
    changes: dict[str, Any] = {}
    if "directionsCustom" in reported:
        angles_rad = _numbers(folder, reported, "directionsCustom")
        if angles_rad.shape[1] != 2:
            raise _refusal(folder, reported, "directionsCustom", "does not have two numbers in every row")
        changes["directions"] = np.degrees(angles_rad)
    if "delayMatrixCustom" in reported:
        changes["delay_matrix"] = _numbers(folder, reported, "delayMatrixCustom").T
        changes["delay_rate_hz"] = settings.recording.sample_rate_hz / _SIGNALS_PER_SAMPLE
    if "rangesCustom" in reported:
        changes |= _ranges(folder, reported, settings)
    return settings.replace(processing=settings.processing.replace(**changes)) if changes else settings


def _ranges(folder: Path, reported: Mapping[str, Any], settings: Settings) -> dict[str, Any]:
    """Return the window and the spacing of evenly spaced ranges."""
    range_m = _numbers(folder, reported, "rangesCustom").ravel()
    if len(range_m) < 2 or not range_m[0] < range_m[-1]:
        raise _refusal(folder, reported, "rangesCustom", "does not have two or more ascending ranges")
    spacing_m = float(range_m[-1] - range_m[0]) / (len(range_m) - 1)
    off_m = float(np.abs(range_m - np.linspace(range_m[0], range_m[-1], len(range_m))).max())
    if off_m > _UNEVEN * spacing_m:
        apart_m = np.diff(range_m)
        raise _refusal(
            folder,
            reported,
            "rangesCustom",
            f"has ranges {apart_m.min():.4g} to {apart_m.max():.4g} m apart, not evenly",
        )
    step_m = sound_speed_m_s(settings.air) / (2 * settings.recording.sample_rate_hz)
    window_m = float(range_m[0]), float(range_m[-1])
    return {"range_m": window_m, "range_decimation": max(1, round(spacing_m / step_m)), "decimation": None}


def _numbers(folder: Path, reported: Mapping[str, Any], key: str) -> NDArray[np.float64]:
    """Return the numbers in a file, at least two-dimensional."""
    name = reported[key]
    path = folder / Path(str(name)).name
    if not isinstance(name, str) or not path.is_file():
        raise _refusal(folder, reported, key, "is not in the folder")
    try:
        numbers = np.loadtxt(path, delimiter=",", ndmin=2, encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise _refusal(folder, reported, key, f"cannot be read ({error})") from error
    if not numbers.size or not all(map(math.isfinite, numbers.ravel())):
        raise _refusal(folder, reported, key, "does not contain finite numbers only")
    return np.asarray(numbers, dtype=np.float64)


def _refusal(folder: Path, reported: Mapping[str, Any], key: str, fault: str) -> DataError:
    return DataError(
        f"{folder}: {key} is the file {reported[key]!r}, which {fault}; correct it, or remove it and {CUSTOM_KEYS[key]}"
    )
