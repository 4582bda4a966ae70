"""Pulse compression of recorded echoes: a check that the recorded call is the call of the settings."""

import itertools
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import scipy
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.sample_format import sample_format
from ertis_numba.settings import Call
from ertis_numba.waveform import call_samples

__all__ = ["CallMatch", "call_match", "first_call_match"]

MIN_LOSS: Final = 2.8
"""Ratio of the peak power of another sweep to that of the call, above which the call does not match."""
_MIN_LOSS_OF_MODULATION: Final = 1.25
"""The same ratio for a sweep of equal duration and other modulation, whose peak after the call's filter is sharper."""
_EQUAL_SLOPE: Final = 0.1  # Deviation of the duration of a sweep of equal duration.
_MAX_CREST: Final = 12.0  # Peak to mean power around the call's own strongest peak; higher values indicate the call.
_MIN_SNR: Final = 40.0  # Peak to median power after the best filter; noise reaches about 20.
_MIN_SMEAR: Final = 0.2  # Minimum extent of the peak of another sweep, relative to the call's duration.
_TAPERED_S: Final = 0.3e-3  # Length of the taper at each end of the record.
_MAX_MICS: Final = 6
_FEW_MICS: Final = 2  # Number of microphones that select the sweeps to compare in all microphones.
_MAX_LIKELY: Final = 16
_BLOCK: Final = 32  # Number of slopes in a block, whose arrays fit into a cache.
_MAX_SAMPLES: Final = 2**17  # Limit on the memory of long records.
_MAX_MEASUREMENTS: Final = 8
_MAX_SLOPE: Final = 4.0
_MIN_SLOPE: Final = 0.3  # Shorter sweeps cannot be distinguished from clicks.
_MAX_SLOPES: Final = 400


@dataclass(frozen=True, slots=True)
class CallMatch:
    """Comparison of the call's matched filter with those of other sweeps, for the strongest sound of a measurement.

    Attributes
    ----------
    loss_db : float
        Peak level after the best filter, relative to the peak after the call's own.
    slope : float
        Sweep duration of the best filter in units of the call's; negative for the opposite direction.
    modulation : {"hyperbolic", "linear"}
        Modulation of the best filter.
    matches : bool
        False if the sound is a sweep other than the call.
    """

    loss_db: float
    slope: float
    modulation: Literal["hyperbolic", "linear"]
    matches: bool

    @property
    def warning(self) -> str:
        """One-line warning; empty if the echoes match the call."""
        if self.matches:
            return ""
        direction = "in the opposite direction" if self.slope < 0 else "in the same direction"
        length = abs(self.slope)
        sweep = f"a {self.modulation} sweep {direction}"
        if not 0.9 < length < 1.1:
            sweep += f" with {length:.2g} times the call's duration over the same band"
        return (
            f"echoes do not match the call of the settings: they look like {sweep}, whose matched filter has a peak "
            f"{self.loss_db:.0f} dB higher. Ranges in the image are wrong; give the emitted call as [call] in a "
            "settings file"
        )


def first_call_match(measurements: Iterable[Measurement]) -> CallMatch | None:
    """Return the match of the first measurement with sound above the noise; None if the first 8 contain no sound."""
    for measurement in itertools.islice(measurements, _MAX_MEASUREMENTS):
        found = call_match(measurement)
        if found is not None:
            return found
    return None


def call_match(measurement: Measurement) -> CallMatch | None:
    """Compare the call's matched filter with those of sweeps of other slopes.

    All filters have the magnitude of the call's spectrum, so a single echo of the call has its highest peak after the
    call's own filter. If the call's filter compresses part of the sound, the call matches, because another sensor may
    be louder.

    Parameters
    ----------
    measurement : Measurement

    Returns
    -------
    CallMatch or None
        None if no sound is above the noise, or the band is too narrow for pulse compression.

    Raises
    ------
    DataError
        The samples do not match the settings.
    """
    settings = measurement.settings
    spectra, magnitude, own, frequency_hz = _spectra(measurement)
    if len(frequency_hz) < 8:  # The band is too narrow, or the record too short, for pulse compression.
        return None
    call = settings.call
    bandwidth_hz = call.high_frequency_hz - call.low_frequency_hz
    n_fft = scipy.fft.next_fast_len(2 * len(frequency_hz))
    plain = (spectra * magnitude).astype(np.complex64)  # Single precision takes half the time of double precision.
    before = _power((spectra * own).astype(np.complex64), n_fft)
    spacing_s = 1 / (n_fft * (frequency_hz[1] - frequency_hz[0]))
    min_half = max(2, round(_MIN_SMEAR * call.duration_s / spacing_s))
    if _snr(before) >= _MIN_SNR and _crest(before, min_half) >= _MAX_CREST:
        return CallMatch(0.0, 1.0, call.modulation, matches=True)  # No other sweep can change this result.
    step = max(1 / (bandwidth_hz * call.duration_s), 2 * _MAX_SLOPE / _MAX_SLOPES)
    count = math.ceil(_MAX_SLOPE / step)
    slopes = np.arange(-count, count + 1) * (_MAX_SLOPE / count)
    highest = np.maximum(before.max(axis=1).astype(np.float64), 1e-300)
    likely = []
    for linear in (False, True):
        curve_rad = _phase_of_sweep(call, frequency_hz, linear=linear)
        for some in np.array_split(slopes, math.ceil(len(slopes) / _BLOCK)):
            peaks = _turned(plain[:_FEW_MICS], some, curve_rad, n_fft).max(axis=2)
            ratios = np.median(peaks / highest[:_FEW_MICS], axis=1)
            likely += [(ratio, linear, slope) for ratio, slope in zip(ratios.tolist(), some.tolist(), strict=True)]
    best_ratio, best_slope, best_linear, best = 0.0, 0.0, False, before
    for _, linear, slope in sorted(likely, reverse=True)[:_MAX_LIKELY]:
        curve_rad = _phase_of_sweep(call, frequency_hz, linear=linear)
        (power,) = _turned(plain, np.array([slope]), curve_rad, n_fft)
        ratio = float(np.median(power.max(axis=1) / highest))
        if ratio > best_ratio:
            best_ratio, best_slope, best_linear, best = ratio, slope, linear, power
    if best_ratio == 0 or _snr(best) < _MIN_SNR:
        return None
    smear_s = max(abs(best_slope - 1), _MIN_SMEAR) * call.duration_s
    crest = _crest(before, max(2, round(smear_s / spacing_s)))
    is_of_same_duration = abs(best_slope - 1) < _EQUAL_SLOPE and best_linear != (call.modulation == "linear")
    least = _MIN_LOSS_OF_MODULATION if is_of_same_duration else MIN_LOSS
    wrong = best_ratio > least and abs(best_slope) >= _MIN_SLOPE and crest < _MAX_CREST
    return CallMatch(
        10 * math.log10(best_ratio), best_slope, "linear" if best_linear else "hyperbolic", matches=not wrong
    )


