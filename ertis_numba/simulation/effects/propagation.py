"""Propagation delays."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.simulation.paths import Paths

__all__ = ["propagation"]


def propagation(paths: Paths, speed_m_s: float) -> NDArray[np.float64]:
    """Return the delays of the paths, ``(r₁ + r₂) / c``: (path, mic) float64, in seconds.

    Delays are not rounded to samples. The factor ``exp(-2πi f τ)`` in the spectrum delays the call by any fraction of a
    sample and preserves the energy at each frequency.
    """
    return paths.length_m / speed_m_s
