"""Checks of images before they are timed, so that no benchmark reports the time of a wrong result."""

import math

import numpy as np

from ertis_numba.base.errors import DataError
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.geometry import unit_vectors
from ertis_numba.pipeline.verification import ExactImage

__all__ = ["MAX_ERROR_DB", "require_error", "require_exact", "require_same_reflector"]

MAX_ERROR_DB = -30.0
_N_DIRECTIONS = 5  # compared with the exact image, spread over the grid
_NEAR_RAD = math.radians(5)
_NEAR_M = 0.01
_SAME_LEVEL_DB = 1.5


def require_exact(image: Energyscape, measurement: Measurement, *, max_error_db: float = MAX_ERROR_DB) -> float:
    """Return the error of an image in dB, measured in some directions."""
    chosen = np.unique(np.linspace(0, len(image.amplitude) - 1, _N_DIRECTIONS + 2).astype(int)[1:-1])
    exact = ExactImage(image, measurement)
    ranges = np.arange(image.amplitude.shape[1])
    expected = np.stack([exact.amplitudes(direction, ranges) for direction in chosen.tolist()])
    difference = np.linalg.norm(image.amplitude[chosen] - expected)
    error_db = 20 * math.log10(float(difference / np.linalg.norm(expected)))
    return require_error(error_db, f"image of {len(image.amplitude)} directions", max_error_db=max_error_db)


def require_error(error_db: float, name: str, *, max_error_db: float = MAX_ERROR_DB) -> float:
    """Return the error of a named image in dB, relative to the exact image."""
    if not error_db <= max_error_db:
        raise DataError(
            f"{name} has an error of {error_db:.1f} dB relative to the exact image; the limit is {max_error_db:g} dB. "
            "Its time is not reported, because the result is wrong"
        )
    return error_db


def require_same_reflector(image: Energyscape, other: Energyscape) -> None:
    """Require the strongest bin of one image to be among the strongest of the other, at nearly the same place.

    Methods sample pulses differently, so two reflectors of nearly equal level may change ranks.
    """
    direction, distance = np.unravel_index(np.argmax(image.amplitude), image.amplitude.shape)
    vectors = unit_vectors(other.azimuth_rad, other.elevation_rad)
    there = unit_vectors(image.azimuth_rad[direction], image.elevation_rad[direction])
    near = np.ix_(vectors @ there > math.cos(_NEAR_RAD), np.abs(other.range_m - image.range_m[distance]) < _NEAR_M)
    ratio = float(np.max(other.amplitude[near], initial=0.0) / np.max(other.amplitude))
    level_db = 20 * math.log10(ratio) if ratio else -math.inf
    if not level_db >= -_SAME_LEVEL_DB:
        raise DataError(
            f"strongest reflector of one image, at {image.range_m[distance]:.3f} m, has {level_db:.1f} dB in the other "
            f"image; the limit is {-_SAME_LEVEL_DB:g} dB. The time is not reported, because a result is wrong"
        )
