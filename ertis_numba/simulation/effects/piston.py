"""The pattern of a circular piston, which emitters, microphones and discs share."""

import numpy as np
import scipy.special
from numpy.typing import NDArray

__all__ = ["piston"]


def piston(argument: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``2 J₁(v) / v`` with ``v = k a sin θ``, 1 on the axis.

    A circular piston in a rigid baffle, far away (L. E. Kinsler et al., Fundamentals of Acoustics,
    section 7.4): half of the power at v = 1.62, a first zero at 3.83, a first side lobe of -17.6 dB.
    """
    safe = np.where(argument == 0, 1.0, argument)
    return np.where(argument == 0, 1.0, 2 * scipy.special.j1(safe) / safe)
