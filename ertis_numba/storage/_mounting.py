"""Mountings of sensors as attributes of their groups."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final, TypeAlias

import h5py
import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError, DamagedError
from ertis_numba.geometry import mounting
from ertis_numba.storage.variables import set_attributes, to_python

__all__ = ["read_mounting", "write_mounting"]

_GIVEN: Final = "given"
_UNKNOWN: Final = "unknown"
_ORIGIN: Final = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)

_Found: TypeAlias = tuple[NDArray[np.float64], NDArray[np.float64]] | tuple[None, None]


def write_mounting(group: h5py.Group, place: Mapping[str, NDArray[np.float64]]) -> None:
    """Store a mounting, in the form of `ertis_numba.geometry.mounting`, or the fact that it is unknown."""
    set_attributes(group, {"mounting": _GIVEN if place else _UNKNOWN, **place})


def read_mounting(group: h5py.Group, path: Path) -> _Found:
    """Return translation and rotation of a sensor, or None for both if its mounting is unknown."""
    # Older files have no attribute `mounting`: their origin counts as unknown, unless the sensor was simulated.
    stated = group.attrs
    status = str(to_python(stated["mounting"])) if "mounting" in stated else ""
    if status == _UNKNOWN or not (status or {"translation_m", "rotation_xyzw"} & stated.keys()):
        return None, None
    if status not in {"", _GIVEN}:
        raise DamagedError(
            f"{path}: attribute mounting is {status[:80]!r}, wanted {_GIVEN!r} or {_UNKNOWN!r}; copy it again"
        )
    sensor = group.name.rpartition("/")[2]
    try:
        place = mounting(sensor, stated["translation_m"], stated["rotation_xyzw"])
    except (ArgumentError, TypeError, ValueError) as error:
        raise DamagedError(f"{path}: {error}") from error
    translation_m, rotation_xyzw = place["translation_m"], place["rotation_xyzw"]
    if not status and "truth" not in group and (*translation_m.tolist(), *rotation_xyzw.tolist()) == _ORIGIN:
        return None, None
    return translation_m, rotation_xyzw
