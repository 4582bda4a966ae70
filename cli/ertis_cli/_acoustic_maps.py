"""Acoustic maps from recordings: their options, and processing of passive measurements."""

import math
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options
from ertis_cli._config import typed

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from ertis_cli._mountings import Mounting
    from ertis_numba.frames import AcousticMap, Measurement
    from ertis_numba.passive import AcousticCamera
    from ertis_numba.settings import Settings
    from ertis_numba.storage import AcousticMapWriter, RecordingReader

__all__ = ["are_wanted", "loudest_rows", "map_options", "require_none", "with_map_options", "write_maps"]

_PREFIX = "passive_"
_MAP_OPTIONS = {"bands_hz": "bands", "method": "map-method", "averages": "average", "focus_m": "focus"}
_METHODS = ("delay_and_sum", "functional", "capon", "music", "clean_sc")
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
            f"{value!r} is not a list of bands; give third_octaves, octaves, or edges in Hz, as in "
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
    from ertis_numba.passive import is_passive
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
    for parameter in context.command.params:
        if parameter.name in _OF_IMAGES and typed(parameter.name):
            raise click.UsageError(
                f"{parameter.opts[0]} is for images, but all measurements are passive and become acoustic maps; give "
                f"--mode active for images, or leave out {parameter.opts[0]}",
                context,
            )


def write_maps(
    path: Path,
    target: Path,
    changed: _Changed,
    *,
    sensors: "Sequence[str]",
    mounting: "Mapping[str, Mounting] | None",
    strict: bool,
    force: bool,
    quiet: bool,
    as_json: bool,
    **device: Any,
) -> None:
    """Write the acoustic maps of a recording.

    Parameters
    ----------
    path, target : Path
        Recording, and the file to write.
    changed : callable
        Function that returns the settings to use from those of the recording.
    sensors : sequence of str
    mounting : mapping of str to Mounting, or None
        Mountings by sensor instead of those of the recording.
    strict, force, quiet, as_json : bool
        As for the command.
    **device
        Device and threads, as for `AcousticCamera`.
    """
    from ertis_numba.storage import AcousticMapWriter, open_recording

    _require_maps()
    with ExitStack() as stack:
        readers = [stack.enter_context(open_recording(path, sensor=name)) for name in sensors]
        writer = AcousticMapWriter(target, recording=readers, mounting=mounting, overwrite=force)
        cameras = [_camera(stack, changed(reader.settings), quiet=quiet, **device) for reader in readers]
        for reader, camera in zip(readers, cameras, strict=True):
            _check(reader, camera, strict=strict)
        stack.enter_context(writer)
        rows = [_written(reader, camera, writer, quiet=quiet) for reader, camera in zip(readers, cameras, strict=True)]
        device_name = cameras[0].device
    for row in rows:
        of = f" of {row['sensor']}" if len(rows) > 1 else ""
        options.say(
            f"{target}: {options.counted(row['maps'], 'acoustic map')} of "
            f"{options.counted(row['measurements'], 'measurement')}{of}, "
            f"{options.counted(row['directions'], 'direction')} × {options.counted(row['bands'], 'band')} on "
            f"{device_name}",
            quiet=quiet,
        )
    if as_json:
        inside = {name: rows[0][name] for name in ("directions", "bands", "loudest")} if len(rows) == 1 else {}
        counts = {name: sum(row[name] for row in rows) for name in ("measurements", "maps")}
        options.print_json(
            {"output": str(target), "kind": "acoustic_map", **counts, **inside, "device": device_name, "sensors": rows}
        )


def _camera(stack: ExitStack, settings: "Settings", *, quiet: bool, **device: Any) -> "AcousticCamera":
    with options.note_when_slow(options.PREPARING, quiet=quiet):
        from ertis_numba.passive import AcousticCamera

        return stack.enter_context(AcousticCamera(settings, **device))


def _check(reader: "RecordingReader", camera: "AcousticCamera", *, strict: bool) -> None:
    """Warn of faulty microphones, or refuse them."""
    from ertis_numba.campaign.sensor_processing import describe_faults
    from ertis_numba.errors import DataError

    name = f"{reader.path}: sensor {reader.sensor}"
    faults = describe_faults(name, replace(reader[0], settings=camera.settings))
    if faults and strict:
        raise DataError(faults)
    if faults:
        click.echo(f"ertis: warning: {faults}", err=True)


def _written(
    reader: "RecordingReader", camera: "AcousticCamera", writer: "AcousticMapWriter", *, quiet: bool
) -> dict[str, Any]:
    """Write the maps of a sensor, and return its report."""
    count, masked_s = 0, 0.0
    power: Any = 0.0
    last: AcousticMap | None = None
    with options.progress(
        _measurements(reader, camera.settings), length=len(reader), label="processing", quiet=quiet
    ) as shown:
        for last in camera.process_many(shown):
            writer.write(last)
            power, count, masked_s = power + last.power, count + 1, max(masked_s, last.masked_s)
    assert last is not None  # noqa: S101  a recording has at least one measurement
    if masked_s:
        emitted = sum(stamp.behaviour == "active" for stamp in reader.stamps())
        options.say(
            f"note: sensor {reader.sensor} emitted its call in {emitted} of "
            f"{options.counted(len(reader), 'measurement')}; the first {1e3 * masked_s:.1f} ms of each are left out, "
            "but maps contain its echoes",
            quiet=quiet,
        )
    mean = last.replace(power=power / count)
    return {
        "sensor": reader.sensor,
        "measurements": len(reader),
        "maps": count,
        "directions": len(mean.azimuth_rad),
        "bands": len(mean.band_hz),
        "loudest": loudest_rows(mean),
    }


def _measurements(reader: "RecordingReader", settings: "Settings") -> "Iterator[Measurement]":
    """Yield the measurements with the settings of the camera, which may correct their array or air."""
    from ertis_numba.campaign.sensor_processing import require_same_air

    as_recorded = settings.air == reader.settings.air
    for measurement in reader:
        if as_recorded:
            require_same_air(measurement, settings)
        yield replace(measurement, settings=settings)


def loudest_rows(found: "AcousticMap") -> list[dict[str, Any]]:
    """Return the loudest direction of each band for JSON.

    Levels are null if they are unknown: all of a method without levels, those of silence, and without the sensitivity
    of the microphones that in dB re 20 µPa.
    """
    from ertis_numba.units import sound_pressure_level_db

    sensitivity_dbfs = found.settings.array.sensitivity_dbfs
    offset_db = None if sensitivity_dbfs is None else sound_pressure_level_db(0.0, sensitivity_dbfs)
    rows = []
    for each in found.loudest():
        is_known = found.has_level and math.isfinite(each.level_dbfs)
        rows.append(
            {
                "band_hz": [round(edge_hz, 3) for edge_hz in each.band_hz],
                "azimuth_deg": round(math.degrees(each.azimuth_rad), 4),
                "elevation_deg": round(math.degrees(each.elevation_rad), 4),
                "level_dbfs": round(each.level_dbfs, 4) if is_known else None,
                "level_db": round(each.level_dbfs + offset_db, 4) if is_known and offset_db is not None else None,
            }
        )
    return rows
