"""What to draw: the latest image of each sensor, its points on the platform, and those that fade."""

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.geometry import Grid, unit_vectors
from ertis_numba.stages.points import PointExtractor
from ertis_numba.viewer._choices import LOWEST_THRESHOLD_DB, MOST_DECAY_S, Choices, colour_table
from ertis_numba.viewer._fusion import Fusion, is_level
from ertis_numba.viewer._polar import Polar, cropped
from ertis_numba.viewer._shapes import Dome, Drawn, Frame, Pose, Sector, Taken

__all__ = ["Scene"]

_MOST_POINTS: Final = 512  # of an image
_MOST_CLOUDS: Final = 256  # that fade, of a sensor: fifteen a second, for as long as they may stay, and some more
_FARTHEST_DOME: Final = 0.25  # radius of the dome, by the range that is seen


@dataclass(slots=True)
class _Cloud:
    """Points of an image on the platform, their levels below its strongest, their ranges and when they were."""

    position_m: NDArray[np.float32]
    level_db: NDArray[np.float32]
    range_m: NDArray[np.float32]
    time_s: float


@dataclass(slots=True)
class _Sensor:
    """What is kept of a sensor."""

    latest: Taken
    extract: PointExtractor
    clouds: deque[_Cloud] = field(default_factory=lambda: deque(maxlen=_MOST_CLOUDS))
    polar: Polar | None = None
    drawn_for: tuple[object, ...] = ()
    levels: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((1, 1), np.uint8))


class Scene:
    """Keeps the latest image of each sensor and makes of it what to draw, with the choices of the moment.

    Points are found once for an image, in all of its ranges; thresholds and windows choose among them, so that what
    is chosen later changes what is shown already.

    Parameters
    ----------
    width_px : int
        Of the pictures.
    """

    def __init__(self, *, width_px: int = 520) -> None:
        self._width_px = width_px
        self._sensors: dict[str, _Sensor] = {}
        self._fusion: tuple[list[tuple[Polar, Pose]], Fusion] | None = None

    @property
    def farthest_m(self) -> float:
        """Last range of all images; 0 as long as there is none."""
        return max((float(kept.latest.image.range_m[-1]) for kept in self._sensors.values()), default=0.0)

    def latest(self, choices: Choices) -> list[tuple[Energyscape, Pose]]:
        """Return the images that are shown, within the window, and where their sensors are."""
        return [
            (cropped(kept.latest.image, choices.range_m), kept.latest.pose) for _, kept in sorted(self._sensors.items())
        ]

    def take(self, taken: Taken) -> None:
        """Take an image to be drawn next; points of later times are forgotten, as where a recording begins anew."""
        name = taken.image.stamp.sensor
        kept = self._sensors.get(name)
        if kept is None or not _same_axes(kept.latest.image, taken.image):
            grid = Grid(taken.image.azimuth_rad, taken.image.elevation_rad)
            extract = PointExtractor(taken.image.settings, grid, top=_MOST_POINTS, min_level_db=LOWEST_THRESHOLD_DB)
            kept = self._sensors[name] = _Sensor(taken, extract, *(() if kept is None else (kept.clouds,)))
        kept.latest = taken
        while kept.clouds and kept.clouds[-1].time_s >= taken.time_s:
            kept.clouds.pop()
        while kept.clouds and taken.time_s - kept.clouds[0].time_s > MOST_DECAY_S:
            kept.clouds.popleft()
        kept.clouds.append(_cloud_of(kept.extract(taken.image), taken))

    def draw(self, choices: Choices) -> Frame:
        """Return what to draw of the images taken so far."""
        kept = dict(sorted(self._sensors.items()))
        latest_s = max((each.latest.time_s for each in kept.values()), default=0.0)
        level = all(each.latest.image.is_planar and is_level(each.latest.pose) for each in kept.values())
        fused = level and len(kept) > 1
        sensors = {
            name: _drawn(each, choices, latest_s, self._width_px, alone=not fused) for name, each in kept.items()
        }
        farthest_m = self.farthest_m if choices.range_m is None else min(self.farthest_m, choices.range_m[1])
        if not fused:
            return Frame(sensors, farthest_m)
        fusion = self._fusion_of(list(kept.values()))
        plan = fusion([each.levels for each in kept.values()], colour_table(choices.colours))
        return Frame(sensors, farthest_m, plan, fusion.height_m)

    def _fusion_of(self, several: list[_Sensor]) -> Fusion:
        """Return what joins the images of several sensors, made anew where one has moved or has other axes."""
        pairs = [(kept.polar, kept.latest.pose) for kept in several if kept.polar is not None]
        if self._fusion is None or self._fusion[0] != pairs:
            self._fusion = pairs, Fusion(pairs)
        return self._fusion[1]


