"""Options, parameter types and output functions shared by several commands."""

import glob
import json
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.shell_completion import CompletionItem

from ertis_cli import _progress
from ertis_cli._naming import with_options
from ertis_cli._parameter_types import (
    BEAMFORMER,
    CHANNELS,
    CLEANING,
    DIRECTION,
    ELEVATION,
    ERROR_BUDGET,
    FILE,
    FOLDER,
    INTERVAL,
    NAMES,
    TEXT_PATH,
    WORKERS,
    ranged,
)
from ertis_numba.base.units import counted
from ertis_numba.settings.beamformers import BEAMFORMERS, WEIGHTINGS
from ertis_numba.settings.limits import EMITTER_M

if TYPE_CHECKING:
    from ertis_numba.analysis.compare import Comparison
    from ertis_numba.base.angles import DegreesFromRadians
    from ertis_numba.chain.costs import PlanCosts
    from ertis_numba.frames import Bearing
    from ertis_numba.pipeline import Pipeline
    from ertis_numba.settings import Array, ExcludedChannels, Settings
    from ertis_numba.storage import EnergyscapeReader, RecordingReader

__all__ = [
    "COMPILING",
    "DIRECTION",
    "ELEVATION",
    "ERROR_BUDGET",
    "FILE",
    "FOLDER",
    "INTERVAL",
    "NAMES",
    "PREPARING",
    "TEXT_PATH",
    "alone",
    "as_json",
    "as_json_of",
    "cleaning",
    "comparisons",
    "complete_layouts",
    "counted",
    "device",
    "emitter_diameter",
    "force",
    "input_file",
    "input_files",
    "measurement",
    "min_level",
    "note",
    "note_doubts",
    "note_height",
    "note_layout",
    "note_missing_points",
    "note_of",
    "note_unknown_angles",
    "note_unknown_bearings",
    "note_unknown_places",
    "note_unlisted_directions",
    "note_when_slow",
    "output",
    "pipeline",
    "place",
    "places",
    "plan",
    "print_json",
    "progress",
    "quiet",
    "say",
    "sensor",
    "sensors_of",
    "settings_file",
    "settings_with",
    "threads",
    "warn",
    "warn_of",
    "warn_of_spacing",
    "without",
    "workers",
]

Item = TypeVar("Item")
Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]


def _excluded_channels(
    _ctx: click.Context, _param: click.Parameter, values: tuple[tuple[str, tuple[int, ...]], ...]
) -> "ExcludedChannels":
    from ertis_numba.settings import ExcludedChannels

    channels: dict[str, tuple[int, ...]] = {}
    for name, each in values:
        channels[name] = (*channels.get(name, ()), *each)
    return ExcludedChannels(channels.pop("", ()), channels)


PREPARING = "preparing ..."
"""Message for a slow start."""
COMPILING = "a first run compiles kernels, which takes longer ..."
"""Message for a start that compiles kernels."""


def as_json_of(objects: str) -> Decorator:
    """Return the option that prints JSON instead of text; its help states the objects that are printed."""
    return click.option("--json", "as_json", is_flag=True, help=f"Print JSON on stdout: {objects}.")


as_json: Decorator = as_json_of("one object, or one per line if there are several")
device: Decorator = click.option(
    "--device",
    type=click.Choice(["auto", "cpu", "cuda", "numpy"]),
    default="auto",
    show_default=True,
    help="Device to compute on; auto chooses cuda (an NVIDIA GPU) if there is one; numpy needs no compiled kernels.",
)
plan: Decorator = click.option(
    "--plan",
    type=click.Choice(["nominal", "measured"]),
    default="nominal",
    show_default=True,
    help="Costs for the choice of the plan: published ones, which give the same images on every machine with the same "
    "instruction set, or those measured on this machine.",
)
alone: Decorator = click.option(
    "--alone",
    is_flag=True,
    help="For odometry: no sensor emits except those given. Otherwise, the motion of a single sensor along its axis is "
    "unknown, because it may hear the calls of others from behind.",
)
force: Decorator = click.option("--force", is_flag=True, help="Overwrite existing output.")
quiet: Decorator = click.option(
    "--quiet", "-q", is_flag=True, help="Print warnings and errors only, no progress or summary."
)
threads: Decorator = click.option("--threads", type=int, metavar="N", help="Number of threads; all cores by default.")


