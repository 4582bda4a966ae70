"""Cross-spectral matrix of the microphones, averaged over blocks of samples."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks

__all__ = ["CrossSpectrum", "FrequencyMoments"]


class FrequencyMoments(NamedTuple):
    """Moments of the frequency of the sound within bins.

    Attributes
    ----------
    channels : (n,) intp
        Some of the microphones.
    first : (bin, n, n) complex128
        Matrix F of these channels. For a wave v, ``-Im(v^H F v) / v^H C v`` is the mean frequency of its sound relative
        to the centre of the bin, in hertz. It lies outside of the bin if the sound is louder outside.
    width_hz : (bin,) float64
        Standard deviation of the frequency.
    """

    channels: NDArray[np.intp]
    first: NDArray[np.complex128]
    width_hz: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class CrossSpectrum:
    """Mean products of the spectra of each pair of microphones (P. D. Welch, 1967).

    Attributes
    ----------
    matrix : (bin, mic, mic) complex64
        One-sided spectrum: element i, j is the mean of ``X_i · conj(X_j)``, and the diagonal is the mean square of each
        microphone within a bin. Calibrated gains are removed; calibrated delays are not.
    frequency_hz : (bin,) float64
        Centres of the bins in hertz, with equal spacing.
    n_blocks : int
        Number of blocks, of which each shares half of its samples with the next one.
    moments : FrequencyMoments, optional
        Frequencies within the bins; unknown by default.

    Raises
    ------
    ArgumentError
        The shapes do not agree.
    """

    matrix: NDArray[np.complex64]
    frequency_hz: NDArray[np.float64]
    n_blocks: int
    moments: FrequencyMoments | None = None

    def __post_init__(self) -> None:
        n_mics = self.matrix.shape[-1]
        checks.shape("matrix", self.matrix.shape, (len(self.frequency_hz), n_mics, n_mics))
        checks.integer("n_blocks", self.n_blocks, 1)

    def of_bins(self, bins: NDArray[np.intp]) -> "CrossSpectrum":
        """Return the spectrum of some bins."""
        moments = self.moments
        if moments is not None:
            moments = FrequencyMoments(moments.channels, moments.first[bins], moments.width_hz[bins])
        return CrossSpectrum(self.matrix[bins], self.frequency_hz[bins], self.n_blocks, moments)
