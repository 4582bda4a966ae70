"""Pictures of energyscapes, and of what exactness costs. The only door to Matplotlib.

They are drawn without pyplot, so that no global state and no window system is needed. As x is
forward, y left and z up in the sensor frame, positive azimuth is on the left: a sector is seen from
above, a map out of the sensor's eyes.
"""

from collections.abc import Sequence
from typing import Literal

from matplotlib.figure import Figure

from ertis_numba import checks
from ertis_numba.figures import _curve, _front, _sector, _sphere
from ertis_numba.figures._canvas import THEMES, Canvas
from ertis_numba.figures._front import Rated
from ertis_numba.frames import Energyscape, Peak

__all__ = ["Rated", "front", "plot"]


def front(points: Sequence[Rated], *, title: str, note: str = "", theme: Literal["dark", "light"] = "dark") -> Figure:
    """Draw error and time of plans; those that no other one beats are joined by a line.

    Parameters
    ----------
    points : sequence of Rated
    title, note : str
        Heading, and the line below it.
    theme : {"dark", "light"}

    Returns
    -------
    matplotlib.figure.Figure

    Raises
    ------
    ArgumentError
        The theme is unknown.
    """
    checks.choice("theme", theme, THEMES)
    return _front.draw(Canvas(THEMES[theme], 1.0, ()), points, title=title, note=note)


def plot(
    image: Energyscape,
    *,
    dynamic_range_db: float = 40.0,
    theme: Literal["dark", "light"] = "dark",
    peaks: Sequence[Peak] | None = None,
) -> Figure:
    """Draw an energyscape.

    A planar image becomes a sector in metres. An image with elevations becomes two: the maximum over
    range as a map of azimuth and elevation, and the maximum over elevation as a sector. An image of
    one direction becomes a curve over range.

    Parameters
    ----------
    image : Energyscape
    dynamic_range_db : float
        What lies further below the strongest has the colour of silence.
    theme : {"dark", "light"}
    peaks : sequence of Peak, optional
        Reflectors to mark and list, as `find_peaks` returns them.

    Returns
    -------
    matplotlib.figure.Figure
        Save it with ``savefig("image.png")``, or as .svg or .pdf.

    Raises
    ------
    ArgumentError
        The dynamic range is not positive, or the theme is unknown.
    """
    checks.positive("dynamic_range_db", dynamic_range_db)
    checks.choice("theme", theme, THEMES)
    canvas = Canvas(THEMES[theme], dynamic_range_db, tuple(peaks or ()))
    if len(image.azimuth_rad) == 1:
        return _curve.draw(canvas, image)
    if image.is_planar:
        return _sector.draw(canvas, image)
    return _sphere.draw(canvas, image)
