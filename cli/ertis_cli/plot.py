"""``ertis plot``: plots of a measurement, of its image, or of an array."""

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

import click

from ertis_cli import _acoustic_plots, _mountings, options
from ertis_cli._config import typed
from ertis_numba.base.constants import FALSE_ALARM

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from matplotlib.figure import Figure

    from ertis_numba.calibration import Calibration
    from ertis_numba.frames import Energyscape, Measurement, OccupancyMap
    from ertis_numba.settings import Settings

__all__ = ["plot"]

_FORMATS = (".pdf", ".png", ".svg")
_KINDS = {
    "image": "a sector, a map and a sector, or a curve, depending on the directions",
    "polar": "a sector in metres",
    "projection": "azimuth versus elevation, the maximum over range",
    "slices": "a horizontal and a vertical section in metres",
    "signals": "microphone signals and their spectrogram",
    "matched-filter": "output of the matched filter for each microphone",
    "array": "array layout and beam pattern",
    "map": "an occupancy map from above, chosen for its file",
    **_acoustic_plots.KINDS,
    "calibration": "residuals and beam pattern before and after a calibration with all measurements of a reflector",
}
_OF_IMAGES = ("image", "polar", "projection", "slices")
_OF_RECORDINGS = ("signals", "matched-filter")
_OF_SOUND = tuple(_acoustic_plots.KINDS)
_ONLY = {
    "sensor": (*_OF_IMAGES, *_OF_RECORDINGS, *_OF_SOUND, "array", "calibration"),
    "measurement": (*_OF_IMAGES, *_OF_RECORDINGS, *_OF_SOUND),
    "peaks": _OF_IMAGES,
    "side-lobes": ("image", "polar", "projection"),
    "height": ("slices",),
    "left": ("slices",),
    "microphone": _OF_RECORDINGS,
    "frequency": ("array",),
    "steer": ("array", "calibration", "spectrum", "spectrogram"),
    "band": ("acoustic_map",),
    "photo": ("acoustic_map",),
    "photo-fov": ("acoustic_map",),
    "poses": ("map",),
    "mounting": ("map",),
    "dynamic-range": tuple(kind for kind in _KINDS if kind != "map"),
}
"""Kinds that support each of these options."""


