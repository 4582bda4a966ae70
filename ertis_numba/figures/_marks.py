"""Labels beside points, without overlaps."""

import math
from collections.abc import Sequence

from matplotlib.axes import Axes
from matplotlib.patheffects import withStroke
from matplotlib.transforms import Bbox, BboxBase

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
    """Write labels beside points, the first ones nearest; omit those without room.

    The limits of the axes must be final. Existing texts are not covered.

    Parameters
    ----------
    axes : Axes
    style : Style
    points : sequence of (x, y)
        Positions in the coordinates of the axes.
    names : sequence of str
    ring_pt : float
        Radius around each point that names avoid.
    colour : str
    bold : bool
    """
    figure = axes.figure
    scale = figure.dpi / 72
    size_pt = style.tick_pt
    taken = [text.get_window_extent() for text in axes.texts if text.get_text()]
    places = [tuple(axes.transData.transform(point)) for point in points]
    rings = [_box(x, y, 2 * ring_pt * scale, 2 * ring_pt * scale) for x, y in places]
    for number, (name, (x, y)) in enumerate(zip(names, places, strict=True)):
        width_pt, height_pt = text_width_pt(name, size_pt, style.font, bold=bold), 1.15 * size_pt
        others = rings[:number] + rings[number + 1 :]
        for reach in _REACHES:
            offset_pt = _free(x, y, reach, ring_pt, width_pt, height_pt, scale, [*taken, *others], figure.bbox)
            if offset_pt is not None:
                break
        else:
            continue
        taken.append(_box(x + offset_pt[0] * scale, y + offset_pt[1] * scale, width_pt * scale, height_pt * scale))
        axes.annotate(
            name,
            points[number],
            xytext=offset_pt,
            textcoords="offset points",
            color=colour,
            fontweight="bold" if bold else "normal",
            ha="center",
            va="center",
            path_effects=[withStroke(linewidth=2.5 * style.line_pt, foreground=style.page)],
            arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.5 * style.line_pt, "shrinkB": ring_pt}
            if reach > _NEAR
            else None,
        )


def _free(
    x: float,
    y: float,
    reach: float,
    ring_pt: float,
    width_pt: float,
    height_pt: float,
    scale: float,
    taken: Sequence[Bbox],
    page: BboxBase,
) -> tuple[float, float] | None:
    """Return an offset in points at which a label covers nothing."""
    for turn_deg in _TURNS_DEG:
        turn = math.radians(turn_deg)
        offset_pt = (
            math.cos(turn) * (reach * ring_pt + 0.5 * width_pt + 1),
            math.sin(turn) * (reach * ring_pt + 0.5 * height_pt + 1),
        )
        box = _box(x + offset_pt[0] * scale, y + offset_pt[1] * scale, width_pt * scale, height_pt * scale)
        inside = page.x0 <= box.x0 and box.x1 <= page.x1 and page.y0 <= box.y0 and box.y1 <= page.y1
        if inside and not any(box.overlaps(other) for other in taken):
            return offset_pt
    return None


def _box(x: float, y: float, width: float, height: float) -> Bbox:
    return Bbox.from_bounds(x - width / 2, y - height / 2, width, height)
