"""HTML page of checks, without external resources; every text from files is escaped."""

import io
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Final

from ertis_numba import figures
from ertis_numba.base.atomic_files import atomic_write
from ertis_numba.base.errors import DataError, ErtisError
from ertis_numba.base.html_parts import escaped, picture, table
from ertis_numba.frames import Measurement
from ertis_numba.sensor_check.result import RecordingCheck, SensorCheck
from ertis_numba.storage import open_recording

__all__ = ["write_page"]

_STYLE: Final = """
:root { color-scheme: light dark; --ok: #1a7f37; --fault: #c62828; --unknown: #9a6700; }
body { font: 16px/1.5 system-ui, sans-serif; max-width: 50rem; margin: 0 auto; padding: 0.5rem 1rem 3rem; }
h1 { font-size: 1.4rem; } h2 { font-size: 1.2rem; margin-top: 2.5rem; } h3 { font-size: 1rem; }
h1, h2, h3, p, td { overflow-wrap: anywhere; }
.verdict { border-left: 0.4rem solid; padding: 0.6rem 0.8rem; font-weight: 600; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-size: 0.9rem; }
th, td { text-align: left; vertical-align: top; padding: 0.3rem 0.6rem 0.3rem 0; border-bottom: 1px solid #8884; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
td.result { white-space: nowrap; font-weight: 600; }
.ok { color: var(--ok); } .fault { color: var(--fault); } .unknown { color: var(--unknown); }
img { max-width: 100%; height: auto; background: white; }
@media (prefers-color-scheme: dark) { :root { --ok: #57ab5a; --fault: #ff8a80; --unknown: #e3b341; } }
"""
_POLICY: Final = "default-src 'none'; img-src data:; style-src 'unsafe-inline'"
_CLASSES: Final = {"ok": "ok", "fault": "fault", "not known": "unknown"}
_PLOTS: Final = {
    "Matched-filter output of each microphone": figures.matched_filter,
    "Signals and spectrogram": figures.signals,
}


def write_page(target: str | Path, checked: Iterable[RecordingCheck], *, overwrite: bool = False) -> Path:
    """Write one HTML page with all results, faults and remedies, and plots of one measurement of each sensor.

    The page needs no other file, no network and no script.

    Parameters
    ----------
    target : str or Path
        Path of the page.
    checked : iterable of RecordingCheck
        Results of `check_recording` and `uncheckable_recording`. The recordings are read again for the plots.
    overwrite : bool
        Replace an existing file.

    Returns
    -------
    Path
        The path.

    Raises
    ------
    ArgumentError
        The file exists, or cannot be written there.
    OSError
        The disk is full or not writable.

    Examples
    --------
    >>> from ertis_numba.sensor_check import check_recording, write_page
    >>> page = write_page("report.html", [check_recording("reflectors.h5")], overwrite=True)
    """
    target, checked = Path(target), list(checked)
    with atomic_write(target, overwrite=overwrite) as part:
        content = "".join(
            (
                "<!DOCTYPE html>\n<html lang=en><head><meta charset=utf-8>",
                "<meta name=viewport content='width=device-width, initial-scale=1'>",
                f'<meta http-equiv=Content-Security-Policy content="{_POLICY}">',
                f"<title>Sensor check</title><style>{_STYLE}</style></head><body><h1>Sensor check</h1>\n",
                *(_of_recording(each) for each in checked),
                "</body></html>\n",
            )
        )
        part.write_bytes(content.encode("utf-8", "backslashreplace"))  # File names may not be valid text.
    return target


def _of_recording(checked: RecordingCheck) -> str:
    state = "ok" if checked.is_fit else "fault"
    lines = [f"<section><h2>{escaped(checked.path.name)}</h2><p class='verdict {state}'>{escaped(checked.verdict)}</p>"]
    if checked.faults:
        rows = [[(escaped(fault.text), ""), (escaped(fault.remedy), "")] for fault in checked.faults]
        lines.append(table([("fault", ""), ("remedy", "")], rows))
    lines += [_of_sensor(checked.path, each) for each in checked.sensors]
    return "\n".join([*lines, "</section>\n"])


def _of_sensor(path: Path, checked: SensorCheck) -> str:
    about = (
        f"Layout {checked.settings.array.layout}, microphones: {checked.n_microphones}, measurements: "
        f"{checked.stored.measurements}, without a call: {checked.n_passive}, examined: {len(checked.examined)}"
    )
    rows = [
        [
            (escaped(item.check), ""),
            (escaped(item.result), f"result {_CLASSES[item.result]}"),
            (escaped(item.detail), ""),
        ]
        for item in checked.items
    ]
    lines = [
        f"<h3>Sensor {escaped(checked.sensor)}</h3><p>{escaped(about)}</p>",
        table([("check", ""), ("result", ""), ("details", "")], rows),
    ]
    if checked.health is not None:
        lines.append(f"<h3>Microphones of sensor {escaped(checked.sensor)}</h3>{_microphones(checked)}")
        if checked.health.not_observable:
            items = "".join(f"<li>{escaped(str(line))}</li>" for line in checked.health.not_observable)
            lines.append(f"<p>Not observable in this recording:</p><ul>{items}</ul>")
    return "\n".join([*lines, *_pictures(path, checked)])


def _microphones(checked: SensorCheck) -> str:
    """Return a table with a row for each microphone."""
    columns = [("channel", "number"), ("state", ""), ("level (dB)", "number"), ("noise (dBFS)", "number")]
    deviations = {}
    if checked.calibration is not None:
        columns += [("delay (µs)", "number"), ("gain (dB)", "number")]
        pairs = zip(checked.calibration.delay_s, checked.calibration.gain_db, strict=True)
        deviations = dict(zip(checked.calibration.channels, pairs, strict=True))
    rows = []
    for item in checked.health.channels if checked.health is not None else ():
        row = [
            (str(item.channel), "number"),
            (escaped(item.state), "ok" if item.state == "ok" else "fault"),
            (_number(item.level_db), "number"),
            (_number(item.noise_dbfs), "number"),
        ]
        if checked.calibration is not None:
            delay_s, gain_db = deviations.get(item.channel, (None, None))
            row += [(_number(None if delay_s is None else 1e6 * delay_s), "number"), (_number(gain_db), "number")]
        rows.append(row)
    return table(columns, rows)


def _pictures(path: Path, checked: SensorCheck) -> list[str]:
    """Return the plots of the first examined measurement as PNG within the page."""
    if not checked.examined:
        return []
    index = checked.examined[0]
    try:
        with open_recording(path, sensor=checked.sensor) as recording:
            measurement = replace(recording[index], settings=checked.settings)
    except (DataError, OSError) as error:  # The file may have changed since the check.
        return [f"<p>No plots: {escaped(str(error))}</p>"]
    names = list(_PLOTS)[measurement.stamp.behaviour == "passive" :]  # The matched filter is that of a call.
    return [_picture(name, measurement, index) for name in names]


def _picture(name: str, measurement: Measurement, index: int) -> str:
    content = io.BytesIO()
    try:
        # A narrow page has one column, which is readable on a phone.
        figures.save(_PLOTS[name](measurement, theme="paper", columns=1), content, format="png")
    except ErtisError as error:  # Short records, for example, have no echoes to plot.
        return f"<p>{name}: {escaped(str(error))}</p>"
    title = f"{name}, measurement {index}"
    return f"<h3>{title}</h3>{picture(content.getvalue(), title)}"


def _number(value: float | None) -> str:
    return "–" if value is None else f"{round(value, 1) + 0.0:.1f}"  # Adding 0.0 turns -0.0 into 0.0.
