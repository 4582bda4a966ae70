"""Figures of energyscapes, signals and arrays, and of accuracy versus processing time.

Figures do not use pyplot, so they need no window system. As x is forward, y left and z up in the sensor frame
(REP-103), positive azimuth is on the left: a sector is seen from above, a map and an array from the sensor. Functions
return a figure, or the axes given as ``ax``; `save` writes a figure to a file. Only the live view also uses Matplotlib.
"""

from collections.abc import Mapping, Sequence
from typing import Unpack, overload

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ertis_numba.analysis.side_lobes import without_side_lobes
from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.calibration import Calibration
from ertis_numba.figures import (
    _array,
    _calibration,
    _captions,
    _images,
    _map,
    _points,
    _slices,
)
from ertis_numba.figures._canvas import Canvas, canvas_of
from ertis_numba.figures._page import compose, save
from ertis_numba.figures._pareto_front import Rated, front
from ertis_numba.figures._sound_figures import acoustic_map, matched_filter, signals, spectrogram, spectrum
from ertis_numba.figures.style import StyleOptions, style_of
from ertis_numba.frames import Energyscape, OccupancyMap, Peak, PointCloud, Trajectory
from ertis_numba.geometry import observable_angles
from ertis_numba.settings import Array, Settings

__all__ = [
    "Rated",
    "StyleOptions",
    "acoustic_map",
    "array",
    "calibration",
    "front",
    "matched_filter",
    "occupancy",
    "plot",
    "points",
    "polar",
    "projection",
    "save",
    "signals",
    "slices",
    "spectrogram",
    "spectrum",
]


@overload
def plot(
    image: Energyscape,
    *,
    ax: None = None,
    dynamic_range_db: float = 40.0,
    peaks: Sequence[Peak] | None = None,
    side_lobes: bool = False,
    **look: Unpack[StyleOptions],
) -> Figure: ...
@overload
def plot(
    image: Energyscape,
    *,
    ax: Axes,
    dynamic_range_db: float = 40.0,
    peaks: Sequence[Peak] | None = None,
    side_lobes: bool = False,
    **look: Unpack[StyleOptions],
) -> Axes: ...
def plot(
    image: Energyscape,
    *,
    ax: Axes | None = None,
    dynamic_range_db: float = 40.0,
    peaks: Sequence[Peak] | None = None,
    side_lobes: bool = False,
    **look: Unpack[StyleOptions],
) -> Figure | Axes:
    """Draw an energyscape on a page with a heading, a colour bar and a list of reflectors, or into given axes.

    A planar image becomes a sector in metres. An image of one direction, or of an array that observes no directions,
    becomes a curve over range. An image with
    elevations becomes a map of azimuth and elevation, which shows the maximum over range. A page also shows its
    maximum over elevation as a sector.

    Parameters
    ----------
    image : Energyscape
    ax : matplotlib.axes.Axes, optional
        Rectilinear axes to draw into. Their position and size stay as they are; the limits, the aspect ratio and, for a
        sector, the frame change. The raster is ``ax.images[-1]``, from which ``figure.colorbar`` makes a colour bar.
    dynamic_range_db : float, default 40
        Level below the strongest point at which the colour scale ends, in dB.
    peaks : sequence of Peak, optional
        Reflectors to mark, as `find_peaks` returns them; a page lists them, too.
    side_lobes : bool, default False
        Show the side lobes of an image with elevations, too. By default, points that lie
        `ertis_numba.analysis.side_lobes.SIDE_LOBE_DB` below the strongest of about the same range are left out: a
        maximum over directions would otherwise show an arc at the range of each echo.
    **look
        ``theme``, ``columns`` and ``font``: see `StyleOptions`. The theme is ``light`` for given axes and ``dark``
        otherwise.

    Returns
    -------
    matplotlib.axes.Axes or matplotlib.figure.Figure
        ``ax`` if it is given, otherwise the page. Save it with `save`, or with ``savefig("image.png")``.

    Raises
    ------
    ArgumentError
        An argument has another type or value than listed above.

    Examples
    --------
    >>> import matplotlib.pyplot as plt
    >>> import ertis_numba as ertis
    >>> with ertis.open_recording("reflectors.h5") as recording:
    ...     image = ertis.Pipeline(recording.settings).process(recording[0])
    >>> ertis.plot(image, peaks=ertis.find_peaks(image, top=5)).savefig("image.png")
    >>> figure, axes = plt.subplots(1, 2)
    >>> ertis.plot(image, ax=axes[0]) is axes[0]
    True
    >>> bar = figure.colorbar(axes[0].images[-1], ax=axes[0], label="dB")
    """
    if ax is not None and (not isinstance(ax, Axes) or ax.name != "rectilinear"):
        name = f"{ax.name} axes" if isinstance(ax, Axes) else f"of type {type(ax).__name__}"
        raise ArgumentError(f"ax is {name}; pass rectilinear Axes, such as matplotlib.pyplot.subplots returns")
    if ax is not None:
        look = {"theme": "light", **look}
    canvas = _canvas_of(image, dynamic_range_db, look, peaks)
    if len(image.azimuth_rad) == 1 or not _has_direction(image):
        panels = [_images.curve(canvas, image)]
    elif image.is_planar:
        panels = [_images.sector(canvas, image)]
    else:
        shown, hidden = _seen(image, side_lobes=side_lobes)
        panels = [draw(canvas, shown, hidden=hidden) for draw in (_images.direction_map, _images.sector)]
    if ax is None:
        return compose(canvas, _captions.of_image(image), panels, width_pt=720.0 if len(panels) == 1 else 1008.0)
    panels[0].draw_on(ax, canvas.style)
    return ax


