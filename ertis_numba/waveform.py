"""The emitted call, its matched filter and the decimation filter."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import ArgumentError
from ertis_numba.settings import Call, Settings

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

_TRANSITION_HZ = 5_000.0  # wide enough that the matched filter rings for 0.4 ms only
_MIN_TRANSITION = 0.02  # of the decimated rate; the filter's length grows with the inverse
_STOPBAND_ATTENUATION_DB = 60.0
_STOPBAND_TOLERANCE_DB = 0.5  # by which a filter may miss its stop band
_WAVEFORM_OVERSAMPLING = 16  # samples of an own waveform for each of its own, between which splines run
_MAX_ROUNDING_ERROR_DB = (
    -50.0
)  # what rounded taps may change the response by, where the stop band is no deeper than 60 dB


def call_samples(call: Call, *, rate_hz: float | None = None) -> NDArray[np.float64]:
    """Return the emitted call: (sample,) float64, amplitude 1 between its ramps.

    Hyperbolic frequency modulation, ``f(t) = 1 / (1/f₀ + t (1/f₁ − 1/f₀) / T)``, whose phase is
    ``2π T / (1/f₁ − 1/f₀) · ln(f₀ / f(t))``, from t = 0 to T inclusive (J. J. Kroszczynski, Pulse
    compression by means of linear-period modulation, Proc. IEEE 57, 1969). Or linear, ``f(t) = f₀ + t (f₁ − f₀) / T``
    with a phase of ``2π (f₀ t + t² (f₁ − f₀) / 2T)``. An own waveform is interpolated, see `call_at`.

    Parameters
    ----------
    call : Call
    rate_hz : float, optional
        Sample rate; the call's own by default.
    """
    rate_hz = call.sample_rate_hz if rate_hz is None else rate_hz
    call.require_samples()
    if call.waveform is not None and rate_hz == call.sample_rate_hz:
        return np.array(call.waveform, dtype=np.float64)
    time_s = np.arange(math.floor(call.duration_s * rate_hz * (1 + 1e-12)) + 1) / rate_hz
    return call_at(call, time_s)


def call_at(call: Call, time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the call at any times, 0 outside ``[0, duration_s]``.

    Between the samples of an own waveform, its Fourier series, 16 times as dense, is joined by cubic splines: at half
    of the sample rate they miss it by -100 dB, and by less below.
    """
    inside_s = np.clip(time_s, 0.0, call.duration_s)
    if call.waveform is not None:
        return np.where(inside_s == time_s, _interpolator(call)(inside_s), 0.0)
    phase_rad = _phase_rad(call, inside_s)
    edge_s = np.minimum(inside_s, call.duration_s - inside_s)
    ramp_s = call.ramp_fraction * call.duration_s
    ramp = np.sin(math.pi / 2 * np.minimum(edge_s, ramp_s) / ramp_s) ** 2 if ramp_s else 1.0
    return np.where(inside_s == time_s, np.sin(phase_rad) * ramp, 0.0)


@functools.lru_cache(maxsize=8)
def _interpolator(call: Call) -> Callable[[NDArray[np.float64]], NDArray[np.float64]]:
    """Return the function of time that an own waveform samples."""
    from scipy.interpolate import CubicSpline  # noqa: PLC0415  takes long to import, and few need it

    samples = call_samples(call)
    n_fft = 2 ** math.ceil(math.log2(2 * len(samples)))  # zeros behind it, over which its beginning does not wrap
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