@click.command(epilog="Kinds: " + "; ".join(f"{name}: {about}" for name, about in _KINDS.items()) + ".")
@options.input_file("IMG.h5|REC.h5|MAPS.h5|SETTINGS.toml|LAYOUT")
@click.option(
    "--kind",
    type=click.Choice(list(_KINDS)),
    default="image",
    show_default=True,
    help="Kind of plot; array also accepts settings, a layout file or the name of a layout.",
)
@options.output("Picture to write: .png, .svg or .pdf; a .png beside the file by default.")
@options.sensor("Sensor to plot; required if the file contains several sensors.")
@options.measurement("Measurement, or map of a file of acoustic maps, to plot, counted from 0; the first by default.")
@click.option(
    "--dynamic-range",
    type=click.FloatRange(max=1000.0),
    metavar="DB",
    help="Dynamic range of the colour scale, in dB below the maximum; 40 by default, and 20 for acoustic maps.",
)
@click.option(
    "--theme",
    type=click.Choice(["dark", "light", "paper"]),
    default="dark",
    show_default=True,
    help="Colour theme; paper is white, with font sizes for print.",
)
@click.option(
    "--columns", type=click.IntRange(1, 2), help="Width of theme paper: 1 is 85 mm, 2 is 170 mm; 2 by default."
)
@click.option("--font", type=click.Choice(["sans", "serif"]), default="sans", show_default=True, help="Font family.")
@click.option(
    "--peaks", "top", type=click.IntRange(min=0), metavar="N", help="Number of reflectors to mark; 5 by default."
)
@click.option(
    "--side-lobes",
    is_flag=True,
    default=None,
    help="Show side lobes in images with elevations: levels 10 dB or more below the strongest at their range.",
)
@click.option("--height", type=float, metavar="M", help="Height of the horizontal section of slices; 0 by default.")
@click.option(
    "--left", type=float, metavar="M", help="Position of the vertical section of slices, to the left; 0 by default."
)
@click.option(
    "--microphone", type=int, metavar="CHANNEL", help="Plot only this microphone, for signals and matched-filter."
)
@click.option(
    "--frequency",
    "frequencies",
    type=click.FloatRange(max=1e9),
    multiple=True,
    metavar="HZ",
    help="Frequency of a beam pattern; repeatable up to five times.",
)
@click.option(
    "--steer",
    type=options.DIRECTION,
    metavar="AZ:EL",
    help="Direction of beam patterns, of a spectrum or of a spectrogram in degrees.",
)
@_acoustic_plots.plot_options
@click.option(
    "--poses", type=options.FILE, metavar="TRAJ", help="Trajectory of the platform, to draw its path into a map."
)
@click.option(
    "--mounting", type=options.FILE, metavar="FILE", help="Mountings of the sensors, to draw them at the last pose."
)
@options.force
@options.quiet
@options.as_json
def plot(
    *,
    path: Path,
    kind: str,
    target: Path | None,
    sensor: str | None,
    measurement: int | None,
    dynamic_range: float | None,
    theme: Literal["dark", "light", "paper"],
    columns: Literal[1, 2] | None,
    font: Literal["sans", "serif"],
    top: int | None,
    side_lobes: bool | None,
    height: float | None,
    left: float | None,
    microphone: int | None,
    frequencies: tuple[float, ...],
    steer: tuple[float, float] | None,
    band_hz: tuple[float, float] | None,
    photo: Path | None,
    photo_fov_deg: tuple[float, float] | None,
    poses: Path | None,
    mounting: Path | None,
    force: bool,
    quiet: bool,
    as_json: bool,
) -> None:
    """Plot a measurement or an array.

    To plot an image of a recording, the recording is first processed with its own settings.
    """
    from ertis_numba import figures
    from ertis_numba.base import checks
    from ertis_numba.base.errors import DataError
    from ertis_numba.storage import atomic_write, check_target

    given: dict[str, Any] = {
        "sensor": sensor,
        "measurement": measurement,
        "peaks": top,
        "side-lobes": side_lobes,
        "height": height,
        "left": left,
        "microphone": microphone,
        "frequency": frequencies or None,
        "steer": steer,
        "band": band_hz,
        "photo": photo,
        "photo-fov": photo_fov_deg,
        "poses": poses,
        "mounting": mounting,
        "dynamic-range": dynamic_range,
    }
    if not typed("kind"):
        kind = _default_kind(path, sensor, measurement or 0, kind)
    _require_supported(kind, path, given)
    if kind != "array":
        _require_no_array(path)
    if not path.name:  # "." and "/" give no name for the picture
        raise DataError(f"{path} is a folder; choose a recording, an energyscape file or a file of acoustic maps")
    target = target or path.with_suffix(".png")
    checks.file_ending("picture", target, _FORMATS)
    check_target(target, overwrite=force)
    look: dict[str, Any] = {
        **({} if dynamic_range is None else {"dynamic_range_db": dynamic_range}),
        "theme": theme,
        "columns": columns,
        "font": font,
    }
    made = _plot_of_file(kind, path, given, look, quiet=quiet)
    with atomic_write(target, overwrite=force) as part:
        figures.save(made.figure, part, format=target.suffix.lower().lstrip("."))
    options.say(f"{target}: {made.content}", quiet=quiet)
    if as_json:
        options.print_json({"output": str(target), "kind": kind, **made.entries})


class _Plot(NamedTuple):
    """Figure, the text that names its content, and entries of the JSON report."""

    figure: "Figure"
    content: str
    entries: dict[str, object]


