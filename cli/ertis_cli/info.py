"""``ertis info``: contents of a file."""

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import _tables, options
from ertis_cli._overview import files_of, overview

if TYPE_CHECKING:
    from ertis_numba.analysis.health import Health
    from ertis_numba.storage import AcousticMapReader, EnergyscapeReader, RecordingReader

    _Reader = RecordingReader | EnergyscapeReader | AcousticMapReader

__all__ = ["info"]

_TIME = re.compile(r"(\d{4}-\d\d-\d\d)T(\d\d:\d\d:\d\d)(\.\d+)?(?:Z|\+00:00)")
_MAX_EXAMINED = 8
_WIDTH = 7  # minimum width of a column
_COLUMNS = {  # name: digits in the report, and in the table
    "offset": (6, 4),
    "changes": (6, 3),
    "overload": (6, 4),
    "level_db": (2, 1),
    "noise_dbfs": (2, 1),
    "tone_hz": (1, 0),
    "tone_db": (2, 1),
}


@click.command()
@options.input_files("FILE|DIR...")
@click.option(
    "--health", "of_health", is_flag=True, help="Show array health, the state of each microphone of a recording."
)
@options.as_json
@click.pass_context
def info(ctx: click.Context, *, paths: tuple[Path, ...], of_health: bool, as_json: bool) -> None:
    """Show the contents of recordings, image files or maps.

    For several files or a folder, which includes its subfolders, show one line per file; the exit code is 1 if a file
    cannot be read.

    In JSON, "sensors" lists the properties of each sensor. If there is only one sensor, the top level repeats its
    properties. For several files, "files" lists one report per file.

    With --health, show the state of each microphone of a recording: ok, dead, stuck, saturated, or with an offset or an
    idle tone. At most 8 measurements, evenly spaced, are examined. The exit code is 0 even if faults are found;
    'ertis sensors check' states whether the sensor is fit for use.
    """
    path, *others = paths
    if of_health and (others or path.is_dir()):
        raise click.UsageError("--health examines one recording; choose one file", ctx=ctx)
    if of_health:
        _report_health(path, as_json=as_json)
        return
    if others or path.is_dir():
        ctx.exit(overview(files_of(paths), _contents, as_json=as_json))
    about, sections = _contents(path)
    flat = [{**about, **sections[0]}] if len(sections) == 1 else [about, *sections]
    if as_json:
        options.print_json({**flat[0], "sensors": sections})
        return
    width = max(len(_label(name)[0]) for section in flat for name in section)
    for index, section in enumerate(flat):
        if index:
            click.echo()
        for name, value in section.items():
            label, unit = _label(name)
            shown = "none (passive)" if name == "call_khz" and value is None else f"{_readable(value)}{unit}"
            click.echo(f"{label:{width}}  {shown}")


