"""Surfaces of a scene, as a reference for points and maps."""

import numpy as np

from ertis_numba.frames import Surfaces
from ertis_numba.simulation.scene import Scene

__all__ = ["surfaces_of"]


def surfaces_of(scene: Scene, time_s: float) -> Surfaces:
    """Return the surfaces of a scene in the world frame at a time in seconds."""
    targets, walls = (*scene.points, *scene.spheres), [wall for _, wall in scene.all_walls()]
    return Surfaces(
        centre_m=np.array([each.position_at(time_s) for each in targets]).reshape(-1, 3),
        radius_m=np.array([0.0 for _ in scene.points] + [each.radius_m for each in scene.spheres]),
        disc_m=np.array([each.diameter_m / 2 for each in scene.points] + [0.0 for _ in scene.spheres]),
        face_m=np.array([each.position_at(time_s) for each in walls]).reshape(-1, 3),
        axes=np.array([each.axes() for each in walls]).reshape(-1, 3, 3),
        half_size_m=np.array([each.size_m or (np.inf, np.inf) for each in walls]).reshape(-1, 2) / 2,
    )
