"""HTML of objects: axes with units, list of reflectors or sources, notes and picture."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import singledispatch
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ertis_numba.analysis.detect import find_peaks
from ertis_numba.analysis.direction_spacing import spacing_warning
from ertis_numba.analysis.peak_notes import list_notes, unconfirmed_note
from ertis_numba.base.constants import FALSE_ALARM
from ertis_numba.base.errors import ErtisError
from ertis_numba.base.html_parts import escaped, table
from ertis_numba.base.units import counted
from ertis_numba.frames import AcousticMap, Bearing, Energyscape, Peak, PointCloud, Stamp, doubt_notes
from ertis_numba.geometry import HEIGHT_NOTE, direction_grid, direction_note, observable_angles
from ertis_numba.notebook.page import Axis, page
from ertis_numba.settings import Settings
from ertis_numba.storage import RecordingReader

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["html_of"]

_TOP: Final = 10
_MAX_TOML: Final = 20_000  # characters; positions of a large array have more
_UNKNOWN: Final = "–"
_NUMBER: Final = "number"
_TWO_DIGITS: Final = "two digits"


@singledispatch
def html_of(shown: Any) -> str:
    """Return an object as HTML: a picture, axes with units, and its strongest reflectors or sources."""
    # Raises TypeError unless it is an Energyscape, PointCloud, AcousticMap, RecordingReader or Settings.
    raise TypeError(f"{type(shown).__name__} has no view; pass an image, points, a map, a recording or settings")


@html_of.register
def _(image: Energyscape) -> str:
    found: list[Peak] = []
    listed, problems = ("", f"Reflectors are unknown: {_flaw(image.amplitude)}"), list[str]()
    if not _flaw(image.amplitude):
        found = find_peaks(image, top=_TOP, false_alarm=FALSE_ALARM)
        listed = _peak_rows(found), "no echo above the noise"
        problems += filter(None, _notes_of_image(image, found))
    axes = [
        Axis("amplitude", "direction, range", image.amplitude, "", "1 is a full-scale echo in every microphone"),
        Axis("azimuth", "direction", image.azimuth_deg, "°", "from x forward towards y left"),
        Axis("elevation", "direction", image.elevation_deg, "°", "from the horizontal plane towards z up"),
        Axis("range", "range", image.range_m, "m", "half of the sound's path"),
    ]

    def draw(figures: Any) -> Any:
        return None if _flaw(image.amplitude) else figures.plot(image, peaks=found)

    title = _title("Energyscape", image.stamp, "measurement" if image.points is None else "pulse")
    return page(title, axes, listed, problems, draw)


def _notes_of_image(image: Energyscape, found: Sequence[Peak]) -> Iterator[str | None]:
    """Yield the notes of ``ertis peaks`` on an image."""
    array = image.settings.array
    if image.points is not None:
        seen = observable_angles(array)
        yield _of_sensor(image.stamp, seen.note)
        yield HEIGHT_NOTE if image.is_planar and seen.elevation else None
    else:
        yield _of_sensor(image.stamp, direction_note(array, image))
        yield spacing_warning(image.settings, image)
    yield from list_notes([(image, found)], false_alarm=FALSE_ALARM)


def _peak_rows(found: Sequence[Peak]) -> str:
    """Return a table of reflectors, with the standard deviations that are known."""
    columns: dict[str, tuple[str, Callable[[Peak], float]]] = {
        "azimuth (°)": ("+.2f", lambda peak: peak.azimuth_deg),
        "elevation (°)": ("+.2f", lambda peak: peak.elevation_deg),
        "range (m)": (".3f", lambda peak: peak.range_m),
        "level (dB)": (".1f", lambda peak: peak.level_db),
        "level (dBFS)": (".1f", lambda peak: peak.level_dbfs),
    }
    if any(peak.grid_error_deg for peak in found):
        columns["grid error (°)"] = (".2f", lambda peak: peak.grid_error_deg)
    if any(math.isfinite(peak.range_sd_m) for peak in found):
        columns |= {
            "σ angle (°)": (_TWO_DIGITS, lambda peak: peak.angle_sd_deg),
            "σ range (mm)": (_TWO_DIGITS, lambda peak: 1e3 * peak.range_sd_m),
            "σ level (dB)": (_TWO_DIGITS, lambda peak: peak.level_sd_db),
        }
    return _rows(columns, found)


@html_of.register
def _(cloud: PointCloud) -> str:
    found = cloud.strongest(_TOP, -1000.0)
    level_dbfs = 20 * np.log10(np.maximum(found.amplitude, np.finfo(np.float32).tiny))
    columns: dict[str, tuple[str, NDArray[Any]]] = {
        "x (m)": ("+.3f", found.position_m[:, 0]),
        "y (m)": ("+.3f", found.position_m[:, 1]),
        "z (m)": ("+.3f", found.position_m[:, 2]),
        "azimuth (°)": ("+.2f", found.azimuth_deg),
        "elevation (°)": ("+.2f", found.elevation_deg),
        "range (m)": (".3f", found.range_m),
        "level (dBFS)": (".1f", level_dbfs),
    }
    if found.uncertainty_m is not None:
        columns |= {
            "σ range (mm)": (_TWO_DIGITS, 1e3 * found.uncertainty_m[:, 0]),
            "σ across (mm)": (_TWO_DIGITS, 1e3 * found.uncertainty_m[:, 1]),
        }
    rows = _rows({name: (form, values.__getitem__) for name, (form, values) in columns.items()}, range(len(found)))
    problems = list(filter(None, _notes_of_points(cloud)))
    flaw = _flaw(cloud.position_m) or _flaw(cloud.amplitude)
    listed = ("", f"Points are unknown: {flaw}") if flaw and len(cloud) else (rows, "no point")
    axes = [
        Axis("position", "point, axis", cloud.position_m, "m", "x forward, y left, z up, in the sensor frame"),
        Axis("amplitude", "point", cloud.amplitude, "", "1 is a full-scale echo in every microphone"),
    ]

    def draw(figures: Any) -> Any:
        return None if flaw else figures.points(cloud)

    return page(_title("Points", cloud.stamp), axes, listed, problems, draw)


def _notes_of_points(cloud: PointCloud) -> Iterator[str | None]:
    if cloud.confirmed is not None:
        yield _of_sensor(cloud.stamp, observable_angles(cloud.settings.array).note)
        yield unconfirmed_note(int((~cloud.is_certain).sum()))
        return
    try:
        grid = direction_grid(cloud.settings.processing)
    except ErtisError:  # The file of the directions is not here.
        yield _of_sensor(cloud.stamp, observable_angles(cloud.settings.array).note)
    else:
        yield _of_sensor(cloud.stamp, direction_note(cloud.settings.array, grid))
    if cloud.uncertainty_m is None:
        yield "standard deviations are unknown; ertis.PointExtractor computes them from the image"


@html_of.register
def _(found: AcousticMap) -> str:
    level = "mean square; a full-scale tone has ½" if found.has_level else "number of the method, without a level"
    axes = [
        Axis("power", "direction, band", found.power, "", level),
        Axis("azimuth", "direction", found.azimuth_deg, "°", "from x forward towards y left"),
        Axis("elevation", "direction", found.elevation_deg, "°", "from the horizontal plane towards z up"),
        Axis("band", "band, edge", found.band_hz, "Hz", "lower and upper edge"),
    ]
    loudest = sorted(found.bearings, key=lambda each: -each.level_dbfs)[:_TOP]
    missing = "no source found"
    if not found.has_bearings:
        missing = "sources were not searched; ertis.BearingFinder finds them"

    def draw(figures: Any) -> Any:
        if _flaw(found.power):
            return None
        return figures.acoustic_map(found) if len(found.azimuth_rad) > 1 else figures.spectrum(found)

    problems = [f"no picture: {flaw}"] if (flaw := _flaw(found.power)) else []
    problems += doubt_notes(loudest)
    return page(_title("Acoustic map", found.stamp), axes, (_bearing_rows(loudest), missing), problems, draw)


def _bearing_rows(bearings: Sequence[Bearing]) -> str:
    """Return a table of sources; angles without a standard deviation are unknown."""
    columns: dict[str, tuple[str, Callable[[Bearing], float | str]]] = {
        "from (kHz)": (".1f", lambda each: each.band_hz[0] / 1e3),
        "to (kHz)": (".1f", lambda each: each.band_hz[1] / 1e3),
        "azimuth (°)": ("+.2f", lambda each: each.azimuth_deg if math.isfinite(each.sideways_deg) else math.nan),
        "σ (°)": (_TWO_DIGITS, lambda each: each.sideways_deg),
        "elevation (°)": ("+.2f", lambda each: each.elevation_deg if math.isfinite(each.upwards_deg) else math.nan),
        "σ up (°)": (_TWO_DIGITS, lambda each: each.upwards_deg),
        "level (dBFS)": (".1f", lambda each: each.level_dbfs),
        "SNR (dB)": (".1f", lambda each: each.snr_db),
    }
    if any(each.level_db is not None for each in bearings):
        columns["level (dB re 20 µPa)"] = (".1f", lambda each: math.nan if each.level_db is None else each.level_db)
    if any(each.doubts for each in bearings):
        columns["doubt"] = ("", lambda each: " ".join(f"{name}?" for name in each.doubts))
    return _rows(columns, bearings)


@html_of.register
def _(recording: RecordingReader) -> str:
    about: dict[str, str] = {"file": str(recording.path), "measurements": str(len(recording))}
    problems: list[str] = []
    try:
        stamps = recording.stamps()
        first, last = (stamps[0].utc, stamps[-1].utc) if stamps else (None, None)
        about |= {"first": first or "unknown", "last": last or "unknown"}
        first_one = recording[0] if stamps else None
        is_passive = bool(stamps) and all(stamp.behaviour == "passive" for stamp in stamps)
    except (ErtisError, ValueError, RuntimeError) as error:  # h5py has its own errors for closed files.
        problems.append(f"measurements cannot be read: {error}")
        first_one, is_passive = None, False
    place_m = recording.translation_m
    about |= {
        "lost measurements": str(sum(gap.n_missing for gap in recording.gaps)),
        "mounting": "unknown" if place_m is None else "x {:g} m, y {:g} m, z {:g} m".format(*place_m),
        "poses": "unknown" if recording.trajectory is None else str(len(recording.trajectory)),
        "ground truth": "unknown" if recording.truth is None else "known",
        **_about(recording.settings),
        **({"call": "none was emitted"} if is_passive else {}),
    }

    def draw(figures: Any) -> Any:
        return None if first_one is None else figures.signals(first_one)

    return page(f"Recording · {recording.sensor}", [], (_facts(about), ""), problems, draw)


@html_of.register
def _(settings: Settings) -> str:
    toml = settings.to_toml()
    shown = toml if len(toml) <= _MAX_TOML else f"{toml[:_MAX_TOML]} …"
    every = f"<details><summary>all settings</summary><pre>{escaped(shown)}</pre></details>"

    def draw(figures: Any) -> Any:
        return figures.array(settings)

    return page("Settings", [], (f"{_facts(_about(settings))}{every}", ""), [], draw)


def _about(settings: Settings) -> dict[str, str]:
    """Return the settings that describe a measurement and its image, in words."""
    call, recording, processing = settings.call, settings.recording, settings.processing
    first_m, last_m = processing.range_m
    given = processing.directions
    directions = given if isinstance(given, str) else f"a list of {len(given)}"
    return {
        "array": settings.array.layout,
        "call": f"{call.start_frequency_hz / 1e3:g} to {call.stop_frequency_hz / 1e3:g} kHz in "
        f"{1e3 * call.duration_s:g} ms",
        "record": f"{counted(recording.n_samples, 'sample')} at {recording.sample_rate_hz / 1e3:g} kHz, "
        f"{1e3 * recording.duration_s:g} ms",
        "air": f"{settings.air.temperature_c:g} °C, {settings.air.humidity_percent:g} % relative humidity",
        "directions": str(directions),
        "ranges": f"{first_m:g} to {last_m:g} m",
        "beamformer": f"{processing.beamformer}, weighting {processing.weighting}",
        "error budget": f"{settings.accuracy.max_error_db:g} dB",
    }


def _facts(about: dict[str, str]) -> str:
    return table([("property", ""), ("value", "")], [[(escaped(k), ""), (escaped(v), "")] for k, v in about.items()])


def _flaw(values: "NDArray[Any]") -> str:
    """Return the reason for which values are not shown; empty if there is none."""
    if not values.size:
        return "there are no values"
    return "" if np.isfinite(values).all() else "values contain NaN or infinity"


def _rows(columns: Mapping[str, tuple[str, Callable[[Any], float | str]]], items: Iterable[Any]) -> str:
    """Return a numbered table of items; empty if there are none."""
    lines = [
        [(str(number), _NUMBER), *((_cell(value(item), form), _NUMBER) for form, value in columns.values())]
        for number, item in enumerate(items, 1)
    ]
    return table([("#", _NUMBER), *((name, _NUMBER) for name in columns)], lines) if lines else ""


def _cell(value: float | str, form: str) -> str:
    """Return a number in a format, or with two digits and never with an exponent; a dash if it is unknown."""
    if isinstance(value, str):
        return escaped(value)
    if not math.isfinite(value):
        return _UNKNOWN
    if form == _TWO_DIGITS:
        form = f".{max(0, 1 - math.floor(math.log10(value)))}f" if value > 0 else "g"
    return f"{round(value, 9) + 0.0:{form}}"  # Adding 0.0 turns -0.0 into 0.0.


def _title(kind: str, stamp: Stamp, taken: str = "measurement") -> str:
    return " · ".join((kind, stamp.sensor, f"{taken} {stamp.sequence}", *filter(None, [stamp.utc])))


def _of_sensor(stamp: Stamp, note: str | None) -> str | None:
    return note and f"sensor {stamp.sensor} {note}"
