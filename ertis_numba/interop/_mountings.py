"""Where sensors are on their platform, as far as somebody said."""

from collections.abc import Mapping, Sequence
from typing import Final, TypeAlias

from ertis_numba.geometry import mounting

__all__ = ["PLATFORM", "Mounting", "Mountings", "checked"]

Mounting: TypeAlias = tuple[tuple[float, float, float], tuple[float, float, float, float]]
"""x, y, z in m, and the unit quaternion x, y, z, w that turns the sensor frame into the platform's."""
Mountings: TypeAlias = Mapping[str, Mounting]
"""By the name of the sensor."""
PLATFORM: Final = "base_link"
"""Frame of the platform, by the name that REP 105 gives it."""


def checked(given: Mapping[str, tuple[Sequence[float], Sequence[float]]] | None) -> Mountings:
    """Return mountings as tuples of floats.

    Raises
    ------
    ArgumentError
        One is none.
    """
    made = {}
    for sensor, (translation_m, rotation_xyzw) in (given or {}).items():
        (x, y, z), (i, j, k, w) = (each.tolist() for each in mounting(sensor, translation_m, rotation_xyzw).values())
        made[sensor] = ((x, y, z), (i, j, k, w))
    return made
