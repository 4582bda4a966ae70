"""Echoes of one pulse around a platform, with their uncertainties and the probabilities of being reflectors."""

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

__all__ = ["CLEAR", "LocatedEchoes", "UsualAmplitude", "View", "displaced_covariance", "echoes_of"]

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]
Flags = NDArray[np.bool_]

_USUAL: Final = 50.0  # Percentile of the amplitudes of a pulse that defines the usual one.
# Amplitude at which half of the points are ghosts, relative to the usual amplitude. It comes from a logistic regression
# of points in simulated places, without obstacles in front of them.
_GHOST: Final = 0.08
CLEAR: Final = 0.9
"""Probability of a clear echo."""
_CLEAR_AMPLITUDE: Final = _GHOST * math.sqrt(CLEAR / (1 - CLEAR))  # The same relative to the usual amplitude.
_SMOOTHING: Final = 0.1  # Weight of a new pulse in the usual amplitude.
# Errors of positions that noise does not explain: overlapping echoes of rough walls, mountings and poses.
_RANGE_SD_M: Final = 0.01
_ANGLE_SD_RAD: Final = {2: math.radians(0.3), 3: math.radians(0.7)}  # By number of dimensions.
_NEAREST_M: Final = 0.01  # Range below which directions have no meaning.


def displaced_covariance(covariance: Floats, offset_m: Floats) -> Floats:
    """Return the covariance of the pose of places that move with a platform: (place, 6, 6)."""
    # A rotation by the small vector δ moves a place at r from the origin of the platform by δ × r.
    x, y, z = offset_m.T
    slopes = np.zeros((len(offset_m), 6, 6))
    slopes[:] = np.eye(6)
    slopes[:, 0, 4], slopes[:, 0, 5] = z, -y
    slopes[:, 1, 3], slopes[:, 1, 5] = -z, x
    slopes[:, 2, 3], slopes[:, 2, 4] = y, -x
    return np.asarray(slopes @ covariance @ slopes.transpose(0, 2, 1))


class View(NamedTuple):
    """Place from which a platform sees its surroundings."""

    place_m: Floats  # origin of the directions, in the world
    rotation: Floats  # from the frame of directions to the world; in a plane, the heading
    covariance: Floats  # (6, 6) of x, y, z, and of the rotation about the world's x, y, z

    def covariance_at_m2(self, offset_m: Floats) -> Floats:
        """Return the covariance of places (point, axis, axis) by errors of the pose; offsets in the world."""
        return displaced_covariance(self.covariance, offset_m)[:, :3, :3]

    @property
    def sd(self) -> tuple[float, float]:
        """Largest standard deviations of the position in metres, and of the rotation in radians."""
        position, rotation = (np.linalg.eigvalsh(self.covariance[part, part])[-1] for part in (slice(3), slice(3, 6)))
        return math.sqrt(max(0.0, position)), math.sqrt(max(0.0, rotation))


class LocatedEchoes(NamedTuple):
    """Points of one pulse around the platform."""

    offset_m: Floats  # (point, axis) in the frame of a `View`; z is 0 in a plane
    sd_m: Floats  # (point, 2) along and across the direction, without the pose
    strength: Floats  # (point,) probability that the point is a reflector
    is_confirmed: Flags  # (point,) False if too few pairs of emitter and receiver confirm it

    @property
    def range_m(self) -> Floats:
        """Distances: (point,) float64."""
        return np.asarray(np.linalg.norm(self.offset_m, axis=1))

    @property
    def covariance_m2(self) -> Floats:
        """Covariances without those of the pose: (point, axis, axis) float64."""
        unit = self.offset_m / np.maximum(self.range_m, _NEAREST_M)[:, None]
        along, across = (variance[:, None, None] for variance in self.sd_m.T**2)
        return np.asarray(across * np.eye(3) + (along - across) * (unit[:, :, None] * unit[:, None, :]))


class UsualAmplitude:
    """Running amplitude of a clear echo, which depends on the walls of a place."""

    def __init__(self) -> None:
        self._usual: float | None = None

    @property
    def clear(self) -> float:
        """Amplitude from which an echo is clear; 0 without any echo so far."""
        return 0.0 if self._usual is None else _CLEAR_AMPLITUDE * self._usual

    def strength(self, amplitude: Singles) -> Floats:
        """Return the probability a² / (a² + g²) of reflectors of amplitude a; g: ghosts: (point,)."""
        if not len(amplitude):
            return np.zeros(0)
        now = float(np.percentile(amplitude, _USUAL))
        self._usual = now if self._usual is None else (1 - _SMOOTHING) * self._usual + _SMOOTHING * now
        power = (amplitude.astype(np.float64) / max(self._usual, 1e-30)) ** 2
        return np.asarray(power / (power + _GHOST**2))


def echoes_of(
    offset_m: Floats,
    uncertainty_m: Floats,
    strength: Floats,
    n_dimensions: int = 2,
    is_confirmed: Flags | None = None,
) -> LocatedEchoes:
    """Return points as echoes, whose uncertainties (point, 2) include errors that noise does not explain."""
    range_m = np.linalg.norm(offset_m, axis=1)
    added_m = np.stack([np.full(len(range_m), _RANGE_SD_M), _ANGLE_SD_RAD[n_dimensions] * range_m], axis=1)
    sd_m = np.hypot(uncertainty_m, added_m)
    confirmed = np.ones(len(range_m), np.bool_) if is_confirmed is None else is_confirmed
    return LocatedEchoes(offset_m, sd_m, strength, confirmed)
