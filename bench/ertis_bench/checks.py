"""No time is reported for a wrong result: images are checked before they are timed."""

import math

import numpy as np

from ertis_numba.errors import DataError
from ertis_numba.frames import Energyscape, Measurement
from ertis_numba.geometry import unit_vectors
from ertis_numba.verification import ExactImage

__all__ = ["MAX_ERROR_DB", "require_exact", "require_same_reflector"]

MAX_ERROR_DB = -30.0
_DIRECTIONS = 5  # checked against the exact image, spread over the grid
_NEAR_RAD = math.radians(5)
_NEAR_M = 0.01
_SAME_LEVEL_DB = 1.5


def require_exact(image: Energyscape, measurement: Measurement, *, max_error_db: float = MAX_ERROR_DB) -> float:
    """Return the error of an image in dB, on some directions; refuse one above ``max_error_db``.

    Raises
    ------
    DataError
        The image is wrong.
    """
    chosen = np.unique(np.linspace(0, len(image.amplitude) - 1, _DIRECTIONS + 2).astype(int)[1:-1])
    exact = ExactImage(image, measurement)
    ranges = np.arange(image.amplitude.shape[1])
    expected = np.stack([exact.amplitudes(direction, ranges) for direction in chosen.tolist()])
    difference = np.linalg.norm(image.amplitude[chosen] - expected)
    error_db = 20 * math.log10(float(difference / np.linalg.norm(expected)))
    if not error_db <= max_error_db:
        raise DataError(
            f"image of {len(image.amplitude)} directions is {error_db:.1f} dB off the exact one; wanted at most "
            f"{max_error_db:g} dB: the times would be those of a wrong result"
        )
    return error_db


def require_same_reflector(image: Energyscape, other: Energyscape) -> None:
    """Refuse two images unless the strongest place of one is among the strongest of the other, near by.

    Methods sample pulses differently, so two reflectors of nearly one level may change places.

    Raises
    ------
    DataError
        The other image is weak there.
    """
    direction, distance = np.unravel_index(np.argmax(image.amplitude), image.amplitude.shape)
    vectors = unit_vectors(other.azimuth_rad, other.elevation_rad)
    there = unit_vectors(image.azimuth_rad[direction], image.elevation_rad[direction])
    near = np.ix_(vectors @ there > math.cos(_NEAR_RAD), np.abs(other.range_m - image.range_m[distance]) < _NEAR_M)
    ratio = float(np.max(other.amplitude[near], initial=0.0) / np.max(other.amplitude))
    level_db = 20 * math.log10(ratio) if ratio else -math.inf
    if not level_db >= -_SAME_LEVEL_DB:
        raise DataError(
            f"strongest reflector of one image, at {image.range_m[distance]:.3f} m, has {level_db:.1f} dB in another; "
            f"wanted at least {-_SAME_LEVEL_DB:g} dB: the times would be those of a wrong result"
        )
