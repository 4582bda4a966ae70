"""Comparison of the sweep in a record with the call of the settings."""

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba.analysis.sound_spectra import SoundSpectra, some_signals, sound_spectra
from ertis_numba.analysis.sweep_search import (
    FoundSweep,
    arrival_of,
    find_sweep,
    power_after,
    refined,
    sub_band_hz,
)
from ertis_numba.analysis.sweeps import Curve, Sweep, curve_of
from ertis_numba.frames import Measurement
from ertis_numba.settings import Call
from ertis_numba.waveform import call_samples

__all__ = ["UNKNOWN_CALL", "CallMatch", "call_match", "first_call_match"]

UNKNOWN_CALL: Final = "the record contains no sweep above the noise, so the call was not checked"
"""Note on measurements that `call_match` cannot compare."""
_WRONG: Final = "another call was emitted, and ranges in the image are wrong"
_MIN_RATIO: Final = 1.3
"""Ratio of the peak powers of another sweep and the call, above which the call does not match."""
_MAX_DOPPLER: Final = 0.03  # Change of the slope of linear sweeps by motion at 2.5 m/s.
_MIN_CREST: Final = 12.0  # Peak to mean power around the call's own strongest peak; higher values indicate the call.
_MIN_SNR: Final = 40.0  # Peak to median power after the best filter; noise reaches about 20.
_SMEAR: Final = 0.2  # Extent of the peak after the filter of another call, relative to the call's duration.
_MIN_BINS: Final = 8  # Fewer are too few for pulse compression.
_MAX_MICS: Final = 6
_PADDING_S: Final = 5e-3
_MAX_MEASUREMENTS: Final = 8
_WIDER: Final = 1.5  # Ratio of the band in which sound of the same sweep is searched to the band of the call.
_GATE_S: Final = 0.4e-3
_MAX_OUTSIDE: Final = 0.15  # Share of the power of an arrival outside of the call's band.
_MIN_OUTSIDE: Final = 0.3  # That power relative to the background.
_MARGIN: Final = 2.0  # Skirts of the call's spectrum, in units of its inverse duration.
_LEVELS: Final = (10**-0.6, 10**-1.2)
_MAX_NOISE: Final = 10**-1.4
_SHARP: Final = 1.3  # Ratio of bandwidths at these levels; that of transducers is above 1.4.
_MAX_SHARE: Final = 0.75  # Bandwidth of the echoes of another call relative to that of the call.
_MIN_SHARE: Final = 0.5  # Bandwidth without sharp edges, below which the call is not known.
_MAX_SWEEP_HZ: Final = 190e3  # What fills the record up to 200 kHz is noise of modulators, or a click.
_MIN_BANDWIDTH_HZ: Final = 12e3  # Bandwidth of a call that is no tone.


@dataclass(frozen=True, slots=True)
class CallMatch:
    """Comparison of the call with the sweep of the strongest sound of a measurement.

    Attributes
    ----------
    matches : bool
        False if the sound is a sweep other than the call.
    loss_db : float
        Peak level after the matched filter of that sweep, relative to the peak after the call's own; 0 by default.
    sweep : Sweep, optional
        Sweep of the sound; None if the sound is the call.
    call : Call, optional
        Call with which it was compared.
    note : str
        Reason why the match is not certain; empty by default.
    """

    matches: bool
    loss_db: float = 0.0
    sweep: Sweep | None = None
    call: Call | None = None
    note: str = ""

    @property
    def warning(self) -> str:
        """One-line warning; empty if the echoes match the call."""
        if self.matches or self.sweep is None or self.call is None:
            return ""
        text = f"echoes do not match the call of the settings: they look like {self.sweep}"
        opposite = self.call.waveform is None and (self.sweep.stop_hz > self.sweep.start_hz) != (
            self.call.stop_frequency_hz > self.call.start_frequency_hz
        )
        if opposite and self.sweep.is_compressible:
            text += ", in the opposite direction"
        if self.loss_db >= 1:
            text += f", whose matched filter has a peak {self.loss_db:.0f} dB higher"
        return f"{text}. Ranges in the image are wrong; set the emitted call as [call] in a settings file"


def first_call_match(measurements: Iterable[Measurement]) -> CallMatch | None:
    """Return the match of the first measurement with sound above the noise; None if the first 8 contain no sound."""
    for measurement in itertools.islice(measurements, _MAX_MEASUREMENTS):
        found = call_match(measurement)
        if found is not None:
            return found
    return None


def call_match(measurement: Measurement) -> CallMatch | None:
    """Compare the call with the sweep that the strongest sound contains, over the whole band of the record.

    If the call's filter compresses part of the sound, and no similar sweep compresses that part better, the call
    matches, because another sensor may be louder.

    Parameters
    ----------
    measurement : Measurement

    Returns
    -------
    CallMatch or None
        None if the sound does not permit a comparison: it is not above the noise, or is not a sweep.

    Raises
    ------
    DataError
        The samples do not match the settings.
    """
    call = measurement.settings.call
    signals, rate_hz = some_signals(measurement, _MAX_MICS)
    low_hz = min(sub_band_hz(rate_hz) / 2, call.low_frequency_hz / _WIDER)
    sound = sound_spectra(signals, rate_hz, low_hz=low_hz, padding_s=call.end_s + _PADDING_S)
    if len(sound.frequency_hz) < _MIN_BINS:
        return None
    if _is_heard(sound, call) and _is_alone(sound, call):
        return CallMatch(matches=True)
    found = find_sweep(sound)
    if found is None or found.sweep.high_hz > _MAX_SWEEP_HZ:
        return CallMatch(matches=True) if _is_heard(sound, call) else None
    return _compared(sound, found, call)


