"""``ertis peaks``: reflectors in an energyscape file, or sources in acoustic maps."""

import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import click

from ertis_cli import _tables, options
from ertis_cli._config import typed
from ertis_numba.base.constants import FALSE_ALARM

if TYPE_CHECKING:
    from ertis_numba.analysis.compare import Comparison, Match
    from ertis_numba.frames import Bearing, Energyscape, Peak

__all__ = ["peaks"]

_WANTED = "an energyscape file or a file of acoustic maps ('ertis process' and 'ertis acoustic' write them)"
_TOP = 10
_MIN_LEVEL_DB = -30.0
_FALSE_ALARM = 1e-4  # per bin, with CFAR
_PLACE = {"azimuth_deg": "+.2f", "elevation_deg": "+.2f", "range_m": ".3f", "level_db": ".1f"}
_ERROR = {"angle_deg": ".3f", "range_m": "+.4f", "level_db": "+.2f"}
_COLUMNS: dict[str, _tables.Side] = {"sensor": "left", **dict.fromkeys(("measurement", *_PLACE), "right")}
_ERROR_COLUMNS: dict[str, _tables.Side] = {
    "angle_error_deg": "right",
    "range_error_m": "right",
    "level_error_db": "right",
    "reflector": "left",
}
_BEARING = {"azimuth_deg": "+.2f", "sideways_deg": ".2f", "elevation_deg": "+.2f", "upwards_deg": ".2f"}
_DOUBTS = ("crosstalk", "interference")
_LEVELS = ("level_dbfs", "level_db", "source_level_db")
_OF_IMAGES = ("detector", "false_alarm", "everything", "truth")
_DIGITS = dict.fromkeys((*_PLACE, "angle_deg", "level_dbfs", "grid_error_deg", "angle_sd_deg", "level_sd_db"), 4) | {
    "range_m": 6,
    "range_sd_m": 7,
}
_SD = {"angle_sd_deg": ".2g", "range_sd_m": ".2g", "level_sd_db": ".2g"}


