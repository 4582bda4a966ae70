"""Custom waveforms of the call: samples from settings or files."""

import functools
import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.csv_numbers import csv_rows, npy_content
from ertis_numba.base.errors import ArgumentError, DataError, SettingsError
from ertis_numba.base.wav import read_wav

__all__ = ["MAX_WAVEFORM_SAMPLES", "WAVEFORM_FILES", "band_hz", "normalise", "read_waveform"]

MAX_WAVEFORM_SAMPLES = 4096
"""Limit on the samples of a custom waveform, 9 ms at 450 kHz. Settings with so many samples and 1024 microphones stay
within `Settings.max_bytes`."""
WAVEFORM_FILES = {".wav", ".csv", ".npy"}
_MAX_FILE_BYTES = 2**22
_DECIMALS = 7  # decimals of a sample; their rounding error is 20 dB below that of a 20-bit converter
_BAND_THRESHOLD = 0.1  # relative to the maximum of the spectrum
_BAND_STEP_HZ = 100.0  # step of the edges, so that they do not depend on rounding in the transform


def read_waveform(path: Path, *, key: str = "call.waveform") -> tuple[tuple[float, ...], float | None]:
    """Return the samples in a WAV, CSV or NPY file of one channel, and their rate if stated; ``key`` is for errors."""
    suffix = path.suffix.lower()
    if suffix not in WAVEFORM_FILES:
        raise SettingsError(f"{key} is {str(path)!r}; choose a .wav, .csv or .npy file, or a list of samples")
    try:
        if not path.is_file():
            raise SettingsError(f"{key} {path}: no such file; choose the name of a .wav, .csv or .npy file")
        n_bytes = path.stat().st_size
        if n_bytes > _MAX_FILE_BYTES:
            raise SettingsError(f"{key} {path} has {n_bytes} bytes; the limit is {_MAX_FILE_BYTES}")
        rate_hz, values = _read_wav(path) if suffix == ".wav" else (None, _read_numbers(path, suffix))
    except (OSError, ValueError, DataError) as error:
        if isinstance(error, SettingsError):
            raise
        raise SettingsError(f"{key} {path} cannot be read ({error}); save it again") from error
    if values.ndim > 1 and suffix == ".csv" and 1 in values.shape:
        values = values.reshape(-1)
    if values.ndim > 1 and values.shape[1] == 1:
        values = values[:, 0]
    if values.ndim != 1 or values.dtype.kind not in "iuf":
        raise SettingsError(
            f"{key} {path} contains {values.dtype} of shape {values.shape}; use one channel of real numbers"
        )
    # Unsigned bytes are the only WAV samples whose silence is not 0.
    middle = 128.0 if suffix == ".wav" and values.dtype == np.uint8 else 0.0
    return tuple((values.astype(np.float64) - middle).tolist()), rate_hz


def _read_wav(path: Path) -> tuple[float, NDArray[Any]]:
    wav = read_wav(path)
    return wav.rate_hz, wav.samples[:]


def _read_numbers(path: Path, suffix: str) -> NDArray[Any]:
    if suffix == ".npy":
        return np.asarray(npy_content(path))
    return np.array(csv_rows(path.name, path.read_text("utf-8-sig")), dtype=np.float64)


def normalise(samples: tuple[float, ...], rate_hz: float) -> tuple[float, ...]:
    """Return samples scaled to a peak of 1, with seven decimals. Many samples lose the zeros at their end."""
    smallest = 17  # the duration of a call is at least 16 samples
    if len(samples) > MAX_WAVEFORM_SAMPLES:
        samples = samples[: max((number + 1 for number, sample in enumerate(samples) if sample), default=len(samples))]
    if not smallest <= len(samples) <= MAX_WAVEFORM_SAMPLES:
        raise ArgumentError(
            f"call.waveform has {len(samples)} samples; use {smallest} to {MAX_WAVEFORM_SAMPLES}, at "
            f"{rate_hz:g} Hz {1e3 * (MAX_WAVEFORM_SAMPLES - 1) / rate_hz:.3g} ms at most"
        )
    values = np.array(samples, dtype=np.float64)
    checks.finite_array("call.waveform", values)
    peak = float(np.abs(values).max())
    if not peak:
        raise ArgumentError("call.waveform contains only 0; choose other samples")
    return tuple(np.round(values / peak, _DECIMALS).tolist())


@functools.lru_cache(maxsize=16)
def band_hz(samples: tuple[float, ...], rate_hz: float) -> tuple[float, float]:
    """Return the edges, in the order of the sweep, between which a spectrum is less than 20 dB below its maximum."""
    n_fft = 2 ** math.ceil(math.log2(16 * len(samples)))
    spectrum = np.abs(np.fft.rfft(samples, n_fft))
    strong = np.flatnonzero(spectrum >= _BAND_THRESHOLD * spectrum.max()) * (rate_hz / n_fft)
    low_hz = math.floor(strong[0] / _BAND_STEP_HZ) * _BAND_STEP_HZ
    high_hz = math.ceil(strong[-1] / _BAND_STEP_HZ) * _BAND_STEP_HZ
    if low_hz <= 0:
        raise ArgumentError(
            "call.waveform has a band that reaches 0 Hz; subtract its mean, and filter out lower frequencies"
        )
    if high_hz >= rate_hz / 2:
        raise ArgumentError(
            f"call.waveform has a band that reaches half of its sample rate of {rate_hz:g} Hz; sample it faster, or "
            "correct call.sample_rate_hz"
        )
    half = len(samples) // 2
    falls = _centroid(samples[:half], n_fft) >= _centroid(samples[half:], n_fft)
    return (high_hz, low_hz) if falls else (low_hz, high_hz)


def _centroid(samples: tuple[float, ...], n_fft: int) -> float:
    """Return the mean frequency of samples in bins, weighted by power."""
    power = np.abs(np.fft.rfft(samples, n_fft)) ** 2
    return float(np.arange(len(power)) @ power / max(power.sum(), 1e-300))
