"""Images of one sensor on a coarse range axis, and their values at points of the platform."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.analysis.noise import medians_of
from ertis_numba.frames import Energyscape
from ertis_numba.fusion.polar_grid import close_directions
from ertis_numba.fusion.rig import MountedSensor
from ertis_numba.geometry import microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s

__all__ = ["Beam", "CoarseImage", "Receiver"]

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Places = NDArray[np.int64]

_NOISE_FACTOR: Final = 10 ** (9.0 / 10)  # Power of a pixel that noise hardly reaches, relative to its mean.
_SIDE_LOBES: Final = 10 ** (-13.0 / 10)  # Power of side lobes relative to the strongest pixel within one step of range.
_LEAST_POWER: Final = 1e-16  # Keeps squares of ratios within single precision.
_BEAM_RAD: Final = math.radians(5.0)  # Half of the width of the main lobe near its top.
_CLOSE_RAD: Final = math.radians(3.0)  # Error of a direction in a search for a confirming echo.
_THINNED: Final = 4  # One of so many ranges serves to estimate the noise.


class CoarseImage(NamedTuple):
    """Highest power within each step of a coarse range axis above ``floor`` (step,), that of noise and side lobes.

    ``highest`` (direction, step) is that of the neighbourhood, with noise and side lobes.
    """

    power: Singles
    highest: Singles
    floor: Singles


class Beam(NamedTuple):
    """Interpolation (point,) between two directions of an image, with the weight ``share`` of the second one.

    ``inside`` is True for points in front of the sensor and within the limits of its directions.
    """

    first: Places
    second: Places
    share: Singles
    inside: NDArray[np.bool_]


class Receiver:
    """Geometry of the images of one sensor, which all have the same directions and ranges."""

    def __init__(self, mounting: MountedSensor, image: Energyscape, step_m: float) -> None:
        self.mounting, self.step_m = mounting, step_m
        self._azimuth_rad, self._elevation_rad, self._range_m = image.azimuth_rad, image.elevation_rad, image.range_m
        self.directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
        self.is_flat = microphones(image.settings.array).is_flat
        """True if the array cannot distinguish front and back."""
        offset_m = microphones(image.settings.array).enabled_positions_m @ mounting.rotation.T
        self.axes_m2 = np.cov(offset_m.T)
        """Second moments (axis, axis) of the positions of microphones, in the platform frame."""
        call, speed_m_s = image.settings.call, sound_speed_m_s(image.settings.air)
        self.pulse_m = speed_m_s / (call.high_frequency_hz - call.low_frequency_hz)
        """Width of the compressed pulse, as length of a path."""
        wave_m = 2 * speed_m_s / (call.high_frequency_hz + call.low_frequency_hz)
        self.width = wave_m / max(
            float(np.ptp(microphones(image.settings.array).enabled_positions_m[:, 1])), wave_m / 2
        )
        """Width of the main lobe, as difference of unit vectors."""
        self.n_steps = int(image.range_m[-1] / step_m) + 1
        steps = (image.range_m / step_m).astype(np.int64)
        self.has_range = np.isin(np.arange(self.n_steps), steps)
        self._first = np.searchsorted(steps, np.arange(self.n_steps + 1)).astype(np.uint32)
        self.lobe = close_directions(self.directions, _BEAM_RAD).astype(np.uint32)
        """Directions within the main lobe of each direction: (direction, neighbour) uint32."""
        self._close = close_directions(self.directions, _CLOSE_RAD).astype(np.uint32)
        # The planar grid is interpolated; directions all over a sphere are dense enough for the nearest one.
        self._order = np.argsort(image.azimuth_rad) if image.is_planar else None

    def fits(self, image: Energyscape) -> bool:
        """Return True for an image with the same directions and ranges."""
        return (
            np.array_equal(image.azimuth_rad, self._azimuth_rad)
            and np.array_equal(image.elevation_rad, self._elevation_rad)
            and np.array_equal(image.range_m, self._range_m)
        )

    def blind_m(self, deaf: NDArray[np.bool_], mounting: MountedSensor) -> float:
        """Return the largest horizontal distance from the origin of a place too near to the image of a sensor."""
        first = deaf[(self._range_m / self.step_m).astype(np.int64)].argmin()
        edge_m = self._range_m[first] * self.directions @ mounting.rotation.T + mounting.translation_m
        return float(np.hypot(edge_m[:, 0], edge_m[:, 1]).max())

    def coarse(self, image: Energyscape, deaf: NDArray[np.bool_]) -> CoarseImage:
        """Return the powers of an image, with direct sound, which hides echoes, at the steps ``deaf``."""
        amplitude = np.ascontiguousarray(image.amplitude, dtype=np.float32)
        noise = float(medians_of(amplitude[:, ::_THINNED].reshape(1, -1))[0]) ** 2 / math.log(2)
        least = np.float32(max(_NOISE_FACTOR * noise, _LEAST_POWER))
        shape = len(self.directions), self.n_steps
        power, highest = np.empty(shape, np.float32), np.empty(shape, np.float32)
        floor = np.empty(self.n_steps, np.float32)
        kernels.load_fusion().coarsen_image(
            amplitude, self._first, deaf, self._close, np.float32(_SIDE_LOBES), least, floor, highest, power
        )
        return CoarseImage(power, highest, floor)

    def beam(self, local_m: Floats) -> Beam:
        """Return the directions of points in the sensor frame, (point, axis)."""
        ahead = local_m[:, 0] > 0
        if self._order is None:
            # Importing SciPy's trees takes a tenth of a second, and planar images do not need them.
            from scipy.spatial import KDTree  # noqa: PLC0415

            tree = KDTree(self.directions)
            distance = np.linalg.norm(local_m, axis=1)
            off, nearest = tree.query(local_m / np.maximum(distance, 1e-9)[:, None])
            spacing = float(np.median(tree.query(self.directions, k=min(2, len(self.directions)))[0][:, -1]))
            return Beam(nearest, nearest, np.zeros(len(nearest), np.float32), ahead & (off < 1.5 * spacing))
        azimuths_rad = self._azimuth_rad[self._order]
        azimuth_rad = np.arctan2(local_m[:, 1], local_m[:, 0])
        inside = ahead & (azimuth_rad >= azimuths_rad[0]) & (azimuth_rad <= azimuths_rad[-1])
        if len(azimuths_rad) == 1:
            only = np.zeros(len(local_m), np.int64)
            return Beam(only, only, np.zeros(len(local_m), np.float32), inside)
        place = np.searchsorted(azimuths_rad, azimuth_rad).clip(1, len(azimuths_rad) - 1)
        gap_rad = np.maximum(azimuths_rad[place] - azimuths_rad[place - 1], 1e-12)
        share = ((azimuth_rad - azimuths_rad[place - 1]) / gap_rad).clip(0, 1)
        return Beam(self._order[place - 1], self._order[place], share.astype(np.float32), inside)
