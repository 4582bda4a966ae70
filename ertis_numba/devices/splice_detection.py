"""Detection of missing and misplaced PDM words.

A sigma-delta modulator keeps the running sum of its errors small, so that below about 150 kHz its bits contain little
except sound. At a splice, the sum of each microphone m jumps by some A_m (a missing bit counts 1), which appears as an
impulse: of any sign, in all microphones, at the same sample. Sound has no such impulse. From ahead it is equal in all
microphones, from the side it reaches them one after the other, and above 90 kHz microphones hear almost nothing.

A real eRTIS alters single words itself: in the only public measurement, the upper 16 bits of ten words are those of
other microphones. Differences in a single word, including flipped bits, are therefore no reason to reject a block: an
impulse counts if it occurs in three of the four bytes.
"""

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.devices.bit_means import MEAN_OF
from ertis_numba.devices.blocks import CHANNELS

__all__ = ["Splices"]

Floats = NDArray[np.floating[Any]]

_MIN_RATE_HZ = 4e6  # At the slower clock, modulators are quiet only below 40 kHz, where sound is.
_BAND_HZ, _TAPS = (90e3, 130e3), 207  # Above all calls, below the modulators' shaped noise.
_HIGH_BAND_HZ, _HIGH_TAPS = (125e3, 180e3), 151
_KAISER = 4.0
_STEP = 30  # Samples of the words per sample of the band: 150 kHz, which preserves 75 to 150 kHz.
_EVERY = 16  # Step, in samples of the band, of the values whose median is the noise.
_SPAN = 4  # Samples of the band that contain a whole impulse.
_LEVEL_SPAN = 32  # The same, for the median level.
_APART = 6  # The same, between stretches that are examined separately.
_MAX = 8  # Limit on stretches, most prominent first.
_RISE = 2.0  # Power relative to the level above which a stretch is examined; that of noise reaches 1.6.
_FINE_STEP, _REACH = 5, 40  # Samples of the words: step of the band near an impulse, and search range of its sample.
_LANES, _MIN_LANES, _MIN_CHANNELS = 4, 3, 4  # Bytes of a word, minimum number of them, and minimum channels in each.

# Limits for a splice, and the range of 98 % of those in the real measurement. Among 28,000 impulses in clicks
# below 100 kHz, as microphones hear them, none was classified as one. Without one of these limits, a hundred were.
_NOISE = (0.03, 0.35)  # Level: below it, there is no microphone; above it, detection is impossible. Typically 0.09.
_MIN_OVER_NOISE, _SIZE = 2.0, (0.45, 4.0)  # Typically 0.75 to 1.7; several added bytes give 4.
_LANE_POWER, _LANE_OVER_NOISE = 0.2, 5.0  # Mean square in the third of the lanes: 0.4 to 1.7; in altered words 0.04.
_ALONE = (0.85, 1.25)  # Share of the surrounding power that it explains: 0.99 to 1.03.
_MIN_AT_ONCE = 0.62  # Share of its power in phase: 0.88 to 0.99; for sounds from the side 0.5 to 0.6.
_MAX_ALIKE = 0.4  # Share of its power common to all channels: 0 to 0.16; for sounds from ahead 1.
# Its size in the higher band relative to that in the lower: 0.97 to 1.12; for sounds 0.2 to 0.7.
_SPECTRUM = (0.8, 1.35)
_MAX_OVER_LEVEL = 8.0  # Level there relative to that of the whole block.
_LOUDEST, _LOUDEST_SHARE = 0.35, 0.8  # Full scale 1, in most channels: overload also destroys noise shaping.


