"""Bearings of the sources in acoustic maps as variables of a sensor's group: those of all maps in one table."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import h5py
import numpy as np

from ertis_numba.base.errors import DamagedError
from ertis_numba.frames import Bearing, known_levels
from ertis_numba.settings import Settings
from ertis_numba.storage.schema import BEARINGS
from ertis_numba.storage.variables import create_variables

__all__ = ["BEARING_SIZES", "BearingReader", "write_bearings"]

BEARING_SIZES: Final = {"angle": 2, "edge": 2}
"""Lengths of the axes of bearings."""
_DOUBTS: Final = ("may_be_crosstalk", "may_be_interference")  # by the number of their bit
_FIELDS: Final[dict[str, tuple[str, ...]]] = {
    "bearing_direction": ("azimuth_deg", "elevation_deg"),
    "bearing_uncertainty": ("sideways_deg", "upwards_deg"),
    "bearing_correlation": ("correlation",),
    "bearing_band": ("band_hz",),
    "bearing_level": ("level_dbfs",),
    "bearing_snr": ("snr_db",),
}


def write_bearings(group: h5py.Group, found: Sequence[tuple[Bearing, ...]]) -> None:
    """Store the bearings of all maps of a sensor, in the order of the maps."""
    every = [each for bearings in found for each in bearings]
    columns: dict[str, Any] = {
        name: [[getattr(each, field) for field in fields] for each in every] for name, fields in _FIELDS.items()
    }
    columns["bearing_doubts"] = [
        sum(getattr(each, field) << bit for bit, field in enumerate(_DOUBTS)) for each in every
    ]
    create_variables(group, BEARINGS, sizes={"bearing": len(every), **BEARING_SIZES})
    group["bearing_count"].resize(len(found), axis=0)
    columns["bearing_count"] = [len(bearings) for bearings in found]
    for name, values in columns.items():
        group[name][...] = np.reshape(values, group[name].shape)
        group[name].flush()


class BearingReader:
    """Bearings of the maps of a sensor, by the number of a map.

    ``group`` is that of the sensor, which has bearings.
    """

    def __init__(self, group: h5py.Group, path: Path, settings: Settings) -> None:
        missing = [variable.name for variable in BEARINGS if variable.name not in group]
        if missing:
            raise DamagedError(f"{path}: bearings of acoustic maps lack {', '.join(missing)}; copy the file again")
        self._bounds = np.concatenate([[0], np.cumsum(group["bearing_count"][:], dtype=np.int64)])
        self._settings = settings
        self._columns: dict[str, Any] = {name: group[name][:] for name in (*_FIELDS, "bearing_doubts")}
        if {len(column) for column in self._columns.values()} != {int(self._bounds[-1])}:
            raise DamagedError(f"{path}: bearing_count does not match the number of bearings; copy the file again")

    def __call__(self, index: int) -> tuple[Bearing, ...]:
        return tuple(self._bearing(row) for row in range(self._bounds[index], self._bounds[index + 1]))

    def _bearing(self, row: int) -> Bearing:
        fields: dict[str, Any] = {}
        for name, fields_of in _FIELDS.items():
            values = np.atleast_1d(self._columns[name][row]).tolist()
            fields |= zip(fields_of, [tuple(values)] if name == "bearing_band" else values, strict=True)
        doubts = int(self._columns["bearing_doubts"][row])
        fields |= {field: bool(doubts >> bit & 1) for bit, field in enumerate(_DOUBTS)}
        fields |= known_levels(self._settings, math.sqrt(math.prod(fields["band_hz"])), fields["level_dbfs"])
        return Bearing(**fields)
