"""Comparison of the sweep in a record with the call of the settings."""

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from ertis_numba.analysis.call_start import WIDER, start_error_s, start_match
from ertis_numba.analysis.emission_time import emission_time_s
from ertis_numba.analysis.foreign_call import foreign_sweep
from ertis_numba.analysis.health.limits import MAX_SHIFT_S
from ertis_numba.analysis.sound_spectra import SoundSpectra, some_signals, sound_spectra
from ertis_numba.analysis.sweep_search import (
    FoundSweep,
    GatedArrival,
    arrival_of,
    find_sweep,
    power_after,
    refined,
    sub_band_hz,
    sweep_along,
)
from ertis_numba.analysis.sweeps import Curve, Sweep, curve_of
from ertis_numba.base import fourier
from ertis_numba.frames import Measurement
from ertis_numba.geometry.waveform import call_samples
from ertis_numba.settings import Call

__all__ = ["SILENT", "CallMatch", "call_match", "first_call_match"]

_WRONG: Final = "another call was emitted, and ranges in the image are wrong"
_MIN_RATIO: Final = 1.3
"""Ratio of the peak powers of another sweep and the call, above which the call does not match."""
_MIN_CLEAR_RATIO: Final = 1.7  # The same, up to which two echoes of the call close together may explain it.
_MAX_DOPPLER: Final = 0.03  # Change of the slope of linear sweeps by motion at 2.5 m/s.
_BEYOND: Final = 1.3  # Largest range errors of calls of another kind, relative to the tolerance of the start.
_MIN_CREST: Final = 12.0  # Peak to mean power around the call's own strongest peak; higher values indicate the call.
_MIN_SNR: Final = 40.0  # Peak to median power after the best filter; noise reaches about 20.
_SMEAR: Final = 0.2  # Extent of the peak after the filter of another call, relative to the call's duration.
_MIN_BINS: Final = 8  # Fewer are too few for pulse compression.
_MAX_MICS: Final = 6
_PADDING_S: Final = 5e-3
_MAX_MEASUREMENTS: Final = 8
_SCALED: Final = 0.25  # Largest difference of the scales of frequencies and of the duration.
_LEAST_SCALE: Final = 0.03  # Natural logarithm of a scale of time.
_MAX_SWEEP_HZ: Final = 190e3  # What fills the record up to 200 kHz is noise of modulators, or a click.
_MIN_BANDWIDTH_HZ: Final = 12e3  # Bandwidth of a call that is no tone.


@dataclass(frozen=True, slots=True)
class CallMatch:
    """Comparison of the call with the sweep of the strongest sound of a measurement.

    ``verdict`` is "differs" if the sound is a sweep other than the call; the field ``sweep`` then states it, and
    ``loss_db`` its peak level after the call's matched filter relative to that after its own. ``note`` is the reason of
    "unknown". For a call that matches, ``start_error_s`` is the largest error of the time of emission, None if the
    sound does not show it, and ``foreign`` another sweep in its band, such as that of another sensor.
    """

    verdict: Literal["matches", "differs", "unknown"]
    loss_db: float = 0.0
    sweep: Sweep | None = None
    call: Call | None = None
    note: str = ""
    start_error_s: float | None = None
    foreign: Sweep | None = None

    @property
    def warning(self) -> str:
        """Mismatch, another call, or the reason why the match is unknown, in one line; empty without any."""
        if self.foreign is not None:
            return (
                f"besides the call of the settings, the record contains {self.foreign}, perhaps of another sensor. Its "
                "echoes appear as rings of ghosts; silence it, or use equal calls on one SYNC chain and 'ertis fuse'"
            )
        if self.sweep is None or self.call is None:
            return self.note
        text = f"echoes do not match the call of the settings: they look like {self.sweep}"
        opposite = self.call.waveform is None and (self.sweep.stop_hz > self.sweep.start_hz) != (
            self.call.stop_frequency_hz > self.call.start_frequency_hz
        )
        if opposite and self.sweep.is_compressible:
            text += ", in the opposite direction"
        if self.loss_db >= 1:
            text += f", whose matched filter has a peak {self.loss_db:.0f} dB higher"
        return f"{text}. Ranges in the image are wrong; set the emitted call as [call] in a settings file"