settings_file: Decorator = click.option(
    "--settings",
    "settings_file",
    metavar="FILE.toml",
    type=FILE,
    help="Settings file (TOML) whose keys override those of the recording.",
)


def beamforming(default: str = "") -> Decorator:
    """Return the options of beamformers and weightings, named like the fields of `Processing`."""
    about = "; ".join(
        f"{name.removeprefix(f'{beamformer}_')}: {option.help}, {option.limits}"
        for beamformer, declared in BEAMFORMERS.items()
        for option in declared.options
        for name in [option.name]
    )
    named = click.option(
        "--beamformer",
        type=BEAMFORMER,
        help=f"Beamformer: {', '.join(BEAMFORMERS)}{default}. Options follow its name, as in dmas:order=3. {about}.",
    )
    weighted = click.option(
        "--weighting", type=click.Choice(list(WEIGHTINGS)), help=f"Weighting of amplitudes{default}."
    )
    return lambda command: named(weighted(command))


def cleaning(default: str = "") -> Decorator:
    """Return the option of range-wise cleaning, whose value has the names of fields of `Processing`."""
    return click.option(
        "--clean",
        type=CLEANING,
        metavar=CLEANING.name,
        help="Keep only amplitudes within DB of the strongest direction of each range, at least DB above the mean of "
        f"each range, or both{default}.",
    )


def workers(of: str = "") -> Decorator:
    """Return the option for processes on this machine or a cluster; ``of`` states their work."""
    return click.option(
        "--workers",
        type=WORKERS,
        metavar=WORKERS.name,
        help=f"Number of worker processes{of}, one per core by default; or the dask scheduler whose workers to use.",
    )


def without(text: str) -> Decorator:
    """Return the option that excludes channels; ``text`` is the beginning of its help."""
    return click.option(
        "--without",
        type=CHANNELS,
        multiple=True,
        callback=_excluded_channels,
        help=f"{text}, counted from 0, as in 5,12; or of one sensor, as in left:5,12. Repeat the option for others.",
    )


def emitter_diameter(text: str) -> Decorator:
    """Return the option for the diameter of emitters; ``text`` is the beginning of its help."""
    return click.option(
        "--emitter-diameter",
        "emitter_diameter_m",
        type=ranged(EMITTER_M),
        metavar="M",
        help=f"{text} in m instead of that of the recordings; 0 is omnidirectional.",
    )


def input_file(metavar: str) -> Decorator:
    """Return the argument for the input file."""
    return click.argument("path", metavar=metavar, type=FILE)


def input_files(metavar: str, *, name: str = "paths") -> Decorator:
    """Return the argument for one or more input files; patterns are expanded, as some shells leave them in place."""
    return click.argument(name, metavar=metavar, nargs=-1, required=True, type=FILE, callback=_expanded)


def _expanded(_ctx: click.Context, _param: click.Parameter, paths: tuple[Path, ...]) -> tuple[Path, ...]:
    return tuple(file for path in paths for file in _matches(path))


def _matches(path: Path) -> list[Path]:
    if path.exists() or not glob.has_magic(str(path)):
        return [path]
    from ertis_numba.interop.pcm_files import natural_order

    found = [Path(name) for name in sorted(glob.glob(str(path), recursive=True), key=natural_order)]  # noqa: PTH207
    if not found:
        raise click.BadParameter(f"no file matches {path}; choose another pattern, or name the files")
    return found


def output(text: str) -> Decorator:
    """Return the option for the output file."""
    return click.option("--output", "-o", "target", type=FILE, metavar="FILE", help=text)


