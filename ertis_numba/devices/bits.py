"""Plausibility check of PDM data from 32 microphones, based on its bits alone.

The wire protocol has no checksum: if a block loses as many bytes as it gains, its header and footer still match. But
bits of a sigma-delta modulator are far from random. They change more often than random bits, their mean follows the
sound, and they never stop in all channels from one sample to the next. `splices` adds another check.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.devices.bit_means import MEAN_OF, BitMeans
from ertis_numba.devices.blocks import CHANNELS
from ertis_numba.devices.splice_detection import Splices

__all__ = ["BitCheck"]

Floats = NDArray[np.floating[Any]]

# Medians use every 32nd mean; those over channels use every eighth. Using all would take half a millisecond.
_EVERY = 32
# Of white bits the mean square of a mean of 31 is 1/31, and the mean product of neighbours less that square is:
_WHITE_PRODUCT = -1 / MEAN_OF
# Range of both by chance. Products of a real sensor are at most -0.30, or -0.19 in its direct sound, where the power
# is that of white bits; those of simulated sensors in loud noise, -0.17. In overload the power is higher.
_POWER_RANGE, _PRODUCT_REACH = (0.012, 0.06), 0.09
_UNSHAPED, _SHAPED = -0.1, -0.25
_OFF = (0.2, 0.5)  # Per channel, full scale 1; text has 0.3 to 0.4, and wind may shift products to -0.2.
# Number in a row; sounds have 3, and overload by frequencies above 100 kHz, which microphones cannot hear, 12.
_WHITE_MEANS = 16

# Half a period in overload lasts 112; a pulse of thirty times full scale that decays in 0.1 ms, 1530.
_EQUAL_WORDS = 4096
_AROUND = 8  # Samples before and after them.
_AS_EVER = (0.3, 0.7)  # Share of differing bits there; near overload, which comes and goes gradually, few differ.


class BitCheck:
    """Detector of blocks that microphones cannot have sent."""

    # `density` (channel,) is the share of ones in the last checked block. Splices are not found at 1.125 MHz.

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
        self._means = BitMeans(n_samples)
        self._is_fast = Splices.can_distinguish(pdm_rate_hz)
        self._splices = Splices(n_samples, pdm_rate_hz) if splices and self._is_fast else None

    def check(self, words: NDArray[np.uint32]) -> str | None:
        """Return the reason for rejecting a block of (sample,) words, whose bit m is channel m, or None.

        ``constant bits``: no channel changes, in the whole block or in a stretch with abrupt ends. ``density``: most
        channels have too many ones or zeros, and change unlike a modulator. ``noise``: the bits are random, in the
        whole block or in a stretch. ``splice``: words are missing or misplaced.
        """
        checks.shape("words", words.shape, (self._n_samples,))
        if words.dtype != np.uint32:
            raise ArgumentError(f"words are {words.dtype}; pass uint32")
        self._words[:, 0] = words  # This copy avoids another compilation of the kernels for read-only arrays.
        np.bitwise_xor(self._words[1:], self._words[:-1], out=self._changes[1:])
        mean, change = self._means(self._words[:, 0]), self._means(self._changes[:, 0])
        ones = np.rint((self._n_samples + MEAN_OF * mean.sum(axis=1, dtype=np.float64)) / 2)
        self.density = ones / self._n_samples
        moving = self._enabled & (self.density > 0) & (self.density < 1)
        if not moving.any():
            return "constant bits" if self._enabled.any() else None
        # BLAS is avoided: on busy cores, its threads take longer to synchronise than the whole computation.
        weights = (moving / moving.sum()).astype(np.float32)
        share = np.einsum("m,mn->n", weights, change)[1:-2]  # 1 if all bits change each time, -1 if none does.
        power = np.einsum("m,mn->n", weights, np.square(mean))[1:-2]
        if self._stops(share, moving):
            return "constant bits"
        if found := self._chance(mean[moving], power, -share - power):
            return found
        return "splice" if self._splices and self._splices.found(self._words, mean, moving) else None

    def _stops(self, share: Floats, moving: NDArray[np.bool_]) -> bool:
        """Return True if long runs of equal words begin and end among varying words, or with the block."""
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
        """Return ``density`` or ``noise`` if bits are not those of modulators, in the block or in a stretch."""
        # `mean` (channel, n) of 31 samples each; `power`, `product` (n,): mean square, and product of neighbours minus
        # it.
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
