"""Sound takes its time."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.paths import Paths

__all__ = ["propagation"]


def propagation(paths: Paths, speed_m_s: float) -> NDArray[np.float64]:
    """Return the delays of the paths, ``(r₁ + r₂) / c``: (path, mic) float64, in seconds.

    They are not rounded to samples: the call's spectrum turns by ``exp(-2πi f τ)``, which delays it by
    any part of a sample and changes the energy of no frequency.
    """
    return paths.length_m / speed_m_s
