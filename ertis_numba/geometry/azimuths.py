"""Azimuths of a grid: order, gaps between them, and closed circles."""

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["ALONE_RAD", "FAR", "is_closed", "reach_rad", "unrolled_rad"]

ALONE_RAD = math.radians(1.0)
"""Angle around a direction without neighbours in which its value applies."""

FAR = 1.3
"""Largest distance from the nearest direction at which its value applies, in spacings."""

_FAR_RAD = math.radians(10.0)  # limit of the same distance where directions are farther apart than usual
_CLOSED = 1.5  # largest gap between the last direction and the first of a closed circle, in widest spacings
_TURN = 2 * math.pi


def reach_rad(gaps_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the angle from either end of each gap in which the value of that direction applies: (gap,)."""
    if len(gaps_rad) < 2:
        return np.full(len(gaps_rad), ALONE_RAD)
    usual_rad = np.sort(gaps_rad)[(len(gaps_rad) - 1) // 2]
    beside_rad = np.maximum(np.append(gaps_rad[1:], 0), np.append(0, gaps_rad[:-1]))
    return np.asarray(np.maximum(FAR * usual_rad, np.minimum(FAR * beside_rad, _FAR_RAD)))


def unrolled_rad(azimuth_rad: NDArray[np.float64], closed_rad: float = 0.0) -> NDArray[np.float64]:
    """Return azimuths, in any order, shifted by whole turns so that the widest gap lies outside of their interval."""
    # Gaps up to `closed_rad` do not count. The middle between the first and the last is from −π to π.
    turns = np.floor((azimuth_rad + math.pi) / _TURN)
    within = np.where(np.abs(azimuth_rad) > math.pi + 1e-9, azimuth_rad - _TURN * turns, azimuth_rad)
    rising = np.unique(within)
    gaps_rad = np.diff(rising, append=rising[0] + _TURN)
    widest = int(gaps_rad.argmax())
    if gaps_rad[widest] <= max(gaps_rad[-1] + 1e-9, closed_rad, 2 * float(reach_rad(gaps_rad)[widest])):
        return within
    moved = np.asarray(within + _TURN * (within <= rising[widest]))
    return moved - _TURN if moved.min() + moved.max() > _TURN else moved


def is_closed(azimuth_rad: NDArray[np.float64]) -> bool:
    """Return True if increasing azimuths form a closed circle, without a wider gap between the last and the first."""
    if len(azimuth_rad) < 3:
        return False
    open_rad = _TURN - float(azimuth_rad[-1] - azimuth_rad[0])
    return 1e-9 < open_rad <= _CLOSED * float(np.diff(azimuth_rad).max())
