"""Air takes the high frequencies."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.air import absorption_db_m
from ertis_numba.settings import Air
from ertis_numba.simulation.paths import Paths

__all__ = ["absorption"]


def absorption(paths: Paths, air: Air, frequency_hz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return what the air leaves of each frequency: (path, mic, frequency) float64.

    ``10 ** (-α(f) (r₁ + r₂) / 20)`` with α from ISO 9613-1. The dispersion that goes with it, some 1e-4 of
    the speed of sound, is left out, as the standard leaves it out.
    """
    return np.asarray(10 ** (-paths.length_m[..., None] * (absorption_db_m(air, frequency_hz) / 20)))
