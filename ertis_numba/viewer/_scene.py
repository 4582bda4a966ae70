"""Drawn objects: the latest image of each sensor, its points on the platform, and fading points."""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.levels import below_strongest_db
from ertis_numba.analysis.point_finder import PointFinder, same_directions
from ertis_numba.analysis.range_cleaning import clean
from ertis_numba.analysis.side_lobes import without_side_lobes
from ertis_numba.frames import Energyscape, PointCloud
from ertis_numba.fusion import Fuser
from ertis_numba.fusion.pulses import is_same_pulse
from ertis_numba.fusion.rig import far_apart
from ertis_numba.geometry import unit_vectors
from ertis_numba.viewer._choices import LOWEST_THRESHOLD_DB, Choices, colour_table
from ertis_numba.viewer._polar import Polar, cropped, is_within
from ertis_numba.viewer._shapes import UNTURNED, Dome, Drawn, DrawnFrame, Pose, ReceivedImage, Sector

__all__ = ["ViewedScene"]

_MAX_POINTS: Final = 512  # Limit per image.
# Limit on fading clouds of a sensor: fifteen per second for the maximum persistence, and some more.
_MAX_CLOUDS: Final = 256
_FARTHEST_DOME: Final = 0.25  # Radius of the dome, relative to the visible range.

Table: TypeAlias = NDArray[np.uint8]


_TILT: Final = math.sin(math.radians(0.5))  # Vertical component of an axis, below which a sensor is horizontal.
_PATIENCE_S: Final = 0.5  # Time for which an image stays until all sensors have one of the next pulse.


@dataclass(slots=True)
class _Cloud:
    """Points of an image with their positions on the platform, levels, ranges and time."""

    points: PointCloud
    position_m: NDArray[np.float32]
    level_db: NDArray[np.float32]
    range_m: NDArray[np.float32]
    time_s: float

    def seen(self, choices: Choices) -> tuple[NDArray[np.bool_], NDArray[np.float32]]:
        """Return True for each shown point, and the levels of all relative to the strongest in the window."""
        low_m, high_m = choices.range_m or (0.0, math.inf)
        within = (self.range_m >= low_m) & (self.range_m <= high_m)
        below_db = self.level_db - self.level_db[within].max(initial=-np.inf)
        return within & (below_db >= choices.threshold_db), below_db


@dataclass(slots=True)
class _SensorImages:
    """State of a sensor, with its last drawn objects for reuse."""

    latest: ReceivedImage[Energyscape]
    clouds: deque[_Cloud] = field(default_factory=lambda: deque(maxlen=_MAX_CLOUDS))
    polar: Polar | None = None
    polar_for: tuple[object, ...] = ()
    outside: bool = False  # The window contains none of it.
    levels: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((1, 1), np.uint8))
    levels_for: tuple[object, ...] = ()
    picture: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((1, 1, 3), np.uint8))
    shape: Sector | Dome | None = None
    drawn_for: tuple[object, ...] = ()


