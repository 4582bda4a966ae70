"""Emissions in a loopback channel: times of the call, or of the pulses of a trigger, to a fraction of a sample."""

import math
import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.base.errors import DataError
from ertis_numba.geometry.waveform import call_samples
from ertis_numba.settings import Call

__all__ = ["Emissions", "find_emissions", "louder_and_earlier"]

_BLOCK: Final = 2**18
_MIN_MATCH: Final = 0.5  # Correlation coefficient with the call; noise of a band with 60 degrees of freedom has 0.3.
_GOOD_MATCH: Final = 0.8
_MIN_PEAK: Final = 5.0  # Peak relative to the median after the matched filter; noise reaches 4.5.
_SAME_LEVEL: Final = 0.5  # Emissions of one file differ by less; crosstalk and echoes are weaker.
_MIN_HEARD: Final = 0.2  # Minimum share of a call that the start of the file cuts off.
_MIN_SNR: Final = 10.0  # Minimum peak of pulses relative to the median deviation.
_ONSET, _RISEN = 0.1, 0.9  # Levels of an onset and at the end of the rise, relative to the peak.
_MIN_PAUSE_S: Final = 0.5e-3  # Minimum silence before a pulse.
_IRREGULAR: Final = 1.5  # Ratio of an interval to the median beyond which an emission may be missing.

_MAX_EARLIER_S: Final = 0.05
_MIN_EARLIER: Final = 3.0  # in samples

Reader = Callable[[slice], NDArray[np.float64]]


@dataclass(frozen=True, slots=True)
class Emissions:
    """Emissions in a file."""

    times: NDArray[np.float64]  # (emission,) in samples from the first one of the file; range 0
    notes: tuple[str, ...]


def find_emissions(read: Reader, n_samples: int, call: Call, *, rate_hz: float, path: Path, channel: int) -> Emissions:
    """Return the emissions in a loopback channel, by the matched filter of the call."""
    # If no part of the channel resembles the call, its pulses are found by their onsets, as those of a trigger.
    times, match = _of_call(read, n_samples, call_samples(call, rate_hz=rate_hz), call.start_s * rate_hz)
    notes = []
    if len(times) and match < _GOOD_MATCH:
        notes.append(
            f"the call in channel {channel} matches that of the settings poorly (correlation {match:.2f}); if another "
            "call was emitted, set it as [call], because all ranges may be shifted"
        )
    if not len(times):
        times, rise = _onsets(read, n_samples, rate_hz)
        if not len(times):
            raise DataError(
                f"{path}: channel {channel} contains no emission: neither the call (correlation "
                f"{max(match, 0.0):.2f}) nor a pulse above the noise; choose the channel of the loopback "
                "(sync_channel), and set the emitted call as [call]"
            )
        notes.append(
            f"channel {channel} does not contain the call (correlation {match:.2f}); emissions are assumed at the "
            f"onsets of its pulses, which rise in {1e6 * rise / rate_hz:.2g} µs"
        )
    complete = times[times >= -0.5]
    if len(complete) < len(times):
        notes.append("an emission that began before the first sample was left out")
    if not len(complete):
        raise DataError(
            f"{path}: the only emission in channel {channel} began before the first sample; start the recorder before "
            "the emission"
        )
    return Emissions(np.maximum(complete, 0.0), (*notes, *_interval_notes(complete / rate_hz)))


def louder_and_earlier(
    read: Callable[[int, slice], NDArray[np.float64]],
    emissions: Emissions,
    call: Call,
    *,
    rate_hz: float,
    channel: int,
    n_channels: int,
) -> str:
    """Return a note if another channel has the call louder and up to half an interval earlier."""
    at = float(emissions.times[0])
    interval = float(np.diff(emissions.times).min()) if len(emissions.times) > 1 else math.inf
    first = max(0, math.ceil(at - min(_MAX_EARLIER_S * rate_hz, interval / 2)))
    replica = call_samples(call, rate_hz=rate_hz)
    if at - first < _MIN_EARLIER:
        return ""
    around = slice(first, math.ceil(at) + len(replica))
    loudest = float(np.ptp(read(channel, around)))
    for other in range(n_channels):
        signal = read(other, around)
        if other == channel or not np.isfinite(signal).all() or np.ptp(signal) < loudest:
            continue
        times, match = _of_call(signal.__getitem__, len(signal), replica, call.start_s * rate_hz)
        if match >= _GOOD_MATCH and len(times) and 0 <= times[0] < at - first - _MIN_EARLIER:
            early_s = (at - first - times[0]) / rate_hz
            return (
                f"channel {other} contains the call {1e3 * early_s:.3g} ms before channel {channel}, and louder; "
                f"use sync_channel={other} if channel {other} is the loopback"
            )
    return ""


def _interval_notes(times_s: NDArray[np.float64]) -> Iterator[str]:
    """Yield a note on intervals in which an emission may be missing."""
    intervals_s = np.diff(times_s)
    if len(intervals_s) < 2:
        return
    usual_s = float(np.median(intervals_s))
    long = np.flatnonzero(intervals_s > _IRREGULAR * usual_s)
    if len(long):
        yield (
            f"the emissions at {times_s[long[0]]:.6g} s and {times_s[long[0] + 1]:.6g} s are "
            f"{intervals_s[long[0]] / usual_s:.3g} times as far apart as usual; emissions between them may be missing"
        )


