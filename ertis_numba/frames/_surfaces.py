"""Surfaces of a simulated scene, as a reference for points and maps."""

from dataclasses import dataclass
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

__all__ = ["Surfaces"]

Floats = NDArray[np.float64]

_STEEPEST: Final = 0.7  # Vertical part of a normal above which a face is a floor or a ceiling.
_HIGHEST_M: Final = 10.0  # Half of the height of an unbounded wall.
_AT_ONCE: Final = 2**20  # Pairs of places and surfaces whose distances are computed at a time.


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """Points, spheres and rectangular faces of a simulated scene at one time."""

    centre_m: Floats  # (target, axis) of points, spheres and discs
    radius_m: Floats  # (target,) of spheres; 0 for others
    disc_m: Floats  # (target,) radius of discs; 0 for others
    face_m: Floats  # (face, axis) centres
    axes: Floats  # (face, 3, axis) normal, width and height as unit vectors
    half_size_m: Floats  # (face, 2) half of width and height; may be infinite

    def seen_from(self, position_m: Floats, rotation: Floats) -> Self:
        """Return the surfaces in the frame of an object, from its position (3,) and rotation (3, 3) to theirs."""
        return type(self)(
            (self.centre_m - position_m) @ rotation,
            self.radius_m,
            self.disc_m,
            (self.face_m - position_m) @ rotation,
            self.axes @ rotation,
            self.half_size_m,
        )

    def flattened(self) -> Self:
        """Return the surfaces in the horizontal plane at height 0, without floors and ceilings."""
        is_steep = np.abs(self.axes[:, 0, 2]) < _STEEPEST
        axes, half_m = self.axes[is_steep], self.half_size_m[is_steep].copy()
        slope = np.linalg.norm(axes[:, 2, :2], axis=1)  # Horizontal part of the axis along the height.
        half_m[:, 1] = np.minimum(half_m[:, 1], _HIGHEST_M) * slope
        flat = np.zeros_like(axes)
        flat[:, 0, 2] = 1.0
        flat[:, 1, :2] = axes[:, 1, :2]
        flat[:, 2] = np.cross(flat[:, 0], flat[:, 1])
        level = np.array([1.0, 1.0, 0.0])
        return type(self)(
            self.centre_m * level, self.radius_m, self.disc_m, self.face_m[is_steep] * level, flat, half_m
        )

    def distance_m(self, place_m: Floats) -> Floats:
        """Return the distance of places from the nearest surface: (place,) float64, infinite if there is none."""
        step = max(1, _AT_ONCE // max(1, len(self.centre_m) + len(self.face_m)))
        parts = [self._distance_m(place_m[first : first + step]) for first in range(0, len(place_m), step)]
        return np.concatenate([np.zeros(0), *parts])

    def _distance_m(self, place_m: Floats) -> Floats:
        away_m = np.linalg.norm(place_m[:, None] - self.centre_m, axis=2)
        target_m = np.maximum(np.abs(away_m - self.radius_m) - self.disc_m, 0.0)
        local_m = np.einsum("fai,pfi->pfa", self.axes, place_m[:, None] - self.face_m)
        local_m[..., 1:] = np.maximum(np.abs(local_m[..., 1:]) - self.half_size_m, 0.0)
        face_m = np.linalg.norm(local_m, axis=2)
        return np.asarray(np.minimum(target_m.min(axis=1, initial=np.inf), face_m.min(axis=1, initial=np.inf)))
