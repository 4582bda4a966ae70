"""Whether a block of PDM words can be what 32 microphones sent, told from its bits alone.

The wire has no checksum, and where as many bytes were lost as added within a block its header and footer stand right.
But a sigma-delta modulator keeps the running sum of its errors small, so that below some 150 kHz its bits hold sound
and little else. Where words are missing, or belong to something else, the sum of each microphone jumps by some A_m
(a missing bit is worth 1), which is heard as an impulse: of any sign, in all microphones, at one and the same sample.
A sound does not do that: from ahead it is alike in all of them, from aside it comes to one after the other, and
microphones hear next to nothing above 90 kHz.

A real eRTIS alters single words itself: in the one measurement that is public, the upper 16 bits of ten words are those
of other microphones. So bits that differ in a single word, a flipped one too, are no reason to reject a block.
"""

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks, kernels
from ertis_numba.errors import ArgumentError

__all__ = ["BitCheck"]

Floats = NDArray[np.floating[Any]]

_CHANNELS, _LANES = 32, 4
_BOX = 31  # samples over which means and changes are taken
_OFF = 0.1  # mean distance of the shares of ones from a half; a real sensor has 0.0001, text 0.16
_JUMP = 0.1  # of the share of ones, against earlier blocks; as much sound would be a fifth of full scale over a record
_FROZEN_BOXES = 33  # equal words over 0.2 ms; half a period in overload lasts a tenth of that

# White bits have changes and means as follows, a modulator's bits change far more often: -0.3 to -0.5.
_WHITE_POWER, _WHITE_PRODUCT = 1 / _BOX, -1 / _BOX
_POWER_RANGE, _PRODUCT_REACH = (0.012, 0.06), 0.09
_SHAPED = -0.25
_WHITE_BOXES = 12  # in a row; after clicks of thirty times full scale and 200 kHz there were 8, after others 3

_LEAST_RATE_HZ = 4e6  # at the slower clock the band that is told from sound here is full of sound
_BAND_HZ, _TAPS = (90e3, 130e3), 255  # above all calls, below the noise that modulators push upwards
_HIGH_BAND_HZ, _HIGH_TAPS = (125e3, 180e3), 151
_KAISER = 5.0
_STEP = 30  # samples between those of the band: 150 kHz, of which 75 to 150 kHz are seen without aliases that matter
_SPAN = 4  # of these, in which all of an impulse lies
_LEVEL_SPAN = 32  # of these, over which the level is a median
_APART = 6  # of these, between impulses that are looked at one by one
_MOST = 8  # impulses looked at, the strongest first
_RISE = 2.0  # over the level, of the power in three lanes; noise reaches 1.75
_FINE_STEP, _REACH = 5, 40  # samples: of the band around an impulse, and how far from it the right sample is sought
_LEAST_CHANNELS = 4  # of a lane that counts

# An impulse is a splice if all of these hold; see _Impulse. Splices of the real measurement lie at 0.75 to 1.7 (size),
# 0.87 (alone), 0.97 (at_once), 0.2 (alike), 0.97 to 1.12 (spectrum). Of 812 impulses in simulated sound none came
# nearer than two of the bounds.
_SIZE = (0.45, 2.0)
_LEAST_OVER_NOISE = 2.0
_LEAST_ALONE = 0.85, 1.25
_LEAST_AT_ONCE = 0.62
_MOST_ALIKE = 0.4
_SPECTRUM = (0.8, 1.35)
_NOISE = (0.03, 0.35)
_MOST_OVER_LEVEL = 8.0
_LOUDEST = 0.4