@click.command()
@options.input_file("IMG.h5|MAPS.h5")
@options.sensor("List this sensor only; all sensors by default.")
@click.option(
    "--top",
    type=int,
    metavar="N",
    help=f"Largest number of rows per measurement, or per band of an acoustic map; {_TOP} by default, all with "
    f"--truth.",
)
@click.option(
    "--min-level",
    type=float,
    metavar="DB",
    help=f"Lowest level relative to the strongest peak; {_MIN_LEVEL_DB:g} by default, no limit with cfar. In acoustic "
    "maps, relative to the loudest source of the band; these contain no sources below -20.",
)
@options.measurement("One measurement, or map of a file of acoustic maps, counted from 0; all by default.")
@click.option(
    "--detector",
    type=click.Choice(["peaks", "cfar"]),
    default="peaks",
    show_default=True,
    help="Detector: peaks compares levels, cfar compares each bin with the noise around it (OS-CFAR).",
)
@click.option(
    "--false-alarm",
    type=float,
    metavar="P",
    help=f"Probability of a false alarm per bin, with cfar; {_FALSE_ALARM:g} by default.",
)
@click.option("--all", "everything", is_flag=True, help="Also list maxima that noise alone may cause.")
@click.option("--truth", is_flag=True, help="Compare with the ground truth in the file of a simulated recording.")
@options.as_json
def peaks(
    *,
    path: Path,
    sensor: str | None,
    top: int | None,
    min_level: float | None,
    measurement: int | None,
    detector: Literal["peaks", "cfar"],
    false_alarm: float | None,
    everything: bool,
    truth: bool,
    as_json: bool,
) -> None:
    """List the reflectors in an energyscape file.

    In a file of acoustic maps, list the sources of sound.

    There is one entry per reflector, the strongest of each measurement first. level_db is relative to the strongest
    peak, and level_dbfs to a full-scale echo in every microphone. Maxima that noise alone may cause in
    one of 1000 images are omitted unless --all is given, as are maxima that a hiss, a tone or a click from their
    direction may cause. Images that are cleaned keep all maxima. angle_sd_deg,
    range_sd_m and level_sd_db are standard deviations, if the noise is known. grid_error_deg is the
    part of angle_sd_deg from directions that cannot be interpolated; other directions have 0. It is -, and null in
    JSON, where the reflector may lie beyond the edge of the grid. No level is more than 1 dB above its image.
    Angles that the array cannot observe are shown as –, and as null in JSON: both for one microphone, the
    elevation for microphones on a horizontal line.

    With --detector cfar, a reflector exceeds the noise around it in range, at any level, and is at most 10 dB below the
    strongest echo at its range. The noise is estimated from 32 bins of the same direction (OS-CFAR), so that
    --false-alarm is the probability per bin that noise alone is listed.

    For fused images, the reflectors are the points that 'ertis fuse' has located from the images of all
    sensors, not maxima of the image.

    With --truth, each true reflector comes first, with the errors of its matched peak or as missed. Then come peaks
    that no reflector explains, as spurious, and peaks of reflectors that do not count, as explained (see
    'ertis compare --help'). In JSON, "truth" of each peak is its true reflector or null, "spurious" is true or
    false, and "missed" lists missed reflectors.

    For a file of acoustic maps, there is one entry per source, the loudest of each map and band first: the bearings
    that 'ertis acoustic' has found in all directions that the array can tell apart, whatever the method and the
    directions of the map. Noise alone yields a source in one of 1000 maps. Side lobes yield none.
    sideways_deg and upwards_deg are the standard deviations of the direction along the sphere, horizontally and
    vertically, because of noise. Levels are those of the band, without noise; level_dbfs is the mean square, where a
    full-scale tone has -3. level_db, in dB re 20 µPa, needs the sensitivity of the microphones. source_level_db, in
    dB re 20 µPa at 1 m from the source, also needs the distance of the source (--focus of 'ertis acoustic'). snr_db is
    relative to the noise of a microphone. A source marked 'crosstalk?' may be electrical crosstalk, and one marked
    'interference?' may be a tone of the electronics (may_be_crosstalk and may_be_interference in JSON). Maps are
    counted from 0, regardless of the number of measurements that they average. --measurement chooses a map. Of the
    other options, --sensor, --top, --min-level and --json apply to maps.
    """
    from ertis_numba.storage import file_kind

    if truth and top is not None:
        raise click.UsageError(
            "--top would omit reflectors that --truth compares; choose one of them", click.get_current_context()
        )
    if detector == "cfar" and truth:
        raise click.UsageError(
            "--truth needs --detector peaks; remove --truth or --detector cfar", click.get_current_context()
        )
    if everything and (truth or detector == "cfar"):
        raise click.UsageError(
            "--all is for --detector peaks without --truth; remove --all or the other option",
            click.get_current_context(),
        )
    if detector != "cfar" and false_alarm is not None:
        raise click.UsageError(
            "--false-alarm needs --detector cfar; add it, or remove --false-alarm", click.get_current_context()
        )
    is_map = file_kind(path, _WANTED) == "acoustic_map"
    sensors = options.sensors_of(path, sensor)
    if is_map:
        _list_sources(path, sensors, measurement, _TOP if top is None else top, min_level, as_json=as_json)
        return
    if detector == "cfar" or everything:
        _require_single_sensors(path, sensors)
    if truth:
        compared: list[tuple[dict[str, Any], Comparison]] = [
            ({"sensor": name, "measurement": index}, comparison)
            for name in sensors
            for index, comparison in options.comparisons(
                path, name, _MIN_LEVEL_DB if min_level is None else min_level, measurement=measurement
            )
        ]
        report = {
            "peaks": [row for place, comparison in compared for row in _compared(place, comparison)],
            "missed": [place | _rounded(item) for place, comparison in compared for item in comparison.missed],
        }
        cells = [row for place, comparison in compared for row in _beside_the_truth(place, comparison)]
        table = _tables.TextTable(_COLUMNS | _ERROR_COLUMNS, cells)
    else:
        find = _finder(detector, _TOP if top is None else top, min_level, false_alarm, everything=everything)
        rows = [row for name in sensors for row in _found(path, name, find, measurement)]
        report = {"peaks": rows}
        more = {"level_dbfs": ".1f"} | ({"grid_error_deg": ".2f"} if _has_grid_errors(rows) else {})
        more |= _SD if any(row["range_sd_m"] is not None for row in rows) else {}
        cells = [(*_cells(row, row), *_formatted(row, more)) for row in rows]
        table = _tables.TextTable(_COLUMNS | dict.fromkeys(more, "right"), cells)
    options.note_unlisted_directions(path, sensors)
    if as_json:
        options.print_json(report)
        return
    if not table.rows:
        click.echo("nothing found", err=True)
        return
    table.print()