def _contents(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the properties of a file, and those of each sensor."""
    from ertis_numba.storage import is_map

    return (_map(path), []) if is_map(path) else _by_sensor(path)


def _by_sensor(path: Path) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Return the properties of a recording or of its results, and those of each sensor."""
    from ertis_numba.storage import file_kind, open_acoustic_maps, open_energyscapes, open_recording

    kind = file_kind(path)
    about: dict[str, Any] = {}
    sections: list[dict[str, Any]] = []
    reader: _Reader
    for name in options.sensors_of(path, None):
        if kind == "recording":
            with open_recording(path, sensor=name) as reader:
                about = _file(reader)
                sections.append({**_sensor(reader), **_recording(reader)})
        elif kind == "acoustic_map":
            with open_acoustic_maps(path, sensor=name) as reader:
                about = {**_file(reader), **_origin(reader)}
                sections.append({**_sensor(reader), **_maps_of_sound(reader)})
        else:
            with open_energyscapes(path, sensor=name) as reader:
                about = {**_file(reader), **_origin(reader)}
                sections.append({**_sensor(reader), **_energyscapes(reader)})
    return about, sections


def _map(path: Path) -> dict[str, Any]:
    """Return the properties of an occupancy map."""
    from ertis_numba.frames import Stamp
    from ertis_numba.storage import read_map

    found = read_map(path)
    return {
        "file": str(path),
        "kind": "occupancy_map",
        "bytes": path.stat().st_size,
        "pulses": found.n_groups,
        "last": Stamp(timestamp_ns=found.time_ns).iso,
        "cell_m": found.cell_m,
        "cells": list(found.log_odds.shape[::-1]),
        "origin_m": [round(edge_m, 6) for edge_m in found.origin_m],
        "size_m": [round(high_m - low_m, 6) for low_m, high_m in found.limits_m],
        "occupied": int(found.is_occupied.sum()),
        "free": int(found.is_free.sum()),
    }


def _label(name: str) -> tuple[str, str]:
    """Return a key as a label, and its unit after a space."""
    from ertis_numba.base.units import unit_of

    suffix, unit = unit_of(name)
    return name.removesuffix(suffix).replace("_", " "), f" {unit}" if unit else ""


def _readable(value: Any) -> str:
    """Format a value for display: lists without brackets, counts of names, times in UTC to the millisecond."""
    if value is None:
        return "unknown"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list):
        return ", ".join(map(_readable, value))
    if isinstance(value, dict):
        return ", ".join(f"{count} {_printable(str(name))}" for name, count in value.items())
    time = _TIME.fullmatch(value) if isinstance(value, str) else None
    return f"{time[1]} {time[2]}{(time[3] or '')[:4]} UTC" if time else _printable(str(value))


def _printable(text: str) -> str:
    """Return a text of a file with escapes for control characters, which a terminal would obey."""
    return "".join(each if each.isprintable() else each.encode("unicode_escape").decode() for each in text)


def _file(reader: "_Reader") -> dict[str, Any]:
    attributes = reader.attributes
    return {
        "file": str(reader.path),
        "kind": attributes["ertis_format"],
        "format_version": attributes["ertis_format_version"],
        "bytes": reader.path.stat().st_size,
        "uuid": reader.uuid,
        "date_created": attributes.get("date_created", ""),
        "source": attributes.get("source", ""),
    }


def _origin(reader: "EnergyscapeReader | AcousticMapReader") -> dict[str, Any]:
    return {name: reader.attributes.get(name, "") for name in ("recording_uuid", "recording_sha256")}


def _sensor(reader: "_Reader") -> dict[str, Any]:
    from ertis_numba.geometry import microphones
    from ertis_numba.geometry.air import sound_speed_m_s

    settings = reader.settings
    return {
        "sensor": reader.sensor,
        "measurements": len(reader),
        "layout": settings.array.layout,
        "microphones": int(microphones(settings.array).enabled.sum()),
        **({"disabled": list(settings.array.disabled)} if settings.array.disabled else {}),
        "call_khz": _call_khz(reader),
        "temperature_c": settings.air.temperature_c,
        "humidity_percent": settings.air.humidity_percent,
        "sound_speed_m_s": round(sound_speed_m_s(settings.air), 2),
        **({} if reader.attributes["ertis_format"] == "acoustic_map" else {"simulated": reader.truth is not None}),
    }


def _call_khz(reader: "_Reader") -> list[float] | None:
    """Return the frequencies of the emitted call; None if no measurement has one."""
    call = reader.settings.call
    return None if _is_passive(reader) else [call.start_frequency_hz / 1e3, call.stop_frequency_hz / 1e3]


def _is_passive(reader: "_Reader") -> bool:
    """Return True if no call was emitted for any measurement."""
    stamps = reader.stamps()
    return bool(stamps) and all(stamp.behaviour == "passive" for stamp in stamps)


