"""Where sensors are on their platform, and how they are turned."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.errors import ArgumentError

__all__ = ["mounting"]

_ORIGIN, _UNTURNED = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
_UNIT = 1e-6  # of deviation that rounding to six digits leaves


def mounting(
    sensor: str, translation_m: Sequence[float] | None = None, rotation_xyzw: Sequence[float] | None = None
) -> dict[str, NDArray[np.float64]]:
    """Return the checked mounting of a sensor; empty if it is unknown.

    If only one of the two is given, the sensor is not turned, or at the origin.

    Parameters
    ----------
    sensor : str
        Its name, for errors.
    translation_m : sequence of 3 float, optional
        x, y, z.
    rotation_xyzw : sequence of 4 float, optional
        The unit quaternion that turns the sensor frame into that of the surroundings.

    Returns
    -------
    dict of str to NDArray
        ``translation_m``: (3,) float64, and ``rotation_xyzw``: (4,) float64; nothing if neither is given.

    Raises
    ------
    ArgumentError
        A number is missing or not finite, or the quaternion has not length 1.
    """
    if translation_m is None and rotation_xyzw is None:
        return {}
    made = {
        "translation_m": np.asarray(_ORIGIN if translation_m is None else translation_m, dtype=np.float64),
        "rotation_xyzw": np.asarray(_UNTURNED if rotation_xyzw is None else rotation_xyzw, dtype=np.float64),
    }
    for (name, values), size in zip(made.items(), (3, 4), strict=True):
        checks.shape(f"{name} of sensor {sensor}", values.shape, (size,))
        checks.finite_array(f"{name} of sensor {sensor}", values)
    length = float(np.linalg.norm(made["rotation_xyzw"]))
    if abs(length - 1) > _UNIT:
        raise ArgumentError(f"rotation_xyzw of sensor {sensor} has length {length:g}; give a unit quaternion")
    return made
