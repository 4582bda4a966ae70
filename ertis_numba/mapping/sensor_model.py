"""Inverse sensor model of a sonar: evidence for free and for occupied space from the points of one pulse."""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.fusion.rig import Emitters, MountedSensor
from ertis_numba.mapping.cell_grid import Window
from ertis_numba.settings import Settings

__all__ = ["Coverage", "LocatedEchoes", "UsualAmplitude", "add_evidence", "echoes_of"]

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

N_AZIMUTHS: Final = 360
"""Directions for free space, of 1°."""
_OCCUPIED: Final = 5.0  # Log-odds of a clear echo, shared among the cells that may contain it.
_MOST: Final = 0.6  # Log-odds of a cell from one pulse; ghosts seldom repeat, so that a single one is not enough.
_FREE: Final = 0.6  # Log-odds of a cell in front of the first clear echo, near the platform.
_FREE_M: Final = 1.0  # Free range in directions without any clear echo.
_IN_FRONT_M: Final = 0.05  # Space in front of an echo that is not free yet.
_BEHIND_M: Final = 0.3  # Distance behind an obstacle within the beam from which it hides echoes.
_DEPTH_M: Final = 0.1  # The same for a wall of the map in the direction of the echo: the thickness of its cells.
_WALL: Final = 1.5  # Log-odds from which a cell hides those behind it.
_OPEN: Final = -0.5  # Log-odds below which a cell lets sound pass.
_CLEAR: Final = 0.6  # Weight of a clear echo.
_HALF_BEAM: Final = 5  # Directions beside an echo in which it may hide others.
_HALF_RAY: Final = 1  # The same for a wall of the map, whose directions are known.
_USUAL: Final = 50.0  # Percentile of the amplitudes of a pulse that is the usual one.
# Amplitude, relative to the usual one, at which one half of the points are ghosts, as measured in simulated places.
_GHOST: Final = 0.2
_DISTRUST: Final = 0.25  # Exponent of the coverage in the weight of echoes, of which more are ghosts at the edges.
_SMOOTHING: Final = 0.1  # Weight of a new pulse in the usual amplitude.
# Errors of positions that noise does not explain: overlapping echoes of rough walls, mountings and poses.
_RANGE_SD_M: Final = 0.01
_ANGLE_SD_RAD: Final = math.radians(0.3)
_REACH_SD: Final = 3.0  # Standard deviations within which an echo counts.
_TOUCHED: Final = 0.02  # Probability of an echo in a cell from which the cell is not free.
_WEAKEST_DB: Final = -15.0  # Emitted power, relative to ahead, below which silence shows nothing.


class LocatedEchoes(NamedTuple):
    """Points of one pulse around the platform.

    Attributes
    ----------
    azimuth_rad, range_m : (point,) float64
        In the plane, in the frame of the platform's heading.
    sd_m : (point, 2) float64
        Standard deviations along and across the direction.
    strength : (point,) float64
        Weight, at most 1: probability that the point is a reflector.
    """

    azimuth_rad: Floats
    range_m: Floats
    sd_m: Floats
    strength: Floats


class UsualAmplitude:
    """Running amplitude of a clear echo, which depends on the walls of a place."""

    def __init__(self) -> None:
        self._usual: float | None = None

    def strength(self, amplitude: Singles) -> Floats:
        """Return the probability that the points of a pulse are reflectors: (point,) float64.

        It is a² / (a² + g²) for the amplitude a, where g is that of ghosts.
        """
        if not len(amplitude):
            return np.zeros(0)
        now = float(np.percentile(amplitude, _USUAL))
        self._usual = now if self._usual is None else (1 - _SMOOTHING) * self._usual + _SMOOTHING * now
        power = (amplitude.astype(np.float64) / max(self._usual, 1e-30)) ** 2
        return np.asarray(power / (power + _GHOST**2))


def echoes_of(offset_m: Floats, uncertainty_m: Floats, strength: Floats) -> LocatedEchoes:
    """Return points as echoes.

    Parameters
    ----------
    offset_m : (point, 2) float64
        Positions in the frame of the platform's heading.
    uncertainty_m : (point, 2) float64
        Standard deviations along and across the direction.
    strength : (point,) float64
    """
    range_m = np.hypot(offset_m[:, 0], offset_m[:, 1])
    sd_m = np.hypot(uncertainty_m, np.stack([np.full(len(range_m), _RANGE_SD_M), _ANGLE_SD_RAD * range_m], axis=1))
    return LocatedEchoes(np.arctan2(offset_m[:, 1], offset_m[:, 0]), range_m, sd_m, strength)