def _recording(reader: "RecordingReader") -> dict[str, Any]:
    stamps = reader.stamps()
    recording, processing = reader.settings.recording, reader.settings.processing
    return {
        "encoding": recording.encoding,
        "samples": recording.n_samples,
        "sample_rate_hz": recording.sample_rate_hz,
        "duration_ms": round(1000 * recording.duration_s, 3),
        **({} if processing.mode == "passive" or _is_passive(reader) else {"range_m": list(processing.range_m)}),
        "first": stamps[0].iso,
        "last": stamps[-1].iso,
        "behaviour": dict(Counter(stamp.behaviour for stamp in stamps)),
        "missing": sum(gap.n_missing for gap in reader.gaps),
        **({"firmware": reader.firmware} if reader.firmware else {}),
        **_placement(reader),
    }


def _energyscapes(reader: "EnergyscapeReader") -> dict[str, Any]:
    processing = reader.settings.processing
    return {
        "directions": len(reader.azimuth_rad),
        "ranges": len(reader.range_m),
        "range_m": [round(float(reader.range_m[index]), 4) for index in (0, -1)],
        "method": processing.method,
        "beamformer": processing.beamformer,
        "weighting": processing.weighting,
        **_placement(reader),
        **_error(reader),
        **({"call_warning": reader.call_warning} if reader.call_warning else {}),
        **({"start_warning": reader.start_warning} if reader.start_warning else {}),
        **({"layout_warning": reader.layout_warning} if reader.layout_warning else {}),
        **({"samples_warning": reader.samples_warning} if reader.samples_warning else {}),
    }


def _maps_of_sound(reader: "AcousticMapReader") -> dict[str, Any]:
    passive = reader.settings.passive
    return {
        "measurements": int(reader.n_measurements.sum()),
        "maps": len(reader),
        "directions": len(reader.azimuth_rad),
        "bands": len(reader.band_hz),
        "band_hz": [round(float(edge_hz), 1) for edge_hz in (reader.band_hz.min(), reader.band_hz.max())],
        "method": passive.method,
        "averages": passive.averages,
        **({"band_note": reader.band_note} if reader.band_note else {}),
        **({} if passive.focus_m is None else {"focus_m": passive.focus_m}),
        **_placement(reader),
    }


def _placement(reader: "_Reader") -> dict[str, Any]:
    """Return the mounting of the sensor, and a summary of the platform's poses."""
    from ertis_numba.frames.pose_doubts import pose_doubts

    found: dict[str, Any] = {"mounting": "unknown"}
    if reader.translation_m is not None and reader.rotation_xyzw is not None:
        found = {"translation_m": reader.translation_m.tolist(), "rotation_xyzw": reader.rotation_xyzw.tolist()}
    if reader.trajectory is None:
        return found | {"poses": 0}
    note = "; ".join(pose_doubts(reader.trajectory))
    return found | {
        "poses": len(reader.trajectory),
        "poses_source": reader.trajectory.source or "unknown",
        "path_length_m": round(reader.trajectory.length_m, 3),
        **({"pose_warning": note} if note else {}),
    }


def _error(reader: "EnergyscapeReader") -> dict[str, Any]:
    """Return the step of rounded levels, and the predicted error and the error budget, if the file contains them."""
    from ertis_numba.frames.level_codes import rounding_db

    step_db = reader.level_step_db
    rounded = {"level_step_db": step_db, "rounding_error_db": round(rounding_db(step_db), 2)} if step_db else {}
    if reader.predicted_error_db is None:
        return rounded
    texts = {name: getattr(reader, name) for name in ("budget_applies_to", "error_warning")}
    return {
        "predicted_error_db": reader.predicted_error_db,
        "max_error_db": reader.max_error_db,
        **{name: text for name, text in texts.items() if text},
        **rounded,
    }


