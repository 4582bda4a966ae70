"""Points of a sequence of images of any sensors."""

from typing import Any

import numpy as np

from ertis_numba.analysis.points import MIN_LEVEL_DB, TOP, PointExtractor
from ertis_numba.frames import AcousticMap, Energyscape, PointCloud
from ertis_numba.geometry import Grid, observable_angles

__all__ = ["PointFinder", "same_directions"]


class PointFinder:
    """Point detector for images of any sensors; it reuses the extractor of a sensor while the settings are the same."""

    def __init__(self, *, top: int | None = None, min_level_db: float | None = None) -> None:
        given = {"top": top, "min_level_db": min_level_db}
        self._finding: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
        self._extractors: dict[str, tuple[Energyscape, PointExtractor]] = {}

    def __call__(self, image: Energyscape) -> PointCloud:
        """Return the points of an image, in the coordinate frame of its sensor; those of a fusion if it has them."""
        if image.points is not None:
            chosen = {"top": TOP, "min_level_db": MIN_LEVEL_DB} | self._finding
            cloud = image.points.strongest(chosen["top"], chosen["min_level_db"])
            if cloud.uncertainty_m is not None and not all(observable_angles(cloud.settings.array)[:2]):
                cloud = cloud.replace(uncertainty_m=cloud.uncertainty_m * np.array([1, np.inf], np.float32))
            return cloud
        known = self._extractors.get(image.stamp.sensor)
        if known is None or not _suits(known[0], image):
            grid = Grid(image.azimuth_rad, image.elevation_rad)
            extractor = PointExtractor(image.settings, grid, **self._finding)
            known = self._extractors[image.stamp.sensor] = image, extractor
        return known[1](image)


def _suits(image: Energyscape, other: Energyscape) -> bool:
    """Return True if two images can share an extractor; their air may differ."""
    ours, theirs = image.settings, other.settings
    return (ours == theirs or ours.replace(air=theirs.air) == theirs) and same_directions(image, other)


def same_directions(image: Energyscape | AcousticMap, other: Energyscape | AcousticMap) -> bool:
    """Return True if two images or acoustic maps have the same directions."""
    return all(
        getattr(image, name) is getattr(other, name) or np.array_equal(getattr(image, name), getattr(other, name))
        for name in ("azimuth_rad", "elevation_rad")
    )
