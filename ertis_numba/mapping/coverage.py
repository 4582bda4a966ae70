"""Part of the surroundings of a platform in which a clear echo would be heard."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.fusion.polar_grid import PolarGrid
from ertis_numba.fusion.rig import Emitters, MountedSensor
from ertis_numba.settings import Settings

__all__ = ["Coverage", "directions_around", "heard_m"]

Floats = NDArray[np.float64]

_N_AZIMUTHS: Final = {2: 360, 3: 120}  # Directions of 1° in a plane and of 3° in space, by number of dimensions.
_HEARD_STEP: Final = 0.9  # Ratio of the distances that `heard_m` distinguishes, so that few coverages are computed.
_HEARD_STEPS: Final = 40
_WEAKEST_DB: Final = -15.0  # Emitted power, relative to ahead, below which silence shows nothing.


def directions_around(n_dimensions: int, reach_m: float, step_m: float) -> PolarGrid:
    """Return directions and ranges around a platform."""
    n_azimuths = _N_AZIMUTHS[n_dimensions]
    n_rows = n_azimuths // 2
    rows = np.zeros(1) if n_dimensions == 2 else ((np.arange(n_rows) + 0.5) / n_rows - 0.5) * math.pi
    return PolarGrid(n_azimuths, rows, math.ceil(reach_m / step_m), step_m)


def heard_m(emitters: Emitters, clear: float, floor: float, last_m: float) -> float:
    """Return the distance to which a clear echo ahead, of amplitude ``clear`` at 1 m, exceeds the noise."""
    distance_m = np.asarray(last_m * _HEARD_STEP ** np.arange(_HEARD_STEPS), np.float64)
    is_heard = clear**2 * emitters.spreading(distance_m, distance_m) > floor**2
    return float(distance_m[is_heard.argmax()]) if is_heard.any() else 0.0


class Coverage(NamedTuple):
    """Part of the surroundings in which a clear echo would be heard; arrays are (direction, range)."""

    grid: PolarGrid
    weight: Floats  # 0 where no sensor emits or listens, to 1 ahead of one
    silence: Floats  # the same, but 0 where a clear echo is within noise: silence shows nothing

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
        heard_m: Sequence[float],
        height_m: float | None = None,
    ) -> Self:
        """Return the coverage of sensors that emit, up to the distances ``heard_m``."""
        emitters = Emitters(settings, diameters_m)
        reach_m = max(
            float(np.hypot(*sensor.translation_m[:2])) + last
            for sensor, (_, last) in zip(sensors, limits_m, strict=True)
        )
        grid = directions_around(2 if height_m is None else 3, reach_m, step_m)
        place_m = grid.directions[:, None] * grid.range_m[:, None]
        weight, silence = np.zeros((2, *place_m.shape[:2]))
        for number, (sensor, (first_m, last_m), end_m) in enumerate(zip(sensors, limits_m, heard_m, strict=True)):
            centre_m = [0.0, 0.0, sensor.translation_m[2] if height_m is None else height_m]
            local_m = sensor.local_m(place_m + centre_m)
            distance_m = np.linalg.norm(local_m, axis=-1)
            power_db = 10 * np.log10(emitters.power(local_m[..., 0] / np.maximum(distance_m, 1e-6), number))
            heard = np.clip(1 - power_db / _WEAKEST_DB, 0.0, 1.0) * (local_m[..., 0] > 0)
            # Silence means less at long ranges, because spreading and oblique walls make echoes weak.
            heard *= (distance_m >= first_m) * np.clip(1 - distance_m / last_m, 0.0, 1.0)
            np.maximum(weight, heard, out=weight)
            np.maximum(silence, heard * (distance_m <= end_m), out=silence)
        return cls(grid, weight, silence)