class _Filter:
    """Decimation filter of the bits of all channels, on one thread; the number of symmetric taps is odd."""

    def __init__(self, n_samples: int, taps: NDArray[np.int16], scale: float, step: int) -> None:
        self._kernels = kernels.load_host()
        self._channels = np.arange(CHANNELS, dtype=np.int32)
        self._taps, self._scale, self._step = taps, np.float32(scale), step
        self._out = np.empty((CHANNELS, -(-(n_samples + step // 2) // step)), dtype=np.float32)

    def __call__(self, words: NDArray[np.uint32]) -> Floats:
        """Return (channel, n) float32, the same array each time, for words, (sample, 1) uint32."""
        with self._kernels.threads(1):
            self._kernels.demodulate_words(
                words, self._channels, self._taps, self._scale, self._step, 0, self._out.shape[1], self._out
            )
        return self._out


class Splices:
    """Detector of impulses in all channels at once, in a band with little sound and noise."""

    def __init__(self, n_samples: int, pdm_rate_hz: float) -> None:
        band = _analytic(_BAND_HZ, pdm_rate_hz, _TAPS)
        largest = (np.iinfo(np.int16).max - _TAPS) / np.abs(band.real).sum()
        taps = np.rint(band.real * largest).astype(np.int16)
        self._filter = _Filter(n_samples, taps, 1 / taps[_TAPS // 2], _STEP)
        half = _TAPS // 2
        at = np.arange(-(half + _REACH) // _FINE_STEP * _FINE_STEP, half + _REACH + 1, _FINE_STEP)
        self._reach = half - int(at[0])
        self._edge = -(-(self._reach + _REACH) // _STEP) + 2
        self._n_samples = n_samples
        bits, places = np.arange(-self._reach, self._reach + 1), np.arange(-_REACH, _REACH + 1)
        self._bank = _by_lag(band.real, at - bits[:, None]).astype(np.float32)
        shapes = [_by_lag(part, at[:, None] - places) for part in (band.real, band.imag)]
        self._fits = [(shape / np.sum(shape**2, axis=0)).astype(np.float32) for shape in shapes]
        self._amplitude = float(np.mean(np.sum(shapes[0] ** 2, axis=0)))
        self._high = _analytic(_HIGH_BAND_HZ, pdm_rate_hz, _HIGH_TAPS).real.astype(np.float32)
        # Variance of a size fitted to noise with unit variance per sample of the band.
        alike = np.correlate(band.real, band.real, "full") / np.sum(band.real**2)
        fit = self._fits[0][:, _REACH]
        self._noise_gain = float(fit @ _by_lag(alike, at[:, None] - at) @ fit)

    @staticmethod
    def can_distinguish(pdm_rate_hz: float) -> bool:
        """Return True if this clock has such a band."""
        return pdm_rate_hz >= _MIN_RATE_HZ

    def found(self, words: NDArray[np.uint32], mean: Floats, moving: NDArray[np.bool_]) -> bool:
        """Return True if there is a splice in (sample, 1) words; mean is (channel, n), of `MEAN_OF` samples each."""
        if self._n_samples < 8 * self._edge * _STEP:
            return False
        band = self._filter(words)
        some = np.abs(band[:, self._edge : -self._edge : _EVERY])
        noise = np.partition(some, some.shape[1] // 2, axis=1)[:, some.shape[1] // 2] / 0.6745  # For Gaussian noise.
        moving = moving & (noise > 0)
        counts = moving.reshape(_LANES, -1).sum(axis=1)
        lanes = np.flatnonzero(counts >= _MIN_CHANNELS)
        if len(lanes) < _MIN_LANES:
            return False
        band *= np.where(moving, 1 / np.where(moving, noise, 1), 0).astype(np.float32)[:, None]
        band = band.reshape(_LANES, -1, band.shape[1])[lanes]
        each = np.einsum("lmn,lmn->ln", band, band) / (_SPAN * counts[lanes, None]).astype(np.float32)
        power = sum((each[:, n : n - _SPAN] for n in range(1, _SPAN)), each[:, :-_SPAN])
        level = _level(power)
        above = np.sum(power > _RISE * level, axis=0) >= _MIN_LANES
        above[: self._edge] = above[-self._edge :] = False
        variance = float(np.mean(noise[moving] ** 2)) * self._noise_gain
        for top in _tops(np.flatnonzero(above), power, level):
            around = float(np.median(level[:, top]))
            at = round((top + (_SPAN - 1) / 2) * _STEP)
            if around < _MAX_OVER_LEVEL and self._is_splice(words, mean, moving, at, variance * around):
                return True
        return False

    def _is_splice(
        self, words: NDArray[np.uint32], mean: Floats, moving: NDArray[np.bool_], at: int, variance: float
    ) -> bool:
        """Return True if the impulse near sample ``at`` is a splice; ``variance``: of sizes by noise alone."""
        if not _NOISE[0] < math.sqrt(variance) < _NOISE[1] or _is_loud(mean[moving], at):
            return False
        at = min(max(at, self._reach + _REACH), self._n_samples - self._reach - _REACH - 1)
        octets = words[at - self._reach : at + self._reach + 1].view(np.uint8)
        bits = np.unpackbits(octets, axis=1, bitorder="little").T.astype(np.float32) * 2 - 1
        # Lane by lane: BLAS uses one thread for products of this size, and its threads synchronise slowly.
        band = (bits.reshape(_LANES, -1, bits.shape[1]) @ self._bank).reshape(CHANNELS, -1)[moving]
        in_phase = band @ self._fits[0]
        place = int(np.argmax(np.sum(in_phase**2, axis=0)))
        sizes, others = in_phase[:, place], band @ self._fits[1][:, place]
        first = self._reach - _REACH + place - _HIGH_TAPS // 2
        high = bits[moving, first : first + _HIGH_TAPS] @ self._high

        count, total = len(sizes), float(sizes @ sizes)
        power = total - count * variance
        if not max(_SIZE[0], _MIN_OVER_NOISE * math.sqrt(variance)) ** 2 < power / count < _SIZE[1] ** 2:
            return False
        lanes = np.bincount(np.flatnonzero(moving) * _LANES // CHANNELS, weights=sizes**2, minlength=_LANES)
        third = np.sort(lanes / np.maximum(moving.reshape(_LANES, -1).sum(axis=1), 1))[-_MIN_LANES] - variance
        if third < max(_LANE_POWER, _LANE_OVER_NOISE * variance):
            return False
        both = power + max(float(others @ others) - count * variance, 0.0)
        around = float(np.sum(band**2)) - count * band.shape[1] * variance / self._noise_gain
        return (
            _ALONE[0] * around < both * self._amplitude < _ALONE[1] * around
            and power > _MIN_AT_ONCE * both
            and float(np.sum(sizes)) ** 2 < _MAX_ALIKE * count * total
            and _SPECTRUM[0] * power < float(sizes @ high) < _SPECTRUM[1] * power
        )


def _is_loud(mean: Floats, at: int) -> bool:
    """Return True if modulators may be in overload near a sample."""
    place = at // MEAN_OF
    loudest = np.max(np.abs(mean[:, max(place - 3, 0) : place + 5]), axis=1)
    return bool(np.quantile(loudest, _LOUDEST_SHARE) > _LOUDEST)


def _analytic(band_hz: tuple[float, float], rate_hz: float, n_taps: int) -> NDArray[np.complex128]:
    """Return a band pass of linear phase and, as imaginary part, its quadrature; the tap in the middle is 1."""
    low, high = (edge_hz / rate_hz for edge_hz in band_hz)
    time = np.arange(n_taps) - n_taps // 2
    envelope = np.sinc((high - low) * time) * np.kaiser(n_taps, _KAISER)
    return np.asarray(envelope * np.exp(1j * math.pi * (low + high) * time))


def _by_lag(taps: Floats, lag: NDArray[np.int64]) -> Floats:
    """Return taps by their distance from the middle one, 0 beyond the ends."""
    half = len(taps) // 2
    return np.where(np.abs(lag) <= half, taps[np.clip(lag + half, 0, len(taps) - 1)], 0.0)


def _level(power: Floats) -> Floats:
    """Return medians over stretches of time, the highest of each and its neighbours: (lane, n), as ``power``."""
    count = power.shape[1] // _LEVEL_SPAN
    stretches = power[:, : count * _LEVEL_SPAN].reshape(len(power), count, _LEVEL_SPAN)
    medians = np.partition(stretches, _LEVEL_SPAN // 2, axis=2)[:, :, _LEVEL_SPAN // 2]
    apart = np.pad(medians, ((0, 0), (1, 1)), mode="edge")
    highest = np.maximum(np.maximum(apart[:, :-2], apart[:, 2:]), medians)
    level = np.repeat(highest, _LEVEL_SPAN, axis=1)
    return np.pad(level, ((0, 0), (0, power.shape[1] - level.shape[1])), mode="edge")


def _tops(above: NDArray[np.int64], power: Floats, level: Floats) -> list[int]:
    """Return the maxima of the third-highest lane in each stretch above the limit, the highest first."""
    if not len(above):
        return []
    rise = np.sort(power[:, above] / level[:, above], axis=0)[-_MIN_LANES]
    begins = np.concatenate([[0], np.flatnonzero(np.diff(above) > _APART) + 1, [len(above)]])
    tops = [first + int(np.argmax(rise[first:stop])) for first, stop in itertools.pairwise(begins.tolist())]
    return [int(above[top]) for top in sorted(tops, key=lambda top: -float(rise[top]))[:_MAX]]