def _require_single_sensors(path: Path, sensors: tuple[str, ...]) -> None:
    """Refuse detectors that search the image, for files whose images have the points of a fusion."""
    from ertis_numba.storage import open_energyscapes

    for name in sensors:
        with open_energyscapes(path, sensor=name) as images:
            if images.has_points:
                raise click.UsageError(
                    f"--detector cfar and --all search images of single sensors, but {path} has the points of a "
                    "fusion; leave both out",
                    click.get_current_context(),
                )


def _list_sources(
    path: Path,
    sensors: tuple[str, ...],
    measurement: int | None,
    top: int,
    min_level_db: float | None,
    *,
    as_json: bool,
) -> None:
    """Print the sources in each band of acoustic maps."""
    from ertis_numba.base.errors import DataError
    from ertis_numba.storage import open_acoustic_maps

    for name in _OF_IMAGES:
        if typed(name):
            option = {"everything": "all"}.get(name, name.replace("_", "-"))
            raise click.UsageError(
                f"--{option} is for images, but {path} holds acoustic maps; leave it out", click.get_current_context()
            )
    rows: list[dict[str, Any]] = []
    for name in sensors:
        listed: list[Bearing] = []
        with open_acoustic_maps(path, sensor=name) as maps:
            if not maps.has_bearings:
                raise DataError(f"{path} contains no bearings; use 'ertis acoustic' again to list sources")
            options.warn_of(name, maps.band_note)
            for index in options.places(measurement, len(maps)):
                found = _chosen(maps[index].bearings, top, -math.inf if min_level_db is None else min_level_db)
                listed += found
                rows += [{"sensor": name, "map": index, **each.as_dict()} for each in found]
            options.note_unknown_bearings(name, maps.settings)
        options.note_doubts(name, listed)
    if as_json:
        options.print_json({"sources": rows})
        return
    if not rows:
        click.echo("no source found", err=True)
        return
    more = {name: ".1f" for name in (*_LEVELS, "snr_db") if any(row[name] is not None for row in rows)}
    columns: dict[str, _tables.Side] = {"sensor": "left"}
    columns |= dict.fromkeys(("map", "band_khz", *_BEARING, *more), "right")
    columns |= {"doubt": "left"} if any(row[f"may_be_{name}"] for row in rows for name in _DOUBTS) else {}
    _tables.TextTable(columns, [_source_cells(row, more)[: len(columns)] for row in rows]).print()


def _chosen(bearings: "Iterable[Bearing]", top: int, min_level_db: float) -> "list[Bearing]":
    """Return the bearings of each band, up to a number, with at least a level relative to the loudest of the band."""
    bands: dict[tuple[float, float], list[Bearing]] = {}
    for each in bearings:
        bands.setdefault(each.band_hz, []).append(each)
    return [
        each for band in bands.values() for each in band[:top] if each.level_dbfs >= band[0].level_dbfs + min_level_db
    ]


def _has_grid_errors(rows: list[dict[str, Any]]) -> bool:
    """Return True if the direction of a row is not interpolated between directions of the grid."""
    return any(row["grid_error_deg"] != 0 for row in rows if (row["azimuth_deg"], row["elevation_deg"]) != (None, None))


def _source_cells(row: dict[str, Any], more: dict[str, str]) -> tuple[str, ...]:
    band = "–".join(f"{edge_hz / 1e3:.1f}" for edge_hz in row["band_hz"])
    doubt = " ".join(f"{name}?" for name in _DOUBTS if row[f"may_be_{name}"])
    return (row["sensor"], str(row["map"]), band, *_formatted(row, _BEARING), *_formatted(row, more), doubt)


