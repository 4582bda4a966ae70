"""Results of single checks: measured values, faults and remedies."""

import math
from collections.abc import Sequence
from typing import Final, Literal, NamedTuple

from ertis_numba.analysis.call_match import CallMatch
from ertis_numba.analysis.health import Health
from ertis_numba.analysis.health.limits import MAX_DELAY_S, MAX_GAIN_DB, MAX_WHITE_DB
from ertis_numba.analysis.sample_faults import LINK as LINK_REMEDY
from ertis_numba.base.units import counted
from ertis_numba.calibration import OtherLayoutError
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.sensor_check.clock import ClockCheck
from ertis_numba.sensor_check.lost_words import LostWords
from ertis_numba.sensor_check.microphone_faults import (
    MICROPHONES,
    SAMPLES,
    channels_in_words,
    microphone_faults,
    record_faults,
)
from ertis_numba.sensor_check.residuals import CalibrationResiduals
from ertis_numba.sensor_check.result import CheckFault
from ertis_numba.settings import Air, Settings
from ertis_numba.storage.verify import SensorReport

__all__ = [
    "CALIBRATION",
    "CALL",
    "COPY",
    "DRIFT",
    "MEASUREMENTS",
    "MICROPHONES",
    "NOISE",
    "NO_CALL",
    "OTHER_CALL",
    "SAMPLES",
    "TIMING",
    "CheckResult",
    "of_calibration",
    "of_call",
    "of_drift",
    "of_microphones",
    "of_noise",
    "of_samples",
    "of_storage",
    "of_timing",
]

NOISE: Final = "noise floor"
MEASUREMENTS: Final = "measurements"
TIMING: Final = "timing"
DRIFT: Final = "clock drift"
CALL: Final = "call"
CALIBRATION: Final = "calibration"
_BITS: Final = {
    "splice": "lost or misplaced words",
    "noise": "random bits",
    "constant bits": "constant bits",
    "density": "bits of no modulator",
}
"""Faults by the reasons of `BitCheck`."""
COPY: Final = "copy the file again, or record again"
"""Remedy for damaged files."""
_NO_NOISE: Final = "no microphone without a fault has a measurable noise"
NO_CALL: Final = "no call was emitted"
OTHER_CALL: Final = "another call was emitted"

_DEVIATIONS: Final = 4.0
_WORTH_S: Final = 1e-6  # 18 degrees of a period at 50 kHz.
_CALIBRATE: Final = "calibrate the array (ertis sensors calibrate), or check it with its own layout (--settings)"


class CheckResult(NamedTuple):
    """Result of one check: ``ok``, ``fault`` or ``not known``, a detail, and faults."""

    result: Literal["ok", "fault", "not known"]
    detail: str
    faults: tuple[CheckFault, ...] = ()


_NOTHING: Final = CheckResult("not known", "no measurement is intact")


def _result_of(faults: Sequence[CheckFault], detail: str) -> CheckResult:
    texts = "; ".join(fault.text for fault in faults)
    return CheckResult("fault" if faults else "ok", texts or detail, tuple(faults))


def of_microphones(report: Health | None) -> CheckResult:
    """Return the result for the microphones; with a call, it is a fault if dead microphones cannot be detected."""
    if report is None:
        return _NOTHING
    count = len(report.channels)
    faults = microphone_faults(report)
    if report.unknown and not faults and report.has_call:
        if count == 1:
            return CheckResult("not known", report.unknown[0])
        text = f"faulty microphones cannot be detected ({report.unknown[0]})"
        faults = (CheckFault(check=MICROPHONES, text=text, remedy="record a whole emission and its echoes"),)
    detail = f"{count} of {count} without a fault"
    if report.unknown:
        detail += f"; not known: {report.unknown[0]}"
    if report.not_observable:
        detail += f"; not observable: {', '.join(fault for each in report.not_observable for fault in each.faults)}"
    return _result_of(faults, detail)


