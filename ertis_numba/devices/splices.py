"""Places in PDM words where some are missing or do not belong.

A sigma-delta modulator keeps the running sum of its errors small, so that below some 150 kHz its bits hold sound and
little else. At a splice the sum of each microphone m jumps by some A_m (a missing bit is worth 1), which is heard as an
impulse: of any sign, in all microphones, at one and the same sample. No sound does that: from ahead it is alike in all
of them, from aside it comes to one after the other, and above 90 kHz microphones hear next to nothing.

A real eRTIS alters single words itself: in the one measurement that is public, ten words have in their upper 16 bits
those of other microphones. So bits that differ in a single word, flipped ones too, are no reason to reject a block: an
impulse counts where it is in three bytes of the four.
"""

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba import kernels
from ertis_numba.devices.blocks import CHANNELS

__all__ = ["MEAN_OF", "Filter", "Splices"]

Floats = NDArray[np.floating[Any]]

MEAN_OF = 31
"""Samples over which means of bits are taken."""

_MIN_RATE_HZ = 4e6  # at the slower clock modulators are quiet below 40 kHz only, where sound is
_BAND_HZ, _TAPS = (90e3, 130e3), 207  # above all calls, below the noise that modulators push upwards
_HIGH_BAND_HZ, _HIGH_TAPS = (125e3, 180e3), 151
_KAISER = 4.0
_STEP = 30  # samples of the words: 150 kHz, which leaves 75 to 150 kHz in order
_EVERY = 16  # samples of the band of which the noise is a median
_SPAN = 4  # samples of the band, in which all of an impulse lies
_LEVEL_SPAN = 32  # the same, over which the level is a median
_APART = 6  # the same, between stretches that are looked at one by one
_MAX = 8  # stretches, those that stand out most first
_RISE = 2.0  # of the power over the level, to be looked at; that of noise reaches 1.6
_FINE_STEP, _REACH = 5, 40  # samples of the words: of the band about an impulse, and how far off its sample may be
_LANES, _MIN_LANES, _MIN_CHANNELS = 4, 3, 4  # bytes of a word, how many of them, and channels in each

# What makes an impulse a splice, and where 98 % of those of the real measurement lie. Of 28,000 impulses in clicks as
# microphones hear them, below 100 kHz, none was taken for one; a hundred would have been but for one of these bounds.
_NOISE = (0.03, 0.35)  # of a size: lower, and there is no microphone; higher, and there is no telling. 0.09
_MIN_OVER_NOISE, _SIZE = 2.0, (0.45, 4.0)  # 0.75 to 1.7; a few bytes too many make 4
_LANE_POWER, _LANE_OVER_NOISE = 0.2, 5.0  # mean square in the third of the lanes: 0.4 to 1.7; in altered words 0.04
_ALONE = (0.85, 1.25)  # share of the power about it that it explains: 0.99 to 1.03
_MIN_AT_ONCE = 0.62  # share of its power that is in phase: 0.88 to 0.99; in sounds from aside 0.5 to 0.6
_MAX_ALIKE = 0.4  # share of its power that is the same in all channels: 0 to 0.16; in sounds from ahead 1
_SPECTRUM = (0.8, 1.35)  # its size in the higher band by that in the lower: 0.97 to 1.12; in sounds 0.2 to 0.7
_MAX_OVER_LEVEL = 8.0  # of the level there, over that of the whole block
_LOUDEST, _LOUDEST_SHARE = 0.35, 0.8  # full scale 1, in most channels: overload breaks the shaping of noise, too


class Filter:
    """Filters the bits of all channels and keeps every so many samples, on one thread.

    Parameters
    ----------
    n_samples : int
    taps : (tap,) int16
        Symmetric, an odd number.
    scale : float
    step : int
    """

    def __init__(self, n_samples: int, taps: NDArray[np.int16], scale: float, step: int) -> None:
        self._kernels = kernels.load("cpu")
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
    """Looks for impulses in all channels at once, in a band that holds neither sound nor much noise.

    Parameters
    ----------
    n_samples : int
        Words of a block.
    pdm_rate_hz : float
    """

    def __init__(self, n_samples: int, pdm_rate_hz: float) -> None:
        band = _analytic(_BAND_HZ, pdm_rate_hz, _TAPS)
        largest = (np.iinfo(np.int16).max - _TAPS) / np.abs(band.real).sum()
        taps = np.rint(band.real * largest).astype(np.int16)
        self._filter = Filter(n_samples, taps, 1 / taps[_TAPS // 2], _STEP)
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
        # Variance of a size that is fitted to noise of which the band's samples have a variance of 1.
        alike = np.correlate(band.real, band.real, "full") / np.sum(band.real**2)
        fit = self._fits[0][:, _REACH]
        self._noise_gain = float(fit @ _by_lag(alike, at[:, None] - at) @ fit)

    @staticmethod
    def can_distinguish(pdm_rate_hz: float) -> bool:
        """Return whether there is such a band at this clock."""
        return pdm_rate_hz >= _MIN_RATE_HZ

    def found(self, words: NDArray[np.uint32], mean: Floats, moving: NDArray[np.bool_]) -> bool:
        """Return whether there is a splice.

        Parameters
        ----------
        words : (sample, 1) uint32
        mean : (channel, n) float32
            Of `MEAN_OF` samples each.
        moving : (channel,) bool
            Those with a microphone that is not stuck.
        """
        if self._n_samples < 8 * self._edge * _STEP:
            return False
        band = self._filter(words)
        some = np.abs(band[:, self._edge : -self._edge : _EVERY])
        noise = np.partition(some, some.shape[1] // 2, axis=1)[:, some.shape[1] // 2] / 0.6745  # if it is Gaussian
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
        """Return whether the impulse near sample ``at`` is a splice; ``variance`` is that of sizes by noise alone.

        Impulses of any size are fitted to each channel, all at the sample where they explain most, and others in
        quadrature, which is what a sound adds that comes a little earlier or later to some microphones.
        """
        if not _NOISE[0] < math.sqrt(variance) < _NOISE[1] or _is_loud(mean[moving], at):
            return False
        at = min(max(at, self._reach + _REACH), self._n_samples - self._reach - _REACH - 1)
        octets = words[at - self._reach : at + self._reach + 1].view(np.uint8)
        bits = np.unpackbits(octets, axis=1, bitorder="little").T.astype(np.float32) * 2 - 1
        # Lane by lane: BLAS leaves products of this size to one thread, and its threads take long to meet.
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
    """Return whether modulators may be in overload near a sample."""
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
    """Return where the third of the lanes rises most in each stretch of what is above, the highest first."""
    if not len(above):
        return []
    rise = np.sort(power[:, above] / level[:, above], axis=0)[-_MIN_LANES]
    begins = np.concatenate([[0], np.flatnonzero(np.diff(above) > _APART) + 1, [len(above)]])
    tops = [first + int(np.argmax(rise[first:stop])) for first, stop in itertools.pairwise(begins.tolist())]
    return [int(above[top]) for top in sorted(tops, key=lambda top: -float(rise[top]))[:_MAX]]
