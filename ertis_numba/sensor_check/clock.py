"""Timing of measurements: their rate, jitter and drift, from counters and time stamps."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.frames import Stamp

__all__ = ["MAX_DRIFT_PPM", "ClockCheck", "check_clock"]

MAX_DRIFT_PPM: Final = 100.0
"""Limit of a drift: usual crystals are within 100 ppm of their frequency, which shifts a range of 5 m by 0.5 mm."""
_MAX_DEVIATION: Final = 0.05  # Rates that differ by more are those of other settings rather than of a drifting clock.
_MIN_MEASUREMENTS: Final = 3
_NEAR: Final = 0.1  # Deviation of a regular interval, relative to the period.
_MIN_REGULAR: Final = 0.8  # Share of the intervals that must be regular.
_COMPUTED_NS: Final = 2.0  # Jitter of times that were computed from a counter and rounded.
_OVERLAP: Final = 0.999
_DEVIATIONS: Final = 4.0
_OUTLIER: Final = 5.0  # Limit of a deviation relative to the median deviation.
_FALL_REMEDY: Final = "synchronise the clock of the host before recording again"
_COUNT_REMEDY: Final = "check the SYNC cable and the supply of the sensor, and record again"
_RATE_REMEDY: Final = "correct recording.sample_rate_hz or recording.n_samples in the settings"
_NOMINAL_REMEDY: Final = "set --rate to the rate of this recording, or check the trigger"


@dataclass(frozen=True, slots=True, kw_only=True)
class ClockCheck:
    """Timing of the measurements of a sensor. Values that are not known are None, the default.

    Attributes
    ----------
    rate_hz : float or None
        Rate of the pulse counter according to the time stamps.
    rate_sd_ppm : float or None
        Standard deviation of the rate, in parts per million.
    jitter_s : float or None
        Root mean square deviation of the time stamps from that rate, in seconds.
    drift_ppm : float or None
        Deviation of the rate from the nominal one in parts per million; a positive value runs fast.
    faults : tuple of (str, str)
        Contradictions between counter, time stamps and settings, as clauses, and their remedies.
    drift_fault : str
        Drift beyond its limit, as a clause; empty by default.
    timing_unknown, drift_unknown : str
        Reason why timing or drift are not known; empty by default.
    """

    rate_hz: float | None = None
    rate_sd_ppm: float | None = None
    jitter_s: float | None = None
    drift_ppm: float | None = None
    faults: tuple[tuple[str, str], ...] = ()
    drift_fault: str = ""
    timing_unknown: str = ""
    drift_unknown: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class _Run:
    """Successive measurements of a session with rising counters."""

    index: NDArray[np.int64]
    count: NDArray[np.float64]
    time_ns: NDArray[np.float64]


def check_clock(stamps: Sequence[Stamp], duration_s: float, nominal_rate_hz: float | None = None) -> ClockCheck:
    """Compare the pulse counters of one sensor with its time stamps, and with the duration of a measurement."""
    # A line with one offset for each session is fitted by least squares; late time stamps are left out.
    if not stamps or not all(stamp.is_timed for stamp in stamps):
        return _unknown("the time stamps are not from a clock, as in simulations and imports")
    runs = [run for run in _runs(stamps) if len(run.count) > 1]
    n_usable = sum(len(run.count) for run in runs)
    if n_usable < _MIN_MEASUREMENTS:
        return _unknown(f"{n_usable} measurements with rising counters are fewer than {_MIN_MEASUREMENTS}")
    falls = [run.index[place] for run in runs for place in np.flatnonzero(np.diff(run.time_ns) < 0) + 1]
    if falls:
        found = ClockCheck(faults=((f"time stamps fall at measurement {falls[0]}", _FALL_REMEDY),))
        return replace(found, drift_unknown="the time stamps are not in order")
    uncertainty_ns = float(np.mean([stamp.timestamp_uncertainty_ns for stamp in stamps]))
    return _with_drift(_by_times(runs, uncertainty_ns, duration_s), nominal_rate_hz)


def _by_times(runs: Sequence[_Run], uncertainty_ns: float, duration_s: float) -> ClockCheck:
    """Return rate and jitter, and contradictions of counters, times and duration."""
    interval_ns = np.concatenate([np.diff(run.time_ns) for run in runs])
    step = np.concatenate([np.diff(run.count) for run in runs])
    period_ns = float(np.median(interval_ns / step))
    if period_ns <= 0:
        return _unknown("the time stamps do not rise")
    extra = interval_ns / period_ns - step
    if np.mean(np.abs(extra) < _NEAR) < _MIN_REGULAR:
        return _unknown("the measurements have no constant rate")
    faults = _miscounts(extra, np.concatenate([run.index[1:] for run in runs]))
    period_ns, jitter_ns, period_sd_ns = _fit(runs, period_ns, uncertainty_ns)
    shortest_s = 1e-9 * period_ns * float(step.min())
    if shortest_s < _OVERLAP * duration_s:
        begin = f"measurements begin every {1e3 * shortest_s:.4g} ms"
        faults.append((f"{begin}, but last {1e3 * duration_s:.4g} ms according to the settings", _RATE_REMEDY))
    found = ClockCheck(rate_hz=1e9 / period_ns, faults=tuple(faults))
    if jitter_ns < _COMPUTED_NS:
        return replace(found, drift_unknown="the time stamps were computed from the counter")
    return replace(found, rate_sd_ppm=1e6 * period_sd_ns / period_ns, jitter_s=1e-9 * jitter_ns)


def _unknown(why: str) -> ClockCheck:
    return ClockCheck(timing_unknown=why, drift_unknown=why)


def _runs(stamps: Sequence[Stamp]) -> list[_Run]:
    """Split the measurements where their session changes or their counter does not rise."""
    by_session: dict[int, list[list[tuple[int, Stamp]]]] = {}
    for index, stamp in enumerate(stamps):
        runs = by_session.setdefault(stamp.session_id, [[]])
        if runs[-1] and stamp.sync_count <= runs[-1][-1][1].sync_count:
            runs.append([])
        runs[-1].append((index, stamp))
    found = []
    for run in (run for runs in by_session.values() for run in runs):
        # Differences to the first are exact in float64, while times since 1970 are not.
        first = run[0][1]
        found.append(
            _Run(
                np.array([index for index, _ in run]),
                np.array([stamp.sync_count - first.sync_count for _, stamp in run], dtype=np.float64),
                np.array([stamp.timestamp_ns - first.timestamp_ns for _, stamp in run], dtype=np.float64),
            )
        )
    return found


def _miscounts(extra: NDArray[np.float64], at: NDArray[np.int64]) -> list[tuple[str, str]]:
    """Return a fault for the first interval that differs from its count by whole periods, and stays so."""
    whole = np.rint(extra)
    jumps = np.flatnonzero((whole != 0) & (np.abs(extra - whole) < _NEAR))
    for place in jumps:
        around = extra[max(0, place - 1) : place + 2].sum()
        if abs(round(float(around))) >= 1:
            count = int(whole[place])
            pulses = f"{abs(count)} {'pulse' if abs(count) == 1 else 'pulses'}"
            side = "fewer" if count > 0 else "more"
            return [(f"the counter has {pulses} {side} than the time at measurement {at[place]}", _COUNT_REMEDY)]
    return []


def _fit(runs: Sequence[_Run], period_ns: float, uncertainty_ns: float) -> tuple[float, float, float]:
    """Return the period, the root mean square of the deviations, and the standard deviation of the period, in ns."""
    kept = [np.ones(len(run.count), bool) for run in runs]
    jitter_ns = 0.0
    spread = 1.0
    for _ in range(2):
        parts = [(run.count[good], run.time_ns[good]) for run, good in zip(runs, kept, strict=True) if good.any()]
        centred = [(count - count.mean(), time_ns - time_ns.mean()) for count, time_ns in parts]
        spread = math.fsum(float(count @ count) for count, _ in centred)
        if spread == 0:  # Each session has one good measurement.
            break
        period_ns = math.fsum(float(count @ time_ns) for count, time_ns in centred) / spread
        rest_ns = np.concatenate([time_ns - period_ns * count for count, time_ns in centred])
        jitter_ns = float(np.sqrt(np.mean(rest_ns**2)))
        kept = [_without_late(run, good, period_ns) for run, good in zip(runs, kept, strict=True)]
    sigma_ns = max(jitter_ns, uncertainty_ns)
    return period_ns, jitter_ns, sigma_ns / math.sqrt(spread or 1.0)


def _without_late(run: _Run, good: NDArray[np.bool_], period_ns: float) -> NDArray[np.bool_]:
    """Return True for measurements whose time is near the line: (measurement,) bool."""
    rest_ns = run.time_ns - period_ns * run.count
    rest_ns = np.abs(rest_ns - np.median(rest_ns[good]))
    return np.asarray(rest_ns <= max(_OUTLIER * float(np.median(rest_ns)), _COMPUTED_NS))


def _with_drift(found: ClockCheck, nominal_rate_hz: float | None) -> ClockCheck:
    if found.rate_hz is None or found.rate_sd_ppm is None:
        return found
    if nominal_rate_hz is None:
        return replace(found, drift_unknown="the nominal rate is not known; add it with --rate")
    drift_ppm = 1e6 * (found.rate_hz / nominal_rate_hz - 1)
    if abs(drift_ppm) > 1e6 * _MAX_DEVIATION:
        text = f"measurements have a rate of {found.rate_hz:.4g} Hz, but the nominal rate is {nominal_rate_hz:g} Hz"
        return replace(
            found, faults=(*found.faults, (text, _NOMINAL_REMEDY)), drift_unknown="the rate is not the nominal one"
        )
    margin_ppm = _DEVIATIONS * found.rate_sd_ppm
    if abs(drift_ppm) - margin_ppm > MAX_DRIFT_PPM:
        side = "fast" if drift_ppm > 0 else "slow"
        text = f"the clock runs {abs(drift_ppm):.0f} ppm {side} relative to the host (limit {MAX_DRIFT_PPM:.0f} ppm)"
        return replace(found, drift_ppm=drift_ppm, drift_fault=text)
    if abs(drift_ppm) + margin_ppm > MAX_DRIFT_PPM:
        text = f"{drift_ppm:+.0f} ± {found.rate_sd_ppm:.0f} ppm is not precise enough; record for a longer time"
        return replace(found, drift_ppm=drift_ppm, drift_unknown=text)
    return replace(found, drift_ppm=drift_ppm)
