"""Drawn objects of acoustic maps: a picture of each sensor, and a sphere or a polar plot around it."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.point_finder import same_directions
from ertis_numba.frames import LEVEL_UNITS, AcousticMap, Energyscape, PointCloud, level_offset_db
from ertis_numba.geometry import unit_vectors
from ertis_numba.viewer._choices import Choices, colour_table
from ertis_numba.viewer._level_plane import LevelPlane
from ertis_numba.viewer._shapes import (
    UNTURNED,
    BandLevel,
    Dome,
    Drawn,
    DrawnFrame,
    LevelScale,
    Pose,
    ReceivedImage,
    Sector,
    Unit,
)

__all__ = ["ViewedMaps", "masked_note"]

_STEP_DB: Final = 5.0  # The automatic scale moves in steps, because each change redraws its axes.
_RADIUS_M: Final = (0.05, 1.0)
_MARKS: Final = np.array([[0.96], [1.04]])  # Marks of a source inside and outside a sphere of radius 1.
_AROUND: Final = 1.3  # Visible range around a sphere of radius 1.

Edges = tuple[float, float]


def masked_note(sensor: str) -> str:
    """Return a note on the time that the maps of a sensor leave out."""
    return f"sensor {sensor} emits its call; acoustic maps leave out the time of the call"


@dataclass(slots=True)
class _SensorMaps:
    """State of a sensor, with its last drawn objects for reuse."""

    latest: ReceivedImage[AcousticMap]
    plane: LevelPlane
    picture: NDArray[np.uint8] = field(default_factory=lambda: np.zeros((1, 1, 3), np.uint8))
    shape: Sector | Dome | None = None
    marks: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None  # Unit vectors, and their distances.
    drawn_for: tuple[object, ...] = ()


class ViewedMaps:
    """Latest acoustic map of each sensor, and the drawn objects for the present choices.

    All sensors have the same colours of levels.

    Parameters
    ----------
    width_px : int
        Width of the pictures.
    """

    farthest_m = 0.0  # Maps have no range.

    def __init__(self, *, width_px: int = 520) -> None:
        self._width_px = width_px
        self._sensors: dict[str, _SensorMaps] = {}

    def latest(self, _: Choices) -> list[tuple[Energyscape, PointCloud, Pose | None]]:
        """Return nothing, because maps have no points."""
        return []

    def clear(self) -> None:
        """Discard all maps, as after a seek."""
        self._sensors.clear()

    def take(self, taken: ReceivedImage[AcousticMap]) -> None:
        """Add a map to draw next."""
        found, name = taken.image, taken.image.stamp.sensor
        kept = self._sensors.get(name)
        if kept is None or not same_directions(kept.latest.image, found):
            plane = LevelPlane(found.azimuth_rad, found.elevation_rad, width_px=self._width_px)
            self._sensors[name] = _SensorMaps(taken, plane)
        else:
            kept.latest = taken

    def draw(self, choices: Choices, now_s: float | None = None) -> DrawnFrame:
        """Return the drawn objects of the present maps.

        Parameters
        ----------
        choices : Choices
        now_s : float, optional
            Present time by the clock of the source, to find overdue sensors; the time of the latest map by default.
        """
        kept = dict(sorted(self._sensors.items()))
        if now_s is None:
            now_s = max((each.latest.time_s for each in kept.values()), default=0.0)
        timely = [each.latest for each in kept.values() if now_s < each.latest.due_s]
        scale = _scale([each.image for each in timely or [each.latest for each in kept.values()]], choices)
        poses = {name: each.latest.pose or (UNTURNED if len(kept) == 1 else None) for name, each in kept.items()}
        places_m = [pose.translation_m for pose in poses.values() if pose is not None]
        radius_m = _radius_m(places_m)
        sensors = {}
        for name, each in kept.items():
            overdue = now_s >= each.latest.due_s
            _prepare(each, choices, scale, radius_m, overdue=overdue)
            sensors[name] = _drawn(each, poses[name], radius_m, overdue=overdue)
        return DrawnFrame(
            sensors,
            _AROUND * radius_m + max((math.hypot(*place_m) for place_m in places_m), default=0.0),
            until_s=min((each.due_s for each in timely), default=math.inf),
            scale=scale,
        )


def _edges(maps: Iterable[AcousticMap]) -> list[Edges]:
    """Return the bands of several maps."""
    return sorted({(float(low_hz), float(high_hz)) for found in maps for low_hz, high_hz in found.band_hz})


def _chosen(bands: list[Edges], band_hz: float | None) -> Edges | None:
    """Return the band that contains a frequency, the nearest of several; None for the sum of all bands."""
    if band_hz is None:
        return None
    inside = [(low_hz, high_hz) for low_hz, high_hz in bands if low_hz <= band_hz <= high_hz]
    return min(inside, key=lambda each: abs(math.log(each[0] * each[1] / band_hz**2)), default=(band_hz, band_hz))


def _power(found: AcousticMap, band: Edges | None, unit: Unit) -> NDArray[np.float64] | None:
    """Return the power (direction,) in a band, or in all, relative to a unit's reference; None without the band."""
    offset_db = level_offset_db(found.settings, found.centre_hz, "dBFS" if unit == "dB" else unit)
    assert offset_db is not None  # noqa: S101  _unit chooses a unit that all maps have
    gain = 10 ** (offset_db / 10)
    if band is None:
        return np.asarray(found.power @ gain)
    places = np.flatnonzero((found.band_hz == band).all(axis=1))
    return np.asarray(found.power[:, places[0]] * gain[places[0]]) if len(places) else None


