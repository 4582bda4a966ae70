"""Scenes of four sensors on a platform, with reflectors at random places."""

import math
from typing import Final

import numpy as np

from ertis_numba.settings import Processing
from ertis_numba.simulation import Electronics, Emitter, Point, Scene, Sensor

__all__ = ["EMITTERS_M", "N_REFLECTORS", "platform_scene", "random_reflectors"]

EMITTERS_M: Final = 0.012, 0.0
"""Diameters of the emitters: as pistons, and omnidirectional."""
N_REFLECTORS: Final = 10
_YAWS_DEG = {"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0}
_RADIUS_M = 0.2
_APART_M = 0.4


def platform_scene(seed: int, points: tuple[Point, ...], diameter_m: float, level_db: float = -24.0) -> Scene:
    """Return a scene of four sensors on a platform."""
    sensors = tuple(
        Sensor(
            name=name,
            position_m=(_RADIUS_M * math.cos(math.radians(yaw)), _RADIUS_M * math.sin(math.radians(yaw)), 0.4),
            yaw_deg=yaw,
            processing=Processing(range_m=(0.3, 4.0), directions="90"),
            emitter=Emitter(level_db=level_db, diameter_m=diameter_m),
            electronics=Electronics(noise_dbfs=-60.0),
        )
        for name, yaw in _YAWS_DEG.items()
    )
    return Scene(seed=seed, sensors=sensors, points=points)


def random_reflectors(seed: int) -> tuple[Point, ...]:
    """Return reflectors at random places around a platform."""
    draws = np.random.default_rng(seed)
    found: list[Point] = []
    places: list[complex] = []
    while len(found) < N_REFLECTORS:
        range_m = draws.uniform(0.9, 3.2)
        place = range_m * np.exp(1j * draws.uniform(-np.pi, np.pi))
        if all(abs(place - other) > _APART_M for other in places):
            places.append(place)
            strength_db = float(draws.uniform(-8, 0) + 6 * np.log2(range_m))
            found.append(Point(position_m=(float(place.real), float(place.imag), 0.4), strength_db=strength_db))
    return tuple(found)
