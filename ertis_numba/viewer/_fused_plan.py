"""Fused image of several sensors in the horizontal plane of the platform."""

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Final

from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.fusion import Fuser
from ertis_numba.fusion.pulses import is_same_pulse
from ertis_numba.viewer._choices import Choices, colour_table
from ertis_numba.viewer._polar import Polar, cropped
from ertis_numba.viewer._shapes import Pose, ReceivedImage, Sector

__all__ = ["FusedPlan", "is_level"]

_TILT: Final = math.sin(math.radians(0.5))  # Vertical component of an axis, below which a sensor is horizontal.
_PATIENCE_S: Final = 0.5  # Time for which an image stays until all sensors have one of the next pulse.


def is_level(pose: Pose) -> bool:
    """Return True if the image plane of a sensor lies in the horizontal plane of the platform."""
    x, y, _, _ = pose.rotation_xyzw
    return 2 * math.hypot(x, y) < _TILT


class FusedPlan:
    """Renderer of the fused image, which it keeps while images and choices are unchanged."""

    def __init__(self, width_px: int) -> None:
        self._width_px = width_px
        self._fuser: tuple[dict[str, Pose], Fuser] | None = None
        self._fused: tuple[list[Energyscape], float, Energyscape] | None = None
        self.points: PointCloud | None = None
        """Points of the latest fused image, in the frame of the platform."""
        self._sector: tuple[list[object], Sector] | None = None
        self._polar: tuple[list[object], Polar] | None = None

    def __call__(self, several: Mapping[str, ReceivedImage[Energyscape]], choices: Choices) -> Sector:
        """Return the image, in the frame of the platform; all poses are known."""
        whole = self._image(several)
        made_for: list[object] = [whole, choices]
        if self._sector is None or self._sector[0] != made_for:
            image = cropped(whole, choices.range_m)
            polar = self._polar_of(image, choices)
            sector = polar.sector(polar.levels(image.amplitude), colour_table(choices.colours))
            self._sector = made_for, Sector(sector, polar.extent_m)
        return self._sector[1]

    def _image(self, several: Mapping[str, ReceivedImage[Energyscape]]) -> Energyscape:
        """Return the fused image of the latest pulse of which all images are here."""
        images = [taken.image for taken in several.values()]
        now_s = max(taken.time_s for taken in several.values())
        poses = {name: taken.pose for name, taken in several.items() if taken.pose is not None}
        if self._fuser is None or self._fuser[0] != poses:
            self._fuser = poses, Fuser({name: (pose.translation_m, pose.rotation_xyzw) for name, pose in poses.items()})
            self._fused = None
        if self._fused is not None:
            are_kept = len(images) == len(self._fused[0]) and all(map(_is, images, self._fused[0]))
            is_mixed = not all(is_same_pulse(image.stamp, images[0].stamp) for image in images)
            if are_kept or (is_mixed and 0 <= now_s - self._fused[1] < _PATIENCE_S):
                return self._fused[2]
        # Sensors that are not on one SYNC chain are fused as if they were.
        first = images[0].stamp
        together = [image.replace(stamp=replace(first, sensor=image.stamp.sensor)) for image in images]
        fused = self._fuser[1](together)
        self._fused, self.points = (images, now_s, fused.image), fused.points
        return self._fused[2]

    def _polar_of(self, image: Energyscape, choices: Choices) -> Polar:
        made_for: list[object] = [image.amplitude.shape, float(image.range_m[0]), choices.dynamic_range_db]
        if self._polar is None or self._polar[0] != made_for:
            self._polar = made_for, Polar(image, dynamic_range_db=choices.dynamic_range_db, width_px=self._width_px)
        return self._polar[1]


def _is(one: Energyscape, other: Energyscape) -> bool:
    return one is other
