"""Echoes from directions that the grid of an image does not contain."""

import functools
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.outside_grid import OutsidePatterns, OutsideSource
from ertis_numba.analysis.point_spread import PULSE_M, spread_of
from ertis_numba.frames import Energyscape
from ertis_numba.geometry import far_field_delays, microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.settings import Settings

__all__ = ["has_outside", "outside_of"]

_BANDS: Final = 16  # Parts of the spectrum: a beam changes little within a sixteenth of the band.
_LEAST: Final = 0.01  # Power relative to the strongest part, from which a part counts.


def has_outside(settings: Settings, directions: NDArray[np.float64]) -> bool:
    """Return True if an array distinguishes directions outside of a grid, unlike those behind a plane array."""
    return _patterns(settings, directions.tobytes()) is not None


def outside_of(image: Energyscape, directions: NDArray[np.float64], range_m: float) -> OutsideSource | None:
    """Return the reflector outside of a grid that explains an image around a range; None if one inside may."""
    patterns = _patterns(image.settings, directions.tobytes())
    if patterns is None:
        return None
    radius_m = np.linalg.norm(microphones(image.settings.array).enabled_positions_m, axis=1).max() + PULSE_M
    near = np.abs(image.range_m - range_m) < radius_m
    values = (image.amplitude[patterns.samples][:, near].astype(np.float64) ** 2).sum(axis=1)
    source = patterns.source_of(values)
    if source is None:
        return None
    at_range = image.amplitude[:, np.argmin(np.abs(image.range_m - range_m))].max()
    return source._replace(power=float(at_range) ** 2 * source.power / float(values.max()))


@functools.lru_cache(maxsize=8)
def _patterns(settings: Settings, grid: bytes) -> OutsidePatterns | None:
    """Return the patterns of echoes of the call."""
    positions_m, speed_m_s = microphones(settings.array).enabled_positions_m, sound_speed_m_s(settings.air)
    every_hz, shares = spread_of(settings).spectrum
    bands = [each for each in np.array_split(np.arange(len(shares)), _BANDS) if (shares[each] > 0).any()]
    if not bands:  # The filters leave nothing of the call.
        return None
    power = np.array([np.sum(shares[each] ** 2) for each in bands])
    frequency_hz = np.array([np.average(every_hz[each], weights=shares[each]) for each in bands])
    is_heard = power > _LEAST * power.max()
    return OutsidePatterns.of(
        np.frombuffer(grid).reshape(-1, 3),
        functools.partial(far_field_delays, positions_m, sound_speed_m_s=speed_m_s),
        frequency_hz[is_heard],
        power[is_heard],
    )