def measurement(text: str) -> Decorator:
    """Return the option that chooses one measurement."""
    return click.option("--measurement", "-m", type=click.IntRange(min=0), metavar="I", help=text)


def min_level(text: str) -> Decorator:
    """Return the option for the lowest level that is kept, relative to the strongest."""
    return click.option("--min-level", type=float, default=-30.0, show_default=True, metavar="DB", help=text)


def sensor(text: str) -> Decorator:
    """Return the option that selects one sensor of a file."""
    return click.option("--sensor", metavar="NAME", help=text)


def sensors_of(path: Path, sensor: str | None, wanted: str = "") -> tuple[str, ...]:
    """Return the chosen sensor, or all sensors of a file; errors name the kinds of file that are wanted."""
    from ertis_numba.storage import sensor_names

    return (sensor_names(path, wanted) if wanted else sensor_names(path)) if sensor is None else (sensor,)


def comparisons(
    path: Path, sensor: str, min_level_db: float, *, measurement: int | None = None
) -> "Iterator[tuple[int, Comparison]]":
    """Yield the index of each measurement, or of one, and the comparison of its energyscape with the ground truth."""
    from ertis_numba.analysis.compare import compare
    from ertis_numba.base.errors import DataError
    from ertis_numba.base.file_kinds import quoted
    from ertis_numba.fusion import PLATFORM
    from ertis_numba.storage import open_energyscapes

    with open_energyscapes(path, sensor=sensor) as images:
        if sensor == PLATFORM:
            raise DataError(
                f"{path} has fused images, which have points instead of peaks; use 'ertis compare {quoted(path)}', or "
                "images of single sensors"
            )
        if images.truth is None:
            images.settings.processing.require_sensor_frame("the ground truth is in the frame of the sensor")
            raise DataError(
                f"{path}: sensor {sensor} holds no ground truth; simulate a scene and process that recording"
            )
        for index in places(measurement, len(images)):
            yield index, compare(images[index], images.truth.reflectors[index], min_level_db=min_level_db)


def places(index: int | None, count: int) -> Sequence[int]:
    """Return the index of the chosen measurement of ``count``, or all indices if none is chosen."""
    return range(count) if index is None else [place(index, count)]


def place(index: int, count: int) -> int:
    """Return the index of a measurement of ``count``; raise ArgumentError if it is outside the file."""
    from ertis_numba.base import checks

    return checks.integer("--measurement", index, 0, count - 1)


def settings_with(
    recorded: "Settings",
    *,
    settings_file: Path | None = None,
    preset: str | None = None,
    max_error_db: float | None = None,
    elevation: tuple[float, float] | float | None = None,
    **options: Any,
) -> "Settings":
    """Return recorded settings, updated from a file, a preset and then options named as in `Processing`."""
    # A layout or positions in the file replace the whole array.
    from ertis_numba.settings import preset_tables

    settings = recorded if settings_file is None else recorded.updated_from_file(settings_file)
    note_layout(settings.array, recorded=recorded.array)
    if preset is not None:
        keys = preset_tables(preset, "processing")["processing"]
        settings = settings.replace(processing=settings.processing.replace(**keys))
    given = {name: value for name, value in options.items() if value is not None}
    given |= given.pop("beamformer", {}) | given.pop("clean", {})
    if elevation is not None:
        given["elevation_deg" if isinstance(elevation, float) else "elevation_limits_deg"] = elevation
    directions = given.get("directions", settings.processing.directions)
    limits = {"azimuth_limits_deg", "elevation_limits_deg", "elevation_deg"} & given.keys()
    if limits and not isinstance(directions, str):
        raise click.UsageError(
            f"limits need a grid, but directions is a list of {len(directions)}; add --directions 2d:N or 3d:N",
            ctx=click.get_current_context(),
        )
    kind = str(directions).partition(":")[0]
    if kind == "2d" and "elevation_limits_deg" in limits:
        raise click.UsageError(
            f"directions {directions} lie at one elevation; use --elevation E, or --directions 3d:N",
            ctx=click.get_current_context(),
        )
    if kind == "3d" and "elevation_deg" in limits:
        raise click.UsageError(
            f"directions {directions} lie between two elevations; use --elevation A:B, or --directions 2d:N",
            ctx=click.get_current_context(),
        )
    if limits and kind not in {"2d", "3d"}:
        raise click.UsageError(
            f"directions {directions} have fixed limits; use --directions 2d:N or 3d:N with limits",
            ctx=click.get_current_context(),
        )
    settings = settings.replace(processing=settings.processing.replace(**given))
    if max_error_db is None:
        return settings
    return settings.replace(accuracy=settings.accuracy.replace(max_error_db=max_error_db))


