"""Mounting of sensors on their platform: position and orientation."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError

__all__ = ["mounting", "require_unit_quaternion"]

_ORIGIN, _UNTURNED = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)
_UNIT = 1e-6  # deviation from length 1 due to rounding to six digits


def mounting(
    sensor: str, translation_m: Sequence[float] | None = None, rotation_xyzw: Sequence[float] | None = None
) -> dict[str, NDArray[np.float64]]:
    """Return the validated translation and unit quaternion of a sensor on its platform; empty if both are unknown."""
    if translation_m is None and rotation_xyzw is None:
        return {}
    try:
        made = {
            "translation_m": np.asarray(_ORIGIN if translation_m is None else translation_m, dtype=np.float64),
            "rotation_xyzw": np.asarray(_UNTURNED if rotation_xyzw is None else rotation_xyzw, dtype=np.float64),
        }
    except (TypeError, ValueError) as error:
        raise ArgumentError(
            f"mounting of sensor {sensor} is not made of numbers ({error}); use x, y, z in metres, and a unit "
            "quaternion x, y, z, w"
        ) from error
    name = f"translation_m of sensor {sensor}"
    checks.shape(name, made["translation_m"].shape, (3,))
    checks.finite_array(name, made["translation_m"])
    require_unit_quaternion(f"rotation_xyzw of sensor {sensor}", made["rotation_xyzw"])
    return made


def require_unit_quaternion(name: str, rotation_xyzw: NDArray[np.float64]) -> None:
    """Raise an error if an array is not a unit quaternion."""
    checks.shape(name, rotation_xyzw.shape, (4,))
    checks.finite_array(name, rotation_xyzw)
    length = float(np.linalg.norm(rotation_xyzw))
    if abs(length - 1) > _UNIT:
        raise ArgumentError(f"{name} has length {length:g}; use a unit quaternion")
