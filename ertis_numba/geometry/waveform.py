"""Samples and spectrum of the call, its matched filter, and the decimation filter."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.settings import Call, Settings
from ertis_numba.settings.fir_filters import FirFilters

__all__ = [
    "MatchedFilterSpectrum",
    "call_at",
    "call_samples",
    "call_spectrum",
    "decimation_taps",
    "filter_response",
    "integer_taps",
    "matched_band_hz",
    "matched_filter_spectrum",
    "matched_guard_s",
    "matched_noise_spectrum",
]

_TRANSITION_HZ = 5_000.0  # wide enough for the matched filter to ring for only 0.4 ms
_MIN_TRANSITION = 0.02  # relative to the decimated rate; the length of the filter is proportional to the inverse
_STOPBAND_ATTENUATION_DB = 60.0
_MAX_FILTERS = 32  # About five times the number of filters in one search for a plan.
_MAX_SPECTRA = 8  # a plan and its pipeline use three; one takes at most some megabytes
_STOPBAND_TOLERANCE_DB = 0.5  # tolerance of the stopband attenuation
_WAVEFORM_OVERSAMPLING = 16  # oversampling of a custom waveform before spline interpolation
_MAX_ROUNDING_ERROR_DB = (
    -50.0
)  # limit on the change of the response by rounding taps, for a stopband attenuation of up to 60 dB


def call_samples(call: Call, *, rate_hz: float | None = None) -> NDArray[np.float64]:
    """Return the emitted call: (sample,), amplitude 1 between its ramps, after the silence before it.

    Hyperbolic sweeps have the frequency ``f(t) = 1 / (1/f₀ + t (1/f₁ − 1/f₀) / T)`` and the phase
    ``2π T / (1/f₁ − 1/f₀) · ln(f₀ / f(t))``, from t = 0 to T inclusive (J. J. Kroszczynski, Pulse compression by means
    of linear-period modulation, Proc. IEEE 57, 1969). Linear sweeps have the frequency ``f(t) = f₀ + t (f₁ − f₀) / T``.
    Custom waveforms are interpolated; see `call_at`.
    """
    rate_hz = call.sample_rate_hz if rate_hz is None else rate_hz
    call.require_samples()
    if call.waveform is not None and rate_hz == call.sample_rate_hz:
        return np.concatenate([np.zeros(call.n_silent), np.array(call.waveform, dtype=np.float64)])
    time_s = np.arange(math.floor(call.end_s * rate_hz * (1 + 1e-12)) + 1) / rate_hz
    return call_at(call, time_s)


def call_at(call: Call, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the call at any times after the start of the record; it is 0 outside ``[start_s, end_s]``."""
    # A custom waveform is oversampled 16 times, and interpolated by cubic splines with an error of -100 dB.
    time_s = np.asarray(time_s) - call.start_s
    inside = (time_s >= 0.0) & (time_s <= call.duration_s)
    values = np.zeros(time_s.shape)
    values[inside] = _inside(call, time_s[inside])
    return values