class Coverage(NamedTuple):
    """Part of the surroundings in which a clear echo would be heard.

    Attributes
    ----------
    weight : (azimuth, range) float64
        0 where no sensor emits or listens, up to 1 ahead of a sensor.
    step_m : float
        Spacing of the ranges, which begin at 0.
    """

    weight: Floats
    step_m: float

    def at(self, azimuth_rad: Floats, range_m: Floats) -> Floats:
        """Return the weights of directions and ranges, 0 beyond the last range: (point,) float64."""
        step = (range_m / self.step_m).astype(np.int64)
        n_ranges = self.weight.shape[1]
        found = self.weight[_direction(azimuth_rad), np.minimum(step, n_ranges - 1)]
        return np.where(step < n_ranges, found, 0.0)

    @classmethod
    def of(
        cls,
        poses: Sequence[MountedSensor],
        limits_m: Sequence[tuple[float, float]],
        settings: Settings,
        diameter_m: float,
        step_m: float,
    ) -> "Coverage":
        """Return the coverage of sensors that emit.

        Parameters
        ----------
        poses : sequence of MountedSensor
        limits_m : sequence of (first, last)
            Ranges of their images.
        settings : Settings
            Settings with the call and the air.
        diameter_m : float
            Diameter of the emitters.
        step_m : float
        """
        emitters = Emitters(settings, diameter_m)
        reach_m = max(
            float(np.hypot(*pose.translation_m[:2])) + last for pose, (_, last) in zip(poses, limits_m, strict=True)
        )
        range_m = (np.arange(math.ceil(reach_m / step_m)) + 0.5) * step_m
        azimuth_rad = (np.arange(N_AZIMUTHS) + 0.5) * (2 * math.pi / N_AZIMUTHS)
        unit = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad), np.zeros(N_AZIMUTHS)], axis=1)
        weight = np.zeros((N_AZIMUTHS, len(range_m)))
        for pose, (first_m, last_m) in zip(poses, limits_m, strict=True):
            place_m = unit[:, None] * range_m[:, None] + [0.0, 0.0, pose.translation_m[2]]
            local_m = pose.local_m(place_m)
            distance_m = np.linalg.norm(local_m, axis=-1)
            power_db = 10 * np.log10(emitters.power(local_m[..., 0] / np.maximum(distance_m, 1e-6)))
            heard = np.clip(1 - power_db / _WEAKEST_DB, 0.0, 1.0) * (local_m[..., 0] > 0)
            # Silence means less at long ranges, because spreading and oblique walls make echoes weak.
            heard *= (distance_m >= first_m) * np.clip(1 - distance_m / last_m, 0.0, 1.0)
            np.maximum(weight, heard, out=weight)
        return cls(weight, step_m)


def add_evidence(
    window: Window, place_m: Floats, heading_rad: float, echoes: LocatedEchoes, coverage: Coverage, *, near_m: float
) -> None:
    """Add the evidence of one pulse to a map.

    Parameters
    ----------
    window : Window
        Part of the map around the platform, which changes.
    place_m : (2,) float64
        Position of the platform in the world.
    heading_rad : float
        Heading of the platform in the world.
    echoes : LocatedEchoes
    coverage : Coverage
    near_m : float
        Radius of the platform, whose own place is free.
    """
    first_m, wall_m = _first_clear_m(echoes), _wall_m(window, place_m, heading_rad, coverage)
    end_m: Floats = np.where(np.isfinite(first_m), first_m - _IN_FRONT_M, _FREE_M)
    is_open = _log_odds(window, place_m, heading_rad, end_m[:, None] + _IN_FRONT_M)[:, 0] < _OPEN
    hiding_m = np.minimum(np.where(is_open, np.inf, first_m), wall_m)
    trusted = echoes.strength * coverage.at(echoes.azimuth_rad, echoes.range_m) ** _DISTRUST
    trusted *= _visible(echoes, hiding_m, wall_m)
    occupied = _occupied(window, place_m, heading_rad, echoes._replace(strength=trusted))
    free = _free(window, place_m, heading_rad, np.minimum(end_m, wall_m), coverage, near_m=near_m)
    free[occupied > _TOUCHED] = 0.0
    window.log_odds[:] += np.minimum(_OCCUPIED * occupied, _MOST) - _FREE * free


def _direction(azimuth_rad: Floats) -> NDArray[np.int64]:
    """Return the direction of azimuths, counted from that of the heading."""
    return np.floor(azimuth_rad * (N_AZIMUTHS / (2 * math.pi))).astype(np.int64) % N_AZIMUTHS


def _first_clear_m(echoes: LocatedEchoes) -> Floats:
    """Return the range of the first clear echo in each direction, infinite without one: (azimuth,) float64."""
    first_m = np.full(N_AZIMUTHS, np.inf)
    is_clear = echoes.strength > _CLEAR
    around = _beside(echoes.azimuth_rad[is_clear], _HALF_BEAM)
    np.minimum.at(first_m, around, echoes.range_m[is_clear][:, None])
    return first_m


