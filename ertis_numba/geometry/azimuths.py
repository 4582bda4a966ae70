"""Azimuths side by side: where they begin, how far from each something is known, and whether they go all around."""

import math

import numpy as np
from numpy.typing import NDArray

__all__ = ["ALONE_RAD", "FAR", "is_closed", "reach_rad", "unrolled_rad"]

ALONE_RAD = math.radians(1.0)
"""How far a direction reaches that has none beside it."""

FAR = 1.3
"""Spacings from the nearest direction, beyond which nothing is known."""

_FAR_RAD = math.radians(10.0)  # the same at most, where directions lie wider apart than is usual
_CLOSED = 1.5  # widest spacings between the last direction and the first, up to which they go all around
_TURN = 2 * math.pi


def reach_rad(gaps_rad: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far from the nearer of its two directions something is known in each gap: (gap,) float64.

    A gap as wide as one beside it is no gap but a coarser part, as grids have that are finer ahead.

    Parameters
    ----------
    gaps_rad : (gap,) float64
        Between directions, from one to the next.
    """
    if len(gaps_rad) < 2:
        return np.full(len(gaps_rad), ALONE_RAD)
    usual_rad = np.sort(gaps_rad)[(len(gaps_rad) - 1) // 2]
    beside_rad = np.maximum(np.append(gaps_rad[1:], 0), np.append(0, gaps_rad[:-1]))
    return np.asarray(np.maximum(FAR * usual_rad, np.minimum(FAR * beside_rad, _FAR_RAD)))


def unrolled_rad(azimuth_rad: NDArray[np.float64], closed_rad: float = 0.0) -> NDArray[np.float64]:
    """Return azimuths, by whole turns moved such that no gap lies between them that is wider than that around them.

    Parameters
    ----------
    azimuth_rad : (direction,) float64
        In any order.
    closed_rad : float
        A gap up to which is none, where directions of other elevations lie between.

    Returns
    -------
    (direction,) float64
        Within a turn; the middle of the first and the last is from -π to π.
    """
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
    """Whether rising directions go all around, with no more between the last and the first than elsewhere."""
    if len(azimuth_rad) < 3:
        return False
    open_rad = _TURN - float(azimuth_rad[-1] - azimuth_rad[0])
    return 1e-9 < open_rad <= _CLOSED * float(np.diff(azimuth_rad).max())