def _inside(call: Call, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the call at times within ``[0, duration_s]`` after its start."""
    if call.waveform is not None:
        return _interpolator(call)(time_s)
    edge_s = np.minimum(time_s, call.duration_s - time_s)
    ramp_s = call.ramp_fraction * call.duration_s
    ramp = np.sin(math.pi / 2 * np.minimum(edge_s, ramp_s) / ramp_s) ** 2 if ramp_s else 1.0
    return np.asarray(np.sin(_phase_rad(call, time_s)) * ramp)


@functools.lru_cache(maxsize=8)
def _interpolator(call: Call) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return a custom waveform as a function of time."""
    from scipy.interpolate import CubicSpline  # noqa: PLC0415  takes long to import, and few need it

    samples = np.array(call.waveform)
    n_fft = 2 ** math.ceil(math.log2(2 * len(samples)))  # zero padding against circular wrap-around
    dense = np.fft.irfft(np.fft.rfft(samples, n_fft), n_fft * _WAVEFORM_OVERSAMPLING) * _WAVEFORM_OVERSAMPLING
    time_s = np.arange((len(samples) - 1) * _WAVEFORM_OVERSAMPLING + 2) / (call.sample_rate_hz * _WAVEFORM_OVERSAMPLING)
    spline: Callable[[NDArray[np.float64]], NDArray[np.float64]] = CubicSpline(time_s, dense[: len(time_s)])
    return spline


def _phase_rad(call: Call, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    if call.modulation == "linear":
        rise_hz_s = (call.stop_frequency_hz - call.start_frequency_hz) / call.duration_s
        return 2 * math.pi * time_s * (call.start_frequency_hz + time_s * rise_hz_s / 2)
    period_s = 1 / call.start_frequency_hz
    period_rise = (1 / call.stop_frequency_hz - period_s) / call.duration_s
    return 2 * math.pi / period_rise * np.log1p(time_s * period_rise / period_s)


def call_spectrum(call: Call, settings: Settings, *, n_fft: int) -> NDArray[np.complex128]:
    """Return the one-sided spectrum of a call in decimated signals: (bin,); ``n_fft`` is at least the call's length."""
    # At the decimated rate, a short call without ramps would alias.
    return _call_spectrum(call, settings.recording.sample_rate_hz, n_fft, settings.decimation)


def _call_spectrum(call: Call, sample_rate_hz: float, n_fft: int, decimation: int) -> NDArray[np.complex128]:
    samples = call_samples(call, rate_hz=sample_rate_hz)
    return np.asarray(np.fft.rfft(samples, n_fft * decimation)[: n_fft // 2 + 1] / decimation)


@dataclass(frozen=True, slots=True, eq=False)
class MatchedFilterSpectrum:
    """The matched filter of a call as the occupied bins of a one-sided spectrum, (bin,), from ``first_bin`` on."""

    # `echo_power` is that of the filtered call in any unit, and `centre_hz` its mean frequency.

    first_bin: int
    values: NDArray[np.complex128]
    echo_power: NDArray[np.float64]
    centre_hz: float


def matched_band_hz(settings: Settings) -> tuple[float, float]:
    """Return the band of the matched filter: `processing.band_edges_hz`, or the call's band widened by 5 kHz."""
    call, given = settings.call, settings.processing.band_edges_hz
    if given is not None:
        return given
    edge_hz = min(_TRANSITION_HZ, call.low_frequency_hz / 2)
    return call.low_frequency_hz - edge_hz, call.high_frequency_hz + edge_hz


def matched_guard_s(settings: Settings, *, down_db: float = 60.0) -> float:
    """Return the time that the matched filter rings before and after the call until it has fallen by ``down_db``."""
    # The edges of its band are raised cosines, whose transform falls with the third power of time.
    low_hz, high_hz = matched_band_hz(settings)
    narrowest_hz = min(settings.call.low_frequency_hz - low_hz, high_hz - settings.call.high_frequency_hz)
    filters = settings.processing.filters(settings.signal_rate_hz)
    own_s = 0.0 if filters is None else filters.half_length_s
    return own_s + 2 / narrowest_hz * max(1.0, 10 ** ((down_db - 60.0) / 60.0))


def matched_filter_spectrum(settings: Settings, *, n_fft: int, decimation: int | None = None) -> MatchedFilterSpectrum:
    """Return the read-only matched filter, with own filters, for spectra of decimated signals."""
    # docs/explanation/accuracy.md defines it. The call itself gives an envelope of 1, unless own filters distort
    # phases.
    decimation = settings.decimation if decimation is None else decimation
    band_hz = matched_band_hz(settings)
    rate_hz = settings.recording.sample_rate_hz
    filters = settings.processing.filters(settings.signal_rate_hz)
    return _matched_filter_spectrum(settings.call, rate_hz, band_hz, n_fft, decimation, filters)


@functools.lru_cache(maxsize=_MAX_SPECTRA)
def _matched_filter_spectrum(
    call: Call,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    n_fft: int,
    decimation: int,
    filters: FirFilters | None,
) -> MatchedFilterSpectrum:
    """Compute the matched filter. Spectra are cached, because a plan needs each several times."""
    spacing_hz = sample_rate_hz / decimation / n_fft
    low_hz, high_hz = band_hz
    last_bin = min(
        math.floor(high_hz / spacing_hz), n_fft // 2
    )  # At the rates of the paper, the edge may exceed the Nyquist frequency.
    bins = np.arange(math.ceil(low_hz / spacing_hz), last_bin + 1)
    frequency_hz = bins * spacing_hz
    spectrum = _call_spectrum(call, sample_rate_hz, n_fft, decimation)[bins]
    outside = np.maximum(
        (call.low_frequency_hz - frequency_hz) / (call.low_frequency_hz - low_hz),
        (frequency_hz - call.high_frequency_hz) / (high_hz - call.high_frequency_hz),
    )
    window = np.cos(math.pi / 2 * np.clip(outside, 0.0, 1.0)) ** 2
    power = np.abs(spectrum) ** 2 * window
    if filters is None:
        values = np.conj(spectrum) * window * (n_fft / np.sum(power))
        echo_power = np.abs(values) ** 2
    else:
        own = filters.response(frequency_hz)
        power *= np.abs(own)
        values = np.conj(spectrum) * window * own * (n_fft / np.sum(power))
        echo_power = np.abs(spectrum * window) ** 2 * np.abs(own)
    values.flags.writeable = echo_power.flags.writeable = False
    return MatchedFilterSpectrum(
        first_bin=int(bins[0]),
        values=values,
        echo_power=echo_power,
        centre_hz=float(np.sum(frequency_hz * power) / np.sum(power)),
    )


def matched_noise_spectrum(settings: Settings, *, n_waves: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return frequencies in Hz, and shares of the power of white noise after the matched filter: (wave,), sum 1."""
    rate_hz, fine_hz = settings.signal_rate_hz, 4 * settings.call.high_frequency_hz
    n_fft = round(max(8 * math.ceil(settings.call.end_s * fine_hz), 1024) * rate_hz / fine_hz)
    matched = matched_filter_spectrum(settings, n_fft=n_fft)
    frequency_hz = (matched.first_bin + np.arange(len(matched.values))) * rate_hz / n_fft
    power = np.abs(matched.values) ** 2
    # Bins are grouped, because the spectrum of a sweep has ripples.
    edges = np.linspace(0, len(power), min(n_waves, len(power)) + 1).astype(int)
    shares = np.add.reduceat(power, edges[:-1]) / power.sum()
    centres_hz = np.add.reduceat(frequency_hz, edges[:-1]) / np.diff(edges)
    return centres_hz, shares


def decimation_taps(
    *, sample_rate_hz: float, decimation: int, pass_hz: float, stopband_attenuation_db: float = _STOPBAND_ATTENUATION_DB
) -> NDArray[np.float64]:
    """Return the anti-aliasing filter of a decimation, (tap,), with the sum 1: a sinc under a Kaiser window (1974)."""
    # Its length is `2 k · decimation + 1`, so that the group delay is exactly k decimated samples.
    taps = _decimation_taps(sample_rate_hz, decimation, pass_hz, stopband_attenuation_db)
    return taps.copy()


@functools.lru_cache(maxsize=_MAX_FILTERS)
def _decimation_taps(
    sample_rate_hz: float, decimation: int, pass_hz: float, stopband_attenuation_db: float
) -> NDArray[np.float64]:
    """Design the filter. Designs are cached, because a planner tries several for each pipeline."""
    rate_hz = sample_rate_hz / decimation
    transition_hz = rate_hz - 2 * pass_hz
    if transition_hz < _MIN_TRANSITION * rate_hz:
        raise ArgumentError(
            f"decimation {decimation} gives a rate of {rate_hz:g} Hz, too low for signals up to {pass_hz:g} Hz; use a "
            "smaller decimation"
        )
    width_rad = 2 * math.pi * transition_hz / sample_rate_hz
    wanted = (stopband_attenuation_db - 7.95) / (2.285 * width_rad)
    half = decimation * math.ceil(wanted / 2 / decimation)
    taps = _windowed_sinc(half, decimation, width_rad)
    # Kaiser's formula is an approximation, which overestimates the attenuation of some short filters.
    folding_hz = np.linspace(rate_hz - pass_hz, min(rate_hz + pass_hz, sample_rate_hz / 2), 256)
    enough = 10 ** ((_STOPBAND_TOLERANCE_DB - stopband_attenuation_db) / 20)
    while decimation > 1 and np.abs(filter_response(taps, folding_hz / sample_rate_hz)).max() > enough:
        half += decimation
        taps = _windowed_sinc(half, decimation, width_rad)
    return taps


def _windowed_sinc(half: int, decimation: int, width_rad: float) -> NDArray[np.float64]:
    stopband_attenuation_db = 7.95 + 2.285 * width_rad * 2 * half  # the attenuation that this length allows
    beta = (
        0.1102 * (stopband_attenuation_db - 8.7)
        if stopband_attenuation_db > 50
        else (0.5842 * max(stopband_attenuation_db - 21, 0) ** 0.4 + 0.07886 * max(stopband_attenuation_db - 21, 0))
    )  # Kaiser's formulae
    position = np.arange(-half, half + 1)
    taps = np.sinc(position / decimation) * np.kaiser(2 * half + 1, beta)
    return np.asarray(taps / taps.sum())


def integer_taps(taps: NDArray[np.float64], *, bits: int = 16) -> NDArray[np.int16] | NDArray[np.int32]:
    """Return (tap,) integers whose magnitudes add up to at most the largest integer of ``bits``, 16 or 32."""
    # Raise ArgumentError if there are so many taps that rounding changes the response by more than -50 dB.
    limit = np.iinfo(np.int16 if bits == 16 else np.int32).max
    scale = max(limit - len(taps) / 2, 0.0) / np.abs(taps).sum()  # Rounding adds up to half a unit per tap.
    whole = np.rint(taps * scale)
    change = np.abs(np.fft.rfft(whole / (whole.sum() or 1.0) - taps, 4 * len(taps))).max()
    change_db = 20 * math.log10(max(change, 1e-20))
    if change_db > _MAX_ROUNDING_ERROR_DB:
        raise ArgumentError(
            f"decimation filter of {len(taps)} taps is too long for {bits} bits (rounding changes its response by "
            f"{change_db:.0f} dB); use a smaller processing.decimation"
        )
    return np.asarray(whole, np.int16) if bits == 16 else np.asarray(whole, np.int32)


def filter_response(taps: NDArray[np.float64], frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the gain of a symmetric filter without its group delay; frequencies are in cycles per input sample."""
    position = np.arange(len(taps)) - (len(taps) - 1) / 2
    return np.asarray(np.cos(2 * math.pi * frequency[:, None] * position) @ taps)
