"""Orders of channels that fit the strongest arrival as well as, or better than, the order of the layout."""

import functools
import itertools
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.health.wave_shapes import CURVATURES, fit_curved, places_of

__all__ = ["other_orders", "spreads_s"]

_MAX_MICS: Final = 64  # In larger arrays, only neighbouring channels are swapped.


@functools.lru_cache(maxsize=16)
def other_orders(count: int) -> tuple[tuple[str, tuple[int, ...]], ...]:
    """Return names and orders of channels that wiring and file formats confuse: rotated, reversed, and two swapped."""
    if count < 3:
        return ()
    straight = tuple(range(count))
    found = {straight[::-1]: "the reversed order"}
    for place in range(1, count):
        found.setdefault(straight[place:] + straight[:place], f"the order rotated by {place}")
    for one, two in itertools.combinations(straight, 2) if count <= _MAX_MICS else itertools.pairwise(straight):
        swapped = [*straight]
        swapped[one], swapped[two] = two, one
        found.setdefault(tuple(swapped), f"the order with channels {one} and {two} swapped")
    return tuple((name, order) for order, name in found.items())


def spreads_s(
    times_s: NDArray[np.float64], positions_m: NDArray[np.float64], path_m: float, speed_m_s: float
) -> NDArray[np.float64]:
    """Return the RMS residuals (arrival,) of arrivals (arrival, mic), of which each is an echo or direct sound."""
    places_m = places_of(positions_m)
    matrix = np.column_stack([np.ones(len(places_m)), places_m])
    spare = max(1, len(places_m) - matrix.shape[1])
    inverse, found = np.linalg.pinv(matrix), []
    for curvature in CURVATURES:
        flat_s = fit_curved(
            times_s, positions_m, curvature / path_m, speed_m_s, lambda flat_s: (flat_s @ inverse.T)[:, 1:]
        )
        flat_s = flat_s - flat_s @ inverse.T @ matrix.T
        found.append(np.sum(flat_s**2, axis=1) / spare)
    direct_s = times_s - np.linalg.norm(positions_m, axis=1) / speed_m_s
    found.append(np.var(direct_s, axis=1, ddof=1))
    return np.asarray(np.sqrt(np.min(found, axis=0)))
