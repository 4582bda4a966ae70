"""Points of several sensors as one cloud: each reflector once, located by all echoes that it causes."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

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
_LEAST_INFORMATION: Final = np.eye(3) / 10.0**2


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

    def rows(self, position_m: Floats, poses: Sequence[MountedSensor]) -> tuple[Floats, Floats]:
        """Return residuals and their derivatives, in standard deviations: (row,) and (row, axis) float64."""
        away_m, back_m = (position_m - poses[number].translation_m for number in (self.emitter, self.receiver))
        from_m, to_m = (max(_NEAREST_M, float(np.linalg.norm(each))) for each in (away_m, back_m))
        across = _tangents(self.direction)
        residual = np.append(
            (self.path_m - from_m - to_m) / self.path_sd_m, -(across @ back_m) / to_m / self.angle_sd_rad
        )
        slopes = np.vstack([(away_m / from_m + back_m / to_m) / self.path_sd_m, across / to_m / self.angle_sd_rad])
        return residual, slopes


class PointFuser:
    """Extractor of the points of one sensor, attributed to the emitters of their echoes.

    Parameters
    ----------
    number : int
        Index of the sensor in ``poses``.
    poses : tuple of MountedSensor
    receiver : Receiver
    image : Energyscape
        Any image of the sensor.
    """

    def __init__(self, number: int, poses: tuple[MountedSensor, ...], receiver: Receiver, image: Energyscape) -> None:
        self._number, self._poses, self._receiver = number, poses, receiver
        self._extract = PointExtractor(image.settings, Grid(image.azimuth_rad, image.elevation_rad), top=_TOP)

    def observations(self, image: Energyscape, shares: Shares, late_m: Mapping[int, float]) -> list[Observation]:
        """Return the echoes of an image, strongest first.

        Parameters
        ----------
        image : Energyscape
        shares : Shares
        late_m : mapping of int to float
            Path of sound between the start of the record and the emission of each sensor.
        """
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
        pose = self._poses[self._number]
        direction = pose.rotation @ (place_m / range_m)
        offset_m = self._poses[emitter].translation_m - pose.translation_m
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
            pose.translation_m + to_m * direction,
            amplitude,
        )


def joined(
    observations: Sequence[Observation], poses: Sequence[MountedSensor], image: Energyscape, grid: PolarGrid
) -> PointCloud:
    """Return one point for each reflector, in the frame of the platform, strongest first.

    Parameters
    ----------
    observations : sequence of Observation
    poses : sequence of MountedSensor
    image : Energyscape
        Fused image, which yields amplitudes.
    grid : PolarGrid
        Cells of the fused image.
    """
    located = [_located(cluster, poses) for cluster in _clusters(sorted(observations, key=_order), poses)]
    position_m = np.array([place for place, _ in located]).reshape(-1, 3)
    cell = grid.cell_of(position_m)
    amplitude = np.where(cell >= 0, _around(image.amplitude).reshape(-1).take(cell.clip(0)), np.float32(0))
    order = np.argsort(-amplitude, kind="stable")
    uncertainty_m = np.array([_along_and_across(place, covariance) for place, covariance in located]).reshape(-1, 2)
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


def _clusters(observations: Sequence[Observation], poses: Sequence[MountedSensor]) -> list[list[Observation]]:
    """Return the observations of each reflector.

    An echo of a foreign call alone has two explanations, and nothing confirms this one, so it is left out.
    """
    found: list[list[Observation]] = []
    means: list[tuple[Floats, Floats]] = []
    for each in observations:
        covariance = _covariance(each, poses)
        best, least = -1, _GATE
        for number, (mean, spread) in enumerate(means):
            offset = each.position_m - mean
            distance = float(offset @ np.linalg.solve(covariance + spread + _SAME_M**2 * np.eye(3), offset))
            if distance < least:
                best, least = number, distance
        pairs = [(other.emitter, other.receiver) for other in found[best]] if best >= 0 else []
        if (each.emitter, each.receiver) in pairs:
            continue  # A pair sees a reflector once; this is a shoulder of the same echo.
        if best < 0 and each.emitter == each.receiver:
            found.append([each])
            means.append((each.position_m, covariance))
        elif best >= 0:
            found[best].append(each)
            means[best] = _located(found[best], poses)
    return found


def _located(cluster: Sequence[Observation], poses: Sequence[MountedSensor]) -> tuple[Floats, Floats]:
    """Return the position of a reflector and its covariance: (axis,) and (axis, axis) float64.

    Least squares with the weights of a Cauchy distribution (P. J. Huber, E. M. Ronchetti, Robust Statistics, 2009).
    """
    position_m = np.median([each.position_m for each in cluster], axis=0)
    covariance = _covariance(cluster[0], poses)
    for _ in range(_ROUNDS if len(cluster) > 1 else 0):
        rows = [each.rows(position_m, poses) for each in cluster]
        residual = np.concatenate([row for row, _ in rows])
        slopes = np.concatenate([slope for _, slope in rows])
        # Echoes that overlap at one sensor shift its direction or range by far more than noise does.
        weighted = slopes / (1 + (residual / _OUTLIER) ** 2)[:, None]
        covariance = np.linalg.inv(weighted.T @ slopes + _LEAST_INFORMATION)
        position_m = position_m + covariance @ weighted.T @ residual
    return position_m, covariance


def _covariance(seen: Observation, poses: Sequence[MountedSensor]) -> Floats:
    _, slopes = seen.rows(seen.position_m, poses)
    return np.asarray(np.linalg.inv(slopes.T @ slopes + _LEAST_INFORMATION))


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
