"""Propagation delays."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.paths import Paths
from ertis_numba.simulation.snapshot import Snapshot

__all__ = ["times"]

Floats = NDArray[np.float64]


def times(
    shot: Snapshot, paths: Paths, sent_s: float, times: tuple[Floats, Floats | None]
) -> tuple[Floats, Floats | None]:
    """Return delays plus the travel time of each path, ``(r₁ + r₂) / c``: (path, mic), not rounded to samples."""
    delay_s, stretch = times
    return delay_s + paths.length_m / shot.speed_m_s, stretch
