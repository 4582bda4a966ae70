"""Part of the surroundings of a platform in which a clear echo would be heard."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.fusion.polar_grid import PolarGrid
from ertis_numba.fusion.rig import Emitters, MountedSensor
from ertis_numba.settings import Settings

__all__ = ["Coverage", "directions_around"]

Floats = NDArray[np.float64]

_N_AZIMUTHS: Final = {2: 360, 3: 120}  # Directions of 1° in a plane and of 3° in space, by number of dimensions.
_WEAKEST_DB: Final = -15.0  # Emitted power, relative to ahead, below which silence shows nothing.


def directions_around(n_dimensions: int, reach_m: float, step_m: float) -> PolarGrid:
    """Return directions and ranges around a platform."""
    n_azimuths = _N_AZIMUTHS[n_dimensions]
    n_rows = n_azimuths // 2
    rows = np.zeros(1) if n_dimensions == 2 else ((np.arange(n_rows) + 0.5) / n_rows - 0.5) * math.pi
    return PolarGrid(n_azimuths, rows, math.ceil(reach_m / step_m), step_m)


class Coverage(NamedTuple):
    """Part of the surroundings in which a clear echo would be heard.

    Attributes
    ----------
    grid : PolarGrid
        Directions and ranges.
    weight : (direction, range) float64
        0 where no sensor emits or listens, up to 1 ahead of a sensor.
    """

    grid: PolarGrid
    weight: Floats

    @property
    def reach_m(self) -> float:
        """Longest range."""
        return self.grid.n_ranges * self.grid.step_m

    def at(self, offset_m: Floats) -> Floats:
        """Return the weights at places, 0 beyond the last range: (point,) float64."""
        cell = self.grid.cell_of(offset_m)
        return np.where(cell >= 0, self.weight.reshape(-1)[cell.clip(0)], 0.0)

    @classmethod
    def of(
        cls,
        sensors: Sequence[MountedSensor],
        limits_m: Sequence[tuple[float, float]],
        settings: Settings,
        diameters_m: Sequence[float],
        step_m: float,
        *,
        height_m: float | None = None,
    ) -> Self:
        """Return the coverage of sensors that emit.

        Parameters
        ----------
        sensors : sequence of MountedSensor
        limits_m : sequence of (first, last)
            Ranges of their images.
        settings : Settings
            Settings with the call and the air.
        diameters_m : sequence of float
            Diameter of each sensor's emitter.
        step_m : float
        height_m : float, optional
            Height on the platform of the centre of the directions in space; by default, directions are those of a plane
            through each sensor.
        """
        emitters = Emitters(settings, diameters_m)
        reach_m = max(
            float(np.hypot(*sensor.translation_m[:2])) + last
            for sensor, (_, last) in zip(sensors, limits_m, strict=True)
        )
        grid = directions_around(2 if height_m is None else 3, reach_m, step_m)
        place_m = grid.directions[:, None] * grid.range_m[:, None]
        weight = np.zeros(place_m.shape[:2])
        for number, (sensor, (first_m, last_m)) in enumerate(zip(sensors, limits_m, strict=True)):
            centre_m = [0.0, 0.0, sensor.translation_m[2] if height_m is None else height_m]
            local_m = sensor.local_m(place_m + centre_m)
            distance_m = np.linalg.norm(local_m, axis=-1)
            power_db = 10 * np.log10(emitters.power(local_m[..., 0] / np.maximum(distance_m, 1e-6), number))
            heard = np.clip(1 - power_db / _WEAKEST_DB, 0.0, 1.0) * (local_m[..., 0] > 0)
            # Silence means less at long ranges, because spreading and oblique walls make echoes weak.
            heard *= (distance_m >= first_m) * np.clip(1 - distance_m / last_m, 0.0, 1.0)
            np.maximum(weight, heard, out=weight)
        return cls(grid, weight)
