"""What is heard, in the few numbers that an image's error depends on."""

import math
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ertis_numba.frames import Measurement
from ertis_numba.geometry import microphones
from ertis_numba.kernels import KernelSet
from ertis_numba.settings import Accuracy, Settings
from ertis_numba.stages.accuracy import Texture
from ertis_numba.stages.fast import FastChain
from ertis_numba.waveform import matched_filter, matched_spectrum

__all__ = ["texture_of"]

_TILE = 96  # ranges
_MOST_MICS = 8  # whose bits are looked at
_SEGMENT = 4096
_WAVES = 40


def texture_of(measurement: Measurement, settings: Settings, kernels: KernelSet, *, threads: int = 1) -> Texture:
    """Return the texture of a measurement that is to be imaged by ``settings``.

    A rough image is enough, since what is wanted are its mean power, and that of what it is summed from.
    """
    rough = settings.replace(
        accuracy=Accuracy(
            precision="float32", oversampling=2, delay_taps=2, beam_taps=0, beam_density=2.0, stop_band_db=60.0, zones=8
        ),
        processing=settings.processing.replace(beamformer="delay_and_sum"),
    )
    chain = FastChain(rough, kernels, threads=threads)
    words = np.require(measurement.words, requirements=["C", "A", "W"]).reshape(len(measurement.words), -1)
    image = np.empty((len(chain.grid), len(chain.range_m)), dtype=np.float32)
    analytic = chain.analytic(words, image)  # (mic, phase, sample), from the first range on
    n_mics, n_phases, _ = analytic.shape
    series = np.moveaxis(analytic, 1, 2)[:, : len(chain.range_m)].reshape(n_mics, -1)
    power = float(np.mean(np.abs(series) ** 2)) or 1e-30
    image_power = float(np.mean(np.square(image, dtype=np.float64)))
    powers = np.abs(series) ** 2
    starts = range(0, powers.shape[1], n_phases * _TILE)
    largest = np.array([powers[:, start : start + n_phases * _TILE].max() for start in starts], dtype=np.float64)
    return Texture(
        shares=_shares(series, settings, n_phases * settings.output_rate_hz),
        gain=max(image_power / (power / n_mics), 1e-3),
        crest=float(np.mean(largest)) / power,
        noise=_noise(words, settings, kernels),
        level=max(power / _white_power(settings), 1e-12),
    )


def _shares(series: NDArray[np.complex64], settings: Settings, rate_hz: float) -> NDArray[np.float64]:
    """Return how power is spread over the frequencies of the model."""
    found = np.sum(np.abs(scipy.fft.fft(series, axis=1)) ** 2, axis=0)
    centres_hz, nominal = matched_spectrum(settings.call, n_waves=_WAVES)
    # Sampling at this rate has moved the band by a multiple of it.
    bins = np.rint(centres_hz / rate_hz * len(found)).astype(int)
    half = max(1, int(np.min(np.diff(bins)) // 2)) if len(bins) > 1 else 1
    around = (bins[:, None] + np.arange(-half, half + 1)) % len(found)
    shares = found[around].mean(axis=1) * np.gradient(centres_hz) if len(bins) > 1 else np.ones(1)
    shares = np.where(nominal > 0, shares, 0.0)
    return np.asarray(shares / shares.sum()) if shares.sum() > 0 else nominal


def _white_power(settings: Settings) -> float:
    """Return the power of white bits after the matched filter."""
    n_fft = 2 ** math.ceil(math.log2(2 * settings.call.duration_s * settings.signal_rate_hz + 256))
    matched = matched_filter(settings.call, n_fft=n_fft, rate_hz=settings.signal_rate_hz)
    return float(np.sum(np.abs(matched.values) ** 2) / n_fft / settings.decimation)


def _noise(words: NDArray[np.unsignedinteger[Any]], settings: Settings, kernels: KernelSet) -> NDArray[np.float64]:
    """Return the power density of the bits by that of white bits, from 0 to half the PDM rate: (bin,) float64."""
    channels = np.flatnonzero(microphones(settings.array).enabled).astype(np.int32)
    channels = np.ascontiguousarray(channels[:: max(1, len(channels) // _MOST_MICS)])
    signals = np.empty((len(channels), len(words)), dtype=np.float32)
    kernels.unpack_bits(words, channels, signals)
    segment = min(_SEGMENT, len(words) // 2 * 2)
    cut = signals[:, : len(words) // segment * segment].reshape(-1, segment)
    window = np.hanning(segment).astype(np.float32)
    return np.asarray(np.mean(np.abs(scipy.fft.rfft(cut * window, axis=1)) ** 2, axis=0) / np.sum(window**2), float)
