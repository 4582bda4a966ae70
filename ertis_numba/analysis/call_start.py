"""Comparison of the frequency at which an emission begins with the start of the call, which determines ranges.

Echoes of a call show its curve of group delay except for a constant, which is the time of the emission. Another call of
nearly the same curve therefore compresses as well, but shifts all ranges, unless it begins at the same frequency.
"""

import functools
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.sound_spectra import SoundSpectra, sound_spectra
from ertis_numba.analysis.sweep_search import GatedArrival, arrival_of, run_around
from ertis_numba.analysis.sweeps import Curve
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Call

__all__ = ["WIDER", "StartMatch", "start_error_s", "start_match"]

StartMatch = Literal["same", "before", "after", "unknown"]
WIDER: Final = 1.5
"""Ratio of the band in which sound of the same sweep is searched to the band of the call."""
_MAX_ERROR_S: Final = 60e-6  # Ranges are 1 cm wrong.
_EARLY: Final = 0.2  # Part of the ramp by which emissions of sensors begin earlier, because they have shorter ramps.
_RESOLUTION_HZ: Final = 400.0  # Resolution of the spectra of an arrival.
_GATE_S: Final = 0.4e-3
_LEVEL: Final = 0.1  # Power at the start of a call relative to that of its first third.
_FIRST: Final = 0.3
_FIRST_HZ: Final = 8e3  # Less is not resolved.
_MIN_SNR: Final = 4.0  # Power at the start relative to the background.
_MIN_EARLIER: Final = 0.3  # Mean power before the start of the call; overloaded samples contain less.
_MAX_LEVEL: Final = 0.25
_BEFORE: Final = 0.5  # Time before the start that is compared, at least, relative to the duration.
_BEFORE_S: Final = 1e-3
_STEP_S: Final = 10e-6
_SMOOTHED_S: Final = 80e-6
_HALF: Final = 0.5
# The power of a Hann ramp rises from 0.1 to 0.5 between 0.38 and 0.64 of its length.
_BEGIN_OF_RISE: Final = 1.46
_MAX_FASTER: Final = 0.38
_GAP_S: Final = 200e-6
_PADDING_S: Final = 2e-3
_MIN_POWER: Final = 1e-3  # Power that counts in the comparison of curves, relative to the highest.


def start_match(sound: SoundSpectra, call: Call, curves: tuple[Curve, Curve], arrival: GatedArrival) -> StartMatch:
    """Compare the first frequency of the strongest arrival with that of a call.

    ``same`` if the range error is at most 1 cm, besides the resolution of the record and a fifth of the ramp.
    ``before`` if the emission begins with other frequencies than the call. ``after`` if the first frequencies of the
    call are missing: they may be absorbed, or not emitted. ``unknown`` if noise hides the start, or a ramp may explain
    the difference. ``curves`` are that of the call, and the one that compresses the arrival best.
    """
    curve, better = curves
    slope_s_hz = abs(float(curve.slopes_s_hz(np.array(call.start_frequency_hz))))
    later_s = max(_FIRST * call.duration_s, _FIRST_HZ * slope_s_hz)
    power, background = _density(sound, curve, call)
    own, _ = _density(_own_sound(call, sound.rate_hz), curve, call)
    since_s = _times_s(call)
    ramp_s = call.ramp_fraction * call.duration_s
    is_first = (since_s > ramp_s / 2) & (since_s < later_s)
    full, own_full = float(power[is_first].max()), float(own[is_first].max())
    if full <= 0:
        return "unknown"
    noise = _MIN_SNR * background / full
    level = max(_LEVEL, float(noise[(since_s > -ramp_s - _MAX_ERROR_S) & (since_s < later_s)].max()))
    if level > _MAX_LEVEL:
        return "unknown"
    begin_s, half_s = _begin_s(since_s, power / full, np.maximum(level, noise), is_first)
    expected_s, own_half_s = _begin_s(since_s, own / own_full, np.full(len(own), level), is_first)
    if begin_s < expected_s:  # A shorter ramp begins earlier, and rises faster.
        faster_s = max(0.0, own_half_s - expected_s - half_s + begin_s)
        begin_s += min(_BEGIN_OF_RISE * faster_s, _MAX_FASTER * ramp_s)
    steeper = float(better.slopes_s_hz(np.array(call.start_frequency_hz))) / slope_s_hz
    shift_s = (begin_s - expected_s) * abs(steeper)
    tolerance_s = start_error_s(call, curve) - (0.0 if shift_s < 0 else _EARLY * ramp_s)
    if abs(_curve_error_s(arrival, call, curve, better) - shift_s) <= tolerance_s:
        return "same"
    if shift_s > 0:
        return "after"
    is_earlier = (since_s >= begin_s) & (since_s < expected_s)
    is_full = float(power[is_earlier].sum()) > _MIN_EARLIER * full * np.count_nonzero(is_earlier)
    return "before" if shift_s < -tolerance_s - ramp_s / 2 and is_full else "unknown"