def polar(
    image: Energyscape,
    *,
    dynamic_range_db: float = 40.0,
    peaks: Sequence[Peak] | None = None,
    side_lobes: bool = False,
    **look: Unpack[StyleOptions],
) -> Figure:
    """Draw an energyscape as a sector in metres, with the maximum over elevation.

    Arguments are those of `plot`.
    """
    canvas = _canvas_with_directions(image, dynamic_range_db, look, peaks)
    shown, hidden = _seen(image, side_lobes=side_lobes)
    return compose(canvas, _captions.of_image(image), [_images.sector(canvas, shown, hidden=hidden)])


def projection(
    image: Energyscape,
    *,
    dynamic_range_db: float = 40.0,
    peaks: Sequence[Peak] | None = None,
    side_lobes: bool = False,
    **look: Unpack[StyleOptions],
) -> Figure:
    """Draw the maximum over range as a map of azimuth and elevation; arguments are those of `plot`."""
    canvas = _canvas_with_directions(image, dynamic_range_db, look, peaks)
    shown, hidden = _seen(image, side_lobes=side_lobes)
    return compose(canvas, _captions.of_image(image), [_images.direction_map(canvas, shown, hidden=hidden)])


def slices(
    image: Energyscape,
    *,
    height_m: float = 0.0,
    left_m: float | None = None,
    dynamic_range_db: float = 40.0,
    peaks: Sequence[Peak] | None = None,
    **look: Unpack[StyleOptions],
) -> Figure:
    """Draw a horizontal and a vertical section through an energyscape in metres.

    The vertical section runs forward. A planar image has a horizontal section only. Reflectors are marked in the
    sections in which they lie.

    Parameters
    ----------
    image : Energyscape
    height_m : float
        Position z of the horizontal section in metres.
    left_m : float, optional
        Position y of the vertical section in metres; 0 by default.
    dynamic_range_db, peaks, **look
        Range of the colours in dB, marked reflectors and the style, as for `plot`.

    Raises
    ------
    ArgumentError
        An argument is invalid, a section lies outside of the image, or a planar image has no vertical section.
    """
    checks.finite("height_m", height_m)
    if left_m is not None:
        checks.finite("left_m", left_m)
    return _slices.draw(
        _canvas_with_directions(image, dynamic_range_db, look, peaks), image, height_m=height_m, left_m=left_m
    )


def points(cloud: PointCloud, *, dynamic_range_db: float = 40.0, **look: Unpack[StyleOptions]) -> Figure:
    """Draw points from above in metres, in colours of their levels.

    Parameters
    ----------
    cloud : PointCloud
        Points to draw, at least one. Those that a fusion has not confirmed are rings.
    dynamic_range_db, **look
        Range of the colours in dB and the style, as for `plot`.

    Raises
    ------
    ArgumentError
        An argument is invalid, or there is no point.
    """
    checks.instance("cloud", cloud, PointCloud, "PointExtractor returns")
    if not len(cloud):
        raise ArgumentError("cloud contains no points; pass a cloud with one or more")
    checks.finite_array("position_m", cloud.position_m)
    return _points.draw(canvas_of(dynamic_range_db, look), cloud)


