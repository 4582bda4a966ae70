"""Check of a recording: every check of every sensor, and the faults."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from ertis_numba.analysis.call_match import first_call_match
from ertis_numba.analysis.emission_time import describe_start, emissions_of
from ertis_numba.analysis.health import Health, health, merge
from ertis_numba.base import checks
from ertis_numba.base.atomic_files import remedy
from ertis_numba.base.errors import ArgumentError, DataError, ErtisError
from ertis_numba.calibration import OtherLayoutError
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.passive.heard_signals import heard_bands
from ertis_numba.passive.outside_bands import OutsideBands
from ertis_numba.sensor_check import items
from ertis_numba.sensor_check.clock import check_clock
from ertis_numba.sensor_check.lost_words import find_lost_words
from ertis_numba.sensor_check.residuals import CalibrationResiduals, calibration_residuals
from ertis_numba.sensor_check.result import CheckFault, CheckItem, RecordingCheck, SensorCheck
from ertis_numba.settings import ExcludedChannels, Settings
from ertis_numba.storage import file_kind, open_recording, sensor_names
from ertis_numba.storage.verify import SensorReport, verify

__all__ = ["check_recording", "uncheckable_recording"]

_MAX_EXAMINED: Final = 8
_CALIBRATED: Final = frozenset({"gain", "inverted polarity", "late", "swapped"})
"""Faults with which the sound of a channel can still be compared with the others."""
_MAX_BITS_EXAMINED: Final = 64  # Takes 7 ms for each measurement of 163,840 words.


def check_recording(
    path: str | Path,
    *,
    settings: Callable[[Settings], Settings] | None = None,
    without: ExcludedChannels | None = None,
    nominal_rate_hz: float | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> RecordingCheck:
    """Check whether the sensors of a recording are fit for use.

    At most 8 intact measurements of each sensor, evenly spaced, are examined for faulty microphones, noise, the call
    and the calibration, and at most 64 for lost words. Measurements without a call are examined only if there are no
    others; the call and the calibration are then not known. Checksums, sequence numbers and time stamps of all
    measurements are checked.

    Parameters
    ----------
    path : str or Path
        Path of the recording.
    settings : callable, optional
        Function that takes the settings of a sensor and returns those in use, such as with another layout; by default
        the settings in the recording.
    without : ExcludedChannels, optional
        Channels to exclude from the check, of all sensors or of some.
    nominal_rate_hz : float, optional
        Nominal rate of pulses or measurements, in hertz; the drift of the clock is not known without it.
    on_progress : callable, optional
        Called with the number of sensors checked so far.

    Raises
    ------
    DataError
        The file cannot be read at all, or is not a recording.
    ArgumentError
        The rate is invalid, or channels are excluded of a sensor that the recording does not contain.
    SettingsError
        ``settings`` refuses the settings of a sensor.

    Examples
    --------
    Print the verdict and the result of each check::

        checked = check_recording("data/synthetic/line.h5")
        print(checked.verdict)
        for item in checked.sensors[0].items:
            print(item.check, item.result, item.detail)
    """
    path = Path(path)
    if nominal_rate_hz is not None:
        checks.between("nominal_rate_hz", nominal_rate_hz, 1e-6, 1e6)
    kind = file_kind(path)
    if kind != "recording":
        name = "an energyscape file" if kind == "energyscape" else "a file of acoustic maps"
        raise DataError(f"{path} is {name}, wanted a recording; use the recording from which it was made")
    names = sensor_names(path)
    without = without or ExcludedChannels()
    without.require_known(names)
    try:
        stored = {report.sensor: report for report in verify(path)}
    except DataError as error:  # No sensor can be read.
        return RecordingCheck(path=path, sensors=(), unreadable=(_unreadable(path, str(error)),))
    sensors, unreadable = [], []
    for number, name in enumerate(names):
        if stored[name].fault:
            unreadable.append(_unreadable(path, stored[name].fault))
        else:
            sensors.append(_check_sensor(path, stored[name], settings, without, nominal_rate_hz))
        if on_progress is not None:
            on_progress(number + 1)
    return RecordingCheck(path=path, sensors=tuple(sensors), unreadable=tuple(unreadable))


def uncheckable_recording(path: str | Path, error: Exception) -> RecordingCheck:
    """Return the result for a recording that cannot be checked, with the error as its fault.

    Parameters
    ----------
    path : str or Path
        Path of the recording.
    error : Exception
        Error that `check_recording` raised.

    Returns
    -------
    RecordingCheck
        A result without sensors, which is not fit for use.

    Examples
    --------
    >>> from ertis_numba.base.errors import DataError
    >>> from ertis_numba.sensor_check import uncheckable_recording
    >>> uncheckable_recording("a.h5", DataError("a.h5 is empty; choose a recording")).verdict
    'a.h5: 1 fault: the file is empty. Remedy: choose a recording'
    """
    return RecordingCheck(path=Path(path), sensors=(), unreadable=(_unreadable(Path(path), _reason(error)),))


def _reason(error: Exception) -> str:
    if isinstance(error, OSError) and not isinstance(error, ErtisError) and error.strerror:
        return f"{error.strerror}; {remedy(error)}"
    return str(error) or type(error).__name__


def _unreadable(path: Path, reason: str) -> CheckFault:
    """Return the fault of a file or sensor that cannot be read; errors name the file and end with a remedy."""
    text, semicolon, action = reason.rpartition("; ")
    text = text or reason
    if text.startswith(f"{path}: "):
        text = text.removeprefix(f"{path}: ")
    elif text.startswith(f"{path} "):
        text = f"the file {text.removeprefix(f'{path} ')}"
    return CheckFault(check=items.MEASUREMENTS, text=text, remedy=action if semicolon else items.COPY)


def _check_sensor(
    path: Path,
    stored: SensorReport,
    settings: Callable[[Settings], Settings] | None,
    without: ExcludedChannels,
    nominal_rate_hz: float | None,
) -> SensorCheck:
    with open_recording(path, sensor=stored.sensor) as recording:
        used = recording.settings if settings is None else settings(recording.settings)
        used = without.applied(used, stored.sensor)
        damaged = {item.index for item in stored.damaged}
        intact = [index for index in range(len(recording)) if index not in damaged]
        stamps = recording.stamps()
        with_call = [index for index in intact if stamps[index].behaviour != "passive"]
        examined = _spread(with_call or intact, _MAX_EXAMINED)
        words = find_lost_words(((index, recording[index]) for index in _spread(intact, _MAX_BITS_EXAMINED)), used)
        heard = [_with_settings(recording[index], used) for index in examined]
        clock = check_clock(stamps, used.recording.duration_s, nominal_rate_hz)
    report = merge([health(measurement) for measurement in heard]) if heard else None
    has_call = report is None or report.has_call
    match = first_call_match(heard, best=True) if has_call else None
    residuals: CalibrationResiduals | OtherLayoutError | str = items.NO_CALL if match is None else items.OTHER_CALL
    shift = None
    if match is not None and match.verdict != "differs":  # The filter of another call does not find times.
        residuals = _calibration_residuals(heard, report)
        shift = describe_start(map(emissions_of, heard), sound_speed_m_s(used.air), delay_s=used.call.delay_s)
    layout = microphones(used.array)
    found: dict[str, items.CheckResult] = {
        items.MICROPHONES: items.of_microphones(report),
        items.NOISE: items.of_noise(report, used, _band_note(heard, used)),
        items.SAMPLES: items.of_samples(report, words, shift),
        items.MEASUREMENTS: items.of_storage(stored),
        items.TIMING: items.of_timing(clock),
        items.DRIFT: items.of_drift(clock),
        items.CALL: items.of_call(match),
        items.CALIBRATION: items.of_calibration(residuals, report),
    }
    return SensorCheck(
        sensor=stored.sensor,
        settings=used,
        n_microphones=int(layout.enabled.sum()),
        items=tuple(CheckItem(check=name, result=each.result, detail=each.detail) for name, each in found.items()),
        faults=tuple(fault for each in found.values() for fault in each.faults),
        examined=tuple(examined),
        n_passive=sum(stamp.behaviour == "passive" for stamp in stamps),
        stored=stored,
        health=report,
        words=words,
        clock=clock,
        call=match,
        calibration=residuals if isinstance(residuals, CalibrationResiduals) else None,
    )


def _spread(indices: Sequence[int], largest: int) -> list[int]:
    """Return at most so many of the indices, evenly spaced and including the first and the last one."""
    last = len(indices) - 1
    places = sorted({round(last * step / (largest - 1)) for step in range(largest)})
    return [indices[place] for place in places] if indices else []


def _with_settings(measurement: Measurement, used: Settings) -> Measurement:
    """Return a measurement with the settings in use, and the air in which it was recorded."""
    return replace(measurement, settings=used.replace(air=measurement.settings.air))


def _band_note(heard: Sequence[Measurement], used: Settings) -> str | None:
    """Return a note on sound outside of the default bands in measurements without a call, if it is louder."""
    try:
        outside = OutsideBands(used, heard_bands(used))
    except ArgumentError:
        return None  # No band suits the record, which processing reports.
    for measurement in heard:
        if measurement.stamp.behaviour == "passive":
            outside.add(measurement)
    return outside.note


def _calibration_residuals(
    heard: Sequence[Measurement], report: Health | None
) -> CalibrationResiduals | OtherLayoutError | str:
    """Return the deviations from the layout, the layout that fits instead, or the reason why neither is known."""
    if report is None or report.unknown:  # Noise can look like faults of channels.
        return "no measurement is intact" if report is None else report.unknown[0]
    faulty = [channel.channel for channel in report.channels if not _CALIBRATED.issuperset(channel.faults)]
    if len(faulty) == len(report.channels):
        return "every channel is faulty"
    found: CalibrationResiduals | OtherLayoutError | str
    try:
        found = calibration_residuals(heard, faulty)
    except np.linalg.LinAlgError:  # Sounds from several places at once can leave the fit without a solution.
        found = "no single echo fits the layout"
    except OtherLayoutError as error:
        found = error
    except (ArgumentError, DataError) as error:
        found = str(error)
    return found
