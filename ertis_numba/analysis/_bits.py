"""Statistics of bits and signals: shares, spectrograms and spectral lines. `health` interprets them."""

from typing import Any, NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ertis_numba.base import fourier

__all__ = [
    "ROUNDING",
    "Shares",
    "bit_shares",
    "bits_of",
    "common_lines",
    "decibels",
    "octets_of",
    "rises",
    "signal_of",
    "spectrogram",
]

ROUNDING = 1e-14
"""Power, relative to a full scale of 1, below which spectra in single precision hold only rounding errors."""
_LONGEST_PATTERN = 32  # Samples. A modulator with noise or dither never repeats a pattern over a whole record.
_RUN_DOUBLINGS = 4  # 2⁴ equal pairs of neighbours make a run of 17 equal bits.
_SURROUNDINGS = 12  # Number of lines on either side.
_BITS = np.unpackbits(np.arange(256, dtype=np.uint8)[:, None], axis=1, bitorder="little")


class Shares(NamedTuple):
    """Bit statistics (bit,) of eight channels: shares of ones, of changes, and of samples where 17 equal bits start."""

    ones: NDArray[np.float64]
    changes: NDArray[np.float64]
    runs: NDArray[np.float64]
    repeats: NDArray[np.bool_]


def octets_of(words: NDArray[np.unsignedinteger[Any]]) -> NDArray[np.uint8]:
    """Return words, (sample, word), as octets, (sample, octet); bit b of octet k is channel 8 k + b."""
    return np.ascontiguousarray(words).view(np.uint8)


def bits_of(octets: NDArray[np.uint8], channel: int) -> NDArray[np.uint8]:
    """Return the bits of a channel as 0 and 1: (sample,) uint8."""
    return np.asarray(octets[:, channel // 8] >> np.uint8(channel % 8) & np.uint8(1))


def signal_of(octets: NDArray[np.uint8], channel: int) -> NDArray[np.float32]:
    """Return the bits of a channel as −1 and 1: (sample,) float32."""
    return np.asarray(2 * bits_of(octets, channel).astype(np.float32) - 1)


def bit_shares(column: NDArray[np.uint8]) -> Shares:
    """Return the bit statistics of eight channels from one octet per sample, at least 33."""
    differs = column[1:] ^ column[:-1]
    runs = ~differs
    for doubling in range(_RUN_DOUBLINGS):
        runs = runs[1 << doubling :] & runs[: -(1 << doubling)]
    repeats = np.uint8(0)
    for period in range(2, _LONGEST_PATTERN + 1):
        repeats |= ~np.bitwise_or.reduce(column[period:] ^ column[:-period])
    return Shares(_ones(column), _ones(differs), _ones(runs), _BITS[repeats] > 0)


def _ones(column: NDArray[np.uint8]) -> NDArray[np.float64]:
    return np.asarray(np.bincount(column, minlength=256) @ _BITS / len(column))


def spectrogram(signal: NDArray[np.float32], *, size: int, n_lines: int) -> NDArray[np.float32]:
    """Return the power of a signal over time and frequency, from frequency 0 on: (segment, line)."""
    # Half-overlapping segments under a Hann window (P. D. Welch, 1967), as scipy.signal has, whose import takes longer.
    segments = sliding_window_view(signal, size)[:: size // 2]
    window = np.hanning(size + 1)[:-1].astype(np.float32)
    lines = fourier.rfft(segments * window)[:, :n_lines]
    return np.asarray((lines.real**2 + lines.imag**2) * np.float32(2 / size / (window @ window)))


def rises(level_db: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the level of each line relative to the median of the surrounding lines, in dB: (mic, line) float64."""
    around = np.pad(level_db, ((0, 0), (_SURROUNDINGS, _SURROUNDINGS)), mode="reflect")
    return np.asarray(level_db - np.median(sliding_window_view(around, 2 * _SURROUNDINGS + 1, axis=1), axis=-1))


def common_lines(rise_db: NDArray[np.float64], min_db: float, share: float) -> tuple[NDArray[np.bool_], list[int]]:
    """Return a mask of lines that stand out in more than a share of channels, and the highest of adjacent ones."""
    apart = np.pad(rise_db, ((0, 0), (1, 1)), constant_values=-np.inf)
    near_db = np.max(sliding_window_view(apart, 3, axis=1), axis=-1)
    is_common = np.mean(near_db > min_db, axis=0) > share
    middle_db = np.where(is_common, np.median(rise_db, axis=0), -np.inf)
    groups = np.split(np.flatnonzero(is_common), np.flatnonzero(np.diff(np.flatnonzero(is_common)) > 1) + 1)
    return is_common, [int(group[np.argmax(middle_db[group])]) for group in groups if len(group)]


def decibels(power: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return levels in dB; powers below `ROUNDING` count as `ROUNDING`."""
    return np.asarray(10 * np.log10(np.maximum(power, ROUNDING)), dtype=np.float64)
