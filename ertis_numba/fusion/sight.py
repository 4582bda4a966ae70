"""Places as the sensors of a platform see them: distances, directions, and power of their echoes."""

from collections.abc import Collection, Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.fusion.rig import Emitters, MountedSensor

__all__ = ["Viewers", "mirrored", "tangents"]

Floats = NDArray[np.float64]
Numbers = NDArray[np.int64]

_VERTICAL: Final = 1e-6


class Viewers:
    """Sensors of a platform that see places, with emitters in each one's air; ``is_flat``: front and back are alike."""

    def __init__(
        self, sensors: Sequence[MountedSensor], emitters: Mapping[int, Emitters], flat: Collection[int]
    ) -> None:
        self.sensor_m = np.array([each.translation_m for each in sensors])
        self.ahead = np.array([each.rotation[:, 0] for each in sensors])
        self.is_flat = np.isin(np.arange(len(sensors)), [*flat])
        self._models: list[Emitters] = [*{id(each): each for each in emitters.values()}.values()]
        places = {id(each): place for place, each in enumerate(self._models)}
        self._sensors = kernels.ViewingSensors(
            self.sensor_m,
            self.ahead,
            self.is_flat,
            np.array([places.get(id(emitters.get(number)), -1) for number in range(len(sensors))]),
            np.stack([model.patterns for model in self._models]),
            np.stack([model.lost for model in self._models]),
            self._models[0].beside_m,
        )

    def sight(self, place_m: Floats) -> kernels.SeenPlaces:
        """Return how the sensors see places: (place, axis) float64."""
        shape = len(place_m), len(self.sensor_m)
        apart_m, depth, radiated, beside_m = np.empty((4, *shape))
        toward, seen = np.empty((2, *shape, 3))
        found = kernels.SeenPlaces(apart_m, toward, depth, seen, radiated, np.empty((*shape, shape[1])), beside_m)
        kernels.load_fusion().see_places(np.ascontiguousarray(place_m), self._sensors, found)
        return found

    def echo_powers(self, sight: kernels.SeenPlaces, place: Numbers, receiver: Numbers) -> Floats:
        """Return the power of echoes of places after the matched filter, by place and receiver: (echo, emitter)."""
        found, of = np.empty((len(place), len(self.sensor_m))), self._sensors.model[receiver]
        for number, model in enumerate(self._models):
            rows = np.flatnonzero(of == number)
            here, apart_m = place[rows], sight.apart_m[place[rows]]
            found[rows] = model.echo_powers(sight.depth[here], apart_m, sight.apart_m[here, receiver[rows]])
        return found


def mirrored(direction: Floats, ahead: Floats) -> Floats:
    """Return directions mirrored at the planes of flat arrays: (..., axis) float64."""
    return np.asarray(direction - 2 * np.einsum("...i,...i->...", direction, ahead)[..., None] * ahead)


def tangents(direction: Floats) -> tuple[Floats, Floats]:
    """Return unit vectors to the left and upwards, across directions: two of (..., axis) float64."""
    x, y, z = np.moveaxis(direction, -1, 0)
    level = np.hypot(x, y)
    # Straight up, any horizontal direction will do.
    is_level = level > _VERTICAL
    safe = np.where(is_level, level, 1.0)
    left_x, left_y = np.where(is_level, -y / safe, 0.0), np.where(is_level, x / safe, 1.0)
    left = np.stack([left_x, left_y, np.zeros_like(x)], axis=-1)
    return left, np.stack([-z * left_y, z * left_x, x * left_y - y * left_x], axis=-1)
