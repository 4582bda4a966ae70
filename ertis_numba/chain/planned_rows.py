"""Predicted error, work and memory of plans that sum the beams of rows first."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.beam_grid import Aperture, estimated_mics
from ertis_numba.chain.error_model import ErrorModel
from ertis_numba.chain.plan_elements import row_aperture
from ertis_numba.chain.rows import Rows, seen_from_rows

__all__ = ["PlannedRows"]

_RANGES, _DIRECTIONS = 12, 40  # Ranges and directions for which the delays of a curved wavefront are compared.


class PlannedRows:
    """Properties of plans with the beams of some rows; ``nearest_m`` is infinite for plane wavefronts."""

    def __init__(self, rows: Rows, aperture: Aperture, *, nearest_m: float, sound_speed_m_s: float) -> None:
        self.rows, self.line = rows, row_aperture(aperture, rows)
        self._aperture, self._speed_m_s = aperture, sound_speed_m_s
        self.is_curved = not math.isinf(nearest_m)
        across = np.abs(aperture.directions[:, 1 - rows.along]).max()
        self.reach_s = float(np.abs(rows.across_m).max() * across) / sound_speed_m_s

    def count_points(self, spacing: NDArray[np.float64], n_taps: int) -> int:
        """Return the number of points along a row, which is that of a beam grid along this axis."""
        extent = float(np.ptp(self.line.directions)) / float(spacing[self.rows.along])
        return math.ceil(extent) + n_taps

    def delay_error(self, errors: ErrorModel, ranges_m: NDArray[np.float64]) -> float:
        """Return the error power of delays as sums of two: of curved wavefronts, and of microphones beside a row."""
        if not self.is_curved:
            return errors.late(float(np.mean(self._aperture.directions[:, 1 - self.rows.along] ** 2) * self._beside_s2))
        mics = estimated_mics(len(self._aperture.positions_m))
        chosen = np.linspace(0, len(self._aperture.directions) - 1, _DIRECTIONS).astype(np.intp)
        some = self._aperture.directions[chosen]
        late_s2 = []
        for range_m in ranges_m[np.linspace(0, len(ranges_m) - 1, _RANGES).astype(np.intp)]:
            exact_s = self._aperture.delays_s(some, sound_speed_m_s=self._speed_m_s, range_m=float(range_m))[:, mics]
            seen, rows_s = seen_from_rows(some, self.rows, float(range_m), sound_speed_m_s=self._speed_m_s)
            number = self.rows.number[mics]
            x_m, u = self.line.positions_m[mics, 0], seen[:, number]
            bent_m = x_m**2 - 2 * range_m * u * x_m
            made_s = bent_m / (np.sqrt(np.maximum(range_m**2 + bent_m, 0.0)) + range_m) / self._speed_m_s
            late_s2.append(np.mean(np.var(exact_s - made_s - rows_s[:, number], axis=1)))
        return errors.late(float(np.mean(late_s2)))

    @property
    def _beside_s2(self) -> float:
        return (self.rows.deviation_m / self._speed_m_s) ** 2