def _spectra(
    measurement: Measurement,
) -> tuple[NDArray[Any], NDArray[np.float64], NDArray[np.complex128], NDArray[np.float64]]:
    """Return spectra of some microphones in the call's band, the call's magnitude, its filter, and frequencies."""
    settings = measurement.settings
    form = sample_format(settings)
    words, _ = form.normalised(form.validated(measurement.data))
    words = words[:_MAX_SAMPLES]
    channels = np.flatnonzero(microphones(settings.array).enabled).astype(np.int32)
    channels = np.ascontiguousarray(channels[:: max(1, -(-len(channels) // _MAX_MICS))])
    signals = np.empty((len(channels), len(words)), dtype=np.float32)
    plain = kernels.load("numpy")  # These kernels need no compilation.
    if settings.recording.is_pdm:
        plain.unpack_bits(words, channels, signals)
    else:
        scale = np.float32(1 / settings.recording.full_scale)
        plain.unpack_pcm(words, channels, scale, np.float32(0), 0, signals)
    call = settings.call
    rate_hz = settings.recording.sample_rate_hz
    emitted = call_samples(call, rate_hz=rate_hz)
    # Without a taper, a hum below the band would cause clicks at both ends.
    edge = np.arange(len(words)) / (_TAPERED_S * rate_hz)
    signals *= np.sin(np.pi / 2 * np.minimum(1.0, np.minimum(edge, edge[::-1]))).astype(np.float32) ** 2
    n_fft = scipy.fft.next_fast_len(len(words) + len(emitted), real=True)
    low, high = (round(edge * n_fft / rate_hz) for edge in (call.low_frequency_hz, call.high_frequency_hz))
    bins = np.arange(max(1, low), min(high, n_fft // 2) + 1)
    spectra = scipy.fft.rfft(signals, n_fft, axis=1)[:, bins]
    own = np.conj(scipy.fft.rfft(emitted, n_fft)[bins])
    return spectra, np.abs(own), own, bins * rate_hz / n_fft


def _phase_of_sweep(call: Call, frequency_hz: NDArray[np.float64], *, linear: bool) -> NDArray[np.float64]:
    """Return the phase of a sweep's matched filter over the call's band.

    Group delays are relative to the delay at the lowest frequency. This shifts peaks but does not widen them.
    """
    span = frequency_hz - frequency_hz[0]
    if linear:
        return np.asarray(math.pi * span**2 * call.duration_s / (call.stop_frequency_hz - call.start_frequency_hz))
    slowness = call.duration_s / (1 / call.stop_frequency_hz - 1 / call.start_frequency_hz)
    at_first = slowness / frequency_hz[0]
    return np.asarray(2 * math.pi * (slowness * np.log(frequency_hz / frequency_hz[0]) - span * at_first))


def _turned(
    spectra: NDArray[np.complex64], slopes: NDArray[np.float64], curve_rad: NDArray[np.float64], n_fft: int
) -> NDArray[np.float32]:
    """Return the power after the matched filters of some sweeps: (slope, mic, sample) float32."""
    angles_rad = np.outer(slopes, curve_rad).astype(np.float32)
    filters = np.cos(angles_rad) + np.complex64(1j) * np.sin(angles_rad)
    return _power(filters[:, None] * spectra, n_fft)


def _power(spectra: NDArray[np.complex64], n_fft: int) -> NDArray[np.float32]:
    made = scipy.fft.ifft(spectra, n_fft, axis=-1)
    return np.asarray(made.real**2 + made.imag**2)


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
