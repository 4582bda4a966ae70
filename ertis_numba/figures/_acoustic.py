"""Acoustic maps: levels over direction, on a photo, and over the bands of one direction."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import FixedFormatter, FixedLocator
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.figures import _captions
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._images import level_map
from ertis_numba.figures._page import Panel, compose
from ertis_numba.figures._sampling import PIXELS, centres, look_raster
from ertis_numba.figures.style import angle, minus
from ertis_numba.frames import AcousticMap, Bearing, LevelReference
from ertis_numba.geometry import observable_angles, unit_vectors

__all__ = ["draw", "draw_bands", "draw_on_photo"]

_LINE_RATIO, _BAND_RATIO = 0.42, 0.42
_SPARE_DB = 3.0
_OPAQUE = 0.6  # of the colours over a photo
_FADED = 0.3  # share of the dynamic range over which they fade in
_TICKS_DEG = (-60, -45, -30, -20, -10, 0, 10, 20, 30, 45, 60)


def draw(canvas: Canvas, found: AcousticMap, *, band_hz: tuple[float, float] | None) -> Figure:
    """Draw the levels of a band over azimuth and elevation, or as a line over azimuth."""
    canvas, level_db, shown = _levels(canvas, found, band_hz)
    heading = _heading(canvas, shown)
    if np.ptp(found.elevation_rad) > 1e-9:
        panel = level_map(canvas, level_db, found.azimuth_rad, found.elevation_rad)
        return compose(canvas, heading, [_with_sources(canvas, shown, panel)])
    _require_directions(found)
    order = np.argsort(found.azimuth_rad)
    azimuth_deg = np.degrees(found.azimuth_rad[order])

    def paint(axes: Axes) -> None:
        axes.plot(azimuth_deg, level_db[order], color=canvas.style.mark)
        axes.set_xlim(azimuth_deg[-1], azimuth_deg[0])  # Positive azimuths are on the left.
        axes.set_ylim(canvas.top_db - canvas.dynamic_range_db, canvas.top_db + _SPARE_DB)
        axes.set_xlabel("azimuth (°)")
        axes.set_ylabel(f"level ({canvas.unit})")
        canvas.grid(axes)

    return compose(canvas, heading, [Panel(paint, lambda width_pt: _LINE_RATIO * width_pt)])


def draw_on_photo(
    canvas: Canvas,
    found: AcousticMap,
    *,
    band_hz: tuple[float, float] | None,
    photo: NDArray[Any],
    fov_deg: tuple[float, float],
) -> Figure:
    """Draw the levels of a band over the picture of a pinhole camera that looks along x."""
    if np.ptp(found.elevation_rad) <= 1e-9:
        raise ArgumentError(
            "the directions of the acoustic map have one elevation, which a photo cannot show; process with directions "
            "in space, such as 3000 or 3d:2000"
        )
    canvas, level_db, combined = _levels(canvas, found, band_hz)
    half_y, half_z = (math.tan(math.radians(each_deg) / 2) for each_deg in fov_deg)
    extent = (half_y, -half_y, -half_z, half_z)
    step = 2 * max(half_y, half_z) / PIXELS

    def paint(axes: Axes) -> AxesImage:
        y, z = np.meshgrid(centres(half_y, -half_y, step), centres(-half_z, half_z, step))
        rays = np.stack([np.ones_like(y), y, z], axis=2)
        rays /= np.linalg.norm(rays, axis=2, keepdims=True)
        raster = look_raster(level_db, unit_vectors(found.azimuth_rad, found.elevation_rad), rays)
        axes.imshow(photo, extent=extent, aspect="auto", interpolation="antialiased", cmap="gray")
        shown = canvas.show(axes, raster, extent=extent)
        above = (raster - (canvas.top_db - canvas.dynamic_range_db)) / (_FADED * canvas.dynamic_range_db)
        shown.set_alpha(_OPAQUE * np.clip(np.nan_to_num(above), 0.0, 1.0))
        axes.set_xlabel("azimuth (°)")
        axes.set_ylabel("elevation (°)")
        for axis, half in ((axes.xaxis, half_y), (axes.yaxis, half_z)):
            seen_deg = [at_deg for at_deg in _TICKS_DEG if abs(math.tan(math.radians(at_deg))) <= half]
            axis.set_major_locator(FixedLocator([math.tan(math.radians(at_deg)) for at_deg in seen_deg]))
            axis.set_major_formatter(FixedFormatter([minus(f"{at_deg}") for at_deg in seen_deg]))
        return shown

    ratio = half_z / half_y
    view = f"field of view {fov_deg[0]:g}° × {fov_deg[1]:g}°"
    heading = _heading(canvas, combined, view)
    return compose(canvas, heading, [Panel(paint, lambda width_pt: ratio * width_pt, box_aspect=ratio)])


def draw_bands(canvas: Canvas, found: AcousticMap, *, direction_deg: tuple[float, float] | None) -> Figure:
    """Draw the level of each band in a direction, by default the loudest of all bands together."""
    reference = LevelReference.of(found.settings, found.centre_hz)
    power = _referred(found, reference)
    place = _place(found, direction_deg, power)
    canvas, level_db = _scaled(canvas, found, reference, power[place])
    edges_khz = found.band_hz / 1e3
    floor_db = canvas.top_db - canvas.dynamic_range_db

    def paint(axes: Axes) -> None:
        axes.bar(
            edges_khz[:, 0],
            np.maximum(level_db, floor_db) - floor_db,
            np.diff(edges_khz, axis=1)[:, 0],
            bottom=floor_db,
            align="edge",
            color=canvas.style.mark,
            edgecolor=canvas.style.page,
            linewidth=canvas.style.line_pt,
        )
        axes.set_xlim(edges_khz.min(), edges_khz.max())
        axes.set_ylim(floor_db, canvas.top_db + _SPARE_DB)
        axes.set_xlabel("frequency (kHz)")
        axes.set_ylabel(f"level of a band ({canvas.unit})")
        canvas.grid(axes)

    place_deg = np.degrees([found.azimuth_rad[place], found.elevation_rad[place]])
    towards = f"azimuth {angle(place_deg[0])}, elevation {angle(place_deg[1])}"
    chosen = towards if direction_deg is not None else f"loudest direction: {towards}"
    unknown = _captions.unknown_levels(reference.offset_db) if found.has_level else ()
    heading = _captions.of_acoustic_map("Spectrum", found, chosen, *unknown)
    return compose(canvas, heading, [Panel(paint, lambda width_pt: _BAND_RATIO * width_pt)])


def _levels(
    canvas: Canvas, found: AcousticMap, band_hz: tuple[float, float] | None
) -> tuple[Canvas, NDArray[np.float32], AcousticMap]:
    """Return the levels of a band over direction, a canvas with their scale, and the map of this band."""
    from ertis_numba.passive.components import gathered  # noqa: PLC0415  few plots need it, and it imports kernels

    if band_hz is not None:
        found.in_band(*band_hz)  # raises an error if there is none
        shown = (found.centre_hz >= band_hz[0]) & (found.centre_hz <= band_hz[1])
        heard = tuple(each for each in found.bearings if band_hz[0] <= each.center_hz <= band_hz[1])
        found = found.replace(power=found.power[:, shown], band_hz=found.band_hz[shown], bearings=heard)
    power = _referred(found, found.reference).sum(axis=1)
    limits_hz = np.array([[found.band_hz.min(), found.band_hz.max()]])
    combined = gathered(found.replace(power=power[:, None].astype(np.float32), band_hz=limits_hz))
    return *_scaled(canvas, found, found.reference, combined.power[:, 0].astype(np.float64)), combined


def _referred(found: AcousticMap, reference: LevelReference) -> NDArray[np.float64]:
    """Return powers relative to a reference, if the map has levels; NaN where that is unknown."""
    return found.power * 10 ** (reference.offset_db / 10) if found.has_level else found.power.astype(np.float64)


def _scaled(
    canvas: Canvas, found: AcousticMap, reference: LevelReference, power: NDArray[np.float64]
) -> tuple[Canvas, NDArray[np.float32]]:
    """Return levels limited to the dynamic range below the highest, and a canvas with their scale."""
    unit = reference.unit if found.has_level else canvas.unit
    highest = float(np.nanmax(power, initial=0.0)) or 1.0
    top_db = 10 * math.log10(highest) if found.has_level else 0.0
    lowest = 10 ** (-canvas.dynamic_range_db / 10)
    below_db = 10 * np.log10(np.maximum(power / highest, lowest))
    return replace(canvas, top_db=top_db, unit=unit), np.asarray(top_db + below_db, np.float32)


def _heading(canvas: Canvas, shown: AcousticMap, *parts: str) -> _captions.Heading:
    low_khz, high_khz = (_captions.number(edge_hz / 1e3) for edge_hz in shown.band_hz[0])
    note = observable_angles(shown.settings.array, shown).note
    parts = (*parts, f"array {note}") if note else parts
    return _captions.of_acoustic_map(
        "Acoustic map",
        shown,
        f"{len(shown.azimuth_rad)} directions",
        f"{low_khz}–{high_khz} kHz",
        _loudest_text(canvas, shown),
        *parts,
    )


def _loudest_text(canvas: Canvas, shown: AcousticMap) -> str:
    """Return the direction and the level of the loudest source in words; of the grid, if no sources were searched."""
    if shown.is_silent[0]:
        return "silence: all values are 0"
    if shown.has_bearings and not shown.bearings:
        return "no source found"
    if shown.bearings:
        loudest = max(shown.bearings, key=lambda each: each.level_dbfs)
        level_db, unit = loudest.level
        doubt = "".join(f", may be {name}" for name in loudest.doubts)
        return f"loudest source at {_towards(loudest)}: {minus(f'{level_db:.1f}')} {unit}{doubt}"
    place = int(shown.power.argmax())
    level = f": {minus(f'{10 * math.log10(shown.power[place, 0]):.1f}')} {canvas.unit}" if shown.has_level else ""
    azimuth_deg, elevation_deg = float(shown.azimuth_deg[place]), float(shown.elevation_deg[place])
    return f"loudest direction: azimuth {angle(azimuth_deg)}, elevation {angle(elevation_deg)}{level}"


def _towards(bearing: Bearing) -> str:
    """Return the angles of a bearing that are known, in words."""
    every = (
        ("azimuth", bearing.azimuth_deg, bearing.sideways_deg),
        ("elevation", bearing.elevation_deg, bearing.upwards_deg),
    )
    return ", ".join(f"{name} {angle(at_deg)}" for name, at_deg, size_deg in every if math.isfinite(size_deg))


def _with_sources(canvas: Canvas, shown: AcousticMap, panel: Panel) -> Panel:
    """Return a map with a ring around each source."""

    def finish(axes: Axes) -> None:
        panel.finish(axes)
        east = min(axes.get_xlim())
        ring: dict[str, Any] = {"fillstyle": "none", "markersize": 1.1 * canvas.style.em_pt, "scalex": False}
        for each in shown.bearings:
            at_deg = east + (each.azimuth_deg - east) % 360.0
            axes.plot(at_deg, each.elevation_deg, "o", color=canvas.style.mark, scaley=False, **ring)

    return replace(panel, finish=finish)


def _place(found: AcousticMap, direction_deg: tuple[float, float] | None, power: NDArray[np.float64]) -> int:
    """Return the index of the direction nearest to one, or of the loudest."""
    if direction_deg is None:
        return int(np.argmax(np.nansum(power, axis=1)))
    wanted = unit_vectors(*np.radians(direction_deg).reshape(2, 1))[0]
    return int(np.argmax(unit_vectors(found.azimuth_rad, found.elevation_rad) @ wanted))


def _require_directions(found: AcousticMap) -> None:
    if len(found.azimuth_rad) < 2:
        raise ArgumentError("the acoustic map has one direction; draw its spectrum instead, or use more directions")
