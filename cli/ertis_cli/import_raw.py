"""``ertis import signals``: import raw PDM data or PCM into a recording."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _image_options, options
from ertis_cli._config import typed

if TYPE_CHECKING:
    from ertis_numba.interop import PcmReader, RawReader
    from ertis_numba.settings import Settings

__all__ = ["import_raw"]

_END_NS = 2**63  # in the year 2262
_PCM = {".wav", ".h5", ".hdf5", ".hdf"}
_RAW = {".bin", ".dat", ".pdm", ".raw"}
_WAV = {".wav", ".wave"}
_UNSTATED_M = (0.0, 0.0)  # range_m before a settings file is read


class _Time(click.DateTime):
    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        try:
            return super().convert(str(value).strip().replace(" ", "T", 1), param, ctx)
        except click.BadParameter:
            example = "year, month and day first, as in 2026-05-04T12:30 or 2026-05-04T12:30:00.5+02:00"
            self.fail(f"{value!r} is not a date with a time; write {example}", param, ctx)


@click.command("signals")
@options.input_files("FILE...", name="raw")
@options.output("Recording to write; FILE.h5 beside the first file or the folder by default.")
@click.option(
    "--layout",
    metavar="NAME",
    shell_complete=options.complete_layouts,
    help="Name of a shipped layout, or a layout file such as .csv or .toml; not needed if a folder contains it.",
)
@click.option(
    "--preset",
    metavar="NAME",
    shell_complete=_image_options.preset_completion("recording"),
    help="Record length (short_, default_, long_) and band (20_80, 25_50); not needed if a folder contains settings.",
)
@click.option(
    "--settings",
    "settings_file",
    metavar="FILE.toml",
    type=options.FILE,
    help="Settings that differ from those of an eRTIS, such as array and call; --layout and air options override it.",
)
@click.option(
    "--skip", "skip_s", type=click.FloatRange(min=0), metavar="S", help="PCM: start of the first emission in the file."
)
@click.option(
    "--length",
    "length_s",
    type=click.FloatRange(min=0, min_open=True),
    metavar="S",
    help="PCM: time between emissions, if a file contains several; by default, a file is one measurement.",
)
@click.option(
    "--start",
    metavar="TIME",
    multiple=True,
    type=_Time([f"%Y-%m-%dT%H:%M{rest}{zone}" for rest in ("", ":%S", ":%S.%f") for zone in ("", "%z")]),
    help="PCM: time of the first emission, such as 2026-05-04T12:30 or 2026-05-04T12:30:00.5+02:00; UTC unless it has "
    "an offset. Use it once for the first file, or once per file. By default, from the metadata or names of the files.",
)
@click.option("--passive", is_flag=True, help="PCM: no call was emitted, so the settings need no call.")
@click.option(
    "--join", is_flag=True, help="PCM: join files of single microphones, listed in the order of the channels."
)
@click.option(
    "--time-expansion",
    type=click.FloatRange(min=0, min_open=True),
    metavar="FACTOR",
    help="PCM: factor by which the files play slower than the sound, such as 10; from their metadata by default.",
)
@click.option(
    "--sync-channel",
    type=click.IntRange(min=0),
    metavar="N",
    help="PCM: channel, counted from 0, that recorded the emitted call or its trigger. Measurements begin at these "
    "emissions; the channel itself is not imported.",
)
@click.option("--raw", "is_raw", is_flag=True, help="Read files as raw eRTIS words, whatever their content and ending.")
@click.option("--sensor", metavar="NAME", default="sensor", show_default=True, help="Name of the sensor.")
@click.option("--temperature", type=float, metavar="C", help="Air temperature in °C; 20 by default.")
@click.option("--humidity", type=float, metavar="PCT", help="Relative humidity in percent; 50 by default.")
@options.force
@options.quiet
@options.as_json
def import_raw(
    *,
    raw: tuple[Path, ...],
    target: Path | None,
    layout: str | None,
    preset: str | None,
    settings_file: Path | None,
    is_raw: bool,
    sensor: str,
    temperature: float | None,
    humidity: float | None,
    force: bool,
    quiet: bool,
    as_json: bool,
    **of_pcm: Any,
) -> None:
    """Import raw eRTIS data or PCM into a recording.

    Raw data are little-endian words without a header, one measurement after the other. The layout and the preset
    supply the missing information; a preset names the length of a measurement and the band of the call in kHz. A
    settings file can supply all of it instead. The recording then contains these settings.

    Instead of files, a folder of a program based on RTIS Dev can be imported. It contains NAME<number>.bin
    for each measurement, and the settings of recording and processing as JSON.

    Names of raw files end in .bin, .raw, .dat or .pdm; other endings need --raw. All other formats are recognized by
    their content.

    WAV files contain multichannel PCM, as do .h5 files with the time_data of Acoular. Their channels are
    the rows of the layout, and their sample rate becomes that of the recording. With --passive, the files
    contain sound without a call, for acoustic maps. A folder of .wav files is imported in the order of the recording
    times. Notes report the source of the times, and everything that was assumed or left out.
    """
    from ertis_numba.interop.pcm_folder import is_wav_folder
    from ertis_numba.storage import check_target, write_recording

    folder = _folder(raw)
    if target is None:
        target = _beside(raw[0]) if folder is None else Path(f"{folder.resolve()}.h5")
    check_target(target, overwrite=force, sources=raw)
    are_pcm = [_is_pcm(path, is_raw=is_raw) for path in raw] if folder is None else [is_wav_folder(folder)]
    is_pcm = all(are_pcm)
    if folder is None:
        _require_content(raw)
    if not is_pcm and any(are_pcm):
        raise click.UsageError(
            "some files are PCM (.wav, .h5) and others are raw data; import each kind separately",
            click.get_current_context(),
        )
    for name in of_pcm:
        if typed(name) and not is_pcm:
            option = f"--{name.removesuffix('_s').replace('_', '-')}"
            raise click.UsageError(
                f"{option} is for PCM (.wav, .h5), but {raw[0]} contains raw words; remove {option}, or choose another "
                "file",
                click.get_current_context(),
            )
    given = {"temperature_c": temperature, "humidity_percent": humidity}
    air = {name: value for name, value in given.items() if value is not None}
    measurements: PcmReader | RawReader
    if is_pcm:
        of_pcm["start_ns"] = [_since_1970_ns(each) for each in of_pcm.pop("start")]
        of_pcm |= {"sensor": sensor, "air": air, "skip_s": of_pcm["skip_s"] or 0.0}
        measurements = _opened_pcm(raw, layout, preset, settings_file, of_pcm)
    else:
        measurements = _opened_raw(raw, folder, layout, preset, settings_file, sensor, check_kind=not is_raw)
        settings = measurements.settings
        measurements.settings = settings.replace(air=settings.air.replace(**air))
    source = ", ".join(path.name for path in raw)
    with options.progress(measurements, length=len(measurements), label="importing", quiet=quiet) as shown:
        write_recording(target, shown, overwrite=force, source=source)
    options.say(f"{target}: {options.counted(len(measurements), 'measurement')}", quiet=quiet)
    notes = getattr(measurements, "notes", ())
    for note in notes:
        options.note(note, quiet=quiet)
    _report_obstacle(measurements.settings, quiet=quiet)
    if as_json:
        options.print_json({"output": str(target), "measurements": len(measurements), "notes": list(notes)})


def _folder(raw: tuple[Path, ...]) -> Path | None:
    """Return the folder to import, if any; refuse folders without measurements, and folders beside other files."""
    several = [path for path in raw if path.is_dir()]
    if several and len(raw) > 1:
        raise click.UsageError(
            f"{several[0]} is a folder; import one folder at a time, or list its files", click.get_current_context()
        )
    if not several:
        return None
    found_suffixes = {path.suffix.lower() for path in raw[0].iterdir() if not path.name.startswith(".")}
    if ".bin" in found_suffixes and found_suffixes & _WAV:
        raise click.UsageError(
            f"{raw[0]} contains .wav and .bin files; list those of one kind instead of the folder",
            click.get_current_context(),
        )
    if found_suffixes & {".bin", *_WAV}:
        return several[0]
    inner = [path for path in sorted(raw[0].iterdir()) if path.is_dir()]
    found = next((each for each in inner if any(path.suffix.lower() in _WAV for path in each.iterdir())), None)
    remedy = f"import {found}" if found else "choose a folder with .wav files, or with .bin files of RTIS Dev"
    raise click.UsageError(f"{raw[0]} contains no files to import; {remedy}", click.get_current_context())


def _is_pcm(path: Path, *, is_raw: bool) -> bool:
    """Return True for PCM by the content of a file, otherwise by its ending; refuse other formats and endings."""
    from ertis_numba.base.errors import DataError
    from ertis_numba.base.file_kinds import kind_of, problem_of

    kind, suffix = None if is_raw else kind_of(path), path.suffix.lower()
    if kind is not None and not (kind.is_wav or kind.is_hdf5):
        raise DataError(f"{path} {problem_of(path)}; if the file contains raw words nevertheless, use --raw")
    if is_raw or kind is not None or suffix in _PCM:
        return not is_raw
    if suffix not in _RAW and path.is_file():
        raise click.UsageError(
            f"{path} has unknown content and an unknown ending; use --raw if the file contains raw eRTIS words without "
            f"a header, like {', '.join(sorted(_RAW))}",
            click.get_current_context(),
        )
    return False


def _require_content(paths: tuple[Path, ...]) -> None:
    """Refuse missing and empty files, before anything is said about options."""
    from ertis_numba.base.errors import DataError

    for path in paths:
        try:
            n_bytes = path.stat().st_size
        except OSError as error:
            raise DataError(f"{path}: {error.strerror}; choose a file with measurements") from error
        if n_bytes == 0:
            raise DataError(f"{path} is empty; record or copy it again, or leave it out")


def _beside(first: Path) -> Path:
    """Return the default name of the recording."""
    if first.suffix.lower() == ".h5":
        raise click.UsageError(
            f"{first} cannot become a recording of the same name; choose another name with --output",
            click.get_current_context(),
        )
    return first.with_suffix(".h5")


def _opened_raw(
    raw: tuple[Path, ...],
    folder: Path | None,
    layout: str | None,
    preset: str | None,
    settings_file: Path | None,
    sensor: str,
    *,
    check_kind: bool,
) -> "RawReader":
    from ertis_numba.interop import open_raw, open_rtis_folder

    if folder is not None:
        if typed("settings_file"):
            raise click.UsageError(
                "--settings is for files, but a folder contains its own settings; remove --settings",
                click.get_current_context(),
            )
        return open_rtis_folder(folder, layout=layout, preset=preset, sensor=sensor)
    if settings_file is None and (layout is None or preset is None):
        _require("--layout" if layout is None else "--preset")
    return open_raw(raw, _settings(layout, preset, settings_file), sensor=sensor, check_kind=check_kind)


def _opened_pcm(
    raw: tuple[Path, ...],
    layout: str | None,
    preset: str | None,
    settings_file: Path | None,
    given: dict[str, Any],
) -> "PcmReader":
    from ertis_numba.interop import open_pcm

    settings = whole_range = None
    if any(part is not None for part in (layout, preset, settings_file)):
        if settings_file is None and (layout is None or not (preset or given["passive"])):
            _require_samples(raw[0])
        if settings_file is None and layout is None:
            _require("--layout")
        if settings_file is None and preset is None and not given["passive"]:
            raise click.UsageError(
                f"the call in {raw[0]} is unknown; use --passive if none was emitted, otherwise --settings with the "
                "call or --preset",
                click.get_current_context(),
            )
        settings = _settings(layout, preset, settings_file, {"processing.range_m": _UNSTATED_M})
        whole_range = settings.processing.range_m == _UNSTATED_M
    elif raw[0].is_dir() or raw[0].suffix.lower() not in _PCM - {".wav"}:
        _require_samples(raw[0])
        _require("--layout" if given["passive"] else "--settings")
    return open_pcm(raw, settings, whole_range=whole_range, **given)


def _require_samples(path: Path) -> None:
    """Refuse a file without usable samples, before anything is said about options."""
    from ertis_numba.interop.pcm_files import inspect

    if path.is_file():
        inspect(path).open().channel(0, slice(0, 1))


def _since_1970_ns(start: datetime) -> int:
    given = start if start.tzinfo else start.replace(tzinfo=UTC)
    since_1970_ns = (given - datetime.fromtimestamp(0, UTC)) // timedelta(microseconds=1) * 1000
    if not 0 <= since_1970_ns < _END_NS:
        raise click.BadParameter(
            f"{given.isoformat()} is outside the range of a recording; use a time from 1970 to 2262",
            param_hint="'--start'",
        )
    return since_1970_ns


def _report_obstacle(settings: "Settings", *, quiet: bool) -> None:
    """Print a note if the recording cannot be processed with its own settings."""
    from ertis_numba.base.errors import ArgumentError
    from ertis_numba.chain.time_window import time_window
    from ertis_numba.geometry import direction_grid
    from ertis_numba.passive.heard_signals import heard_bands

    try:
        direction_grid(settings.processing)
        if settings.processing.mode == "passive":
            heard_bands(settings)
        else:
            time_window(settings, largest_delay_s=0.0, n_taps=1)
    except ArgumentError as error:
        options.note(f"this recording cannot be processed with its own settings: {error}", quiet=quiet)


def _require(option: str) -> None:
    raise click.MissingParameter(ctx=click.get_current_context(), param_hint=f"'{option}'", param_type="option")


def _settings(
    layout: str | None, preset: str | None, settings_file: Path | None, changes: dict[str, Any] | None = None
) -> "Settings":
    """Return the settings from preset, changes of it, settings file and options."""
    from ertis_numba.settings import Array, Settings

    settings = Settings() if preset is None else Settings.from_preset(preset)
    for name, value in (changes or {}).items():
        settings = settings.replace(name, value)
    settings = options.settings_with(settings, settings_file=settings_file)
    if layout is not None:
        settings = settings.replace(array=Array(layout=layout))
        options.note_layout(settings.array)
    return settings
