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
    """Say what a recording or an energyscape file holds."""
    from ertis_numba.storage import file_kind, open_energyscapes, open_recording

    reader: RecordingReader | EnergyscapeReader
    if file_kind(path) == "recording":
        with open_recording(path) as reader:
            report = {**_common(reader), **_recording(reader)}
    else:
        with open_energyscapes(path) as reader:
            report = {**_common(reader), **_energyscapes(reader)}
    if as_json:
        options.print_json(report)
        return
    width = max(map(len, report))
    for name, value in report.items():
        click.echo(f"{name.replace('_', ' '):{width}}  {value}")


def _common(reader: "RecordingReader | EnergyscapeReader") -> dict[str, Any]:
    settings, attributes = reader.settings, reader.attributes
    return {
        "file": str(reader.path),
        "kind": attributes["ertis_format"],
        "format_version": attributes["ertis_format_version"],
        "bytes": reader.path.stat().st_size,
        "uuid": reader.uuid,
        "date_created": attributes.get("date_created", ""),
        "source": attributes.get("source", ""),
        "sensor": reader.sensor,
        "measurements": len(reader),
        "layout": settings.array.layout,
        "microphones": sum(settings.array.enabled or ()) or len(settings.array.positions_m or ()),
        "call_khz": [settings.call.start_frequency_hz / 1e3, settings.call.stop_frequency_hz / 1e3],
        "temperature_c": settings.air.temperature_c,
    }


def _recording(reader: "RecordingReader") -> dict[str, Any]:
    first_ns, last_ns = (reader[index].stamp.timestamp_ns for index in (0, -1))
    recording = reader.settings.recording
    return {
        "samples": recording.n_samples,
        "pdm_rate_hz": recording.pdm_rate_hz,
        "duration_ms": round(1000 * recording.duration_s, 3),
        "first": _iso(first_ns),
        "last": _iso(last_ns),
        "missing": sum(gap.last - gap.first + 1 for gap in reader.gaps),
        "simulated": reader.truth is not None,
    }


def _energyscapes(reader: "EnergyscapeReader") -> dict[str, Any]:
    return {
        "directions": len(reader.azimuth_rad),
        "ranges": len(reader.range_m),
        "range_m": [round(float(reader.range_m[index]), 4) for index in (0, -1)],
        "method": reader.settings.processing.method,
        "recording_uuid": reader.attributes.get("recording_uuid", ""),
        "recording_sha256": reader.attributes.get("recording_sha256", ""),
    }


def _iso(time_ns: int) -> str | None:
    """Return a time as ISO 8601; none is known where the record says 0."""
    if not time_ns:
        return None
    second = datetime.fromtimestamp(time_ns // 10**9, UTC)
    return f"{second:%Y-%m-%dT%H:%M:%S}.{time_ns % 10**9:09d}Z"
