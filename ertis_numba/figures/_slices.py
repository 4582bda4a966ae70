"""Cuts through an image: a level plane and an upright one, in metres of the sensor frame."""

from dataclasses import dataclass, replace

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.figures import _captions
from ertis_numba.figures._canvas import Canvas
from ertis_numba.figures._page import Panel, compose
from ertis_numba.figures._sampling import centres, join_ranges, thickened, volume_raster
from ertis_numba.figures.style import minus
from ertis_numba.frames import Energyscape, Peak
from ertis_numba.geometry import unit_vectors

__all__ = ["draw"]

_PIXELS = 500  # along the longer side
_NEAR_M = 0.05  # of a plane, or a fiftieth of the range: reflectors that are ringed in it
_MAX_RATIO = 1.1


def draw(canvas: Canvas, image: Energyscape, *, height_m: float, left_m: float | None) -> Figure:
    """Draw the plane of a height and the upright one that runs forward at a distance to the left."""
    if image.is_planar and left_m is not None:
        raise ArgumentError(
            f"left_m is {left_m:g}, but a planar image has no upright plane; "
            "leave it out, or choose an image with elevations"
        )
    level_db = canvas.level_db(image.amplitude)
    cuts = [_level(image, height_m)]
    if not image.is_planar:
        cuts.append(_upright(image, left_m or 0.0))
    rasters = [cut.sample(level_db, image) for cut in cuts]
    drawn = tuple(peak for peak in canvas.peaks if any(cut.place(peak) for cut in cuts))
    canvas = replace(canvas, peaks=drawn)  # the list has the reflectors in the planes only
    panels = [cut.panel(canvas, raster) for cut, raster in zip(cuts, rasters, strict=True)]
    return compose(canvas, _captions.of_image(image), panels, width_pt=720.0 if len(cuts) == 1 else 1008.0)


@dataclass(frozen=True, slots=True)
class _Cut:
    """A plane through an image; across, up and normal are axes of the sensor frame."""

    name: str  # argument that sets its position
    at_m: float
    across: int
    up: int
    normal: int
    title: str
    extent_m: tuple[float, float, float, float]  # (left, right, bottom, top); left > right if y increases to the left

    def sample(self, level_db: NDArray[np.float32], image: Energyscape) -> NDArray[np.float32]:
        """Return the levels in the plane, which the image must contain: (row, column), NaN where there are none."""
        left, right, bottom, top = self.extent_m
        step_m = max(abs(right - left), top - bottom) / _PIXELS
        across_m = centres(left, right, step_m)
        up_m = centres(bottom, top, step_m)
        points_m = np.full((len(up_m), len(across_m), 3), self.at_m)
        points_m[..., self.across] = across_m
        points_m[..., self.up] = up_m[:, None]
        range_m, joined_db = thickened(*join_ranges(image.range_m, level_db, largest=_PIXELS))
        directions = unit_vectors(image.azimuth_rad, image.elevation_rad)
        raster = volume_raster(joined_db, directions, range_m, points_m=points_m)
        if np.isnan(raster).all():
            raise ArgumentError(
                f"{self.name} is {self.at_m:g}, where the image shows nothing; use a plane that crosses it"
            )
        return raster

    def panel(self, canvas: Canvas, raster: NDArray[np.float32]) -> Panel:
        """Return the picture of the plane and the reflectors in it."""
        left, right, bottom, top = self.extent_m
        names = "x, forward (m)", "y, left (m)", "z, up (m)"

        def paint(axes: Axes) -> AxesImage:
            axes.set_xlabel(names[self.across])
            axes.set_ylabel(names[self.up])
            shown = canvas.show(axes, raster, extent=self.extent_m, aspect="equal")
            axes.locator_params(min_n_ticks=1)  # more would run into each other in a narrow picture
            canvas.grid(axes)
            return shown

        ratio = min(_MAX_RATIO, (top - bottom) / abs(right - left))
        return Panel(
            paint, lambda width_pt: ratio * width_pt, lambda axes: canvas.mark_peaks(axes, self.place), self.title
        )

    def place(self, peak: Peak) -> tuple[float, float] | None:
        """Return where a reflector is in the picture; None if it is not in the plane."""
        unit = unit_vectors(np.radians(peak.azimuth_deg), np.radians(peak.elevation_deg))
        place_m = peak.range_m * unit
        if abs(place_m[self.normal] - self.at_m) > max(_NEAR_M, peak.range_m / 50):
            return None
        return float(place_m[self.across]), float(place_m[self.up])


def _level(image: Energyscape, height_m: float) -> _Cut:
    spans = _spans(image)
    title = f"level plane at z = {minus(f'{height_m:g}')} m"
    return _Cut("height_m", height_m, 1, 0, 2, title, (spans[1][1], spans[1][0], *spans[0]))


def _upright(image: Energyscape, left_m: float) -> _Cut:
    spans = _spans(image)
    title = f"upright plane at y = {minus(f'{left_m:g}')} m"
    return _Cut("left_m", left_m, 0, 2, 1, title, (*spans[0], *spans[2]))


def _spans(image: Energyscape) -> list[tuple[float, float]]:
    """Return how far the image and the sensor reach along x, y and z."""
    points_m = unit_vectors(image.azimuth_rad, image.elevation_rad) * image.range_m[-1]
    min_m = 0.1 * float(image.range_m[-1])  # what is thinner could not be seen
    spans = []
    for low, high in zip(points_m.min(axis=0), points_m.max(axis=0), strict=True):
        first, last = min(0.0, float(low)), max(0.0, float(high))
        spare = max(0.0, min_m - (last - first)) / 2
        spans.append((first - spare, last + spare))
    return spans