class ViewedScene:
    """Latest image of each sensor, and the drawn objects for the present choices.

    Points are detected once per image, in all of its ranges; threshold and window then select among them, so that later
    choices also apply to present images.

    Parameters
    ----------
    width_px : int
        Width of the pictures.
    clean_within_db, clean_above_mean_db : float, optional
        Levels by which images are cleaned, as for `ertis_numba.analysis.range_cleaning.clean`; not cleaned by default.
    """

    def __init__(
        self,
        *,
        width_px: int = 520,
        clean_within_db: float | None = None,
        clean_above_mean_db: float | None = None,
    ) -> None:
        self._width_px = width_px
        self._clean_db = clean_within_db, clean_above_mean_db
        self._find = PointFinder(top=_MAX_POINTS, min_level_db=LOWEST_THRESHOLD_DB)
        self._sensors: dict[str, _SensorImages] = {}
        self._plan = FusedPlan(2 * width_px)  # A circle has less room than a sector.
        self._fused_clouds: deque[_Cloud] = deque(maxlen=_MAX_CLOUDS)
        self._fused_from: frozenset[str] = frozenset()  # Sensors of the fused image on display.

    @property
    def farthest_m(self) -> float:
        """Last range of all images; 0 without images."""
        return max((float(kept.latest.image.range_m[-1]) for kept in self._sensors.values()), default=0.0)

    def latest(self, choices: Choices) -> list[tuple[Energyscape, PointCloud, Pose | None]]:
        """Return the shown images with their drawn points and the poses of their sensors.

        The points of a fused image are those of the fusion, and belong to the first of its sensors.
        """
        found = []
        for name, kept in sorted(self._sensors.items()):
            cloud, pose = kept.clouds[-1], kept.latest.pose
            drawn = cloud.points.only(cloud.seen(choices)[0])
            if name in self._fused_from:
                cloud, pose = self._fused_clouds[-1], UNTURNED
                drawn = cloud.points.only(cloud.seen(choices)[0] & (name == min(self._fused_from)))
            found.append((kept.latest.image, drawn, pose))
        return found

    def clear(self) -> None:
        """Discard all images, as after a seek."""
        self._sensors.clear()
        self._fused_clouds.clear()
        self._fused_from = frozenset()

    def take(self, taken: ReceivedImage[Energyscape]) -> None:
        """Add an image to draw next; points of later times are discarded, as after a restart of the playback."""
        if self._clean_db != (None, None):
            within_db, above_mean_db = self._clean_db
            taken = replace(taken, image=clean(taken.image, within_db=within_db, above_mean_db=above_mean_db))
        name = taken.image.stamp.sensor
        kept = self._sensors.get(name)
        if kept is None or not _same_axes(kept.latest.image, taken.image):
            kept = self._sensors[name] = _SensorImages(taken, *(() if kept is None else (kept.clouds,)))
        kept.latest = taken
        while kept.clouds and kept.clouds[-1].time_s >= taken.time_s:
            kept.clouds.pop()
        kept.clouds.append(_cloud_of(self._find(taken.image), taken.time_s, taken.pose or UNTURNED))

    def draw(self, choices: Choices, now_s: float | None = None) -> DrawnFrame:
        """Return the drawn objects of the present images.

        Parameters
        ----------
        choices : Choices
        now_s : float, optional
            Present time by the clock of the source, from which fading and overdue sensors follow; the time of the
            latest image by default.
        """
        kept = dict(sorted(self._sensors.items()))
        if now_s is None:
            now_s = max((each.latest.time_s for each in kept.values()), default=0.0)
        timely = [each for each in kept.values() if now_s < each.latest.due_s]
        for each in kept.values():
            self._prepare(each, choices)
        joined = {name: each.latest for name, each in kept.items() if each in timely and not each.outside}
        fused = len(joined) > 1 and all(map(_is_level, joined.values())) and _share_reflectors(joined)
        sensors = {}
        for name, each in kept.items():
            overdue = now_s >= each.latest.due_s
            pose = each.latest.pose or (UNTURNED if len(kept) == 1 else None)
            alone = pose is not None and (overdue or not fused)
            sensors[name] = _drawn(each, choices, now_s, pose, overdue=overdue, alone=alone)
        self._fused_from = frozenset(joined) if fused else frozenset()
        plan, height_m = None, 0.0
        if fused:
            plan = self._plan(joined, choices)
            height_m = min(taken.pose.translation_m[2] for taken in joined.values() if taken.pose is not None)
            sensors |= self._with_fused_points({name: sensors[name] for name in joined}, choices, now_s)
        return DrawnFrame(
            sensors,
            self.farthest_m if choices.range_m is None else min(self.farthest_m, choices.range_m[1]),
            fused=plan,
            height_m=height_m,
            until_s=_until_s(timely, sensors, choices, now_s),
        )

    def _with_fused_points(self, joined: dict[str, Drawn], choices: Choices, now_s: float) -> dict[str, Drawn]:
        """Return objects of fused sensors with the points of the fusion, all at the first sensor."""
        cloud, time_s = self._plan.points, max(drawn.time_s for drawn in joined.values())
        clouds = self._fused_clouds
        if cloud is not None and not (clouds and clouds[-1].points is cloud):
            while clouds and clouds[-1].time_s >= time_s:
                clouds.pop()
            clouds.append(_cloud_of(cloud, time_s, UNTURNED))
        position_m, colours, share_left, n_points = _points(clouds, choices, now_s, colour_table(choices.colours))
        first = min(joined)
        found = {}
        for name, drawn in joined.items():
            count = None if name == first else 0
            found[name] = replace(
                drawn,
                position_m=position_m[:count],
                colours=colours[:count],
                share_left=share_left[:count],
                n_points=n_points if name == first else 0,
            )
        return found

    def _prepare(self, kept: _SensorImages, choices: Choices) -> None:
        """Update the levels of a sensor's image after a new image or choice."""
        image = kept.latest.image
        kept.outside = not is_within(image, choices.range_m)
        if not kept.outside:
            image = cropped(image, choices.range_m)
        polar_for = (len(image.range_m), float(image.range_m[0]), choices.dynamic_range_db)
        if kept.polar is None or kept.polar_for != polar_for:
            kept.polar = Polar(image, dynamic_range_db=choices.dynamic_range_db, width_px=self._width_px)
            kept.polar_for = polar_for
        if kept.levels_for != (kept.latest, kept.polar):
            kept.levels, kept.levels_for = kept.polar.levels(_echoes(image).amplitude), (kept.latest, kept.polar)


def _same_axes(image: Energyscape, other: Energyscape) -> bool:
    return same_directions(image, other) and np.array_equal(image.range_m, other.range_m)


def _cloud_of(cloud: PointCloud, time_s: float, pose: Pose) -> _Cloud:
    return _Cloud(
        cloud,
        pose.placed(cloud.position_m),
        np.asarray(20 * np.log10(np.maximum(cloud.amplitude, np.float32(1e-30))), dtype=np.float32),
        np.asarray(np.linalg.norm(cloud.position_m, axis=1), dtype=np.float32),
        time_s,
    )


