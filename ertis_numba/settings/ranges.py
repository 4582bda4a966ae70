"""Ranges that suit a record and its call."""

import math
from typing import Any

from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings.call import Call
from ertis_numba.settings.processing import Processing
from ertis_numba.settings.recording import Recording

__all__ = ["fit_ranges", "max_decimation", "record_range_m"]

_MIN_SOUND_SPEED_M_S = 300.0  # slightly below the speed at -40 °C
_MIN_RATE_PER_BANDWIDTH = 1.8  # ranges per second, relative to the bandwidth of the call
_MIN_RATE_PER_HIGHEST_FREQUENCY = {
    "fast": 4.4,
    "paper": 5.5,
}  # signal rate relative to the highest frequency of the call
_MIN_RATE_PER_BAND_EDGE = 2.5  # signal rate relative to the upper edge of the matched filter's band
_MAX_DECIMATION = 100  # A larger one would need more filter taps than 16 bits can represent.
_MAX_RANGE_DECIMATION = 10_000


def fit_ranges(processing: Processing, recording: Recording, call: Call) -> Processing:
    """Return processing with ranges that suit a record and its call."""
    # A default window is shortened to whole echoes, and a `range_decimation` that could lose 2 dB is reduced.
    if recording.duration_s <= call.end_s:
        raise ArgumentError(
            f"recording.n_samples gives a record of {1e3 * recording.duration_s:.4g} ms, but the call ends after "
            f"{1e3 * call.end_s:.4g} ms; use more samples"
        )
    changes: dict[str, Any] = {}
    first_m, last_m = Processing().range_m
    if processing.range_m == (first_m, last_m):
        echo_m = (recording.duration_s - call.end_s) * _MIN_SOUND_SPEED_M_S / 2
        last_m = min(last_m, math.floor(10 * echo_m) / 10 or math.floor(1000 * echo_m) / 1000)
        changes["range_m"] = (first_m if first_m < last_m else 0.0, last_m)
    min_hz = _MIN_RATE_PER_BANDWIDTH * (call.high_frequency_hz - call.low_frequency_hz)
    if recording.sample_rate_hz / processing.range_decimation < min_hz * (1 - 1e-9):
        suits = max_decimation(recording.sample_rate_hz, call, processing)
        changes |= {"range_decimation": _range_decimation(recording.sample_rate_hz / min_hz, suits), "decimation": None}
    return processing.replace(**changes)


def record_range_m(recording: Recording, call: Call, sound_speed_m_s: float) -> tuple[float, float]:
    """Return the ranges, rounded inwards to a cm, of echoes after the call and within the record; first 0 for none."""
    first_m, last_m = (sound_speed_m_s * time_s / 2 for time_s in (call.duration_s, recording.duration_s - call.end_s))
    steps = 100 if last_m > 0.1 else 1000
    first_m, last_m = math.ceil(first_m * steps) / steps, math.floor(last_m * steps) / steps
    return (first_m if first_m < last_m else 0.0, last_m)


def max_decimation(sample_rate_hz: float, call: Call, processing: Processing) -> int:
    """Return the largest decimation whose low-pass filter needs few taps."""
    min_hz = _MIN_RATE_PER_HIGHEST_FREQUENCY[processing.method] * call.high_frequency_hz
    if processing.band_edges_hz is not None:
        min_hz = max(min_hz, _MIN_RATE_PER_BAND_EDGE * processing.band_edges_hz[1])
    return min(max(1, math.floor(sample_rate_hz / min_hz)), _MAX_DECIMATION)


def _range_decimation(largest: float, suits: int) -> int:
    """Return a range decimation of at most ``largest``, if possible a multiple of the call's decimation."""
    step = min(max(1, math.floor(largest)), _MAX_RANGE_DECIMATION)
    suits -= suits % 10 if suits > 10 else 0  # round numbers, as in RTIS
    return step - step % suits if step > suits else step