def of_noise(report: Health | None, used: Settings, note: str | None = None) -> CheckResult:
    """Return the noise and the dynamic range, if any, and a note; noise as that of random bits is a fault."""
    if report is None:
        return _NOTHING
    if report.noise_dbfs is None:
        return CheckResult("not known", "; ".join(filter(None, (_NO_NOISE, note))))
    low_hz, high_hz = used.call.low_frequency_hz, used.call.high_frequency_hz
    detail = f"{report.noise_dbfs:.1f} dBFS in the call's band, dynamic range {report.dynamic_range_db or 0.0:.1f} dB"
    if report.dynamic_range_db is None:
        low_hz, high_hz = used.passive.extent_of(used.recording)
        high_hz = min(high_hz, used.recording.sample_rate_hz / 2)
        detail = (
            f"{report.noise_dbfs:.1f} dBFS from {low_hz / 1e3:g} to {high_hz / 1e3:g} kHz, including the sound of "
            "sources; the dynamic range needs a call"
        ) + (f"; {note}" if note else "")
    white_dbfs = 10 * math.log10(2 * (high_hz - low_hz) / used.recording.sample_rate_hz)
    if not used.recording.is_pdm or report.noise_dbfs <= white_dbfs + MAX_WHITE_DB:
        return CheckResult("ok", detail)
    text = f"the noise of {report.noise_dbfs:.1f} dBFS is that of random bits"
    remedy = "check that the array is connected, and that its clock runs"
    return _result_of([CheckFault(check=NOISE, text=text, remedy=remedy)], detail)


def of_samples(report: Health | None, words: LostWords, shift: tuple[str, str] | None) -> CheckResult:
    """Return lost words, and the faults of whole records: repeated blocks, a shift, and another order."""
    if report is None:
        return _NOTHING
    faults = list(record_faults(report))
    if shift is not None:
        faults.append(CheckFault(check=SAMPLES, text=shift[0], remedy=shift[1]))
    by_reason: dict[str, list[int]] = {}
    for index, reason in words.reasons.items():
        by_reason.setdefault(reason, []).append(index)
    for reason, indices in by_reason.items():
        count = f"{len(indices)} of {words.n_examined} examined measurements"
        verb = "has" if len(indices) == 1 else "have"
        text = f"{count} {verb} {_BITS[reason]}, the first at {indices[0]}"
        faults.append(CheckFault(check=SAMPLES, text=text, remedy="check the link to the sensor, and record again"))
    lost = f"lost words are not observable ({words.unknown})"
    return _result_of(faults, lost if words.unknown else _none_lost(words))


def _none_lost(words: LostWords) -> str:
    return f"no lost word found in {counted(words.n_examined, 'measurement')}"


def of_storage(stored: SensorReport) -> CheckResult:
    """Return missing and damaged measurements."""
    faults = []

    def add(text: str, remedy: str) -> None:
        faults.append(CheckFault(check=MEASUREMENTS, text=text, remedy=remedy))

    if not stored.measurements:
        add("there are no measurements", "record again")
    if stored.gaps:
        reasons = ", ".join(dict.fromkeys(gap.reason for gap in stored.gaps))
        numbered = stored.missing + stored.measurements
        add(f"{stored.missing} of {numbered} measurements are missing ({reasons})", "check cable, hub and disk")
    if stored.damaged:
        count = len(stored.damaged)
        add(f"{count} of {stored.measurements} measurements {'is' if count == 1 else 'are'} damaged", COPY)
    if stored.out_of_order:
        add(f"{counted(len(stored.out_of_order), 'measurement')} out of order", "record again")
    count = len(stored.copies)
    all_equal = 0 < count == stored.measurements - 1
    if count and not all_equal:
        kind = "are copies" if count > 1 else "is a copy"
        add(f"{count} of {stored.measurements} measurements {kind} of the one before in every sample", LINK_REMEDY)
    if stored.remark:
        add(stored.remark, COPY)
    if all_equal and not faults:  # An emulated sensor repeats the measurement of its scene.
        text = f"all {stored.measurements} measurements are equal in every sample, as those of an emulated sensor are"
        return CheckResult("not known", f"{text}; a real one that sends them has stopped")
    return _result_of(faults, f"{stored.measurements} stored, none missing or damaged")