def _is_level(taken: ReceivedImage[Energyscape]) -> bool:
    """Return True if an image lies in the horizontal plane of a platform, and its pose is known."""
    return taken.pose is not None and taken.image.is_planar and is_level(taken.pose)


def _share_reflectors(joined: Mapping[str, ReceivedImage[Energyscape]]) -> bool:
    """Return True if the ranges of images of mounted sensors overlap."""
    places_m = {name: taken.pose.translation_m for name, taken in joined.items() if taken.pose is not None}
    return far_apart(places_m, max(float(taken.image.range_m[-1]) for taken in joined.values())) is None


def _until_s(timely: list[_SensorImages], sensors: dict[str, Drawn], choices: Choices, now_s: float) -> float:
    """Return the time of the next picture without new images: at once while points fade."""
    if choices.decay_s and any(len(drawn.position_m) for drawn in sensors.values()):
        return now_s
    return min((kept.latest.due_s for kept in timely), default=math.inf)


def _drawn(
    kept: _SensorImages, choices: Choices, now_s: float, pose: Pose | None, *, overdue: bool, alone: bool
) -> Drawn:
    """Return the drawn objects of a sensor, whose shape is separate if it is ``alone``."""
    taken, polar = kept.latest, kept.polar
    assert polar is not None  # noqa: S101  it was prepared
    table = colour_table(choices.colours, dim=overdue)
    shape = choices.threshold_db, kept.outside and choices.range_m
    drawn_for = (*kept.levels_for, choices.colours, overdue, alone, *shape)
    if kept.drawn_for != drawn_for:
        kept.drawn_for = drawn_for
        kept.shape = None
        kept.picture = polar.empty(choices.range_m) if kept.outside else polar.picture(kept.levels, table)
        if alone and not kept.outside and taken.image.is_planar:
            kept.shape = Sector(polar.sector(kept.levels, table), polar.extent_m)
        elif alone and not kept.outside:
            kept.shape = _dome(cropped(_echoes(taken.image), choices.range_m), choices, table)
    position_m, colours, share_left, n_points = _points(kept.clouds, choices, now_s, table)
    if pose is None:  # Points of sensors without a common frame cannot be drawn together.
        position_m, colours, share_left = position_m[:0], colours[:0], share_left[:0]
    return Drawn(
        pose=pose,
        stamp=taken.image.stamp,
        time_s=taken.time_s,
        overdue=overdue,
        picture=kept.picture,
        shape=kept.shape,
        position_m=position_m,
        colours=colours,
        share_left=share_left,
        n_points=n_points,
    )


def _points(
    clouds: deque[_Cloud], choices: Choices, now_s: float, table: Table
) -> tuple[NDArray[np.float32], NDArray[np.uint8], NDArray[np.float32], int]:
    """Return points on the platform, their colours, their remaining share, and the number from the latest image."""
    places, colours, left, n_points = [np.empty((0, 3), np.float32)], [np.empty((0, 3), np.uint8)], [np.empty(0)], 0
    for cloud in clouds:
        latest = cloud is clouds[-1]
        share_left = 1 - max(0.0, now_s - cloud.time_s) / choices.decay_s if choices.decay_s else float(latest)
        if share_left <= 0:
            continue
        seen, below_db = cloud.seen(choices)
        shade = 1 + below_db[seen] / choices.dynamic_range_db
        places.append(cloud.position_m[seen])
        colours.append(table[np.rint(255 * np.clip(shade, 0.15, 1)).astype(np.uint8)])
        left.append(np.full(np.count_nonzero(seen), share_left))
        n_points = int(np.count_nonzero(seen)) if latest else 0
    return np.concatenate(places), np.concatenate(colours), np.concatenate(left).astype(np.float32), n_points


def _echoes(image: Energyscape) -> Energyscape:
    """Return an image with elevations without its side lobes: their maximum would show an arc at each range."""
    return image if image.is_planar else without_side_lobes(image)


def _dome(image: Energyscape, choices: Choices, table: Table) -> Dome:
    """Return the directions with echoes as strong as the shown points."""
    level_db = below_strongest_db(image.amplitude.max(axis=1), choices.dynamic_range_db)
    shade = 1 + level_db / choices.dynamic_range_db
    radius_m = _FARTHEST_DOME * float(image.range_m[-1])
    # Directions spread evenly over a hemisphere have a square of this side each.
    size_m = radius_m * math.sqrt(2 * math.pi / len(shade))
    seen = (shade > 0) & (level_db >= choices.threshold_db)
    return Dome(
        np.asarray(radius_m * unit_vectors(image.azimuth_rad[seen], image.elevation_rad[seen]), dtype=np.float32),
        table[np.rint(255 * shade[seen]).astype(np.uint8)],
        size_m,
    )


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
