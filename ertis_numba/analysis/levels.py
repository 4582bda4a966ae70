"""Levels, as pictures show them."""

import numpy as np
from numpy.typing import NDArray

__all__ = ["below_strongest_db"]


def below_strongest_db(amplitude: NDArray[np.float32], dynamic_range_db: float) -> NDArray[np.float32]:
    """Return levels below the strongest, cut at the dynamic range; silence is all floor.

    Parameters
    ----------
    amplitude : float32 of any shape
    dynamic_range_db : float
    """
    strongest = np.float32(amplitude.max(initial=0.0)) or np.float32(1)
    floor = np.float32(10 ** (-dynamic_range_db / 20))
    return np.asarray(20 * np.log10(np.maximum(amplitude / strongest, floor)), dtype=np.float32)