def _report_health(path: Path, *, as_json: bool) -> None:
    """Print the state of the microphones of each sensor."""
    from ertis_numba.analysis.health import health, merge
    from ertis_numba.storage import open_recording

    sections: list[dict[str, Any]] = []
    for name in options.sensors_of(path, None):
        with open_recording(path, sensor=name) as recording:
            last = len(recording) - 1
            examined = sorted({round(last * step / (_MAX_EXAMINED - 1)) for step in range(_MAX_EXAMINED)})
            report = merge([health(recording[index]) for index in examined])
            sections.append({"sensor": name, "measurements": last + 1, **_health(report)})
    if as_json:
        options.print_json({"file": str(path), "sensors": sections})
        return
    for index, section in enumerate(sections):
        if index:
            click.echo()
        for line in _health_lines(section):
            click.echo(line)
        _microphones(section).print()
        for line in _finding_lines(section):
            click.echo(line)


def _health(report: "Health") -> dict[str, Any]:
    return {
        "examined": report.measurements,
        "has_call": report.has_call,
        "verdict": report.verdict(),
        "faults": report.faults,
        "noise_dbfs": _rounded(report.noise_dbfs, 2),
        "dynamic_range_db": _rounded(report.dynamic_range_db, 2),
        "tones_hz": [round(tone_hz, 1) for tone_hz in report.tones_hz],
        "unknown": report.unknown,
        "not_observable": tuple(map(str, report.not_observable)),
        "findings": [
            {**asdict(item), "measured": _rounded(item.measured, 3), "unit": item.unit, "remedy": item.remedy}
            for item in report.findings
        ],
        "channels": [
            {**asdict(item), "state": item.state}
            | {name: _rounded(getattr(item, name), digits) for name, (digits, _) in _COLUMNS.items()}
            for item in report.channels
        ],
    }


def _health_lines(section: dict[str, Any]) -> Iterator[str]:
    """Yield the properties of an array."""
    yield f"sensor         {section['sensor']}"
    yield f"measurements   {section['measurements']}, of which {section['examined']} examined"
    band = "call's band" if section["has_call"] else "bands of acoustic maps"
    yield f"noise          {_cell(section['noise_dbfs'], 1)} dBFS in the {band}"
    if section["has_call"]:
        yield f"dynamic range  {_cell(section['dynamic_range_db'], 1)} dB"
    if section["tones_hz"]:
        yield f"common tones   {', '.join(f'{tone_hz / 1000:.1f}' for tone_hz in section['tones_hz'])} kHz"
    for text in section["unknown"]:
        yield f"cannot tell    {text}"


def _finding_lines(section: dict[str, Any]) -> Iterator[str]:
    """Yield each finding with its figures and remedy, and the faults that the scene does not show."""
    for text in section["not_observable"]:
        yield f"not observable {text}"
    for item in section["findings"]:
        channels = "record" if len(item["channels"]) != 1 else f"channel {item['channels'][0]}"
        figures = f"{item['measured']:g} {item['unit']}".strip()
        limit = f"limit {item['limit']:.3g} {item['unit']}".strip()
        detail = f"; {item['detail']}" if item["detail"] else ""
        yield f"fault          {channels}: {item['fault']}, {figures} ({limit}){detail}; {item['remedy']}"
    yield f"verdict        {section['verdict']}"


def _microphones(section: dict[str, Any]) -> _tables.TextTable:
    """Return a row for each microphone of an array."""
    columns: dict[str, _tables.Side] = {"channel": "right", "state": "left"}
    columns |= dict.fromkeys([name.rjust(_WIDTH) for name in _COLUMNS], "right")
    rows = [
        (str(row["channel"]), row["state"], *(_cell(row[name], digits) for name, (_, digits) in _COLUMNS.items()))
        for row in section["channels"]
    ]
    return _tables.TextTable(columns, rows, {state: "green" if state == "ok" else "red" for _, state, *_ in rows})


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None else round(value, digits) + 0.0  # which turns -0.0 into 0.0


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{_rounded(value, digits):.{digits}f}"