def start_error_s(call: Call, curve: Curve) -> float:
    """Return the error of the time of emission up to which the start is the ``same``."""
    slope_s_hz = abs(float(curve.slopes_s_hz(np.array(call.start_frequency_hz))))
    return _MAX_ERROR_S + _RESOLUTION_HZ * slope_s_hz + _EARLY * call.ramp_fraction * call.duration_s


def _times_s(call: Call) -> NDArray[np.float64]:
    """Return the times since the start of a call at which powers are compared."""
    return np.arange(-max(_BEFORE * call.duration_s, _BEFORE_S), call.duration_s, _STEP_S)


def _density(sound: SoundSpectra, curve: Curve, call: Call) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the power of the strongest arrival at times since the start of the call, and the background."""
    low_hz, high_hz = call.low_frequency_hz, call.high_frequency_hz
    arrival = arrival_of(sound, curve, low_hz / WIDER, high_hz * WIDER, gate_s=_GATE_S, whole_hz=(low_hz, high_hz))
    at_s = curve.delay_s(arrival.frequency_hz) - curve.delay_s(call.start_frequency_hz)
    order, from_s = np.argsort(at_s), _times_s(call) - _SMOOTHED_S / 2

    def smoothed(power: NDArray[np.float64]) -> NDArray[np.float64]:
        total = np.cumsum(power[order])
        return np.asarray(np.interp(from_s + _SMOOTHED_S, at_s[order], total) - np.interp(from_s, at_s[order], total))

    return smoothed(arrival.power) if arrival.peak.any() else 0 * from_s, smoothed(arrival.background)


@functools.lru_cache(maxsize=16)
def _own_sound(call: Call, rate_hz: float) -> SoundSpectra:
    """Return the spectra of a call itself."""
    time_s = np.arange(round((call.duration_s + 2 * _PADDING_S) * rate_hz)) / rate_hz - _PADDING_S
    signals = call_at(call.replace(delay_s=0.0), time_s).astype(np.float32)[None]
    return sound_spectra(signals, rate_hz, low_hz=call.low_frequency_hz / WIDER, padding_s=_PADDING_S)


def _begin_s(
    since_s: NDArray[np.float64], power: NDArray[np.float64], level: NDArray[np.float64], is_first: NDArray[np.bool_]
) -> tuple[float, float]:
    """Return the times at which a power exceeds a level, across short gaps by interference, and half its peak."""
    highest = int(np.argmax(np.where(is_first, power, 0)))
    is_heard = run_around(power > level, highest, round(_GAP_S / _STEP_S) - 1)
    return float(since_s[np.argmax(is_heard)]), float(since_s[np.argmax(is_heard & (power > _HALF))])


def _curve_error_s(arrival: GatedArrival, call: Call, own: Curve, better: Curve) -> float:
    """Return the mean difference of the delays of two curves since the first frequency of the call."""
    at_hz, power = arrival.frequency_hz, np.maximum(arrival.power, 0)
    power = np.where(power > _MIN_POWER * power.max(), power, 0)
    later_s = [curve.delay_s(at_hz) - curve.delay_s(call.start_frequency_hz) for curve in (better, own)]
    return float(np.average(later_s[0] - later_s[1], weights=power)) if power.any() else 0.0
