"""Cross-spectral matrix of the microphones, averaged over blocks of samples."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks

__all__ = ["CrossSpectrum", "FrequencyMoments"]


class FrequencyMoments(NamedTuple):
    """Moments of the frequency of the sound within bins, at some microphones, ``channels``.

    For a wave v and ``first``, the matrix F (bin, n, n), ``-Im(v^H F v) / v^H C v`` is the mean frequency of its sound
    relative to the centre of the bin, in Hz. It lies outside of the bin if the sound is louder outside.
    """

    channels: NDArray[np.intp]
    first: NDArray[np.complex128]
    width_hz: NDArray[np.float64]  # (bin,) standard deviation of the frequency


@dataclass(frozen=True, slots=True, eq=False)
class CrossSpectrum:
    """Mean products of the spectra of each pair of microphones (P. D. Welch, 1967).

    The matrix (bin, mic, mic) is one-sided: element i, j is the mean of ``X_i · conj(X_j)``, and the diagonal is the
    mean square of each microphone within a bin. Calibrated gains are removed; calibrated delays are not.
    """

    matrix: NDArray[np.complex64]
    frequency_hz: NDArray[np.float64]  # (bin,) centres, with equal spacing
    n_blocks: int  # each shares half of its samples with the next
    moments: FrequencyMoments | None = None  # within the bins; unknown by default

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
