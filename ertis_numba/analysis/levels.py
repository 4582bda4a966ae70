"""Levels of images for display."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["below_strongest_db"]


def below_strongest_db(amplitude: NDArray[np.float32], dynamic_range_db: float) -> NDArray[np.float32]:
    """Return levels from ``-dynamic_range_db`` to 0 relative to the strongest amplitude; the lowest if silent."""
    strongest = np.float32(amplitude.max(initial=0.0)) or np.float32(1)
    floor = np.float32(10 ** (-dynamic_range_db / 20))
    return np.asarray(20 * np.log10(np.maximum(amplitude / strongest, floor)), dtype=np.float32)
