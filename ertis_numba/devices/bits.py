"""Whether a block of PDM words can be what 32 microphones sent, told from its bits alone.

The wire has no checksum, and where as many bytes are lost as added within a block its header and footer stand right.
But the bits of a sigma-delta modulator are far from chance: they change more often than chance would have it, their
mean follows the sound, and neither stops from one sample to the next in all channels. `splices` has the rest.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks
from ertis_numba.devices.blocks import CHANNELS
from ertis_numba.devices.splices import MEAN_OF, Filter, Splices
from ertis_numba.errors import ArgumentError

__all__ = ["BitCheck"]

Floats = NDArray[np.floating[Any]]

_EVERY = 32  # means of which medians are taken; of those over channels every eighth. All would take half a millisecond
# Of white bits the mean square of a mean of 31 is 1/31, and the mean product of neighbours less that square is:
_WHITE_PRODUCT = -1 / MEAN_OF
# How far both stray by chance. Products of a real sensor are -0.30 and less, in its direct sound -0.19 where the power
# is that of white bits; those of simulated sensors, in loud noise, -0.17. In overload the power is higher.
_POWER_RANGE, _PRODUCT_REACH = (0.012, 0.06), 0.09
_UNSHAPED, _SHAPED = -0.1, -0.25
_OFF = (0.2, 0.5)  # of a channel, full scale 1; text has 0.3 to 0.4, and wind may do that to products of -0.2
_WHITE_MEANS = 16  # in a row; sounds have 3, and overload by what is above 100 kHz, which microphones do not hear, 12

_EQUAL_WORDS = 4096  # half a period in overload lasts 112, a push of thirty times full scale that fades in 0.1 ms 1530
_AROUND = 8  # samples before and after them
_AS_EVER = (0.3, 0.7)  # share of bits there that differ; next to overload, which comes and goes, few do as a rule


class BitCheck:
    """Tells blocks that cannot be what the microphones sent.

    Parameters
    ----------
    n_samples : int
        Words of a block.
    pdm_rate_hz : float
        At the slower clock of 1.125 MHz neither splices nor stretches of noise can be told from sound.
    enabled : (channel,) bool, optional
        Channels that have a microphone; all by default.
    splices : bool
        Look for places where words are missing or do not belong, too. That finds nearly all of them. What is told
        from them is what simulated sensors hear and what one real sensor does, in the one measurement that is public.

    Attributes
    ----------
    density : (channel,) float64 or None
        Share of ones in the block that was checked last; 0 or 1 is a stuck microphone, which is no reason to reject.

    Raises
    ------
    ArgumentError
        A number is out of range, or ``enabled`` is not of 32 channels.
    """

    def __init__(
        self,
        n_samples: int,
        pdm_rate_hz: float,
        enabled: NDArray[np.bool_] | None = None,
        *,
        splices: bool = False,
    ) -> None:
        self._n_samples = checks.integer("n_samples", n_samples, _EQUAL_WORDS)
        checks.positive("pdm_rate_hz", pdm_rate_hz)
        self._enabled = np.ones(CHANNELS, dtype=bool) if enabled is None else np.asarray(enabled, dtype=bool)
        checks.shape("enabled", self._enabled.shape, (CHANNELS,))
        self.density: NDArray[np.float64] | None = None
        self._words = np.empty((n_samples, 1), dtype=np.uint32)
        self._changes = np.zeros((n_samples, 1), dtype=np.uint32)
        self._mean, self._change = (
            Filter(n_samples, np.ones(MEAN_OF, dtype=np.int16), 1 / MEAN_OF, MEAN_OF) for _ in range(2)
        )
        self._squares = np.empty_like(self._mean(self._words))
        self._is_fast = Splices.can_distinguish(pdm_rate_hz)
        self._splices = Splices(n_samples, pdm_rate_hz) if splices and self._is_fast else None

    def check(self, words: NDArray[np.uint32]) -> str | None:
        """Return why a block cannot be right, or None.

        ``constant bits``: no channel changes, all along or over a stretch that begins and ends at once. ``density``:
        most channels have too many ones or zeros, and change as no modulator does. ``noise``: the bits are those of
        chance, all along or over a stretch. ``splice``: words are missing or do not belong here.

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
            raise ArgumentError(f"words are {words.dtype}; give uint32")
        self._words[:, 0] = words  # a copy of its own: the kernels would be compiled once more for read-only arrays
        np.bitwise_xor(self._words[1:], self._words[:-1], out=self._changes[1:])
        mean, change = self._mean(self._words), self._change(self._changes)
        ones = np.rint((self._n_samples + MEAN_OF * mean.sum(axis=1, dtype=np.float64)) / 2)
        self.density = ones / self._n_samples
        moving = self._enabled & (self.density > 0) & (self.density < 1)
        if not moving.any():
            return "constant bits" if self._enabled.any() else None
        # Not by BLAS, whose threads take longer to meet on busy cores than all of this takes.
        weights = (moving / moving.sum()).astype(np.float32)
        share = np.einsum("m,mn->n", weights, change)[1:-2]  # 1 where all bits change each time, -1 where none does
        power = np.einsum("m,mn->n", weights, np.square(mean, out=self._squares))[1:-2]
        if self._stops(share, moving):
            return "constant bits"
        if found := self._chance(mean[moving], power, -share - power):
            return found
        return "splice" if self._splices and self._splices.found(self._words, mean, moving) else None

    def _stops(self, share: Floats, moving: NDArray[np.bool_]) -> bool:
        """Whether there are long runs of equal words that begin and end among words like any others, or with the block.

        In overload, too, words may be equal, but modulators enter and leave it one after the other.
        """
        if _longest(share < -1 + 0.5 / (CHANNELS * MEAN_OF)) < _EQUAL_WORDS // MEAN_OF - 3:
            return False
        mask = np.sum(np.uint32(1) << np.flatnonzero(moving).astype(np.uint32), dtype=np.uint32)
        words = self._words[:, 0] & mask
        begins = np.flatnonzero(np.concatenate([[True], words[1:] != words[:-1], [True]]))
        for run in np.flatnonzero(np.diff(begins) >= _EQUAL_WORDS):
            first, stop = begins[run : run + 2]
            around = words[max(first - _AROUND, 0) : first], words[stop : stop + _AROUND]
            differ = (np.bitwise_count(side ^ words[first]).mean() / moving.sum() for side in around if len(side))
            if all(_AS_EVER[0] < share < _AS_EVER[1] for share in differ):
                return True
        return False

    def _chance(self, mean: Floats, power: Floats, product: Floats) -> str | None:
        """Return ``density`` or ``noise`` where bits are not those of modulators, all along or over a stretch.

        Parameters
        ----------
        mean : (channel, n) float32
            Of each 31 samples.
        power, product : (n,) float32
            Mean square of these means and the mean product of neighbours less that.
        """
        low, high = _POWER_RANGE
        usual, middle = np.quantile(product[:: _EVERY // 4], [0.25, 0.5])
        if usual > _UNSHAPED:
            if low < np.median(power[:: _EVERY // 4]) < high:
                return "noise"
            if _OFF[0] < np.median(np.abs(np.median(mean[:, ::_EVERY], axis=1))) < _OFF[1]:
                return "density"
        if not self._is_fast or middle > _SHAPED:
            return None
        is_white = (power > low) & (power < high) & (np.abs(product - _WHITE_PRODUCT) < _PRODUCT_REACH)
        return "noise" if _longest(is_white) >= _WHITE_MEANS else None


def _longest(flags: NDArray[np.bool_]) -> int:
    """Return the length of the longest run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return int(np.max(edges[1::2] - edges[::2], initial=0))
