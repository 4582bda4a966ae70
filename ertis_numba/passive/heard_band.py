"""Spectrum of the sound of a band, at the frequencies of its sources."""

import math
from typing import Final, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.passive.cross_spectrum import CrossSpectrum, FrequencyMoments
from ertis_numba.passive.likelihood import Delays

__all__ = ["HeardBand"]

Floats = NDArray[np.float64]

_LEAST: Final = 1e-30
_SINGULAR: Final = 1e-9  # Keeps the inverse of equal waves finite.
_ROUNDING: Final = 3e-7  # of powers in single precision
_SWEEPS: Final = 2  # Waves depend on the frequencies.
_OWN: Final = 0.75  # Largest distance of sound from the centre of its bin, in spacings of bins.
_CERTAIN: Final = 2.0  # Power of a source relative to its deviation in noise that shows frequencies.


class HeardBand(NamedTuple):
    """Spectrum of the sound of a band."""

    # The phases of a wave are those of the mean frequency of the sound. Bins with sound beyond the band are left out.

    matrix: NDArray[np.complex128]  # (bin, mic, mic) with a mean power of 1
    level: Floats  # (bin,) mean power
    shares: Floats  # (bin,) share in the band
    weights: Floats  # (bin,) the same with a sum of 1
    omega: Floats  # (bin,) mean angular frequencies outside of the sources
    omegas: Floats  # (bin, source) mean angular frequencies of each source
    width: Floats  # (bin,) standard deviations of the angular frequency
    n_blocks: int
    is_beyond: bool  # the mean frequency of the last source lies beyond the band

    @classmethod
    def of(cls, heard: CrossSpectrum, places: Floats, shares: Floats, delays: Delays) -> Self | None:
        """Return the band with sources in some directions, (source, axis); None if all its sound is that beyond it."""
        matrix = heard.matrix.astype(np.complex128)
        level = np.trace(matrix, axis1=1, axis2=2).real / matrix.shape[1]
        matrix /= level[:, None, None]
        heard_hz, width_hz = heard.frequency_hz, np.zeros(len(matrix))
        rest_hz, sources_hz = heard_hz, np.repeat(heard_hz[:, None], len(places), axis=1)
        middle_hz, reach_hz = _extent_hz(heard)
        is_beyond = False
        if heard.moments is not None:
            width_hz, delay_s = heard.moments.width_hz, delays(places)
            for sweep in range(_SWEEPS if len(places) else 1):
                frequencies = _Frequencies.of(heard.moments, matrix, level, delay_s, sources_hz)
                rest_hz = heard_hz + frequencies.rest_hz
                sources_hz = heard_hz[:, None] + frequencies.certain_hz(heard.n_blocks)
                if len(places) and not sweep:  # The direction was found with these frequencies.
                    is_beyond = abs(frequencies.mean_hz(shares * level, heard_hz - middle_hz)) > reach_hz
        last_hz = sources_hz[:, -1] if len(places) else rest_hz
        shares = np.where(np.abs(last_hz - middle_hz) <= reach_hz, shares, 0.0)
        if not shares.any():
            return None
        turn = 2 * np.pi
        # Bins with sound of other bins only are no further samples of it.
        is_own = np.abs(last_hz - heard_hz) <= _OWN * 2 * reach_hz / len(heard_hz)
        weights = np.where(is_own, shares, 0.0) if (is_own & (shares > 0)).any() else shares
        weights = weights / weights.sum()
        return cls(
            matrix,
            level,
            shares,
            weights,
            turn * rest_hz,
            turn * sources_hz,
            turn * width_hz,
            heard.n_blocks,
            is_beyond,
        )


class _Frequencies(NamedTuple):
    """Moments of the frequencies of sources relative to the bins, powers, noise: (bin, source); and the rest."""

    moments_hz: Floats
    powers: Floats
    noise: Floats
    rest_hz: Floats

    @classmethod
    def of(
        cls, moments: FrequencyMoments, matrix: NDArray[np.complex128], level: Floats, delay_s: Floats, place_hz: Floats
    ) -> Self:
        """Return the moments of sources by beams that do not hear each other."""
        channels, first = moments.channels, moments.first / level[:, None, None]
        matrix = matrix[:, channels[:, None], channels]
        rest, rest_moments_hz = (np.einsum("bmm->b", each).real for each in (matrix, 1j * first))
        n = len(channels) - len(delay_s)
        if not len(delay_s) or n < 1:
            none = np.zeros_like(place_hz)
            return cls(none, none, none, rest_moments_hz / rest)
        waves = np.exp(-2j * np.pi * place_hz[:, None] * delay_s.T[channels])
        products = waves.conj().transpose(0, 2, 1) @ waves
        inverse = np.linalg.inv(products + _SINGULAR * len(channels) * np.eye(len(delay_s)))
        beams = waves @ inverse
        heard, moved = matrix @ beams, 1j * first @ beams
        left = np.maximum(rest - (waves.conj() * heard).sum(axis=(1, 2)).real, _ROUNDING * rest)
        noise = left[:, None] / n * np.einsum("bss->bs", inverse).real
        powers = (beams.conj() * heard).sum(axis=1).real - noise
        rest_hz = (rest_moments_hz - (waves.conj() * moved).sum(axis=(1, 2)).real) / left
        return cls((beams.conj() * moved).sum(axis=1).real, powers, noise, rest_hz)

    def mean_hz(self, weights: Floats, frequency_hz: Floats) -> float:
        """Return the mean frequency of the last source over bins with their frequencies; 0 if it has no power."""
        power = float(weights @ self.powers[:, -1])
        total_hz = float(weights @ (self.powers[:, -1] * frequency_hz + self.moments_hz[:, -1]))
        return total_hz / power if power > 0 else 0.0

    def certain_hz(self, n_blocks: int) -> Floats:
        """Return the mean frequency of the source in each bin, or that of the bin if noise hides the source."""
        noise, powers = _CERTAIN / math.sqrt(n_blocks) * self.noise, np.maximum(self.powers, 0)
        return np.asarray(self.moments_hz * powers / np.maximum(powers**2 + noise**2, _LEAST))


def _extent_hz(heard: CrossSpectrum) -> tuple[float, float]:
    """Return the middle of the bins, and half of their extent."""
    first_hz, last_hz = float(heard.frequency_hz[0]), float(heard.frequency_hz[-1])
    spacing_hz = float(heard.frequency_hz[1]) - first_hz if len(heard.frequency_hz) > 1 else 0.0
    return (first_hz + last_hz) / 2, (last_hz - first_hz + spacing_hz) / 2