def call_spectrum(
    call: Call, settings: Settings, *, n_fft: int, decimation: int | None = None
) -> NDArray[np.complex128]:
    """Return the one-sided spectrum of a call in decimated signals: (bin,) complex128.

    The call is sampled at the rate of the record. At the decimated rate, a call that is short or has no ramp would
    alias, because it has power above the Nyquist frequency. The decimation filter removes that power from the signals.

    Parameters
    ----------
    call : Call
    settings : Settings
        Settings of the record.
    n_fft : int
        Length of the transform of decimated signals, at least that of the call.
    decimation : int, optional
        Samples of the record per signal sample; that of the settings by default.
    """
    decimation = settings.decimation if decimation is None else decimation
    samples = call_samples(call, rate_hz=settings.recording.sample_rate_hz)
    return np.asarray(np.fft.rfft(samples, n_fft * decimation)[: n_fft // 2 + 1] / decimation)


@dataclass(frozen=True, slots=True, eq=False)
class MatchedFilterSpectrum:
    """The matched filter of a call as the occupied bins of a one-sided spectrum.

    Attributes
    ----------
    first_bin : int
        Bin of the first value.
    values : (bin,) complex128
    centre_hz : float
        Mean frequency of the filtered call, weighted by its power.
    """

    first_bin: int
    values: NDArray[np.complex128]
    centre_hz: float


def matched_band_hz(settings: Settings) -> tuple[float, float]:
    """Return the band of the matched filter: `processing.band_edges_hz`, or the call's band widened by 5 kHz."""
    call, given = settings.call, settings.processing.band_edges_hz
    if given is not None:
        return given
    edge_hz = min(_TRANSITION_HZ, call.low_frequency_hz / 2)
    return call.low_frequency_hz - edge_hz, call.high_frequency_hz + edge_hz


def matched_guard_s(settings: Settings, *, down_db: float = 60.0) -> float:
    """Return how long the matched filter rings before the call and after it, until it is ``down_db`` down.

    The edges of its band are raised cosines, whose transform falls with the third power of time.
    """
    low_hz, high_hz = matched_band_hz(settings)
    narrowest_hz = min(settings.call.low_frequency_hz - low_hz, high_hz - settings.call.high_frequency_hz)
    return 2 / narrowest_hz * max(1.0, 10 ** ((down_db - 60.0) / 60.0))


def matched_filter_spectrum(settings: Settings, *, n_fft: int, decimation: int | None = None) -> MatchedFilterSpectrum:
    """Return the matched filter for spectra of ``n_fft`` points of decimated signals.

    ``H(f) = g conj(S(f)) W(f)`` for positive frequencies and 0 for others, with S the spectrum of the call, W a
    window that is 1 over the call's band and falls to 0 outside it as a raised cosine, and g such
    that the call itself gives an analytic signal with an envelope of 1 at its peak.

    Parameters
    ----------
    settings : Settings
        Settings with the call, the rate of the record and the edges of the band.
    n_fft : int
        Even or odd, at least as long as the call.
    decimation : int, optional
        Samples of the record per signal sample; that of the settings by default.

    Returns
    -------
    MatchedFilter
    """
    call = settings.call
    decimation = settings.decimation if decimation is None else decimation
    spacing_hz = settings.recording.sample_rate_hz / decimation / n_fft
    low_hz, high_hz = matched_band_hz(settings)
    last_bin = min(math.floor(high_hz / spacing_hz), n_fft // 2)  # the paper's rates may leave the edge no room
    bins = np.arange(math.ceil(low_hz / spacing_hz), last_bin + 1)
    frequency_hz = bins * spacing_hz
    spectrum = call_spectrum(call, settings, n_fft=n_fft, decimation=decimation)[bins]
    outside = np.maximum(
        (call.low_frequency_hz - frequency_hz) / (call.low_frequency_hz - low_hz),
        (frequency_hz - call.high_frequency_hz) / (high_hz - call.high_frequency_hz),
    )
    window = np.cos(math.pi / 2 * np.clip(outside, 0.0, 1.0)) ** 2
    power = np.abs(spectrum) ** 2 * window
    return MatchedFilterSpectrum(
        first_bin=int(bins[0]),
        values=np.conj(spectrum) * window * (n_fft / np.sum(power)),
        centre_hz=float(np.sum(frequency_hz * power) / np.sum(power)),
    )


def matched_noise_spectrum(settings: Settings, *, n_waves: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the power of white noise after the matched filter: frequencies in hertz and shares, both (wave,) float64.

    The shares add up to 1. Of an echo, whose own spectrum comes on top, the band is a little narrower.
    """
    rate_hz, fine_hz = settings.signal_rate_hz, 4 * settings.call.high_frequency_hz
    n_fft = round(max(8 * math.ceil(settings.call.duration_s * fine_hz), 1024) * rate_hz / fine_hz)
    matched = matched_filter_spectrum(settings, n_fft=n_fft)
    frequency_hz = (matched.first_bin + np.arange(len(matched.values))) * rate_hz / n_fft
    power = np.abs(matched.values) ** 2
    # Parts of the band rather than single bins: the spectrum of a sweep has ripples.
    edges = np.linspace(0, len(power), min(n_waves, len(power)) + 1).astype(int)
    shares = np.add.reduceat(power, edges[:-1]) / power.sum()
    centres_hz = np.add.reduceat(frequency_hz, edges[:-1]) / np.diff(edges)
    return centres_hz, shares


def decimation_taps(
    *, sample_rate_hz: float, decimation: int, pass_hz: float, stopband_attenuation_db: float = _STOPBAND_ATTENUATION_DB
) -> NDArray[np.float64]:
    """Return the low-pass filter that guards a decimation: (tap,) float64, sum 1.

    A sinc under a Kaiser window (J. F. Kaiser, 1974). What would alias into ``0 … pass_hz`` is
    damped by ``stopband_attenuation_db``, by half a decibel less at the worst. The length is ``2 k · decimation + 1``, so
    that the group delay is k samples of the decimated signal exactly.

    Parameters
    ----------
    sample_rate_hz : float
    decimation : int
    pass_hz : float
        Upper edge of the band that must stay clean.
    stopband_attenuation_db : float

    Returns
    -------
    (tap,) float64

    Raises
    ------
    ArgumentError
        The decimated rate cannot hold ``pass_hz``.
    """
    rate_hz = sample_rate_hz / decimation
    transition_hz = rate_hz - 2 * pass_hz
    if transition_hz < _MIN_TRANSITION * rate_hz:
        raise ArgumentError(
            f"decimation {decimation} leaves {rate_hz:g} Hz, too little for signals up to {pass_hz:g} Hz; lower it"
        )
    width_rad = 2 * math.pi * transition_hz / sample_rate_hz
    wanted = (stopband_attenuation_db - 7.95) / (2.285 * width_rad)
    half = decimation * math.ceil(wanted / 2 / decimation)
    taps = _windowed_sinc(half, decimation, width_rad)
    # Kaiser's formula is a fit; for some short filters it promises a few decibels too much.
    folding_hz = np.linspace(rate_hz - pass_hz, min(rate_hz + pass_hz, sample_rate_hz / 2), 256)
    enough = 10 ** ((_STOPBAND_TOLERANCE_DB - stopband_attenuation_db) / 20)
    while decimation > 1 and np.abs(filter_response(taps, folding_hz / sample_rate_hz)).max() > enough:
        half += decimation
        taps = _windowed_sinc(half, decimation, width_rad)
    return taps


def _windowed_sinc(half: int, decimation: int, width_rad: float) -> NDArray[np.float64]:
    stopband_attenuation_db = 7.95 + 2.285 * width_rad * 2 * half  # what this length can do
    beta = (
        0.1102 * (stopband_attenuation_db - 8.7)
        if stopband_attenuation_db > 50
        else (0.5842 * max(stopband_attenuation_db - 21, 0) ** 0.4 + 0.07886 * max(stopband_attenuation_db - 21, 0))
    )  # Kaiser's formulae
    position = np.arange(-half, half + 1)
    taps = np.sinc(position / decimation) * np.kaiser(2 * half + 1, beta)
    return np.asarray(taps / taps.sum())


def integer_taps(taps: NDArray[np.float64], *, bits: int = 16) -> NDArray[np.int16] | NDArray[np.int32]:
    """Return a filter in whole numbers whose magnitudes add up to the largest of them at most: (tap,) int16 or int32.

    It is a filter of its own rather than an approximation at every sum: rounding some hundred taps to 16 bits changes
    the response by -65 dB or less, and everything after is exact.

    Parameters
    ----------
    taps : (tap,) float64
    bits : {16, 32}

    Returns
    -------
    (tap,) int16 or int32

    Raises
    ------
    ArgumentError
        There are so many taps that rounding them changes the response by more than -50 dB.
    """
    limit = np.iinfo(np.int16 if bits == 16 else np.int32).max
    scale = max(limit - len(taps) / 2, 0.0) / np.abs(taps).sum()  # rounding adds up to a half a tap
    whole = np.rint(taps * scale)
    change = np.abs(np.fft.rfft(whole / (whole.sum() or 1.0) - taps, 4 * len(taps))).max()
    change_db = 20 * math.log10(max(change, 1e-20))
    if change_db > _MAX_ROUNDING_ERROR_DB:
        raise ArgumentError(
            f"decimation filter of {len(taps)} taps is too long for {bits} bits ({change_db:.0f} dB off); "
            "give a smaller processing.decimation"
        )
    return np.asarray(whole, np.int16) if bits == 16 else np.asarray(whole, np.int32)


def filter_response(taps: NDArray[np.float64], frequency: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the gain of a symmetric filter, its group delay removed: (frequency,) float64.

    ``frequency`` is in cycles per sample of the filter's input.
    """
    position = np.arange(len(taps)) - (len(taps) - 1) / 2
    return np.asarray(np.cos(2 * math.pi * frequency[:, None] * position) @ taps)
