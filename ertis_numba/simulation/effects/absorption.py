"""Absorption of high frequencies by air."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import absorption_db_m
from ertis_numba.settings import Air
from ertis_numba.simulation.paths import Paths

__all__ = ["absorption"]


def absorption(paths: Paths, air: Air, frequency_hz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the amplitude gain of each frequency after absorption: (path, mic, frequency) float64.

    The gain is ``10 ** (-α(f) (r₁ + r₂) / 20)`` with α from ISO 9613-1. The associated dispersion, about 1e-4 of the
    speed of sound, is neglected, as in the standard.
    """
    return np.asarray(10 ** (-paths.length_m[..., None] * (absorption_db_m(air, frequency_hz) / 20)))
