"""Common parts of pictures of levels: raster, marked reflectors and their list."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.image import AxesImage
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from ertis_numba.analysis.levels import below_strongest_db
from ertis_numba.base import checks
from ertis_numba.figures._marks import name_points
from ertis_numba.figures.style import Style, StyleOptions, minus, style_of
from ertis_numba.frames import Peak

__all__ = ["Canvas", "canvas_of"]

_RING_PT = 5.0


@dataclass(frozen=True, slots=True)
class Canvas:
    """Choices of one picture."""

    style: Style
    dynamic_range_db: float = 40.0
    peaks: tuple[Peak, ...] = ()
    is_searched: bool = False  # for peaks, which may be none
    top_db: float = 0.0  # level of the brightest colour
    unit: str = "dB re strongest"

    def level_db(self, amplitude: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the level relative to the strongest, limited to the dynamic range."""
        return below_strongest_db(amplitude, self.dynamic_range_db)

    def show(
        self,
        axes: Axes,
        level_db: NDArray[np.floating],
        *,
        extent: tuple[float, float, float, float],
        aspect: Literal["auto", "equal"] = "auto",
    ) -> AxesImage:
        """Draw a raster whose NaN are not drawn; ``extent`` is left, right, bottom, top."""
        shown = axes.imshow(
            level_db,
            extent=extent,
            origin="lower",
            aspect=aspect,
            vmin=self.top_db - self.dynamic_range_db,
            vmax=self.top_db,
            interpolation="antialiased",
        )
        axes.set_xlim(*extent[:2])
        axes.set_ylim(*extent[2:])
        return shown

    def grid(self, axes: Axes) -> None:
        """Draw thin lines from the ticks."""
        axes.grid(color=self.style.faint, alpha=0.3, linewidth=0.6 * self.style.line_pt)

    def mark_peaks(self, axes: Axes, place: Callable[[Peak], tuple[float, float] | None]) -> None:
        """Mark and number reflectors at place, the strongest on top, once position and limits of axes are final."""
        style = self.style
        frame, stroke = axes.bbox.padded(1.0), [withStroke(linewidth=2.0 * style.line_pt, foreground=style.page)]
        places = [(number, at) for number, peak in enumerate(self.peaks, 1) if (at := place(peak)) is not None]
        places = [(number, at) for number, at in places if not math.isnan(sum(at))]  # of unknown angles
        seen = [(number, at) for number, at in places if frame.contains(*axes.transData.transform(at))]
        ring: dict[str, Any] = {"markersize": 2 * _RING_PT * style.line_pt, "color": style.mark}
        for _, at in reversed(seen):
            axes.plot(
                *at,
                "o",
                fillstyle="none",
                scalex=False,
                scaley=False,
                markeredgewidth=style.line_pt,
                path_effects=stroke,
                **ring,
            )
        names, ring_pt = [str(number) for number, _ in seen], _RING_PT * style.line_pt
        name_points(axes, style, [at for _, at in seen], names, ring_pt=ring_pt, colour=style.mark, bold=True)

    def rows(self) -> list[str]:
        """Return the list of reflectors, its heading first."""
        if not self.peaks:
            return ["no echo above the noise"] if self.is_searched else []
        spatial = any(abs(peak.elevation_deg) >= 0.05 for peak in self.peaks)
        farthest_m = max(peak.range_m for peak in self.peaks)
        decimals = 2 if farthest_m >= 1 else 2 - math.floor(math.log10(max(farthest_m, 1e-4)))  # three digits of it
        width = max(5, len(f"{farthest_m:.{decimals}f}"))
        rows = [f" #  azimuth {'elevat. ' if spatial else ''}  {'range':>{width}}    dB"]
        for number, peak in enumerate(self.peaks, 1):
            angles = (peak.azimuth_deg, peak.elevation_deg) if spatial else (peak.azimuth_deg,)
            directions = " ".join(map(_angle, angles))
            row = f"{number:>2}  {directions}  {peak.range_m:{width}.{decimals}f} m {_tenth(peak.level_db):5.1f}"
            rows.append(minus(row))
        return rows


def _angle(angle_deg: float) -> str:
    """Return an angle of seven characters; a dash if it is unknown."""
    return f"{'–':>6} " if math.isnan(angle_deg) else f"{_tenth(angle_deg):+6.1f}°"


def _tenth(value: float) -> float:
    """Return a number to one digit, 0 without a sign."""
    return round(value, 1) + 0.0


def canvas_of(dynamic_range_db: float, look: StyleOptions, peaks: Sequence[Peak] | None = None) -> Canvas:
    """Return the canvas of a figure with marked peaks; none means that they have not been searched for."""
    checks.positive("dynamic_range_db", dynamic_range_db)
    marked = tuple(checks.items("peaks", peaks or (), Peak, "find_peaks returns"))
    return Canvas(style_of(**look), dynamic_range_db, marked, is_searched=peaks is not None)
