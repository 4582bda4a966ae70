"""Signal model of a measurement: the signal statistics that determine the error of an image."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import fourier
from ertis_numba.chain.beam_grid import estimated_mics
from ertis_numba.chain.error_model import SignalModel
from ertis_numba.chain.fast_chain import FastChain
from ertis_numba.chain.interpolation_fit import WAVES
from ertis_numba.frames import Measurement
from ertis_numba.frames.sample_format import sample_format
from ertis_numba.geometry import array_weights, microphones
from ertis_numba.geometry.waveform import matched_band_hz, matched_filter_spectrum, matched_noise_spectrum
from ertis_numba.kernels import KernelSet
from ertis_numba.settings import Accuracy, Settings

__all__ = ["ROUGH_DELAY_TAPS", "ROUGH_ZONES", "signal_model_of"]

ROUGH_DELAY_TAPS = 2
ROUGH_ZONES = 8

_FEW_DIRECTIONS = "2d:19"  # Directions of the chain if it computes no image.
_TILE = 96  # Number of ranges.
_MAX_BINS = 2**18  # Number of image bins from which quantiles are computed.
_MAX_MICS = 8  # Number of microphones whose noise is measured.
_SEGMENT = 4096
_SEGMENTS = 16  # Number of segments whose noise is measured at a time.
_TAPERED = 0.5  # Tapered share of the ranges at each end.
_QUANTILES = (np.arange(16) + 0.5) / 16


def signal_model_of(
    measurement: Measurement,
    settings: Settings,
    kernels: KernelSet,
    *,
    threads: int = 1,
    amplitude: NDArray[np.float32] | None = None,
) -> SignalModel:
    """Return the signal model of a measurement; without its delay-and-sum image ``amplitude``, compute a rough one."""
    low_hz, high_hz = matched_band_hz(settings)
    processing = settings.processing.replace(beamformer="delay_and_sum", weighting="none", delay_matrix=())
    if amplitude is not None:
        processing = processing.replace(directions=_FEW_DIRECTIONS)
    rough = settings.replace(
        accuracy=Accuracy(
            precision="float32",
            oversampling=min(64, max(2, math.ceil(2 * (high_hz - low_hz) / settings.output_rate_hz))),
            delay_taps=ROUGH_DELAY_TAPS,
            beam_taps=0,
            beam_density=2.0,
            stopband_attenuation_db=60.0,
            focal_zones=ROUGH_ZONES,
        ),
        processing=processing,
    )
    chain = FastChain(rough, kernels, threads=threads)
    form = sample_format(settings)
    words, exponent = form.normalised(form.validated(measurement.data))  # All statistics are relative to the level.
    try:
        heard, lead = chain.analytic(words)
        if amplitude is None:
            image = chain.new_image()
            chain.process(words, image)
        else:
            image = np.ldexp(amplitude, -exponent) if exponent else amplitude
    finally:
        chain.close()
    analytic = heard[:, :, lead:]
    n_mics, n_phases, _ = analytic.shape
    gain = microphones(settings.array).gain[microphones(settings.array).enabled, None]
    series = np.moveaxis(analytic, 1, 2)[:, : len(chain.range_m)].reshape(n_mics, -1)
    undivided = float(np.mean(np.abs(series) ** 2)) or 1e-30  # Power before calibration, like that of the tiles.
    series = (series / gain * array_weights(settings)[:, None]).astype(np.complex64)
    power = float(np.mean(np.abs(series) ** 2)) or 1e-30
    image_power = float(np.einsum("dr,dr->d", image, image, dtype=np.float64).sum()) / image.size  # without a copy
    # A tile extends beyond its ranges by the largest delay.
    starts = range(0, len(chain.range_m), _TILE)
    largest = [np.max(np.abs(heard[:, :, start : start + _TILE + 2 * lead])) ** 2 for start in starts]
    covariance = _covariance(series, settings, n_phases * settings.output_rate_hz)
    noise = _noise(words, settings, kernels)
    level = max(undivided / _white_power(settings), 1e-30)
    band_hz, shares = matched_noise_spectrum(settings, n_waves=WAVES)
    bins_hz = np.linspace(0, settings.recording.sample_rate_hz / 2, len(noise))
    decimated = noise[: max(1, math.ceil(len(noise) / settings.decimation))]
    return SignalModel(
        shares=_shares(series, settings, n_phases * settings.output_rate_hz),
        gain=max(image_power / (power / n_mics), 1e-3),
        crest=float(np.mean(largest)) / undivided,
        noise=noise,
        level=level,
        loudness=float(np.mean(decimated)) / level,
        record_level=float(np.interp(band_hz, bins_hz, noise) @ shares) / level,
        covariance=covariance,
        places=np.square(np.quantile(_some(image), _QUANTILES), dtype=np.float64) / (image_power or 1.0),
    )


def _some(image: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return bins spread evenly over an image; quantiles of all bins of a large image would take 0.1 s."""
    return image.ravel()[:: max(1, image.size // _MAX_BINS) | 1]


def _shares(series: NDArray[np.complex64], settings: Settings, rate_hz: float) -> NDArray[np.float64]:
    """Return the distribution of the power over the frequencies of the model."""
    # Without a taper, strong echoes at the ends would leak to the edges of the band, where interpolation errors peak.
    edge = np.arange(series.shape[1]) / max(1, series.shape[1] - 1)
    taper = np.sin(np.pi / 2 * np.minimum(1.0, np.minimum(edge, 1 - edge) / _TAPERED)) ** 2
    found = np.zeros(series.shape[1])
    for signal in series:  # One by one, because transforms of all microphones need much memory.
        found += np.abs(fourier.fft(signal * taper)) ** 2
    centres_hz, nominal = matched_noise_spectrum(settings, n_waves=WAVES)
    # Sampling at this rate has shifted the band by a multiple of the rate.
    bins = np.rint(centres_hz / rate_hz * len(found)).astype(int)
    half = max(1, int(np.min(np.diff(bins)) // 2)) if len(bins) > 1 else 1
    around = (bins[:, None] + np.arange(-half, half + 1)) % len(found)
    shares = found[around].mean(axis=1) * np.gradient(centres_hz) if len(bins) > 1 else np.ones(1)
    shares = np.where(nominal > 0, shares, 0.0)
    return np.asarray(shares / shares.sum()) if shares.sum() > 0 else nominal


def _covariance(series: NDArray[np.complex64], settings: Settings, rate_hz: float) -> NDArray[np.complex128]:
    """Return the covariance of the microphones in each tile: (tile, wave, mic, mic) complex128."""
    layout = microphones(settings.array)
    centres_hz, _ = matched_noise_spectrum(settings, n_waves=WAVES)
    mics = estimated_mics(len(series))
    length = max(8, round(_TILE * rate_hz / settings.output_rate_hz))
    half = length // 2
    padded = np.pad(series[mics], ((0, 0), (half, length + half)))
    tiles = np.lib.stride_tricks.sliding_window_view(padded, length, axis=1)[:, :: max(1, half)]
    # Sampling has shifted the band by multiples of the rate. Each bin represents its alias within the band.
    bins_hz = np.arange(length) * rate_hz / length
    frequency_hz = bins_hz + rate_hz * np.rint(((centres_hz[0] + centres_hz[-1]) / 2 - bins_hz) / rate_hz)
    inside = (frequency_hz > centres_hz[0]) & (frequency_hz < centres_hz[-1])
    frequency_hz = frequency_hz[inside]
    late_s = layout.delay_s[layout.enabled][mics]
    # Without a window, strong echoes at the ends would leak to the edges of the band, where interpolation errors peak.
    window = np.hanning(length)
    spectra = np.stack(
        [
            fourier.fft(tile * window)[:, inside] * np.exp(2j * np.pi * late * frequency_hz)
            for tile, late in zip(tiles, late_s, strict=True)
        ]
    )
    nearest = np.argmin(np.abs(frequency_hz[:, None] - centres_hz), axis=1)
    found = np.empty((spectra.shape[1], len(centres_hz), len(mics), len(mics)), np.complex128)
    for wave in range(len(centres_hz)):
        part = spectra[:, :, nearest == wave]
        np.einsum("mtb,ntb->tmn", part, np.conj(part), out=found[:, wave])
    return found


def _white_power(settings: Settings) -> float:
    """Return the power of white bits after the matched filter."""
    n_fft = 2 ** math.ceil(math.log2(2 * settings.call.end_s * settings.signal_rate_hz + 256))
    matched = matched_filter_spectrum(settings, n_fft=n_fft)
    return float(np.sum(np.abs(matched.values) ** 2) / n_fft / settings.decimation)


def _noise(words: NDArray[Any], settings: Settings, kernels: KernelSet) -> NDArray[np.float64]:
    """Return the power density of samples from 0 to half their rate, relative to white bits: (bin,) float64."""
    channels = np.flatnonzero(microphones(settings.array).enabled).astype(np.int32)
    channels = np.ascontiguousarray(channels[:: max(1, len(channels) // _MAX_MICS)])
    segment = min(_SEGMENT, len(words) // 2 * 2)
    n_segments = len(words) // segment
    window = np.hanning(segment).astype(np.float32)
    power = np.zeros(segment // 2 + 1)
    for first in range(0, n_segments, _SEGMENTS):  # so that memory does not grow with the record
        part = words[first * segment : min(first + _SEGMENTS, n_segments) * segment]
        signals = np.empty((len(channels), len(part)), dtype=np.float32)
        if settings.recording.is_pdm:
            octets = np.ascontiguousarray(part).view(np.uint8)  # Loading a kernel would take longer.
            for signal, channel in zip(signals, channels, strict=True):
                signal[:] = octets[:, channel // 8] >> np.uint8(channel % 8) & np.uint8(1)
            signals *= 2
            signals -= 1
        else:
            scale = np.float32(1 / settings.recording.full_scale)
            kernels.unpack_pcm(part, channels, scale, np.float32(0), 0, signals)
        spectra = fourier.rfft(signals.reshape(-1, segment) * window)
        power += np.sum(np.abs(spectra) ** 2, axis=0, dtype=np.float64)
    return power / (len(channels) * n_segments * float(np.sum(window**2)))
