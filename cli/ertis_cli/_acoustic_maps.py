"""Acoustic maps from recordings: their options, and processing of passive measurements."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options
from ertis_cli._config import typed

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ertis_numba.campaign import CampaignOptions
    from ertis_numba.settings import Settings

__all__ = [
    "are_wanted",
    "map_options",
    "require_none",
    "require_options_of",
    "summary",
    "with_map_options",
    "write_maps",
]

_PREFIX = "passive_"
_MAP_OPTIONS = {"bands_hz": "bands", "method": "map-method", "averages": "average", "focus_m": "focus"}
_METHODS = ("delay_and_sum", "functional", "capon", "music", "clean_sc", "hr_clean_sc")
_OF_IMAGES = (
    *("range_m", "preset", "beamformer", "weighting", "dmas_order", "snapshots", "diagonal_loading", "array_weights"),
    *("clean_within_db", "clean_above_mean_db", "last_stage", "wavefront", "method", "max_error_db", "plan"),
    *("explain", "verify", "dtype", "batch"),
)
_Changed = Callable[["Settings"], "Settings"]


class _Bands(click.ParamType):  # type: ignore[type-arg]  # generic since click 8.4 only
    name = "BANDS"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if value in ("third_octaves", "octaves"):
            return value
        with suppress(ValueError):
            bands = tuple(tuple(float(edge) for edge in band.split(":")) for band in str(value).split(","))
            if all(len(band) == 2 for band in bands):
                return bands
        return self.fail(
            f"{value!r} is not a list of bands; use third_octaves, octaves, or edges in Hz, as in "
            "20000:30000,30000:40000",
            param,
            ctx,
        )


def map_options(command: Callable[..., Any]) -> Callable[..., Any]:
    """Add the options of acoustic maps, named like the fields of `Passive` after ``passive_``."""
    for option in reversed(
        (
            click.option(
                "--mode",
                type=click.Choice(["auto", "active", "passive"]),
                help="Results to compute: images (active), acoustic maps (passive), or maps of passive measurements "
                "and images of others (auto); the recording's own by default.",
            ),
            click.option(
                "--bands",
                "passive_bands_hz",
                type=_Bands(),
                help="Bands of acoustic maps: third_octaves, octaves, or A:B,... in Hz; the recording's own by "
                "default.",
            ),
            click.option(
                "--map-method",
                "passive_method",
                type=click.Choice(_METHODS),
                help="Method of acoustic maps; the recording's own by default.",
            ),
            click.option(
                "--average",
                "passive_averages",
                type=click.IntRange(1, 100_000),
                metavar="N",
                help="Number of measurements in an acoustic map; the recording's own by default.",
            ),
            click.option(
                "--focus",
                "passive_focus_m",
                type=click.FloatRange(0.01, 10_000.0),
                metavar="M",
                help="Distance of sources in m for acoustic maps; the recording's own by default.",
            ),
        )
    ):
        command = option(command)
    return command


def with_map_options(settings: "Settings", given: "Mapping[str, Any]") -> "Settings":
    """Return settings with the options of `map_options`; others and None change nothing."""
    changes = {
        name.removeprefix(_PREFIX): value
        for name, value in given.items()
        if name.startswith(_PREFIX) and value is not None
    }
    return settings.replace(passive=settings.passive.replace(**changes)) if changes else settings


def are_wanted(path: Path, sensors: "Sequence[str]", changed: _Changed) -> bool:
    """Return True if all measurements of the sensors become acoustic maps."""
    from ertis_numba.frames import is_passive
    from ertis_numba.storage import open_recording

    for name in sensors:
        with open_recording(path, sensor=name) as recording:
            settings = changed(recording.settings)
            if not all(is_passive(settings, stamp) for stamp in recording.stamps()):
                return False
    return True


def require_none(reason: str) -> None:
    """Raise an error for options of acoustic maps, with the reason for which they have no effect."""
    for name, option in _MAP_OPTIONS.items():
        if typed(_PREFIX + name):
            raise click.UsageError(
                f"--{option} is for acoustic maps, but {reason}, or leave out --{option}", click.get_current_context()
            )


def _require_maps() -> None:
    """Raise an error for options of images, which have no effect on acoustic maps."""
    context = click.get_current_context()
    reason = "all measurements become acoustic maps; use --mode active for images"
    if context.params.get("mode") == "passive":  # also of measurements with a call
        reason = "--mode passive makes acoustic maps; leave out --mode"
    for parameter in context.command.params:
        if parameter.name in _OF_IMAGES and typed(parameter.name):
            raise click.UsageError(
                f"{parameter.opts[0]} is for images, but {reason}, or leave out {parameter.opts[0]}", context
            )


def require_options_of(mode: str | None) -> None:
    """Raise an error for options that have no effect on the results of a mode, for several recordings."""
    if mode == "passive":
        _require_maps()
    elif mode == "active":
        require_none("--mode active makes images; leave out --mode")


def write_maps(
    path: Path,
    target: Path,
    wanted: "CampaignOptions",
    *,
    sensors: "Sequence[str]",
    quiet: bool,
    as_json: bool,
) -> None:
    """Write the acoustic maps of a recording."""
    _require_maps()
    with ExitStack() as stack:
        with options.note_when_slow(options.PREPARING, quiet=quiet):
            from ertis_numba.campaign import prepare_maps

            work = stack.enter_context(prepare_maps(path, target, wanted, sensors=sensors, warn=options.warn))
        steps = stack.enter_context(closing(work.run()))
        shown = stack.enter_context(options.progress(steps, length=work.measurements, label="processing", quiet=quiet))
        for _ in shown:
            pass
    report = work.report()
    for line in summary(target, report["sensors"], report["device"]):
        options.say(line, quiet=quiet)
    if as_json:
        options.print_json({"output": str(target), **report})


def summary(target: Path, rows: "Sequence[dict[str, Any]]", device: str) -> Iterator[str]:
    """Yield a line with the maps of each sensor."""
    for row in rows:
        of = f" of {row['sensor']}" if len(rows) > 1 else ""
        yield (
            f"{target}: {options.counted(row['maps'], 'acoustic map')} of "
            f"{options.counted(row['measurements'], 'measurement')}{of}, "
            f"{options.counted(row['directions'], 'direction')} × {options.counted(row['bands'], 'band')} on "
            f"{device}, {row['median_ms']:.1f} ms each (median)"
        )