class BitCheck:
    """Tells blocks that cannot be what the microphones sent.

    Parameters
    ----------
    n_samples : int
        Words of a block.
    pdm_rate_hz : float
        At the slower clock of 1.125 MHz splices and stretches of noise are not looked for.
    enabled : (channel,) bool, optional
        Channels that have a microphone; all by default.

    Attributes
    ----------
    density : (channel,) float64
        Share of ones in the block that was checked last; exactly 0 or 1 is a stuck microphone.

    Raises
    ------
    ArgumentError
        A number is out of range, or ``enabled`` is not of 32 channels.
    """

    def __init__(self, n_samples: int, pdm_rate_hz: float, enabled: NDArray[np.bool_] | None = None) -> None:
        self._n_samples = checks.whole("n_samples", n_samples, _BOX)
        checks.positive("pdm_rate_hz", pdm_rate_hz)
        self._enabled = np.ones(_CHANNELS, dtype=bool) if enabled is None else np.asarray(enabled, dtype=bool)
        checks.shape("enabled", self._enabled.shape, (_CHANNELS,))
        self.density = np.full(_CHANNELS, 0.5)
        self._known: list[Floats] = []
        self._words = np.empty((n_samples, 1), dtype=np.uint32)
        self._changes = np.zeros((n_samples, 1), dtype=np.uint32)
        self._mean, self._change = (_Filter(n_samples, np.ones(_BOX, np.int16), 1 / _BOX, _BOX) for _ in range(2))
        self._splices = _Splices(n_samples, pdm_rate_hz) if pdm_rate_hz >= _LEAST_RATE_HZ else None

    def check(self, words: NDArray[np.uint32]) -> str | None:
        """Return why a block cannot be right, or None.

        ``constant bits``: in no channel, or over a long stretch, any bit changes. ``density``: most channels have far
        too many ones or zeros, or many have others than in the blocks before. ``noise``: bits as if thrown by dice.
        ``splice``: words are missing or do not belong here.

        Parameters
        ----------
        words : (sample,) uint32
            Bit m is channel m.

        Raises
        ------
        ArgumentError
            The words are not of this shape and type.
        """
        checks.shape("words", words.shape, (self._n_samples,))
        if words.dtype != np.uint32:
            raise ArgumentError(f"words is of {words.dtype}; give uint32")
        self._words[:, 0] = words  # a copy of its own: the kernels would be compiled once more for read-only arrays
        np.bitwise_xor(self._words[1:], self._words[:-1], out=self._changes[1:])
        mean, change = self._mean(self._words), self._change(self._changes)
        self.density = 0.5 + 0.5 * _BOX / self._n_samples * mean.sum(axis=1, dtype=np.float64)
        # Sums of bits are whole numbers, which float32 holds exactly; their means are not.
        self.density = np.rint(self.density * self._n_samples) / self._n_samples
        moving = self._enabled & (self.density > 0) & (self.density < 1)
        return self._whole(mean, change, moving) or (self._splices and self._splices(self._words, mean, moving)) or None

    def _whole(self, mean: Floats, change: Floats, moving: NDArray[np.bool_]) -> str | None:
        """Return what is wrong with the bits apart from splices."""
        if not moving.any():
            return "constant bits" if self._enabled.any() else None
        weights = (moving / moving.sum()).astype(np.float32)
        # Not by BLAS, whose threads take longer to meet, where others keep the cores busy, than all of this does.
        changes = np.einsum("m,mn->n", weights, change)  # 1 where all bits change at each sample, -1 where none does
        power = np.einsum("m,mn->n", weights, np.square(mean))
        if _longest(changes[1:-1] <= -1 + 0.5 / (_BOX * _CHANNELS)) >= _FROZEN_BOXES:
            return "constant bits"
        if np.mean(np.abs(self.density[moving] - 0.5)) > _OFF or self._jumps(moving):
            return "density"
        return "noise" if self._is_noise(power[1:-2], -changes[1:-2] - power[1:-2]) else None

    def _jumps(self, moving: NDArray[np.bool_]) -> bool:
        """Whether a quarter of the channels has another share of ones than before, and not all of them alike.

        A microphone may well break. So blocks are not rejected twice for what has come to stay.
        """
        for known in self._known:
            both = moving & (known > 0) & (known < 1)
            change = self.density[both] - known[both]
            if not both.any() or np.mean(np.abs(change - np.median(change)) > _JUMP) < 0.25:
                self._known = [self.density]
                return False
        found = bool(self._known)
        self._known = [*self._known[:1], self.density]
        return found

    def _is_noise(self, power: Floats, product: Floats) -> bool:
        """Whether bits are white, all along or over a stretch.

        Parameters
        ----------
        power, product : (box,) float32
            Mean square of the mean of 31 samples, and the mean product of neighbours less that.
        """
        if abs(power.mean() - _WHITE_POWER) < 0.002 and abs(product.mean() - _WHITE_PRODUCT) < 0.006:
            return True
        if self._splices is None or np.median(product) > _SHAPED:
            return False
        low, high = _POWER_RANGE
        white = (power > low) & (power < high) & (np.abs(product - _WHITE_PRODUCT) < _PRODUCT_REACH)
        return _longest(white) >= _WHITE_BOXES


