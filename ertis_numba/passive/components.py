"""Components of CLEAN-SC, gathered at the directions of their sources."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.detect import neighbours_of
from ertis_numba.frames import AcousticMap
from ertis_numba.geometry import unit_vectors

__all__ = ["gathered", "strongest_first"]


def gathered(found: AcousticMap) -> AcousticMap:
    """Return a map of components, in which each source has one direction; other maps remain as they are."""
    # In each band, strongest direction first, a direction takes over the components of its neighbours.
    if not found.settings.passive.traits.is_sparse:
        return found
    neighbours = neighbours_of(unit_vectors(found.azimuth_rad, found.elevation_rad))
    power = np.zeros_like(found.power)
    for band in range(power.shape[1]):
        left = found.power[:, band].astype(np.float64)
        for place in strongest_first(left):
            if left[place]:
                around = np.union1d(neighbours[place], place)
                power[place, band] = left[around].sum()
                left[around] = 0
    return found.replace(power=power)


def strongest_first(power: NDArray[np.float64]) -> list[int]:
    """Return the directions with power, the strongest first."""
    places = np.flatnonzero(power)
    return [int(place) for place in places[np.argsort(-power[places], kind="stable")]]