SILENT: Final = CallMatch("unknown", note="the record contains no sweep above the noise, so the call was not checked")
"""Result for measurements without a sweep."""


def first_call_match(measurements: Iterable[Measurement], *, best: bool = False) -> CallMatch:
    """Return the first known match among 8 measurements; otherwise the first unknown one with sound."""
    every = []
    for measurement in itertools.islice(measurements, _MAX_MEASUREMENTS):
        every.append(call_match(measurement))
        if every[-1].verdict == "matches" or (every[-1].verdict == "differs" and not best):
            return every[-1]
    ranks = ("differs", "unknown")
    return min(every, key=lambda each: (ranks.index(each.verdict), each is SILENT), default=SILENT)


def call_match(measurement: Measurement) -> CallMatch:
    """Compare the call with the sweep that the strongest sound contains, over the whole band of the record."""
    # The call matches if its filter compresses part of the sound, no similar sweep does so better, and the emission
    # begins at its first frequency. Another sensor may be louder.
    call = measurement.settings.call
    signals, rate_hz = some_signals(measurement, _MAX_MICS)
    low_hz = min(sub_band_hz(rate_hz) / 2, call.low_frequency_hz / WIDER)
    sound = sound_spectra(signals, rate_hz, low_hz=low_hz, padding_s=call.end_s + _PADDING_S)
    if len(sound.frequency_hz) < _MIN_BINS:
        return SILENT
    found = _match(sound, call)
    if found.verdict == "matches" and (curve := curve_of(call)) is not None:
        return replace(found, foreign=foreign_sweep(sound, call, curve))
    is_clear = found is SILENT or found.verdict != "unknown"
    emission_s = None if is_clear else emission_time_s(measurement)
    if emission_s is None or abs(emission_s) > MAX_SHIFT_S:
        return found
    return CallMatch(
        "matches", found.loss_db, start_error_s=MAX_SHIFT_S
    )  # Direct sound at the right time shows that ranges are right.


def _match(sound: SoundSpectra, call: Call) -> CallMatch:
    """Return the match of a call with a sound, without the time of the direct sound."""
    is_heard, curve = _is_heard(sound, call), curve_of(call)
    if is_heard and curve is None:
        found = find_sweep(sound)  # A waveform that was read with another sample rate is a longer or shorter call.
        other = SILENT if found is None or not _is_scaled(found.sweep, call) else _compared(sound, found, call)
        return CallMatch("matches") if other is SILENT else other
    judged = SILENT
    if is_heard and curve is not None:
        arrival = arrival_of(sound, curve, call.low_frequency_hz, call.high_frequency_hz)
        better, gain = refined(arrival, curve)
        judged = _judged(sound, arrival, (curve, better), call)
        if gain < _MIN_RATIO or _differs_by_motion(better, curve):
            return judged
    found = find_sweep(sound)
    if found is not None and found.sweep.high_hz <= _MAX_SWEEP_HZ:
        return _compared(sound, found, call)
    return judged


def _is_scaled(sweep: Sweep, call: Call) -> bool:
    """Return True if a sweep is about as the call, but with time and frequency on another scale."""
    of_time = call.duration_s / max(sweep.duration_s, 1e-9)
    scales = sweep.low_hz / call.low_frequency_hz, sweep.high_hz / call.high_frequency_hz, of_time
    return max(scales) / min(scales) < 1 + _SCALED and abs(math.log(np.mean(scales))) > _LEAST_SCALE


def _filter_rad(call: Call, sound: SoundSpectra, part: slice) -> NDArray[np.float64]:
    """Return the phases of the call's matched filter, which continues beyond its band if the call is a sweep."""
    curve = curve_of(call)
    if curve is not None:
        return curve.phase_rad(sound.frequency_hz[part])
    spectrum = fourier.rfft(call_samples(call, rate_hz=sound.rate_hz), sound.n_fft)
    first = round(float(sound.frequency_hz[0]) * sound.n_fft / sound.rate_hz)
    return np.asarray(-np.angle(spectrum[first:][part]))


def _is_heard(sound: SoundSpectra, call: Call) -> bool:
    """Return True if the call's filter compresses part of the sound."""
    part = sound.band(call.low_frequency_hz, call.high_frequency_hz)
    if part.stop - part.start < _MIN_BINS:
        return False
    power = power_after(sound, _filter_rad(call, sound, part), part)
    half = max(2, round(_SMEAR * call.duration_s * sound.time_rate_hz))
    return _snr(power) >= _MIN_SNR and _crest(power, half) >= _MIN_CREST


