"""Points of fused images as variables of a sensor's group: the points of all images in one table."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import h5py
import numpy as np

from ertis_numba.base.errors import ArgumentError, DamagedError
from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.settings import Settings
from ertis_numba.storage.schema import POINTS
from ertis_numba.storage.variables import create_variables

__all__ = ["POINT_SIZES", "PointReader", "require_uniform", "write_points"]

POINT_SIZES: Final = {"axis": 3, "component": 2}
"""Lengths of the axes of points."""
_UNKNOWN: Final = -1


def require_uniform(image: Energyscape, first: Energyscape) -> None:
    """Refuse an image with points after one without, and the reverse: readers could not tell none from unknown."""
    if (image.points is None) != (first.points is None):
        has, lacks = ("the first image has", "another") if image.points is None else ("an image has", "the first")
        raise ArgumentError(
            f"{has} points, but {lacks} has none; pass points with all images of a sensor, or with none"
        )


def write_points(group: h5py.Group, clouds: Sequence[PointCloud]) -> None:
    """Store the points of all images of a sensor, one cloud for each."""
    unknown_m = [np.full((len(cloud), 2), np.nan, np.float32) for cloud in clouds]
    columns = {
        "point_count": np.array([len(cloud) for cloud in clouds], dtype=np.uint32),
        "point_position": np.concatenate([cloud.position_m for cloud in clouds]),
        "point_amplitude": np.concatenate([cloud.amplitude for cloud in clouds]),
        "point_uncertainty": np.concatenate(
            [
                unknown if cloud.uncertainty_m is None else cloud.uncertainty_m
                for cloud, unknown in zip(clouds, unknown_m, strict=True)
            ]
        ),
        "point_confirmed": np.concatenate(
            [np.full(len(cloud), _UNKNOWN) if cloud.confirmed is None else cloud.confirmed for cloud in clouds]
        ),
    }
    create_variables(group, POINTS, sizes={"point": len(columns["point_amplitude"]), **POINT_SIZES})
    group["point_count"].resize(len(clouds), axis=0)
    for name, values in columns.items():
        group[name][...] = values
        group[name].flush()


class PointReader:
    """Points of the images of a sensor, in the group of a sensor that has points."""

    def __init__(self, group: h5py.Group, path: Path, settings: Settings) -> None:
        missing = [variable.name for variable in POINTS if variable.name not in group]
        if missing:
            raise DamagedError(f"{path}: points of images lack {', '.join(missing)}; copy the file again")
        counts = np.asarray(group["point_count"][:], np.int64)
        self._bounds = np.concatenate([[0], np.cumsum(counts)])
        self._settings = settings
        self._position_m, self._amplitude, self._uncertainty_m = (
            np.asarray(group[f"point_{name}"][:], np.float32) for name in ("position", "amplitude", "uncertainty")
        )
        self._confirmed = np.asarray(group["point_confirmed"][:], np.int8)
        columns = self._position_m, self._amplitude, self._uncertainty_m, self._confirmed
        lengths = {*(len(column) for column in columns), int(self._bounds[-1])}
        if len(lengths) != 1:
            raise DamagedError(f"{path}: point_count does not match the number of points; copy the file again")

    def __call__(self, image: Energyscape, index: int) -> Energyscape:
        """Return an image with its points."""
        own = slice(self._bounds[index], self._bounds[index + 1])
        confirmed = self._confirmed[own]
        cloud = PointCloud(
            self._position_m[own],
            self._amplitude[own],
            self._settings,
            image.stamp,
            translation_m=(0.0, 0.0, 0.0),
            rotation_xyzw=(0.0, 0.0, 0.0, 1.0),
            uncertainty_m=self._uncertainty_m[own],
            confirmed=None if (confirmed == _UNKNOWN).any() else confirmed.astype(np.bool_),
        )
        return image.replace(points=cloud)