def _same_axes(image: Energyscape, other: Energyscape) -> bool:
    return all(
        getattr(image, name) is getattr(other, name) or np.array_equal(getattr(image, name), getattr(other, name))
        for name in ("azimuth_rad", "elevation_rad", "range_m")
    )


def _cloud_of(cloud: PointCloud, taken: Taken) -> _Cloud:
    return _Cloud(
        taken.pose.placed(cloud.position_m),
        np.asarray(20 * np.log10(np.maximum(cloud.energy, np.float32(1e-30))), dtype=np.float32),
        np.asarray(np.linalg.norm(cloud.position_m, axis=1), dtype=np.float32),
        taken.time_s,
    )


def _drawn(kept: _Sensor, choices: Choices, now_s: float, width_px: int, *, alone: bool) -> Drawn:
    """Return what to draw of a sensor."""
    taken = kept.latest
    image = cropped(taken.image, choices.range_m)
    drawn_for = (id(kept.extract), len(image.range_m), float(image.range_m[0]), choices.dynamic_range_db)
    if kept.polar is None or kept.drawn_for != drawn_for:
        kept.polar = Polar(image, dynamic_range_db=choices.dynamic_range_db, width_px=width_px)
        kept.drawn_for = drawn_for
    polar, table = kept.polar, colour_table(choices.colours)
    levels = kept.levels = polar.levels(image.energy)
    position_m, colours, n_points = _points(kept.clouds, choices, now_s)
    shape: Sector | Dome | None = None
    if not image.is_planar:
        shape = _dome(image, choices)
    elif alone:
        shape = Sector(polar.sector(levels, table), polar.extent_m)
    return Drawn(
        pose=taken.pose,
        sequence=image.stamp.sequence,
        timestamp_ns=image.stamp.timestamp_ns,
        picture=polar.picture(levels, table),
        shape=shape,
        position_m=position_m,
        colours=colours,
        n_points=n_points,
    )


def _points(
    clouds: deque[_Cloud], choices: Choices, now_s: float
) -> tuple[NDArray[np.float32], NDArray[np.uint8], int]:
    """Return points on the platform, their colours, and how many are of the latest image."""
    table = colour_table(choices.colours)
    low_m, high_m = choices.range_m or (0.0, math.inf)
    places, colours, n_points = [np.empty((0, 3), np.float32)], [np.empty((0, 3), np.uint8)], 0
    for cloud in clouds:
        share_left = 1.0
        if cloud is not clouds[-1]:
            share_left = 1 - (now_s - cloud.time_s) / choices.decay_s if choices.decay_s else 0.0
        if share_left <= 0:
            continue
        within = (cloud.range_m >= low_m) & (cloud.range_m <= high_m)
        below_db = cloud.level_db - cloud.level_db[within].max(initial=-np.inf)
        seen = within & (below_db >= choices.threshold_db)
        shade = 1 + below_db[seen] / choices.dynamic_range_db
        places.append(cloud.position_m[seen])
        colours.append((table[np.rint(255 * np.clip(shade, 0.15, 1)).astype(np.uint8)] * share_left).astype(np.uint8))
        n_points = int(np.count_nonzero(seen))
    return np.concatenate(places), np.concatenate(colours), n_points


def _dome(image: Energyscape, choices: Choices) -> Dome:
    highest = image.energy.max(axis=1)
    strongest = np.float32(highest.max(initial=0.0)) or np.float32(1)
    level_db = 20 * np.log10(np.maximum(highest / strongest, np.float32(1e-10)))
    shade = np.clip(1 + level_db / choices.dynamic_range_db, 0, 1)
    radius_m = _FARTHEST_DOME * float(image.range_m[-1])
    # Directions that are spread evenly over half a sphere have a square of this side each.
    size_m = radius_m * math.sqrt(2 * math.pi / len(highest))
    return Dome(
        np.asarray(radius_m * unit_vectors(image.azimuth_rad, image.elevation_rad), dtype=np.float32),
        colour_table(choices.colours)[np.rint(255 * shade).astype(np.uint8)],
        size_m,
    )
