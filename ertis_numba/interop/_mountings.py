"""Mountings of sensors on their platform, as far as they are known."""

from collections.abc import Mapping, Sequence
from typing import Final, TypeAlias

from ertis_numba.geometry import mounting

__all__ = ["PLATFORM", "Mounting", "Mountings", "validated"]

Mounting: TypeAlias = tuple[tuple[float, float, float], tuple[float, float, float, float]]
"""Position x, y, z in m, and the unit quaternion x, y, z, w that rotates the sensor frame into that of the platform."""
Mountings: TypeAlias = Mapping[str, Mounting]
"""Mountings by name of the sensor."""
PLATFORM: Final = "base_link"
"""Name of the platform's frame in REP 105."""


def validated(given: Mapping[str, tuple[Sequence[float], Sequence[float]]] | None) -> Mountings:
    """Return mountings as tuples of floats, all valid."""
    made = {}
    for sensor, (translation_m, rotation_xyzw) in (given or {}).items():
        (x, y, z), (i, j, k, w) = (each.tolist() for each in mounting(sensor, translation_m, rotation_xyzw).values())
        made[sensor] = ((x, y, z), (i, j, k, w))
    return made
