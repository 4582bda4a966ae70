"""Labels beside points, without overlaps."""

import itertools
import math
from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox
from numpy.typing import NDArray

from ertis_numba.figures.style import Style, text_width_pt

__all__ = ["name_points"]

_TURNS_DEG = (35.0, 145.0, -35.0, -145.0, 90.0, -90.0, 0.0, 180.0)
_REACHES = (1.0, 1.7, 2.6, 3.6)  # how far off a name may stand, by the nearest that is possible
_NEAR = 1.3  # a name that stands farther off is joined to its point by a line


def name_points(
    axes: Axes,
    style: Style,
    points: Sequence[tuple[float, float]],
    names: Sequence[str],
    *,
    ring_pt: float,
    colour: str,
    bold: bool = False,
) -> None:
    """Write labels beside points, ring_pt away; omit those without room; the limits of axes must be final."""
    px_per_pt, size_pt, page = axes.figure.dpi / 72, style.tick_pt, axes.figure.bbox
    taken = [text.get_window_extent() for text in axes.texts if text.get_text()]
    places = [axes.transData.transform(point) for point in points]
    ring_px = np.full(2, ring_pt * px_per_pt)
    rings = [_box(place, 2 * ring_px) for place in places]
    for number, (name, place) in enumerate(zip(names, places, strict=True)):
        size_px = px_per_pt * np.array([text_width_pt(name, size_pt, style.font, bold=bold), 1.15 * size_pt])
        others = [*taken, *rings[:number], *rings[number + 1 :]]
        for reach, turn_deg in itertools.product(_REACHES, _TURNS_DEG):
            turn = math.radians(turn_deg)
            offset_px = np.array([math.cos(turn), math.sin(turn)]) * (reach * ring_px + size_px / 2 + px_per_pt)
            box = _box(place + offset_px, size_px)
            inside = page.contains(*box.min) and page.contains(*box.max)
            if inside and not any(box.overlaps(other) for other in others):
                break
        else:
            continue
        taken.append(box)
        arrow = {"arrowstyle": "-", "color": colour, "linewidth": 0.5 * style.line_pt, "shrinkB": ring_pt}
        axes.annotate(
            name,
            points[number],
            xytext=tuple(offset_px / px_per_pt),
            textcoords="offset points",
            color=colour,
            fontweight="bold" if bold else "normal",
            ha="center",
            va="center",
            path_effects=[withStroke(linewidth=2.5 * style.line_pt, foreground=style.page)],
            arrowprops=arrow if reach > _NEAR else None,
        )


def _box(middle: NDArray[np.float64], size: NDArray[np.float64]) -> Bbox:
    return Bbox([middle - size / 2, middle + size / 2])
