"""Directivity of a circular piston, shared by emitters, microphones and discs."""

import math

import numpy as np
import scipy
from numpy.typing import NDArray

__all__ = ["in_baffle", "piston"]


def piston(argument: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ``2 J₁(v) / v`` with ``v = k a sin θ``, 1 on the axis.

    This is the far field of a circular piston in a rigid baffle (L. E. Kinsler et al., Fundamentals of Acoustics,
    section 7.4). Half of the power is at v = 1.62, the first zero at 3.83, and the first side lobe at −17.6 dB.
    """
    safe = np.where(argument == 0, 1.0, argument)
    return np.where(argument == 0, 1.0, 2 * scipy.special.j1(safe) / safe)


def in_baffle(
    cos: NDArray[np.float64], diameter_m: float, speed_m_s: float, frequency_hz: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the directivity of a piston at angles (path, mic) off its axis, 0 behind it: (path, mic, frequency)."""
    sin = np.sqrt(np.maximum(1 - cos**2, 0.0))
    pattern = piston(math.pi * diameter_m / speed_m_s * sin[..., None] * frequency_hz)
    return np.asarray(np.where(cos[..., None] >= 0, pattern, 0.0))