def _finder(
    detector: str, top: int, min_level: float | None, false_alarm: float | None, *, everything: bool
) -> "Callable[[Energyscape], list[Peak]]":
    """Return a function that finds the reflectors of an image."""
    if detector == "cfar":
        from ertis_numba.analysis.cfar import cfar_peaks

        found = partial(cfar_peaks, top=top, false_alarm=_FALSE_ALARM if false_alarm is None else false_alarm)
        return found if min_level is None else partial(found, min_level_db=min_level)
    from ertis_numba.analysis.detect import find_peaks

    return partial(
        find_peaks,
        top=top,
        min_level_db=_MIN_LEVEL_DB if min_level is None else min_level,
        false_alarm=None if everything else FALSE_ALARM,
    )


def _found(
    path: Path, sensor: str, find: "Callable[[Energyscape], list[Peak]]", measurement: int | None
) -> list[dict[str, Any]]:
    """Return a row for each peak of a sensor."""
    from ertis_numba.analysis.detect import find_peaks
    from ertis_numba.analysis.peak_notes import list_notes, open_edge_note
    from ertis_numba.storage import open_energyscapes

    with open_energyscapes(path, sensor=sensor) as images:
        options.warn_of_spacing(sensor, images.settings, images)
        by_place = {index: find(images[index]) for index in options.places(measurement, len(images))}
        found = [(index, peak) for index, peaks in by_place.items() for peak in peaks]
        if isinstance(find, partial) and find.func is find_peaks:
            limits = {name: find.keywords[name] for name in ("min_level_db", "false_alarm")}
            notes = list_notes(((images[index], peaks) for index, peaks in by_place.items()), **limits)
        else:
            notes = [open_edge_note(images, (peak.grid_error_deg for _, peak in found)) or ""]
        for note in notes:
            options.note_of(sensor, note)
        return [{"sensor": sensor, "measurement": index, **_rounded(peak)} for index, peak in found]


def _compared(place: dict[str, Any], comparison: "Comparison") -> Iterator[dict[str, Any]]:
    """Yield a row for each peak of a measurement, the strongest first."""
    shown: list[tuple[Peak, Match | None, bool]] = [(match.peak, match, False) for match in comparison.matched]
    shown += [(peak, None, True) for peak in comparison.spurious]
    shown += [(peak, None, False) for peak in comparison.explained]
    for peak, match, is_spurious in sorted(shown, key=lambda entry: -entry[0].level_db):
        yield {
            **place,
            **_rounded(peak),
            "spurious": is_spurious,
            "truth": _rounded(match.reflector) if match else None,
            "error": _error(match) if match else None,
        }


def _beside_the_truth(place: dict[str, Any], comparison: "Comparison") -> Iterator[tuple[str, ...]]:
    """Yield the cells of each true reflector of a measurement, then of the other peaks."""
    for match in comparison.matched:
        reported = _formatted(_error(match), _ERROR)
        yield (*_cells(place, _rounded(match.reflector)), *reported, match.reflector.name)
    for reflector in comparison.missed:
        yield (*_cells(place, _rounded(reflector)), "missed", "-", "-", reflector.name)
    for verdict, given in (("spurious", comparison.spurious), ("explained", comparison.explained)):
        for peak in given:
            yield (*_cells(place, _rounded(peak)), verdict, "-", "-", "-")


def _cells(place: dict[str, Any], found: dict[str, Any]) -> tuple[str, ...]:
    """Return the cells with the sensor, measurement and position of a reflector or a peak."""
    return (place["sensor"], str(place["measurement"]), *_formatted(found, _PLACE))


def _formatted(row: dict[str, Any], forms: dict[str, str]) -> tuple[str, ...]:
    """Return the cells of numbers with given formats; a dash for unknown ones."""
    return tuple(_dash(name) if row[name] is None else f"{row[name]:{form}}" for name, form in forms.items())


def _dash(name: str) -> str:
    return "–" if name in ("azimuth_deg", "elevation_deg", "angle_deg") else "-"


def _error(match: "Match") -> dict[str, float | None]:
    return {name: _number(getattr(match, name), _DIGITS[name]) for name in ("angle_deg", "range_m", "level_db")}


def _rounded(item: Any) -> dict[str, Any]:
    """Return the fields of a peak or a reflector with rounded numbers, or None, without its emitter."""
    fields = {name: value for name, value in asdict(item).items() if name != "emitter"}
    return {name: _number(value, _DIGITS[name]) if name in _DIGITS else value for name, value in fields.items()}


def _number(value: float, digits: int) -> float | None:
    return round(value, digits) if math.isfinite(value) else None
