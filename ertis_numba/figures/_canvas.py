"""Common parts of pictures of levels: raster, colour bar, marked reflectors and their list."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from ertis_numba.analysis.levels import below_strongest_db
from ertis_numba.figures._marks import name_points
from ertis_numba.figures._page import FigurePage, PageBox, lay_out
from ertis_numba.figures._words import Heading
from ertis_numba.figures.style import MONOSPACE, Style, minus, text_width_pt
from ertis_numba.frames import Peak

__all__ = ["Canvas"]

_RING_PT = 5.0
_ROW = 1.6  # height of a row of the list, by the size of its letters
_MAX_ROWS = 24  # below a picture
_MIN_ROWS = 12  # beside one, whatever its height
_LABEL_EMS = 13.0  # length of what is written along the scale
_SHARE_ALONE = 0.8  # of its box that a scale takes which no list is under
_LEVEL_EMS = 5.8  # what a scale that lies takes, with its ticks and its label


@dataclass(frozen=True, slots=True)
class Canvas:
    """Choices of one picture."""

    style: Style
    dynamic_range_db: float
    peaks: tuple[Peak, ...] = ()
    is_searched: bool = False  # for peaks, which may be none

    def lay_out(
        self, heading: Heading, panels: Sequence[Callable[[float], float]], *, width_pt: float
    ) -> tuple[FigurePage, list[PageBox], PageBox]:
        """Return a page with boxes for pictures, and the box of their scale and of the list of reflectors.

        There is room for the scale and some reflectors beside pictures of any height.
        """
        style, rows = self.style, self._rows()
        list_pt = _ROW * style.list_pt
        lying_pt = (_LEVEL_EMS + 0.5) * style.em_pt + list_pt * min(len(rows), _MIN_ROWS)
        widest_pt = max((text_width_pt(row, style.list_pt, MONOSPACE) for row in rows), default=0.0)
        return lay_out(
            style,
            heading,
            panels,
            width_pt=width_pt,
            side_pt=max(widest_pt + 3 * style.em_pt, 7 * style.em_pt),
            side_tall_pt=lying_pt if rows else _LABEL_EMS / _SHARE_ALONE * style.em_pt + 1.0,
            below_pt=6 * style.em_pt + list_pt * min(len(rows), _MAX_ROWS),
        )

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
        return axes.imshow(
            level_db,
            extent=extent,
            origin="lower",
            aspect=aspect,
            cmap=self.style.colours,
            vmin=-self.dynamic_range_db,
            vmax=0.0,
            interpolation="antialiased",
        )

    def grid(self, axes: Axes) -> None:
        """Draw thin lines from the ticks."""
        axes.grid(color=self.style.faint, alpha=0.3, linewidth=0.6 * self.style.line_pt)

    def mark_peaks(self, axes: Axes, place: Callable[[Peak], tuple[float, float] | None]) -> None:
        """Mark and number the reflectors at the positions from ``place``, the strongest on top.

        Axis limits must be final.
        """
        style = self.style
        frame = axes.bbox.padded(1.0)
        places = [(number, at) for number, peak in enumerate(self.peaks, 1) if (at := place(peak)) is not None]
        seen = [(number, at) for number, at in places if frame.contains(*axes.transData.transform(at))]
        for _, (x, y) in reversed(seen):
            (ring,) = axes.plot(
                x,
                y,
                "o",
                markersize=2 * _RING_PT * style.line_pt,
                markerfacecolor="none",
                markeredgecolor=style.mark,
                markeredgewidth=style.line_pt,
                scalex=False,
                scaley=False,
            )
            ring.set_path_effects([withStroke(linewidth=2.0 * style.line_pt, foreground=style.page)])
        name_points(
            axes,
            style,
            [at for _, at in seen],
            [str(number) for number, _ in seen],
            ring_pt=_RING_PT * style.line_pt,
            colour=style.mark,
            bold=True,
        )

    def side(self, page: FigurePage, box: PageBox, shown: AxesImage, *, label: str = "dB re strongest") -> Figure:
        """Draw the colour bar into its box, and the list of reflectors below it; return the figure."""
        style, em_pt = self.style, self.style.em_pt
        height_pt = min(16 * em_pt, (0.45 if self._rows() else _SHARE_ALONE) * box.height)
        upright = height_pt >= _LABEL_EMS * em_pt and box.width < 30 * em_pt
        if upright:
            bar = PageBox(box.left + em_pt, box.bottom + box.height - height_pt - 2 * em_pt, 1.3 * em_pt, height_pt)
            axes = page.axes(bar, y=label)
        else:
            bar = PageBox(box.left + 0.1 * box.width, box.bottom + box.height - 2.2 * em_pt, 0.8 * box.width, em_pt)
            axes = page.axes(bar, x=label)
        names = axes.get_xlabel(), axes.get_ylabel()
        page.figure.colorbar(shown, cax=axes, orientation="vertical" if upright else "horizontal")
        axes.set_xlabel(names[0])
        axes.set_ylabel(names[1])
        for solid in axes.collections:
            solid.set_rasterized(True)  # hundreds of colours are one picture in a file of vectors
        top_pt = bar.bottom - (2.0 if upright else 3.6) * em_pt
        fitting = int((top_pt - box.bottom) / (_ROW * style.list_pt))
        rows = self._rows()
        if len(rows) > fitting:
            rows = [*rows[: max(fitting - 1, 0)], f"and {len(rows) - max(fitting - 1, 1)} more"]
        if rows and fitting >= min(2, len(rows)):
            page.text("\n".join(rows), box.left + (em_pt if upright else 0), top_pt, style.list_pt, font=MONOSPACE)
        return page.figure

    def _rows(self) -> list[str]:
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
            directions = " ".join(f"{_tenth(angle_deg):+6.1f}°" for angle_deg in angles)
            row = f"{number:>2}  {directions}  {peak.range_m:{width}.{decimals}f} m {_tenth(peak.level_db):5.1f}"
            rows.append(minus(row))
        return rows


def _tenth(value: float) -> float:
    """Return a number to one digit, 0 without a sign."""
    return round(value, 1) + 0.0