def pipeline(
    settings: "Settings",
    *,
    quiet: bool,
    device: str = "auto",
    threads: int | None = None,
    plan: "PlanCosts" = "nominal",
) -> "Pipeline":
    """Return a pipeline, and print a message if its start is slow."""
    with note_when_slow(PREPARING, quiet=quiet):
        from ertis_numba.pipeline import Pipeline

        return Pipeline(settings, device=device, threads=threads, predict=False, plan=plan)


def complete_layouts(ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG001
    """Return the layout names that complete a text in a shell, or files if no name does."""
    from ertis_numba.geometry import layout_names

    names = [CompletionItem(name) for name in layout_names() if name.startswith(incomplete)]
    return names or [CompletionItem(incomplete, type="file")]


def note_layout(array: "Array", *, recorded: "Array | None" = None) -> None:
    """Print notes about an array's layout file once, unless its import into the recording printed them."""
    import numpy as np

    from ertis_numba.geometry import microphones

    context = click.get_current_context()
    noted: set[str] = context.meta.setdefault("ertis_cli.noted_layouts", set())
    if not array.is_file or array.layout in noted:
        return
    noted.add(array.layout)
    layout = microphones(array)
    if recorded is not None and np.array_equal(layout.positions_m, microphones(recorded).positions_m):
        return
    for text in layout.notes:
        note(text, quiet=bool(context.params.get("quiet")))


def note_unlisted_directions(path: Path, sensors: Sequence[str]) -> None:
    """Print a note for each sensor whose sound contradicts its settings, or whose array cannot observe some angles."""
    from ertis_numba.storage import open_energyscapes

    for name in sensors:
        with open_energyscapes(path, sensor=name) as images:
            note_missing_points(images)
            texts = images.call_warning, images.start_warning, images.layout_warning, images.samples_warning
            for text in filter(None, texts):
                note(f"sensor {name}: {text}")
            if images.has_points:
                note_unknown_places(name, images.settings)
                note_height(images.settings, images)
            elif images.points_note is None:
                note_unknown_angles(name, images.settings, images)


def note_missing_points(reader: "EnergyscapeReader | RecordingReader", *, quiet: bool = False) -> None:
    """Print a note if a file has fused images without the points of the fusion."""
    if reader.points_note is not None:
        note(reader.points_note, quiet=quiet)


def note_unknown_angles(
    sensor: str, settings: "Settings", grid: "DegreesFromRadians", *, is_passive: bool = False
) -> None:
    """Print a note on angles that the array of a sensor, or its directions, cannot show."""
    from ertis_numba.geometry import direction_note

    text = direction_note(settings.array, grid, is_passive=is_passive)
    if text is not None:
        note(f"sensor {sensor} {text}")


def note_unknown_places(sensor: str, settings: "Settings", *, quiet: bool = False) -> None:
    """Print a note if the places of a sensor's echoes are unknown, as with microphones on a line."""
    from ertis_numba.geometry import observable_angles

    text = observable_angles(settings.array).note
    if text is not None:
        note(f"sensor {sensor} {text}", quiet=quiet)


def note_height(settings: "Settings", grid: "DegreesFromRadians", *, located: bool = True, quiet: bool = False) -> None:
    """Print a note once if the directions of several sensors lie in the horizontal plane."""
    from ertis_numba.geometry import HEIGHT_NOTE, observable_angles

    noted = click.get_current_context().meta
    if grid.elevation_rad.any() or not observable_angles(settings.array).elevation or "ertis_cli.height" in noted:
        return
    noted["ertis_cli.height"] = True
    each = "all directions have elevation 0°, so echoes from above or below the sensors count as those at their height"
    note(HEIGHT_NOTE if located else each, quiet=quiet)


def note_unknown_bearings(sensor: str, settings: "Settings") -> None:
    """Print a note on angles that bearings cannot show, and a warning if the array needs too fine a search."""
    from ertis_numba.geometry import direction_grid
    from ertis_numba.passive.search_grid import search_changes, search_warning

    searched = settings.replace(**search_changes(settings))
    note_unknown_angles(sensor, searched, direction_grid(searched.processing), is_passive=True)
    warn_of(sensor, search_warning(searched))


def note_doubts(sensor: str, bearings: "Iterable[Bearing]") -> bool:
    """Print a note on bearings that may not be those of sound, or are unknown; return True if there are any."""
    from ertis_numba.frames import doubt_notes

    notes = doubt_notes(bearings)
    for text in notes:
        note_of(sensor, text)
    return bool(notes)


def say(text: str, *, quiet: bool) -> None:
    """Print a line on stderr, unless ``quiet``."""
    if not quiet:
        click.echo(text, err=True)


def note(text: str, *, quiet: bool = False) -> None:
    """Print a note on stderr, unless ``quiet``: results are right, and this may matter."""
    say(f"note: {with_options(text)}", quiet=quiet)


def note_of(sensor: str, text: str | None, *, quiet: bool = False) -> None:
    """Print a note about the results of a sensor, if there is any."""
    if text:
        note(f"sensor {sensor}: {text}", quiet=quiet)


def warn(text: str) -> None:
    """Print a warning on stderr: results may be wrong or incomplete."""
    click.echo(f"ertis: warning: {with_options(text)}", err=True)


def warn_of(sensor: str, text: str | None) -> None:
    """Print a warning about the results of a sensor, if there is any."""
    if text:
        warn(f"sensor {sensor}: {text}")


def warn_of_spacing(sensor: str, settings: "Settings", grid: "DegreesFromRadians") -> None:
    """Print a warning if a sensor's images have directions too far apart; fused images have no array of their own."""
    from ertis_numba.analysis.direction_spacing import spacing_warning
    from ertis_numba.fusion import PLATFORM

    if sensor != PLATFORM:
        warn_of(sensor, spacing_warning(settings, grid))


def print_json(report: dict[str, Any]) -> None:
    """Print one JSON object as a line on stdout."""
    click.echo(json.dumps(report, indent=None, allow_nan=False))


def progress(items: Iterable[Item], *, length: int, label: str, quiet: bool) -> AbstractContextManager[Iterable[Item]]:
    """Return ``items`` under a progress bar on stderr; no bar is drawn if ``quiet`` or off a terminal."""
    if quiet or not _progress.is_drawn_on(sys.stderr):
        return nullcontext(items)
    return _progress.bar(items, length=length, label=label)


@contextmanager
def note_when_slow(text: str, *, quiet: bool, after_s: float = 1.0) -> Iterator[threading.Timer]:
    """Print text if the block takes over after_s, and a message once if it compiles kernels; yield the timer."""
    from ertis_numba.kernels import on_compiling

    timer = threading.Timer(after_s, say, args=(text,), kwargs={"quiet": quiet})
    timer.daemon = True
    timer.start()
    context = click.get_current_context(silent=True)
    reported: dict[str, Any] = {} if context is None else context.meta

    def compiling() -> None:
        if not reported.get(COMPILING):
            reported[COMPILING] = True
            say(COMPILING, quiet=quiet)

    withdraw = on_compiling(compiling)
    try:
        yield timer
    finally:
        withdraw()
        timer.cancel()
