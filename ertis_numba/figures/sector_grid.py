"""Rings in metres and rays in degrees of a sector, for figures and for the live view."""

import math
from typing import Any

from matplotlib.axes import Axes
from matplotlib.text import Annotation

from ertis_numba.figures.style import Style, angle
from ertis_numba.geometry import Fan, plan_m

__all__ = ["draw_grid", "part_names"]

_APART_PX = 2.0  # Minimum distance of names.
_METRES = " m"


def draw_grid(
    axes: Axes, style: Style, fan: Fan, *, first_m: float = 0.0, largest: int = 6, spare_m: float = 0.0
) -> None:
    """Draw labelled rings, first from first_m, and rays on axes in m right and ahead, whose limits are final."""
    line: dict[str, Any] = {"color": style.faint, "alpha": 0.35, "linewidth": 0.7 * style.line_pt}
    line |= {"clip_on": False, "scalex": False, "scaley": False}
    size_pt, first_rad = style.tick_pt, float(fan.azimuth_rad[0])
    for ray_deg in fan.rays_deg():
        across, ahead = plan_m(math.radians(ray_deg), 1.0)
        axes.plot(*plan_m(math.radians(ray_deg), fan.range_m), **line)
        align = (_side(across, "right", "left"), _side(ahead, "top", "bottom"))
        place, offset_pt = (math.radians(ray_deg), fan.range_m[1]), (0.5 * size_pt * across, 0.5 * size_pt * ahead)
        _name(axes, place, angle(math.remainder(ray_deg, 360)), offset_pt, align)
    # Names of rings stand beside the first edge, outside of the sector, or under or over it where that edge runs level.
    if abs(math.degrees(math.asin(math.cos(first_rad)))) < 20:
        offset_pt, align = (0.0, math.copysign(1.4 * size_pt, math.sin(first_rad))), ("center", "center")
    else:
        offset_pt, align = (0.8 * size_pt, math.copysign(0.8 * size_pt, -math.cos(first_rad))), ("left", "center")
    for ring_m in fan.rings_m(first_m, largest=largest, spare_m=spare_m):
        if ring_m >= fan.range_m[0] - spare_m:
            axes.plot(*plan_m(fan.arc_rad, ring_m), **line)
        _name(axes, (first_rad, ring_m), f"{ring_m:g}{_METRES}", offset_pt, align)


def _side(towards: float, before: str, behind: str) -> str:
    """Return the side of a label on which it points outwards."""
    return "center" if abs(towards) < 0.3 else behind if towards > 0 else before


def _name(
    axes: Axes, place: tuple[float, float], text: str, offset_pt: tuple[float, float], align: tuple[str, str]
) -> None:
    options: dict[str, Any] = {"textcoords": "offset points", "annotation_clip": False}
    axes.annotate(text, tuple(plan_m(*place)), xytext=offset_pt, ha=align[0], va=align[1], **options)


def part_names(axes: Axes) -> None:
    """Move names of rings into the figure; remove those that overlap; the position of the axes must be final."""
    right_px, px_per_pt = axes.figure.bbox.x1, axes.figure.dpi / 72
    rings = [text for text in axes.texts if isinstance(text, Annotation) and text.get_text().endswith(_METRES)]
    kept = [text.get_window_extent() for text in axes.texts if text not in rings]
    for name in reversed(rings):
        beyond_px = max(0.0, name.get_window_extent().x1 - right_px)
        x_pt, y_pt = name.xyann
        name.xyann = (x_pt - beyond_px / px_per_pt, y_pt)
        box = name.get_window_extent().padded(_APART_PX)
        if any(box.overlaps(other) for other in kept):
            name.remove()
        else:
            kept.append(box)
