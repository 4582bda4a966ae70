"""``ertis info``: what a file holds."""

from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from ertis_cli import options

if TYPE_CHECKING:
    from ertis_numba.storage import EnergyscapeReader, RecordingReader

__all__ = ["info"]


@click.command()
@options.input_file("FILE")
@options.as_json
def info(*, path: Path, as_json: bool) -> None:
    """Say what a recording or an energyscape file holds.

    In JSON, "sensors" lists what each sensor has; if there is one only, the same also stands beside
    what is said of the file.
    """
    from ertis_numba.storage import file_kind, open_energyscapes, open_recording

    kind = file_kind(path)
    about: dict[str, Any] = {}
    sections: list[dict[str, Any]] = []
    reader: RecordingReader | EnergyscapeReader
    for name in options.sensors_of(path, None):
        if kind == "recording":
            with open_recording(path, sensor=name) as reader:
                about = _file(reader)
                sections.append({**_sensor(reader), **_recording(reader)})
        else:
            with open_energyscapes(path, sensor=name) as reader:
                about = {**_file(reader), **_origin(reader)}
                sections.append({**_sensor(reader), **_energyscapes(reader)})
    flat = [{**about, **sections[0]}] if len(sections) == 1 else [about, *sections]
    if as_json:
        options.print_json({**flat[0], "sensors": sections})
        return
    width = max(len(name) for section in flat for name in section)
    for index, section in enumerate(flat):
        if index:
            click.echo()
        for name, value in section.items():
            click.echo(f"{name.replace('_', ' '):{width}}  {value}")


def _file(reader: "RecordingReader | EnergyscapeReader") -> dict[str, Any]:
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


def _origin(reader: "EnergyscapeReader") -> dict[str, Any]:
    return {name: reader.attributes.get(name, "") for name in ("recording_uuid", "recording_sha256")}


def _sensor(reader: "RecordingReader | EnergyscapeReader") -> dict[str, Any]:
    settings = reader.settings
    return {
        "sensor": reader.sensor,
        "measurements": len(reader),
        "layout": settings.array.layout,
        "microphones": sum(settings.array.enabled or ()) or len(settings.array.positions_m or ()),
        "call_khz": [settings.call.start_frequency_hz / 1e3, settings.call.stop_frequency_hz / 1e3],
        "temperature_c": settings.air.temperature_c,
        "simulated": reader.truth is not None,
    }


def _recording(reader: "RecordingReader") -> dict[str, Any]:
    stamps = reader.stamps()
    recording = reader.settings.recording
    return {
        "samples": recording.n_samples,
        "pdm_rate_hz": recording.pdm_rate_hz,
        "duration_ms": round(1000 * recording.duration_s, 3),
        "first": _iso(stamps[0].timestamp_ns),
        "last": _iso(stamps[-1].timestamp_ns),
        "missing": sum(gap.last - gap.first + 1 for gap in reader.gaps),
        "translation_m": reader.translation_m.tolist(),
        "rotation_xyzw": reader.rotation_xyzw.tolist(),
    }


def _energyscapes(reader: "EnergyscapeReader") -> dict[str, Any]:
    return {
        "directions": len(reader.azimuth_rad),
        "ranges": len(reader.range_m),
        "range_m": [round(float(reader.range_m[index]), 4) for index in (0, -1)],
        "method": reader.settings.processing.method,
    }


def _iso(time_ns: int) -> str | None:
    """Return a time as ISO 8601; none is known where the record says 0."""
    if not time_ns:
        return None
    second = datetime.fromtimestamp(time_ns // 10**9, UTC)
    return f"{second:%Y-%m-%dT%H:%M:%S}.{time_ns % 10**9:09d}Z"