def _plot_of_file(kind: str, path: Path, given: "Mapping[str, Any]", look: dict[str, Any], *, quiet: bool) -> _Plot:
    """Draw a plot of any kind with the given options."""
    from ertis_numba import figures
    from ertis_numba.storage import read_map

    azimuth_deg, elevation_deg = given["steer"] or (0.0, 0.0)
    towards: dict[str, Any] = {"azimuth_deg": azimuth_deg, "elevation_deg": elevation_deg}
    if kind == "array":
        settings = _settings(path, given["sensor"])
        figure = figures.array(settings, frequencies_hz=given["frequency"], **towards, **look)
        return _Plot(figure, f"array of {path}", {})
    if kind == "calibration":
        made, settings = _calibrated(path, given["sensor"])
        return _Plot(figures.calibration(made, settings, **towards, **look), f"calibration with {path}", {})
    if kind == "map":
        return _Plot(_map(read_map(path), given["poses"], given["mounting"], look), f"map of {path}", {})
    return _plot_of_measurement(kind, path, given, look, quiet=quiet)


def _plot_of_measurement(
    kind: str, path: Path, given: "Mapping[str, Any]", look: dict[str, Any], *, quiet: bool
) -> _Plot:
    """Draw the signals, the sound or the image of one measurement."""
    from ertis_numba import figures

    sensor, row, index = given["sensor"], _acoustic_plots.row_name(path), given["measurement"] or 0
    if kind in _OF_RECORDINGS:
        heard = _measurement(path, sensor, index)
        draw = figures.signals if kind == "signals" else figures.matched_filter
        figure, name = draw(heard, microphone=given["microphone"], **look), heard.stamp.sensor
    elif kind in _OF_SOUND:
        chosen = {"steer": given["steer"], "band_hz": given["band"]}
        chosen |= {"photo": given["photo"], "photo_fov_deg": given["photo-fov"]}
        figure, name = _acoustic_plots.draw(kind, path, sensor, index, **chosen, quiet=quiet, look=look)
    else:
        image = _image(path, sensor, index, quiet=quiet)
        places = {"height_m": given["height"], "left_m": given["left"], "side_lobes": given["side-lobes"]}
        look = look | {name: value for name, value in places.items() if value is not None}
        top = 5 if given["peaks"] is None else given["peaks"]
        figure, name = _drawn(kind, image, top, look, quiet=quiet), image.stamp.sensor
    return _Plot(figure, f"{row} {index} of {path}", {"sensor": name, row: index})


def _default_kind(path: Path, sensor: str | None, index: int, kind: str) -> str:
    """Return the kind of plot that suits a file, if none is typed."""
    from ertis_numba.storage import is_map

    if kind == "image" and is_map(path):
        return "map"
    return "acoustic_map" if kind == "image" and _acoustic_plots.is_acoustic(path, sensor, index) else kind


def _require_supported(kind: str, path: Path, given: "Mapping[str, object]") -> None:
    """Raise an error for a file or a given option that a kind of plot does not support."""
    for name, value in given.items():
        if value is not None and kind not in _ONLY[name]:
            raise click.UsageError(
                f"--{name} is for --kind {', '.join(_ONLY[name])}; remove it with {kind}",
                click.get_current_context(),
            )
    _acoustic_plots.require_fitting(kind, path)


def _map(found: "OccupancyMap", poses: Path | None, mounting: Path | None, look: dict[str, Any]) -> "Figure":
    """Draw a map, with the path of the platform and its sensors if they are given."""
    from ertis_numba import figures
    from ertis_numba.interop.trajectory_files import read_trajectory

    if mounting is not None and poses is None:
        raise click.UsageError("--mounting requires --poses; add --poses TRAJ", click.get_current_context())
    trajectory = None if poses is None else read_trajectory(poses)
    return figures.occupancy(found, trajectory=trajectory, mountings=_mountings.mountings(mounting, None), **look)