class _Filter:
    """Filters the bits of all channels and keeps every so many samples, on one thread.

    Returns (channel, n) float32, the same array each time: new ones would cost as much as filling them.
    """

    def __init__(self, n_samples: int, taps: NDArray[np.int16], scale: float, step: int) -> None:
        self._kernels = kernels.load("cpu")
        self._channels = np.arange(_CHANNELS, dtype=np.int32)
        self._taps, self._scale, self._step = taps, np.float32(scale), step
        self._out = np.empty((_CHANNELS, -(-(n_samples + step // 2) // step)), dtype=np.float32)

    def __call__(self, words: NDArray[np.uint32]) -> Floats:
        with self._kernels.threads(1):
            self._kernels.demodulate_words(
                words, self._channels, self._taps, self._scale, self._step, 0, self._out.shape[1], self._out
            )
        return self._out


class _Splices:
    """Looks for impulses in all channels at once, in a band that holds neither sound nor much noise.

    In three of the four bytes of a word the power must rise: an altered word of a real sensor shows in two.
    """

    def __init__(self, n_samples: int, pdm_rate_hz: float) -> None:
        band = _analytic(_BAND_HZ, pdm_rate_hz, _TAPS)
        sums = (np.iinfo(np.int16).max - _TAPS) / np.abs(band.real).sum()
        taps = np.rint(band.real * sums).astype(np.int16)
        self._filter = _Filter(n_samples, taps, 1 / taps[_TAPS // 2], _STEP)
        half = _TAPS // 2
        at = np.arange(-(half + _REACH) // _FINE_STEP * _FINE_STEP, half + _REACH + 1, _FINE_STEP)
        self._reach = -int(at[0]) + half
        self._edge = -(-(self._reach + _REACH) // _STEP) + 2
        self._n_samples = n_samples
        bits, places = np.arange(-self._reach, self._reach + 1), np.arange(-_REACH, _REACH + 1)
        self._bank = _shifted(band.real, at[None, :] - bits[:, None]).astype(np.float32)
        real, imaginary = (_shifted(part, at[:, None] - places) for part in (band.real, band.imag))
        self._energy = float(np.mean(np.sum(real**2, axis=0)))
        self._fits = [(part / np.sum(part**2, axis=0)).astype(np.float32) for part in (real, imaginary)]
        self._high = _analytic(_HIGH_BAND_HZ, pdm_rate_hz, _HIGH_TAPS).real.astype(np.float32)
        # Variance of a fitted size, where the samples of the band have a variance of 1.
        alike = np.correlate(band.real, band.real, "full") / np.sum(band.real**2)
        fit = self._fits[0][:, _REACH]
        self._noise_gain = float(fit @ _shifted(alike, at[:, None] - at) @ fit)

    def __call__(self, words: NDArray[np.uint32], mean: Floats, moving: NDArray[np.bool_]) -> str | None:
        """Return ``splice`` or None; ``mean`` is that of boxes of 31 samples, (channel, box) float32."""
        counts = moving.reshape(_LANES, -1).sum(axis=1)
        lanes = np.flatnonzero(counts >= _LEAST_CHANNELS)
        if len(lanes) < 3 or self._n_samples < 8 * self._edge * _STEP:
            return None
        band = self._filter(words)
        some = np.abs(band[:, self._edge : -self._edge : 16])
        noise = np.partition(some, some.shape[1] // 2, axis=1)[:, some.shape[1] // 2] / 0.6745  # of Gaussian noise
        moving = moving & (noise > 0)
        band *= np.where(moving, 1 / np.maximum(noise, 1e-9), 0)[:, None].astype(np.float32)
        band = band.reshape(_LANES, -1, band.shape[1])[lanes]
        total = np.cumsum(np.einsum("lmn,lmn->ln", band, band), axis=1, dtype=np.float64)
        power = (total[:, _SPAN:] - total[:, :-_SPAN]) / (_SPAN * counts[lanes, None])
        level = _level(power)
        above = np.sum(power > _RISE * level, axis=0) >= 3
        above[: self._edge] = above[-self._edge :] = False
        variance = float(np.mean(noise[moving] ** 2)) * self._noise_gain
        for top in _tops(np.flatnonzero(above), power, level):
            around = float(np.median(level[:, top]))
            # The span of ``power[n]`` begins one after n.
            at = round((top + (_SPAN + 1) / 2) * _STEP)
            if around < _MOST_OVER_LEVEL and self._is_splice(words, mean, moving, at, variance * around):
                return "splice"
        return None

    def _is_splice(
        self, words: NDArray[np.uint32], mean: Floats, moving: NDArray[np.bool_], at: int, variance: float
    ) -> bool:
        """Whether the impulse near a sample is a splice.

        Impulses of any size are fitted to each channel, in phase and, as what a sound from elsewhere would add, in
        quadrature, at the sample at which those in phase explain most.

        ``size``: root mean square of A_m. ``alone``: share of the power around that the fit explains. ``at once``:
        share of that which is in phase. ``alike``: share of that which is common to all channels. ``spectrum``: size
        in a higher band by that in this one. All of them without the noise.
        """
        if not _NOISE[0] < math.sqrt(variance) < _NOISE[1] or self._is_loud(mean[moving], at):
            return False
        at = min(max(at, self._reach + _REACH), self._n_samples - self._reach - _REACH - 1)
        octets = words[at - self._reach : at + self._reach + 1].view(np.uint8)
        bits = np.unpackbits(octets, axis=1, bitorder="little").T.astype(np.float32) * 2 - 1
        # Lane by lane, as products of this size are left to one thread.
        band = (bits.reshape(_LANES, -1, bits.shape[1]) @ self._bank).reshape(_CHANNELS, -1)[moving]
        in_phase = band @ self._fits[0]
        place = int(np.argmax(np.sum(in_phase**2, axis=0)))
        sizes, others = in_phase[:, place], band @ self._fits[1][:, place]
        first = self._reach - _REACH + place - _HIGH_TAPS // 2
        high = bits[moving, first : first + _HIGH_TAPS] @ self._high

        count = len(sizes)
        power = float(sizes @ sizes)
        signal = power - count * variance
        if signal < count * max(_SIZE[0] ** 2, _LEAST_OVER_NOISE**2 * variance) or signal > count * _SIZE[1] ** 2:
            return False
        both = signal + max(float(others @ others) - count * variance, 0.0)
        around = float(np.sum(band**2)) - count * variance / self._noise_gain * band.shape[1]
        low, most = _LEAST_ALONE
        return (
            low * around < both * self._energy < most * around
            and signal > _LEAST_AT_ONCE * both
            and float(np.sum(sizes)) ** 2 < _MOST_ALIKE * count * power
            and _SPECTRUM[0] * signal < float(sizes @ high) < _SPECTRUM[1] * signal
        )

    @staticmethod
    def _is_loud(mean: Floats, at: int) -> bool:
        """Whether modulators may be in overload, which breaks their noise shaping, too."""
        box = at // _BOX
        return float(np.median(np.max(np.abs(mean[:, max(box - 3, 0) : box + 5]), axis=1))) > _LOUDEST


def _analytic(band_hz: tuple[float, float], rate_hz: float, n_taps: int) -> NDArray[np.complex128]:
    """Return a band pass of linear phase and, as imaginary part, its quadrature; the tap in the middle is 1."""
    low, high = (edge / rate_hz for edge in band_hz)
    time = np.arange(n_taps) - n_taps // 2
    envelope = np.sinc((high - low) * time) * np.kaiser(n_taps, _KAISER)
    return np.asarray(envelope * np.exp(1j * math.pi * (low + high) * time))


def _shifted(taps: Floats, lag: NDArray[np.int64]) -> Floats:
    """Return taps by their distance from the middle one, 0 beyond the ends."""
    half = len(taps) // 2
    return np.where(np.abs(lag) <= half, taps[np.clip(lag + half, 0, len(taps) - 1)], 0.0)


def _level(power: Floats) -> Floats:
    """Return medians over stretches of time, the highest of each and its neighbours: (lane, n), as ``power``."""
    count = power.shape[1] // _LEVEL_SPAN
    parts = power[:, : count * _LEVEL_SPAN].reshape(len(power), count, _LEVEL_SPAN)
    medians = np.partition(parts, _LEVEL_SPAN // 2, axis=2)[:, :, _LEVEL_SPAN // 2]
    apart = np.pad(medians, ((0, 0), (1, 1)), mode="edge")
    highest = np.maximum(np.maximum(apart[:, :-2], apart[:, 2:]), medians)
    level = np.repeat(highest, _LEVEL_SPAN, axis=1)
    return np.pad(level, ((0, 0), (0, power.shape[1] - level.shape[1])), mode="edge")


def _tops(above: NDArray[np.int64], power: Floats, level: Floats) -> list[int]:
    """Return where the third of the lanes rises most in each stretch of what is above, the highest first."""
    if not len(above):
        return []
    rise = np.sort(power[:, above] / level[:, above], axis=0)[-3]
    begins = np.concatenate([[0], np.flatnonzero(np.diff(above) > _APART) + 1, [len(above)]])
    tops = [first + int(np.argmax(rise[first:stop])) for first, stop in itertools.pairwise(begins.tolist())]
    return [int(above[top]) for top in sorted(tops, key=lambda top: -float(rise[top]))[:_MOST]]


def _longest(flags: NDArray[np.bool_]) -> int:
    """Return the length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return int(np.max(edges[1::2] - edges[::2], initial=0))