def array(
    settings: Settings | str,
    *,
    frequencies_hz: Sequence[float] | None = None,
    azimuth_deg: float = 0.0,
    elevation_deg: float = 0.0,
    dynamic_range_db: float = 40.0,
    **look: Unpack[StyleOptions],
) -> Figure:
    """Draw the layout of an array, and its beam pattern along azimuth and along elevation.

    Parameters
    ----------
    settings : Settings or str
        Settings with an array, call and air, or the name of a layout for the default call and air.
    frequencies_hz : sequence of float, optional
        One to five frequencies in hertz; by default the limits of the call's band, and the mean power over the band.
    azimuth_deg, elevation_deg : float
        Steering direction in degrees, -90 to 90.
    dynamic_range_db, **look
        Range of the colours in dB and the style, as for `plot`.
    """
    checks.positive("dynamic_range_db", dynamic_range_db)
    if isinstance(settings, str):
        settings = Settings(array=Array(layout=settings))
    checks.instance("settings", settings, Settings, "Settings.load reads, or the name of a layout")
    return _array.draw(
        Canvas(style_of(**look), dynamic_range_db),
        settings,
        frequencies_hz=frequencies_hz,
        azimuth_deg=checks.between("azimuth_deg", azimuth_deg, -90.0, 90.0),
        elevation_deg=checks.between("elevation_deg", elevation_deg, -90.0, 90.0),
    )


def calibration(
    made: Calibration,
    settings: Settings,
    *,
    azimuth_deg: float = 0.0,
    elevation_deg: float = 0.0,
    dynamic_range_db: float = 40.0,
    **look: Unpack[StyleOptions],
) -> Figure:
    """Draw the residuals of a calibration, and the beam pattern along azimuth, before and after.

    Patterns show plane waves that the calibrated array receives, with beams of the former and of the new layout.
    Steering directions are -90 to 90 degrees; ``settings`` are those of the recordings, for the call and the air.
    ``dynamic_range_db``, ``**look``: range of the colours in dB and the style, as for `plot`.
    """
    checks.positive("dynamic_range_db", dynamic_range_db)
    checks.instance("made", made, Calibration, "calibrate returns")
    checks.instance("settings", settings, Settings, "a measurement contains")
    return _calibration.draw(
        Canvas(style_of(**look), dynamic_range_db),
        made,
        settings,
        azimuth_deg=checks.between("azimuth_deg", azimuth_deg, -90.0, 90.0),
        elevation_deg=checks.between("elevation_deg", elevation_deg, -90.0, 90.0),
    )


def occupancy(
    found: OccupancyMap,
    *,
    trajectory: Trajectory | None = None,
    mountings: Mapping[str, _map.Mounting] | None = None,
    **look: Unpack[StyleOptions],
) -> Figure:
    """Draw an occupancy map from above: white for free, grey for unknown, and black for occupied cells.

    A map of three dimensions is also drawn from the side. Each view shows the most certain occupied cell along each
    line of sight, so leave out floor and ceiling with ``height_m`` of `Mapper`.

    Parameters
    ----------
    found : OccupancyMap
    trajectory : Trajectory, optional
        Path of the platform in the frame of the map, drawn as a line with an arrow at the last pose.
    mountings : mapping of str to (translation_m, rotation_xyzw), optional
        Sensors on the platform, drawn as dots at the last pose.
    **look
        Style of the figure, as for `plot`.
    """
    checks.instance("found", found, OccupancyMap, "Mapper.map returns")
    if trajectory is not None:
        checks.instance("trajectory", trajectory, Trajectory, "read_trajectory returns")
    return _map.draw(style_of(**look), found, trajectory, mountings or {})


def _seen(image: Energyscape, *, side_lobes: bool) -> tuple[Energyscape, bool]:
    """Return the image to draw, and whether its side lobes are hidden."""
    hidden = not (image.is_planar or side_lobes)
    return (without_side_lobes(image) if hidden else image), hidden


def _has_direction(image: Energyscape) -> bool:
    return observable_angles(image.settings.array).has_direction(is_planar=image.is_planar)


def _canvas_with_directions(
    image: Energyscape, dynamic_range_db: float, look: StyleOptions, peaks: Sequence[Peak] | None
) -> Canvas:
    """Return the canvas of a picture over directions; refuse images without directions."""
    canvas = _canvas_of(image, dynamic_range_db, look, peaks)
    if not _has_direction(image):
        note = observable_angles(image.settings.array).note
        raise ArgumentError(
            f"the array of sensor {image.stamp.sensor} {note}; draw a curve over range with ertis.plot ('ertis plot "
            "--kind image')"
        )
    return canvas


def _canvas_of(image: Energyscape, dynamic_range_db: float, look: StyleOptions, peaks: Sequence[Peak] | None) -> Canvas:
    checks.instance("image", image, Energyscape, "Pipeline.process returns")
    return canvas_of(dynamic_range_db, look, peaks)