def _visible(echoes: LocatedEchoes, hiding_m: Floats, wall_m: Floats) -> Floats:
    """Return the share of the amplitude that passes the obstacles in front of echoes: (point,) float64.

    The share of directions that are open passes on the way to the reflector, and again on the way back. Around an echo,
    obstacles within the beam count: a wall fills it, and a post does not. In the direction of the echo, a wall of the
    map hides everything behind it.

    Parameters
    ----------
    echoes : LocatedEchoes
    hiding_m : (azimuth,) float64
        Ranges of the first obstacles.
    wall_m : (azimuth,) float64
        Ranges of the first walls of the map.
    """
    passed = [
        np.mean(first_m[_beside(echoes.azimuth_rad, half_width)] + behind_m >= echoes.range_m[:, None], axis=1)
        for first_m, half_width, behind_m in ((hiding_m, _HALF_BEAM, _BEHIND_M), (wall_m, _HALF_RAY, _DEPTH_M))
    ]
    return np.asarray(np.minimum(*passed) ** 2)


def _beside(azimuth_rad: Floats, half_width: int) -> NDArray[np.int64]:
    """Return the directions beside azimuths, and their own: (point, direction) int64."""
    beside = np.arange(-half_width, half_width + 1)
    return np.asarray((_direction(azimuth_rad)[:, None] + beside) % N_AZIMUTHS)


def _wall_m(window: Window, place_m: Floats, heading_rad: float, coverage: Coverage) -> Floats:
    """Return the range behind the first cell that earlier pulses have found occupied: (azimuth,) float64."""
    range_m = np.asarray((np.arange(coverage.weight.shape[1]) + 0.5) * coverage.step_m, np.float64)
    is_wall = _log_odds(window, place_m, heading_rad, range_m) > _WALL
    first_m = range_m[is_wall.argmax(axis=1)] + float(window.x_m[1] - window.x_m[0])
    return np.asarray(np.where(is_wall.any(axis=1), first_m, np.inf))


def _log_odds(window: Window, place_m: Floats, heading_rad: float, range_m: Floats) -> Singles:
    """Return the log-odds of a map along all directions, at (range,) or (azimuth, range): (azimuth, range) float32."""
    cell_m = float(window.x_m[1] - window.x_m[0])
    azimuth_rad = (np.arange(N_AZIMUTHS) + 0.5) * (2 * math.pi / N_AZIMUTHS) + heading_rad
    row, column = (
        np.rint((place_m[axis] - centre_m[0] + unit[:, None] * range_m) / cell_m)
        .astype(np.int64)
        .clip(0, len(centre_m) - 1)
        for axis, centre_m, unit in ((1, window.y_m, np.sin(azimuth_rad)), (0, window.x_m, np.cos(azimuth_rad)))
    )
    return np.asarray(window.log_odds[row, column])


def _free(
    window: Window, place_m: Floats, heading_rad: float, end_m: Floats, coverage: Coverage, *, near_m: float
) -> Singles:
    """Return the weight of free space in each cell: (row, column) float32, 0 to 1."""
    n_ranges = coverage.weight.shape[1]
    range_m = (np.arange(n_ranges) + 0.5) * coverage.step_m
    polar = np.where(range_m < end_m[:, None], coverage.weight, 0.0).astype(np.float32)
    dx_m, dy_m = (window.x_m - place_m[0])[None, :], (window.y_m - place_m[1])[:, None]
    distance_m = np.hypot(dx_m, dy_m)
    step = np.minimum((distance_m / coverage.step_m).astype(np.int64), n_ranges - 1)
    free = polar[_direction(np.arctan2(dy_m, dx_m) - heading_rad), step]
    free[distance_m < near_m] = 1.0
    return np.asarray(free)


def _occupied(window: Window, place_m: Floats, heading_rad: float, echoes: LocatedEchoes) -> Singles:
    """Return the expected number of echoes in each cell: (row, column) float32."""
    occupied = window._replace(log_odds=np.zeros_like(window.log_odds))
    cell_m = float(window.x_m[1] - window.x_m[0])
    azimuth_rad = echoes.azimuth_rad + heading_rad
    unit = np.stack([np.cos(azimuth_rad), np.sin(azimuth_rad)], axis=1)
    centre_m = place_m + unit * echoes.range_m[:, None]
    variance_m2 = echoes.sd_m**2 + cell_m**2 / 12
    reach_m = _REACH_SD * echoes.sd_m.max(axis=1, initial=0.0) + cell_m
    peak = echoes.strength * cell_m**2 / (2 * math.pi * np.sqrt(variance_m2.prod(axis=1)))
    for number, (ahead, left) in enumerate(unit.tolist()):
        part = occupied.around(centre_m[number], float(reach_m[number]))
        dx_m, dy_m = (part.x_m - centre_m[number, 0])[None, :], (part.y_m - centre_m[number, 1])[:, None]
        along, across = (ahead * dx_m + left * dy_m) ** 2, (ahead * dy_m - left * dx_m) ** 2
        squared = along / variance_m2[number, 0] + across / variance_m2[number, 1]
        part.log_odds[:] += (peak[number] * np.exp(-squared / 2)).astype(np.float32)
    return occupied.log_odds