def of_timing(clock: ClockCheck) -> CheckResult:
    """Return the rate of the measurements, and contradictions of counters and times."""
    faults = [CheckFault(check=TIMING, text=text, remedy=remedy) for text, remedy in clock.faults]
    if clock.timing_unknown and not faults:
        return CheckResult("not known", clock.timing_unknown)
    detail = f"{clock.rate_hz:.6g} Hz" if clock.rate_hz is not None else ""
    if clock.jitter_s is not None:
        detail += f", jitter {1e3 * clock.jitter_s:.3g} ms"
    return _result_of(faults, detail)


def of_drift(clock: ClockCheck) -> CheckResult:
    """Return the drift of the clock."""
    if clock.drift_unknown:
        return CheckResult("not known", clock.drift_unknown)
    if clock.drift_fault:
        remedy = "check that the clock of the host is synchronised, then the clock that triggers"
        return _result_of([CheckFault(check=DRIFT, text=clock.drift_fault, remedy=remedy)], "")
    return _result_of((), f"{clock.drift_ppm or 0.0:+.0f} ± {clock.rate_sd_ppm or 0.0:.0f} ppm relative to the host")


def of_call(match: CallMatch | None) -> CheckResult:
    """Return the match of the call; None without one."""
    if match is None:
        return CheckResult("not known", NO_CALL)
    if match.verdict == "unknown":
        return CheckResult("not known", match.note)
    if match.verdict == "matches":
        shown = "but do not show its start, which determines ranges"
        if match.start_error_s is not None:
            error_cm = 50 * match.start_error_s * sound_speed_m_s(Air())
            shown = f"which determines ranges to within {error_cm:.1f} cm if the sample rate is right"
        texts = f"echoes match the call of the settings, {shown}", match.warning
        return CheckResult("ok", "; ".join(filter(None, texts)))
    text, _, rest = match.warning.partition(". ")
    return _result_of([CheckFault(check=CALL, text=text, remedy=rest.partition("; ")[2])], "")


def of_calibration(residuals: CalibrationResiduals | OtherLayoutError | str, report: Health | None) -> CheckResult:
    """Return the deviations from the layout; faults that the health of the microphones names are left out."""
    if isinstance(residuals, OtherLayoutError):
        remedy = f'set array.layout = "{residuals.layout}" in a settings file (--settings)'
        return _result_of([CheckFault(check=CALIBRATION, text=residuals.finding, remedy=remedy)], "")
    if isinstance(residuals, str):
        return CheckResult("not known", residuals)
    faulty = report.faults if report else {}
    reported = {channel for channels in faulty.values() for channel in channels}
    order = next((finding for finding in residuals.findings if not finding.channels), None)
    if order is not None and not reported:  # Several echoes can fit another order by chance.
        return CheckResult("not known", f"{order.text}, unless several echoes arrive at once")
    faults = [
        CheckFault(check=CALIBRATION, text=finding.text, remedy=_CALIBRATE)
        for finding in residuals.findings
        if not reported.issuperset(finding.channels)
    ]
    every = range(len(residuals.channels))
    beyond = [
        place
        for place in every
        if residuals.channels[place] not in reported
        and (
            abs(residuals.delay_s[place]) - _DEVIATIONS * residuals.delay_sd_s[place] > MAX_DELAY_S
            or abs(residuals.gain_db[place]) - _DEVIATIONS * residuals.gain_sd_db[place] > MAX_GAIN_DB
        )
    ]
    if beyond:
        verb = "deviates" if len(beyond) == 1 else "deviate"
        channels = channels_in_words([residuals.channels[place] for place in beyond])
        text = f"{channels} {verb} from the layout by {_worst(residuals, beyond)}"
        faults.append(CheckFault(check=CALIBRATION, text=text, remedy=_CALIBRATE))
    detail = f"{1e6 * residuals.rms_s:.2g} µs RMS from the layout; {_worst(residuals, every)}"
    if residuals.rms_s > _WORTH_S:
        detail += "; 'ertis sensors calibrate' reduces this"
    return _result_of(faults, detail)


def _worst(residuals: CalibrationResiduals, places: Sequence[int]) -> str:
    """Return the largest deviations of some channels, as text."""
    delay_s = max((abs(residuals.delay_s[place]) for place in places), default=0.0)
    gain_db = max((abs(residuals.gain_db[place]) for place in places), default=0.0)
    return f"up to {1e6 * delay_s:.2g} µs and {gain_db:.2g} dB"