def _differs_by_motion(curve: Curve, own: Curve | None) -> bool:
    """Return True if motion may cause the difference of two curves; hyperbolic sweeps tolerate motion."""
    return (
        own is not None
        and curve.modulation == own.modulation != "hyperbolic"
        and abs(float(curve.slopes_s_hz(np.array(own.pivot_hz))) / own.slope_s_hz - 1) < _MAX_DOPPLER
    )


def _compared(sound: SoundSpectra, found: FoundSweep, call: Call) -> CallMatch:
    """Return the match of the call with the sweep of the sound, which is unknown if that is no sweep."""
    sweep, bandwidth_hz = found.sweep, call.high_frequency_hz - call.low_frequency_hz
    is_tone = sweep.is_tone and bandwidth_hz > _MIN_BANDWIDTH_HZ
    is_near = sweep.high_hz > call.low_frequency_hz / WIDER and sweep.low_hz < call.high_frequency_hz * WIDER
    if not sweep.is_compressible and not (is_tone and is_near):
        return SILENT
    part = sound.band(min(sweep.low_hz, call.low_frequency_hz), max(sweep.high_hz, call.high_frequency_hz))
    best = power_after(sound, found.curve.phase_rad(sound.frequency_hz[part]), part)
    if _snr(best) < _MIN_SNR:
        return SILENT
    own = power_after(sound, _filter_rad(call, sound, part), part)
    ratio = float(np.median(best.max(axis=1) / np.maximum(own.max(axis=1), 1e-30)))
    loss_db = max(0.0, 10 * math.log10(ratio))
    if sweep.is_tone or (ratio > _MIN_RATIO and not _differs_by_motion(found.curve, curve_of(call))):
        if ratio < _MIN_CLEAR_RATIO and not sweep.is_tone:
            either = f"echoes look like {sweep}, or like two close echoes of the call"
            note = f"{either}; if they are not two echoes, {_WRONG}"
            return CallMatch("unknown", loss_db, call=call, note=note)
        return CallMatch("differs", loss_db, sweep, call)
    own_curve = curve_of(call)
    if own_curve is None:
        return CallMatch("matches", loss_db)
    arrival = arrival_of(sound, own_curve, call.low_frequency_hz, call.high_frequency_hz)
    return _judged(sound, arrival, (own_curve, found.curve), call, loss_db)


def _judged(
    sound: SoundSpectra, arrival: GatedArrival, curves: tuple[Curve, Curve], call: Call, loss_db: float = 0.0
) -> CallMatch:
    """Return the match of a call whose curve is nearly that of the sound, by the start of the emission."""
    start = start_match(sound, call, curves, arrival)
    if start == "same":
        return CallMatch("matches", loss_db, start_error_s=_BEYOND * start_error_s(call, curves[0]))
    sweep = sweep_along(sound, curves[1], call.low_frequency_hz / WIDER, call.high_frequency_hz * WIDER)
    if start == "before":
        return CallMatch("differs", loss_db, sweep, call)
    reason = f"echoes contain only about {sweep.band} of the call; if its emitter has no such band"
    if start == "unknown":
        first = f"{call.start_frequency_hz / 1e3:g} kHz"
        reason = f"echoes do not show whether the emission begins at {first} as the call does; if it does not"
    return CallMatch("unknown", loss_db, call=call, note=f"{reason}, {_WRONG}")


def _snr(power: NDArray[np.float32]) -> float:
    """Return the peak power relative to the median power, as the median over microphones."""
    middle = np.median(power, axis=1).astype(np.float64)
    return float(np.median(power.max(axis=1) / np.maximum(middle, 1e-300)))


def _crest(power: NDArray[np.float32], half: int) -> float:
    """Return the peak power relative to the mean within ``half`` samples of it, as the median over microphones."""
    crests = []
    for row in power:
        peak = int(np.argmax(row))
        around = row[max(0, peak - half) : peak + half + 1]
        crests.append(float(row[peak]) / max(float(around.mean()), 1e-300))
    return float(np.median(crests))