def _calibrated(path: Path, sensor: str | None) -> "tuple[Calibration, Settings]":
    from ertis_numba.calibration import calibrate
    from ertis_numba.storage import open_recording

    with open_recording(path, sensor=sensor) as recording:
        return calibrate(recording), recording.settings


def _drawn(kind: str, image: "Energyscape", top: int, look: dict[str, Any], *, quiet: bool) -> "Figure":
    """Draw an image with rings around its strongest reflectors, if ``top`` is above 0."""
    from ertis_numba import figures
    from ertis_numba.analysis.detect import find_peaks
    from ertis_numba.analysis.peak_notes import list_notes

    peaks = find_peaks(image, top=top) if top else None
    for note in list_notes([(image, peaks)], false_alarm=FALSE_ALARM) if peaks is not None else ():
        options.note_of(image.stamp.sensor, note, quiet=quiet)
    draw: dict[str, Callable[..., Figure]]
    draw = {"image": figures.plot, "polar": figures.polar, "projection": figures.projection, "slices": figures.slices}
    return draw[kind](image, peaks=peaks, **look)


def _image(path: Path, sensor: str | None, index: int, *, quiet: bool) -> "Energyscape":
    """Return an image, and warn if its directions are too far apart."""
    from ertis_numba.storage import file_kind, open_energyscapes

    if file_kind(path) == "energyscape":
        with open_energyscapes(path, sensor=sensor) as images:
            image = images[options.place(index, len(images))]
            options.note_missing_points(images, quiet=quiet)
    else:
        measurement = _measurement(path, sensor, index)
        image = options.pipeline(measurement.settings, quiet=quiet).process(measurement)
    options.warn_of_spacing(image.stamp.sensor, image.settings, image)
    return image


def _measurement(path: Path, sensor: str | None, index: int) -> "Measurement":
    from ertis_numba.storage import open_recording

    with open_recording(path, sensor=sensor) as recording:
        return recording[options.place(index, len(recording))]


def _require_no_array(path: Path) -> None:
    """Raise an error for input that only ``--kind array`` supports."""
    from ertis_numba.geometry import layout_names
    from ertis_numba.settings import LAYOUT_SUFFIXES

    if path.suffix.lower() in LAYOUT_SUFFIXES or (str(path) in layout_names() and not path.exists()):
        raise click.UsageError(
            f"{path} contains no measurement; use --kind array, or a recording, an energyscape file or a file of "
            "acoustic maps",
            click.get_current_context(),
        )


def _settings(path: Path, sensor: str | None) -> "Settings":
    """Return the settings of a file, or default settings with the array of a layout."""
    from ertis_numba.geometry import layout_names
    from ertis_numba.settings import LAYOUT_SUFFIXES, Array, Settings
    from ertis_numba.storage import file_kind, open_energyscapes, open_recording

    suffix = path.suffix.lower()
    is_name = str(path) in layout_names() or not (suffix or path.exists())  # a layout, possibly misspelt
    is_layout = is_name or (suffix in LAYOUT_SUFFIXES and (suffix != ".toml" or _is_layout(path)))
    if sensor is not None and (is_layout or suffix == ".toml"):
        raise click.UsageError(
            "--sensor chooses a sensor in a file; remove it, because settings and layouts have no sensors",
            click.get_current_context(),
        )
    if is_layout:
        settings = Settings(array=Array(layout=str(path)))
        options.note_layout(settings.array)
        return settings
    if suffix == ".toml":
        return Settings.load(path)
    opened = open_energyscapes if file_kind(path) == "energyscape" else open_recording
    with opened(path, sensor=sensor) as reader:
        return reader.settings


def _is_layout(path: Path) -> bool:
    """Return True if a TOML file is a layout, with positions at its top level, and not settings."""
    try:
        return bool(re.search(r"^\s*positions(_\w+)?\s*=", path.read_text("utf-8"), re.MULTILINE))
    except (OSError, UnicodeDecodeError):
        return False  # reading it as settings reports the error