def _of_call(
    read: Reader, n_samples: int, replica: NDArray[np.float64], lead: float
) -> tuple[NDArray[np.float64], float]:
    """Return the times of the call in samples, negative if cut off by the start, and the highest correlation."""
    found: list[tuple[float, float, float]] = []
    length = len(replica)
    medians: list[float] = []
    cumulative = np.cumsum(replica**2)
    for first in range(-length, n_samples, _BLOCK):
        last = min(first + _BLOCK, n_samples)
        signal = _read_padded(read, first - 1, last + length + 1, n_samples)
        level, match = _correlated(signal, replica)
        lags = np.arange(first - 1, first - 1 + len(level))
        heard = 1 - cumulative[np.clip(-lags - 1, 0, length - 1)] / cumulative[-1]
        match = np.where(lags < 0, match / np.sqrt(np.maximum(heard, _MIN_HEARD)), match)
        match[(lags < 0) & (heard < _MIN_HEARD)] = 0
        level = np.where(lags < 0, level / np.maximum(heard, _MIN_HEARD), level)
        medians.append(float(np.median(level)))
        peaks = 1 + np.flatnonzero((level[1:-1] > level[:-2]) & (level[1:-1] >= level[2:]))
        peaks = peaks[(match[peaks] >= _MIN_MATCH / 2) & (lags[peaks] >= first) & (lags[peaks] < last)]
        for peak in peaks.tolist():
            before, here, after = level[peak - 1 : peak + 2].tolist()
            offset = 0.5 * (before - after) / min(before - 2 * here + after, -1e-300)
            found.append((float(lags[peak]) + offset, here, float(match[peak])))
    if not found:
        return np.zeros(0), 0.0
    best = max(correlation for *_, correlation in found)
    sure = [(time, peak_level) for time, peak_level, correlation in found if correlation >= _MIN_MATCH]
    audible = _MIN_PEAK * float(np.median(medians))
    loudest = max((peak_level for _, peak_level in sure), default=0.0)
    kept: list[tuple[float, float]] = []
    for peak_of_call in sure:
        if peak_of_call[1] < max(_SAME_LEVEL * loudest, audible):
            continue
        if kept and peak_of_call[0] - kept[-1][0] < length - lead:
            kept[-1] = max(kept[-1], peak_of_call, key=operator.itemgetter(1))
        else:
            kept.append(peak_of_call)
    return np.array([time for time, _ in kept]), best


def _correlated(signal: NDArray[np.float64], replica: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """Return the envelope of the correlation at each lag, and its ratio to that of an equal signal."""
    length, count = len(replica), len(signal) - len(replica) + 1
    n_fft = scipy.fft.next_fast_len(len(signal), real=True)
    wanted = scipy.fft.rfft(replica, n_fft)
    magnitude = np.abs(wanted)
    band = magnitude > 0.03 * magnitude.max()
    first, last = np.flatnonzero(band)[[0, -1]]
    spectrum = scipy.fft.rfft(signal, n_fft)
    spectrum[:first] = spectrum[last + 1 :] = 0
    within = scipy.fft.irfft(spectrum, n_fft)
    one_sided = np.zeros(n_fft, np.complex128)
    one_sided[: len(spectrum)] = 2 * spectrum * np.conj(wanted)
    level = np.abs(scipy.fft.ifft(one_sided))[:count]
    power = np.concatenate([[0.0], np.cumsum(within[: len(signal)] ** 2)])
    received = np.maximum(power[length:] - power[:-length], 0)[:count]
    floor = 1e-9 * max(float(received.max()), 1e-300)
    return level, level / np.sqrt(np.maximum(received, floor) * np.sum(replica**2))


def _read_padded(read: Reader, first: int, last: int, n_samples: int) -> NDArray[np.float64]:
    """Return samples of the channel, with zeros outside of the file."""
    inside = read(slice(max(first, 0), min(last, n_samples)))
    return np.pad(inside, (max(-first, 0), max(last - n_samples, 0)))


def _onsets(read: Reader, n_samples: int, rate_hz: float) -> tuple[NDArray[np.float64], float]:
    """Return the onsets of pulses in samples, −1 before the first sample, and the rise time of the first pulse."""
    blocks = [slice(first, min(first + _BLOCK, n_samples)) for first in range(0, n_samples, _BLOCK)]
    middles = [float(np.median(read(block))) for block in blocks]
    middle = float(np.median(middles))
    peak = max(float(np.abs(read(block) - middle).max()) for block in blocks)
    noise = float(np.median([np.median(np.abs(read(block) - middle)) for block in blocks]))
    limit = max(_ONSET * peak, _MIN_SNR * noise)
    if peak <= limit or not peak:
        return np.zeros(0), 0.0
    pause = math.ceil(_MIN_PAUSE_S * rate_hz)
    times: list[float] = []
    previous, sign, before, rise_time = -pause, 0.0, 0.0, 0.0
    for block in blocks:
        signal = read(block) - middle
        above = np.flatnonzero(np.abs(signal) > limit)
        starts = above[np.diff(above + block.start, prepend=previous) >= pause]
        for start in starts.tolist():
            sign = sign or math.copysign(1.0, signal[start])
            if signal[start] * sign > 0:
                earlier = abs(signal[start - 1]) if start else before
                rise = (limit - earlier) / max(abs(signal[start]) - earlier, 1e-300)
                time = block.start + start - 1 + float(np.clip(rise, 0, 1))
                pulse = np.abs(signal[start : start + pause])
                rise_time = rise_time or 1.0 + int(np.argmax(pulse >= _RISEN * pulse.max()))
                times.append(time if block.start + start else -1.0)
        previous = int(above[-1]) + block.start if len(above) else previous
        before = abs(float(signal[-1]))
    return np.array(times), rise_time