def _filter_rad(call: Call, sound: SoundSpectra, part: slice) -> NDArray[np.float64]:
    """Return the phases of the call's matched filter, which continues beyond its band if the call is a sweep."""
    curve = curve_of(call)
    if curve is not None:
        return curve.phase_rad(sound.frequency_hz[part])
    spectrum = scipy.fft.rfft(call_samples(call, rate_hz=sound.rate_hz), sound.n_fft)
    first = round(float(sound.frequency_hz[0]) * sound.n_fft / sound.rate_hz)
    return np.asarray(-np.angle(spectrum[first:][part]))


def _is_heard(sound: SoundSpectra, call: Call) -> bool:
    """Return True if the call's filter compresses part of the sound."""
    part = sound.band(call.low_frequency_hz, call.high_frequency_hz)
    if part.stop - part.start < _MIN_BINS:
        return False
    power = power_after(sound, _filter_rad(call, sound, part), part)
    half = max(2, round(_SMEAR * call.duration_s * sound.rate_hz))
    return _snr(power) >= _MIN_SNR and _crest(power, half) >= _MIN_CREST


def _is_alone(sound: SoundSpectra, call: Call) -> bool:
    """Return True if no similar sweep compresses the strongest arrival better, and it fills the call's band."""
    curve = curve_of(call)
    if curve is None:
        return True
    arrival = arrival_of(sound, curve, call.low_frequency_hz, call.high_frequency_hz)
    better, gain = refined(arrival, curve)
    is_similar = gain < _MIN_RATIO or _differs_by_motion(better, curve)
    return is_similar and _band_of(sound, FoundSweep(curve, Sweep.of_call(call)), call) == "same"


def _differs_by_motion(curve: Curve, own: Curve | None) -> bool:
    """Return True if motion may cause the difference of two curves; hyperbolic sweeps tolerate motion."""
    return (
        own is not None
        and curve.modulation == own.modulation != "hyperbolic"
        and abs(float(curve.slopes_s_hz(np.array(own.pivot_hz))) / own.slope_s_hz - 1) < _MAX_DOPPLER
    )


def _band_of(sound: SoundSpectra, found: FoundSweep, call: Call) -> Literal["same", "other", "narrow"]:
    """Compare the band of the strongest arrival with that of the call; transducers have bands without sharp edges."""
    low_hz = min(found.sweep.low_hz, call.low_frequency_hz / _WIDER)
    high_hz = max(found.sweep.high_hz, call.high_frequency_hz * _WIDER)
    whole_hz = (call.low_frequency_hz, call.high_frequency_hz)
    arrival = arrival_of(sound, found.curve, low_hz, high_hz, gate_s=_GATE_S, whole_hz=whole_hz)
    if not arrival.peak.any():
        return "same"
    at_hz, power, background = arrival.frequency_hz, arrival.power, arrival.background
    margin_hz = _MARGIN / call.duration_s
    outside = (at_hz < call.low_frequency_hz - margin_hz) | (at_hz > call.high_frequency_hz + margin_hz)
    beyond = float(power[outside].sum())
    if beyond > _MAX_OUTSIDE * power.sum() and beyond > _MIN_OUTSIDE * background[outside].sum():
        return "other"
    inside = (at_hz >= call.low_frequency_hz) & (at_hz <= call.high_frequency_hz)
    expected = np.abs(found.curve.slopes_s_hz(at_hz[inside])) + 1e-30  # A sweep stays there for this time.
    power, background = power[inside] / expected, background[inside] / expected
    if len(power) < _MIN_BINS or background.max() > _MAX_NOISE * power.max():
        bandwidth_hz = call.high_frequency_hz - call.low_frequency_hz
        return "narrow" if found.sweep.high_hz - found.sweep.low_hz < _MAX_SHARE * bandwidth_hz else "same"
    inner, outer = (int(np.ptp(np.flatnonzero(power > level * power.max()))) for level in _LEVELS)
    if outer < _MAX_SHARE * len(power) and outer < _SHARP * inner:
        return "other"
    return "narrow" if outer < _MIN_SHARE * len(power) else "same"


def _compared(sound: SoundSpectra, found: FoundSweep, call: Call) -> CallMatch | None:
    """Return the match of the call with the sweep of the sound; None if that is no sweep."""
    sweep, bandwidth_hz = found.sweep, call.high_frequency_hz - call.low_frequency_hz
    if not sweep.is_compressible and not (sweep.is_tone and bandwidth_hz > _MIN_BANDWIDTH_HZ):
        return None
    part = sound.band(min(sweep.low_hz, call.low_frequency_hz), max(sweep.high_hz, call.high_frequency_hz))
    best = power_after(sound, found.curve.phase_rad(sound.frequency_hz[part]), part)
    if _snr(best) < _MIN_SNR:
        return None
    own = power_after(sound, _filter_rad(call, sound, part), part)
    ratio = float(np.median(best.max(axis=1) / np.maximum(own.max(axis=1), 1e-30)))
    loss_db, band = max(0.0, 10 * math.log10(ratio)), _band_of(sound, found, call)
    is_other = ratio > _MIN_RATIO and not _differs_by_motion(found.curve, curve_of(call))
    if sweep.is_tone or is_other or band == "other":
        return CallMatch(matches=False, loss_db=loss_db, sweep=sweep, call=call)
    if band == "narrow":
        note = f"echoes contain only about {sweep.band} of the call; if its emitter has no such band, {_WRONG}"
        return CallMatch(matches=True, loss_db=loss_db, call=call, note=note)
    return CallMatch(matches=True, loss_db=loss_db, call=call)


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
