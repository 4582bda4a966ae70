"""Use of a reflector at a known place: mirrored layouts, the speed of sound, and the size of the array."""

import math
from typing import Final, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import DataError
from ertis_numba.calibration.wavefronts import Target, travel_times
from ertis_numba.geometry import unit_vectors

__all__ = [
    "ArrayScale",
    "ReflectorPlace",
    "SoundSpeed",
    "flipped",
    "mirror_of",
    "scale_from_direction",
    "speed_from_distance",
    "speed_from_spread",
]

_FLIPS: Final[dict[str, tuple[float, float, float]]] = {
    "mirrored left to right": (1.0, -1.0, 1.0),
    "mirrored upside down": (1.0, 1.0, -1.0),
    "turned by 180° about its axis": (1.0, -1.0, -1.0),
}
_MAX_APART_DEG: Final = 20.0  # A place that is given roughly may differ so far from the measured one.
_MIN_ASIDE_DEG: Final = 10.0
_PACE_SD: Final = 0.05  # Relative deviation of the speed of sound between 0 and 60 °C.
_DISTANCE_SD_M: Final = 2e-3  # of a tape measure
_ROUGH_DEG: Final = 8.0  # Error of a direction that is stated roughly.
_MIN_OFF_AXIS_DEG: Final = 15.0  # The sine of smaller angles is not known to 13 %.


class ReflectorPlace(NamedTuple):
    """Place of a reflector, as seen from the sensor."""

    azimuth_deg: float
    elevation_deg: float
    range_m: float

    @property
    def shows_mirroring(self) -> bool:
        """True if mirror images of the direction differ enough to be told apart."""
        return min(abs(self.azimuth_deg), abs(self.elevation_deg)) >= _MIN_ASIDE_DEG

    def checked(self) -> "ReflectorPlace":
        """Return the place; raise ArgumentError if an angle or the range is out of its limits."""
        checks.between("azimuth of the place", self.azimuth_deg, -90.0, 90.0)
        checks.between("elevation of the place", self.elevation_deg, -90.0, 90.0)
        checks.between("range of the place", self.range_m, 0.05, 100.0)
        return self


class SoundSpeed(NamedTuple):
    """Measured speed of sound and its standard deviation."""

    speed_m_s: float
    sd_m_s: float


class ArrayScale(NamedTuple):
    """Size of the array relative to the layout, and its error for each degree of error of the direction."""

    ratio: float
    error_1_deg: float

    @property
    def contradicts(self) -> bool:
        """True if even a rough direction contradicts the size of the layout."""
        return abs(self.ratio - 1) > _ROUGH_DEG * self.error_1_deg / self.ratio

    def __str__(self) -> str:
        return f"{self.ratio:.2f} times that of the layout (± {self.error_1_deg:.2f} per degree of error)"


def mirror_of(source_m: NDArray[np.float64], place: ReflectorPlace) -> str:
    """Return how the layout is mirrored; empty if it is not; raise DataError if no mirror image explains source_m."""
    known = unit_vectors(np.radians(place.azimuth_deg), np.radians(place.elevation_deg)).ravel()
    found = source_m / np.linalg.norm(source_m)
    tried = {"": (1.0, 1.0, 1.0), **_FLIPS}
    apart_deg = {name: _apart_deg(found * np.array(flip), known) for name, flip in tried.items()}
    best = min(apart_deg, key=lambda name: apart_deg[name])
    if apart_deg[best] < _MAX_APART_DEG:
        return best
    azimuth_deg = math.degrees(math.atan2(found[1], found[0]))
    raise DataError(
        f"the reflector of the first recording appears at azimuth {azimuth_deg:.0f}°, elevation "
        f"{math.degrees(math.asin(found[2])):.0f}°, but the given place is {place.azimuth_deg:g}°, "
        f"{place.elevation_deg:g}°, which no mirrored layout explains; correct the place, or turn the sensor"
    )


def scale_from_direction(source_m: NDArray[np.float64], place: ReflectorPlace) -> ArrayScale | None:
    """Return the size of the array relative to the layout by the known direction of a reflector; None near the axis.

    Delays across an array that is k times as large as its layout are those of a sine from the axis that is k times as
    large.
    """
    ahead, *aside = unit_vectors(np.radians(place.azimuth_deg), np.radians(place.elevation_deg)).ravel()
    known = math.hypot(*aside)
    if known < math.sin(math.radians(_MIN_OFF_AXIS_DEG)):
        return None
    ratio = float(np.linalg.norm(source_m[1:]) / np.linalg.norm(source_m)) / known
    return ArrayScale(ratio, ratio * math.radians(1) * abs(ahead) / known)


def flipped(name: str) -> NDArray[np.float64]:
    """Return the factors of x, y and z that undo a mirror image: (3,) float64."""
    return np.array(_FLIPS[name])


def _apart_deg(one: NDArray[np.float64], other: NDArray[np.float64]) -> float:
    return math.degrees(math.acos(float(np.clip(one @ other, -1.0, 1.0))))


def speed_from_distance(
    source_m: NDArray[np.float64], place: ReflectorPlace, speed_m_s: float, target: Target
) -> SoundSpeed:
    """Return the speed ``c r₀ / r`` by the known distance r₀, to 2 mm, of a reflector measured at r with c."""
    paths = 2.0 if target == "wall" else 1.0
    found = float(speed_m_s * paths * place.range_m / np.linalg.norm(source_m))
    return SoundSpeed(found, found * _DISTANCE_SD_M / place.range_m)


def speed_from_spread(
    time_s: NDArray[np.float64],
    time_sd_s: NDArray[np.float64],
    positions_m: NDArray[np.float64],
    source_m: NDArray[np.float64],
    speed_m_s: float,
    target: Target,
) -> SoundSpeed:
    """Return the speed of sound from the spread of the times (mic,) at which direct sound arrives."""
    # Least squares with the emitter's position and 1 / c as unknowns, with a normal prior of 5 % for 1 / c.

    def residuals(unknown: NDArray[np.float64]) -> NDArray[np.float64]:
        model = travel_times(unknown[None, :3], positions_m, speed_m_s / (1 + unknown[3]), target)
        return np.append((time_s - model.time_s[0]) / time_sd_s, unknown[3] / _PACE_SD)

    def jacobian(unknown: NDArray[np.float64]) -> NDArray[np.float64]:
        model = travel_times(unknown[None, :3], positions_m, speed_m_s / (1 + unknown[3]), target)
        slopes = np.column_stack([model.by_source[0], model.time_s[0] / (1 + unknown[3])])
        return np.vstack([-slopes / time_sd_s[:, None], [0, 0, 0, 1 / _PACE_SD]])

    found = scipy.optimize.least_squares(residuals, np.append(source_m, 0.0), jac=jacobian, x_scale="jac")
    slopes = jacobian(found.x)
    sd = math.sqrt(float(np.linalg.pinv(slopes.T @ slopes, hermitian=True)[3, 3]))
    speed = speed_m_s / (1 + float(found.x[3]))
    return SoundSpeed(speed, speed * sd)
