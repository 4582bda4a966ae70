"""Points of several sensors as one cloud: each reflector once, located by all echoes that it causes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.analysis.points import PointExtractor
from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.fusion.attribution import Shares
from ertis_numba.fusion.polar_grid import PolarGrid
from ertis_numba.fusion.receivers import Receiver
from ertis_numba.fusion.rig import MountedSensor
from ertis_numba.geometry import Grid

__all__ = ["Observation", "PointFuser", "joined"]

Floats = NDArray[np.float64]

_TOP: Final = 128  # Points per image.
_MIN_SHARE: Final = 0.5
_RANGE_SD_M: Final = 1e-3  # Errors that noise does not explain, such as those of mountings and of the air.
_ANGLE_SD_RAD: Final = math.radians(0.25)
_UNKNOWN_RANGE_SD_M: Final = 5e-3
_UNKNOWN_ANGLE_SD_RAD: Final = math.radians(1.0)
_SAME_M: Final = 0.015  # Distance of two observations of the same reflector, in addition to their uncertainties.
_GATE: Final = 16.0  # Squared Mahalanobis distance; four standard deviations along one axis.
_ROUNDS: Final = 8
_OUTLIER: Final = 2.0  # Residual, in standard deviations, that has half of the weight.
_NEAREST_M: Final = 0.05
_VERTICAL: Final = 1e-6
# Between emitter and receiver, the path does not depend on the position, which may then be anywhere within 10 m.
_LEAST_INFORMATION_1_M2: Final = 1 / 10.0**2


class Observation(NamedTuple):
    """Echo in the image of one sensor, attributed to an emitter.

    Attributes
    ----------
    emitter, receiver : int
    path_m : float
        Path of the sound.
    direction : (axis,) float64
        Unit vector from the receiver, in the frame of the platform.
    path_sd_m, angle_sd_rad : float
        Standard deviations of path and direction.
    position_m : (axis,) float64
        Position of the reflector according to this echo alone.
    amplitude : float
    """

    emitter: int
    receiver: int
    path_m: float
    direction: Floats
    path_sd_m: float
    angle_sd_rad: float
    position_m: Floats
    amplitude: float


class PointFuser:
    """Extractor of the points of one sensor, attributed to the emitters of their echoes.

    Parameters
    ----------
    number : int
        Index of the sensor in ``sensors``.
    sensors : tuple of MountedSensor
    receiver : Receiver
    image : Energyscape
        Any image of the sensor.
    deaf : (step,) bool
        Steps at which direct sound hides echoes.
    """

    def __init__(
        self,
        number: int,
        sensors: tuple[MountedSensor, ...],
        receiver: Receiver,
        image: Energyscape,
        deaf: NDArray[np.bool_],
    ) -> None:
        self._number, self._sensors, self._receiver = number, sensors, receiver
        self._is_deaf = deaf[(image.range_m / receiver.step_m).astype(np.int64)]
        self._extract = PointExtractor(image.settings, Grid(image.azimuth_rad, image.elevation_rad), top=_TOP)

    def observations(self, image: Energyscape, shares: Shares, late_m: Mapping[int, float]) -> list[Observation]:
        """Return the echoes of an image, strongest first.

        Parameters
        ----------
        image : Energyscape
        shares : Shares
        late_m : mapping of int to float
            Path of sound between the emission of this sensor and that of each emitter.
        """
        if self._is_deaf.any():  # Points are found relative to the strongest one, which direct sound would be.
            image = image.replace(amplitude=np.where(self._is_deaf, np.float32(0), image.amplitude))
        cloud = self._extract(image)
        found = []
        for place_m, amplitude, uncertainty_m in zip(
            cloud.position_m.astype(np.float64), cloud.amplitude.tolist(), _uncertainties(cloud), strict=True
        ):
            range_m = float(np.linalg.norm(place_m))
            emitter = self._emitter(place_m / range_m, range_m, shares)
            if emitter is None:
                continue
            seen = self._observation(place_m, range_m, emitter, 2 * range_m - late_m[emitter], uncertainty_m, amplitude)
            if seen is not None:
                found.append(seen)
        return found

    def _emitter(self, direction: Floats, range_m: float, shares: Shares) -> int | None:
        """Return the emitter that explains an echo best, or None if reflectors elsewhere explain it."""
        receiver = self._receiver
        step = int(range_m / receiver.step_m)
        row = int(np.argmax(receiver.directions @ direction)) * receiver.n_steps
        near = slice(row + max(0, step - 1), row + min(receiver.n_steps, step + 2))
        emitters = [emitter for emitter, number in shares if number == self._number]
        share = [float(shares[emitter, self._number][near].max(initial=0.0)) for emitter in emitters]
        return emitters[int(np.argmax(share))] if sum(share) > _MIN_SHARE else None

    def _observation(
        self, place_m: Floats, range_m: float, emitter: int, path_m: float, uncertainty_m: Floats, amplitude: float
    ) -> Observation | None:
        mounting = self._sensors[self._number]
        direction = mounting.rotation @ (place_m / range_m)
        offset_m = self._sensors[emitter].translation_m - mounting.translation_m
        beyond = path_m**2 - float(offset_m @ offset_m)
        if beyond <= 0:
            return None
        to_m = beyond / (2 * (path_m - float(direction @ offset_m)))
        return Observation(
            emitter,
            self._number,
            path_m,
            direction,
            2 * math.hypot(float(uncertainty_m[0]), _RANGE_SD_M),
            math.hypot(float(uncertainty_m[1]) / range_m, _ANGLE_SD_RAD),
            mounting.translation_m + to_m * direction,
            amplitude,
        )


def joined(
    observations: Sequence[Observation], sensors: Sequence[MountedSensor], image: Energyscape, grid: PolarGrid
) -> PointCloud:
    """Return one point for each reflector, in the frame of the platform, strongest first.

    Parameters
    ----------
    observations : sequence of Observation
    sensors : sequence of MountedSensor
    image : Energyscape
        Fused image, which yields amplitudes.
    grid : PolarGrid
        Cells of the fused image.
    """
    reflectors = _Reflectors(sorted(observations, key=_order), sensors)
    position_m = reflectors.position_m
    cell = grid.cell_of(position_m)
    amplitude = np.where(cell >= 0, _around(image.amplitude).reshape(-1).take(cell.clip(0)), np.float32(0))
    order = np.argsort(-amplitude, kind="stable")
    uncertainty_m = np.array(
        [_along_and_across(*each) for each in zip(position_m, reflectors.covariance_m2, strict=True)]
    ).reshape(-1, 2)
    return PointCloud(
        position_m[order].astype(np.float32),
        amplitude[order],
        image.settings,
        replace(image.stamp),
        translation_m=(0.0, 0.0, 0.0),
        rotation_xyzw=(0.0, 0.0, 0.0, 1.0),
        uncertainty_m=uncertainty_m[order].astype(np.float32),
    )


def _order(seen: Observation) -> tuple[bool, float]:
    """Return the place of an observation: own echoes first, each kind from the strongest one."""
    return seen.emitter != seen.receiver, -seen.amplitude


class _Reflectors:
    """Reflectors that cause observations, each at the position that fits all of its echoes best.

    An echo of a foreign call alone has two explanations, and nothing confirms this one, so it is left out.

    Parameters
    ----------
    observations : sequence of Observation
        Own echoes first, each kind from the strongest one.
    sensors : sequence of MountedSensor

    Attributes
    ----------
    position_m : (reflector, axis) float64
    covariance_m2 : (reflector, axis, axis) float64
    """

    def __init__(self, observations: Sequence[Observation], sensors: Sequence[MountedSensor]) -> None:
        self._locate = kernels.load_fusion().locate_reflector
        self._emitter_m = np.array([sensors[each.emitter].translation_m for each in observations]).reshape(-1, 3)
        self._receiver_m = np.array([sensors[each.receiver].translation_m for each in observations]).reshape(-1, 3)
        self._path_m = np.array([each.path_m for each in observations])
        self._axes = np.array([[each.direction, *_tangents(each.direction)] for each in observations])
        self._deviation = np.array([(each.path_sd_m, each.angle_sd_rad) for each in observations])
        self._place_m = np.array([each.position_m for each in observations]).reshape(-1, 3)
        self._members: list[list[int]] = []
        self._pairs: list[set[tuple[int, int]]] = []
        self._mean_m, self._spread_m2 = np.empty_like(self._place_m), np.empty((len(observations), 3, 3))
        for index, each in enumerate(observations):
            self._add(index, (each.emitter, each.receiver))
        self.position_m, self.covariance_m2 = (
            values[: len(self._members)] for values in (self._mean_m, self._spread_m2)
        )

    def _add(self, index: int, pair: tuple[int, int]) -> None:
        """Add an observation to the nearest reflector, or to none, or let it be a new one."""
        position_m, covariance_m2 = self._located([index])
        nearest = self._nearest(position_m, covariance_m2)
        if nearest is None:
            if pair[0] == pair[1]:
                self._mean_m[len(self._members)], self._spread_m2[len(self._members)] = position_m, covariance_m2
                self._members.append([index])
                self._pairs.append({pair})
        elif pair not in self._pairs[nearest]:  # A pair sees a reflector once; another echo is a shoulder of the first.
            self._members[nearest].append(index)
            self._pairs[nearest].add(pair)
            self._mean_m[nearest], self._spread_m2[nearest] = self._located(self._members[nearest])

    def _nearest(self, position_m: Floats, covariance_m2: Floats) -> int | None:
        """Return the reflector with the least Mahalanobis distance, or None if all are too far away."""
        count = len(self._members)
        if not count:
            return None
        offset_m = position_m - self._mean_m[:count]
        spread_m2 = self._spread_m2[:count] + covariance_m2 + _SAME_M**2 * np.eye(3)
        distance = np.einsum("ri,ri->r", offset_m, np.linalg.solve(spread_m2, offset_m[..., None])[..., 0])
        nearest = int(np.argmin(distance))
        return nearest if distance[nearest] < _GATE else None

    def _located(self, members: list[int]) -> tuple[Floats, Floats]:
        """Return the position of a reflector and its covariance: (axis,) and (axis, axis) float64."""
        places_m = np.sort(self._place_m[members], axis=0)
        median_m = (places_m[(len(members) - 1) // 2] + places_m[len(members) // 2]) / 2
        position_m, covariance_m2 = median_m.copy(), np.empty((3, 3))
        is_alone = len(members) == 1
        self._locate(
            self._emitter_m[members],
            self._receiver_m[members],
            self._path_m[members],
            self._axes[members],
            self._deviation[members],
            _LEAST_INFORMATION_1_M2,
            _NEAREST_M,
            math.inf if is_alone else _OUTLIER,
            1 if is_alone else _ROUNDS,
            position_m,
            covariance_m2,
        )
        return median_m if is_alone else position_m, covariance_m2


def _tangents(direction: Floats) -> Floats:
    """Return two unit vectors across a direction: (2, axis) float64."""
    x, y, z = direction.tolist()
    level = math.hypot(x, y)
    # Straight up, any horizontal direction will do.
    left = np.array([-y / level, x / level, 0.0]) if level > _VERTICAL else np.array([0.0, 1.0, 0.0])
    up = np.array([-z * left[1], z * left[0], x * left[1] - y * left[0]])
    return np.stack([left, up])


def _uncertainties(cloud: PointCloud) -> Floats:
    """Return standard deviations along range and across, with defaults for unknown ones: (point, 2) float64."""
    range_m = np.maximum(np.linalg.norm(cloud.position_m, axis=1), _NEAREST_M)
    unknown_m = np.stack([np.full(len(cloud), _UNKNOWN_RANGE_SD_M), _UNKNOWN_ANGLE_SD_RAD * range_m], axis=1)
    given_m = unknown_m if cloud.uncertainty_m is None else cloud.uncertainty_m.astype(np.float64)
    return np.asarray(np.where(np.isfinite(given_m), given_m, unknown_m))


def _along_and_across(place_m: Floats, covariance: Floats) -> tuple[float, float]:
    """Return standard deviations along the line from the platform, and across it in the horizontal plane."""
    direction = place_m / max(_NEAREST_M, float(np.linalg.norm(place_m)))
    across = _tangents(direction)[0]
    return math.sqrt(direction @ covariance @ direction), math.sqrt(across @ covariance @ across)


def _around(amplitude: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the highest amplitude of each cell and the two beside it in range."""
    found = amplitude.copy()
    np.maximum(found[:, 1:], amplitude[:, :-1], out=found[:, 1:])
    np.maximum(found[:, :-1], amplitude[:, 1:], out=found[:, :-1])
    return found
