"""Errors of the strongest reflectors of an image."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ertis_numba.analysis.detect import peaks_of_grid
from ertis_numba.frames import Energyscape, Peak
from ertis_numba.geometry import unit_vectors

__all__ = ["PEAKS", "PeakErrors", "peak_errors"]

PEAKS = 10
"""Number of strongest reflectors to compare."""

_NEAR_DEG, _NEAR_M = 5.0, 0.02  # Half a main lobe and half a pulse; peaks farther away are other reflectors.


@dataclass(frozen=True, slots=True)
class PeakErrors:
    """Largest errors at the ``wanted`` reflectors of the exact image, of which ``lost`` were missed; None for none."""

    wanted: int
    lost: int
    level_db: float | None
    range_mm: float | None
    angle_deg: float | None


def peak_errors(image: Energyscape, wanted: Sequence[Peak]) -> PeakErrors:
    """Return the errors of an image at the strongest reflectors of the exact image."""
    # Reflectors of nearly the same level may change order. Twice the number ensures that the last are included.
    found = peaks_of_grid(image, top=2 * PEAKS, min_level_db=-1000.0, false_alarm=None)
    errors = [error for peak in wanted if (error := _nearest(peak, found)) is not None]
    level_db, range_m, angle_deg = np.max(np.abs(errors), axis=0).tolist() if errors else (None, None, None)
    return PeakErrors(
        wanted=len(wanted),
        lost=len(wanted) - len(errors),
        level_db=level_db,
        range_mm=None if range_m is None else 1000 * range_m,
        angle_deg=angle_deg,
    )


def _nearest(peak: Peak, found: Sequence[Peak]) -> tuple[float, float, float] | None:
    """Return the errors of level, range and angle of the peak that matches a reflector."""
    errors = (
        (other.level_db - peak.level_db, other.range_m - peak.range_m, _angle_deg(peak, other)) for other in found
    )
    near = [error for error in errors if abs(error[1]) <= _NEAR_M and error[2] <= max(_NEAR_DEG, peak.angle_sd_deg)]
    return min(near, key=lambda error: (error[1] / _NEAR_M) ** 2 + (error[2] / _NEAR_DEG) ** 2, default=None)


def _angle_deg(one: Peak, other: Peak) -> float:
    angles_rad = np.radians([[peak.azimuth_deg, peak.elevation_deg] for peak in (one, other)])
    first, second = unit_vectors(angles_rad[:, 0], angles_rad[:, 1])
    return math.degrees(2 * math.asin(min(1.0, float(np.linalg.norm(first - second)) / 2)))
