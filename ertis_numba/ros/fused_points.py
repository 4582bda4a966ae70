"""Points of all sensors that emitted together, in the frame of their platform."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Final, NamedTuple

import numpy as np

from ertis_numba.base.errors import ErtisError
from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.fusion import Fused, Fuser
from ertis_numba.fusion.emissions import unproven_note
from ertis_numba.fusion.pulses import PulseGroups
from ertis_numba.interop._mountings import Mounting

__all__ = ["LOCAL_FRAME", "FusedImages", "FusedPoints", "PulseImages", "joined"]

PLATFORM_FRAME: Final = "base_link"
LOCAL_FRAME: Final = "base_link_local"
"""Frame of fused points near the sensors, if these are far from the origin of their platform."""
_N_EVIDENCE: Final = 3  # Pulses that show whether an emitter works, …
_CHECKED_EVERY: Final = 10  # … checked once in so many.
_FAR_M: Final = 1000.0  # Distance from which float32 rounds by more than 30 µm.


class FusedPoints:
    """Collector of the points of each SYNC pulse, joined in the frame of the platform."""

    def __init__(self, on_note: Callable[[str], None] = lambda _: None) -> None:
        self._groups: PulseGroups[PointCloud] = PulseGroups(on_note)

    def add(self, cloud: PointCloud) -> list[PointCloud]:
        """Add points of a mounted sensor; return groups that are complete now, joined; later points are left out."""
        return [joined(group) for group in self._groups.add(cloud)]


class PulseImages(NamedTuple):
    """Fused image of a SYNC pulse with its points, and the images of its sensors."""

    image: Energyscape
    images: Mapping[str, Energyscape]


class FusedImages:
    """Fuser of the images of each SYNC pulse, whose points are the reflectors that all sensors locate."""

    def __init__(self, on_note: Callable[[str], None] = lambda _: None) -> None:
        self._note, self._noted = on_note, ""
        self._groups: PulseGroups[Energyscape] = PulseGroups(on_note)
        self._fuser: tuple[dict[str, Mounting], Fuser] | None = None
        self._n_empty = 0
        self._n_fused, self._unshown = 0, frozenset[str]()

    def add(self, image: Energyscape, mountings: Mapping[str, Mounting]) -> list[PulseImages]:
        """Add an image; return the pulses that are complete now, with an origin in whole metres, as `joined`."""
        # A pulse that cannot be fused is left out with a note.
        fused = []
        for group in self._groups.add(image):
            try:
                fused.append(PulseImages(self._fused(group, mountings), group))
            except ErtisError as error:  # Others of its pulses may be usable.
                if str(error) != self._noted:
                    self._noted = str(error)
                    self._note(f"SYNC pulse {image.stamp.sync_count} is left out: {error}")
        return fused

    def _fused(self, group: Mapping[str, Energyscape], mountings: Mapping[str, Mounting]) -> Energyscape:
        # Whole metres, since the image reaches from the origin to all sensors.
        x_m, y_m, z_m = origin_m = _origin_m(mountings[min(mountings)][0], step_m=1.0)
        near = {
            name: ((place[0][0] - x_m, place[0][1] - y_m, place[0][2] - z_m), place[1])
            for name, place in mountings.items()
        }
        if self._fuser is None or self._fuser[0] != near:
            self._fuser = near, Fuser(near)
        images = [*group.values()]
        fused = self._fuser[1](image for image in images if image.is_planar == images[0].is_planar)
        self._note_empty(fused)
        self._note_emitters(fused)
        stamp = replace(fused.stamp, sensor=LOCAL_FRAME if any(origin_m) else PLATFORM_FRAME)
        points = fused.points.replace(stamp=stamp, translation_m=origin_m)
        return fused.image.replace(stamp=stamp, points=points)

    def _note_empty(self, fused: Fused) -> None:
        """State when pulses begin to carry nothing but noise, and when they end."""
        count = fused.stamp.sync_count
        if not fused.is_empty:
            if self._n_empty:
                self._note(f"SYNC pulse {count} has echoes again, after {self._n_empty} without any above the noise")
            self._n_empty = 0
            return
        if not self._n_empty:
            self._note(f"SYNC pulse {count} carried no echo above the noise")
        self._n_empty += 1

    def _note_emitters(self, fused: Fused) -> None:
        """Note sensors whose emission no echo proves; checked now and then, because it takes longer than the points."""
        self._n_fused += 1
        if fused.is_empty or self._n_fused % _CHECKED_EVERY != _N_EVIDENCE:
            return
        unshown, count = frozenset(fused.without_own_echo), fused.stamp.sync_count
        if unshown - self._unshown:
            note = unproven_note(", ".join(sorted(unshown)), is_every=unshown == {*fused.sensors})
            self._note(f"SYNC pulse {count}: {note}")
        self._unshown = unshown


def joined(clouds: Mapping[str, PointCloud]) -> PointCloud:
    """Return the points of several mounted sensors in the frame of the platform, with the earliest time."""
    # Sensors more than 1 km away have the frame `base_link_local`, whose `translation_m` is in whole kilometres.
    each = list(clouds.values())
    stamp = min((cloud.stamp for cloud in each), key=lambda stamp: stamp.timestamp_ns)
    uncertainty_m = [
        np.full((len(cloud), 2), np.nan, np.float32) if cloud.uncertainty_m is None else cloud.uncertainty_m
        for cloud in each
    ]
    origin_m = _origin_m((0.0, 0.0, 0.0) if each[0].translation_m is None else each[0].translation_m)
    position_m = np.concatenate([cloud.on_platform_m() for cloud in each]) - origin_m
    return each[0].replace(
        position_m=position_m.astype(np.float32),
        amplitude=np.concatenate([cloud.amplitude for cloud in each]),
        uncertainty_m=np.concatenate(uncertainty_m),
        stamp=replace(stamp, sensor=LOCAL_FRAME if any(origin_m) else PLATFORM_FRAME),
        translation_m=origin_m,
        rotation_xyzw=(0.0, 0.0, 0.0, 1.0),
    )


def _origin_m(place_m: Sequence[float], *, step_m: float = _FAR_M) -> tuple[float, float, float]:
    """Return the origin of the points near a sensor, rounded to a step; 0 near the origin of the platform."""
    x_m, y_m, z_m = (step_m * round(each_m / step_m) if abs(each_m) > _FAR_M else 0.0 for each_m in place_m)
    return x_m, y_m, z_m