def _decibels(power: NDArray[np.float64]) -> NDArray[np.float32]:
    with np.errstate(divide="ignore"):
        return np.asarray(10 * np.log10(power), np.float32)


def _unit(maps: Iterable[AcousticMap]) -> Unit:
    """Return the unit of the levels of several maps: the most informative one that all of them have."""
    if not all(found.has_level for found in maps):
        return "dB"
    units = {found.reference.unit for found in maps}
    return next((unit for unit in reversed(LEVEL_UNITS.values()) if unit in units), "dBFS")


def _loudest(maps: Iterable[AcousticMap], band: Edges | None, unit: Unit, *, is_shown: bool) -> BandLevel:
    """Return the loudest direction of a band, of the maps that have it."""
    best = BandLevel(band, -math.inf, "", 0.0, 0.0, is_shown)
    for found in maps:
        power = _power(found, band, unit)
        if power is None:
            continue
        place = int(power.argmax())
        level_db = float(_decibels(power[place : place + 1])[0])
        if level_db > best.level_db:
            direction_deg = float(found.azimuth_deg[place]), float(found.elevation_deg[place])
            best = BandLevel(band, level_db, found.stamp.sensor, *direction_deg, is_shown)
    return best


def _scale(maps: list[AcousticMap], choices: Choices) -> LevelScale:
    """Return the colours of levels, and the loudest direction of each band."""
    edges, unit = _edges(maps), _unit(maps)
    chosen = _chosen(edges, choices.band_hz)
    bands = tuple(_loudest(maps, band, unit, is_shown=band == chosen) for band in (None, *edges))
    high_db = choices.max_level_db
    if high_db is None:
        loudest_db = max((each.level_db for each in bands if each.is_shown), default=-math.inf)
        high_db = math.ceil(loudest_db / _STEP_DB) * _STEP_DB if math.isfinite(loudest_db) else 0.0
    return LevelScale(high_db - choices.dynamic_range_db, high_db, unit, bands)


def _radius_m(places_m: list[tuple[float, float, float]]) -> float:
    """Return the radius of spheres that do not overlap, within limits."""
    apart_m = min((math.dist(one, other) for one, other in combinations(places_m, 2)), default=math.inf)
    return min(max(apart_m / 2, _RADIUS_M[0]), _RADIUS_M[1])


def _prepare(kept: _SensorMaps, choices: Choices, scale: LevelScale, radius_m: float, *, overdue: bool) -> None:
    """Draw the map of a sensor, unless it is drawn already."""
    found, plane = kept.latest.image, kept.plane
    band = _chosen(_edges([found]), choices.band_hz)
    drawn_for = (found, band, scale.low_db, scale.high_db, scale.unit, choices.colours, radius_m, overdue)
    if kept.drawn_for == drawn_for:
        return
    kept.drawn_for, kept.shape, kept.marks = drawn_for, None, None
    power = _power(found, band, scale.unit)
    if power is None:
        low_hz, high_hz = found.band_hz.min(), found.band_hz.max()
        text = f"no band at {choices.band_hz / 1e3:g} kHz:" if choices.band_hz is not None else ""
        kept.picture = plane.empty(f"{text}\nthe map covers {low_hz / 1e3:.3g} to {high_hz / 1e3:.3g} kHz")
        return
    table = colour_table(choices.colours, dim=overdue)
    shades = scale.shade(_decibels(power))
    kept.marks = _marks(found, band, shades, is_planar=plane.is_planar)
    kept.picture = plane.picture(shades, table, scale)
    if plane.is_planar:
        west, east, low, high = (radius_m * each for each in plane.extent)
        kept.shape = Sector(plane.sector(shades, table), (west, east, low, high))
    else:
        seen = shades > 0
        position_m = radius_m * unit_vectors(found.azimuth_rad[seen], found.elevation_rad[seen])
        size_m = radius_m * plane.spacing_rad
        kept.shape = Dome(np.asarray(position_m, np.float32), table[shades[seen]], size_m)


def _marks(
    found: AcousticMap, band: Edges | None, shades: NDArray[np.uint8], *, is_planar: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return unit vectors of the sources, (source, axis), or of the loudest direction if none were searched."""
    grid = unit_vectors(found.azimuth_rad, found.elevation_rad)
    if found.has_bearings:
        heard = [each for each in found.bearings if band is None or each.band_hz == band]
        directions = unit_vectors(
            np.array([each.azimuth_rad for each in heard]), np.array([each.elevation_rad for each in heard])
        )
        places = (directions @ grid.T).argmax(axis=1)
    else:
        places = np.flatnonzero(shades.argmax() == np.arange(len(shades)))[: int(shades.any())]
        directions = grid[places]
    return directions, shades[places][None] / 255 if is_planar else np.broadcast_to(_MARKS, (2, len(places)))


def _drawn(kept: _SensorMaps, pose: Pose | None, radius_m: float, *, overdue: bool) -> Drawn:
    """Return the drawn objects of a sensor, with points at the marks."""
    position_m = np.empty((0, 3), np.float32)
    if kept.marks is not None and pose is not None:
        directions, distances = kept.marks
        position_m = pose.placed(np.asarray(radius_m * (distances[..., None] * directions).reshape(-1, 3), np.float32))
    return Drawn(
        pose=pose,
        stamp=kept.latest.image.stamp,
        time_s=kept.latest.time_s,
        overdue=overdue,
        picture=kept.picture,
        shape=kept.shape,
        position_m=position_m,
        colours=np.full((len(position_m), 3), 255, np.uint8),
        share_left=np.ones(len(position_m), np.float32),
        n_points=0,
    )
