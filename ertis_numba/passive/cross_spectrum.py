"""Cross-spectral matrix of the microphones, averaged over blocks of samples."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ertis_numba import checks

__all__ = ["CrossSpectrum"]


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

    Raises
    ------
    ArgumentError
        The shapes do not agree.
    """

    matrix: NDArray[np.complex64]
    frequency_hz: NDArray[np.float64]
    n_blocks: int

    def __post_init__(self) -> None:
        n_mics = self.matrix.shape[-1]
        checks.shape("matrix", self.matrix.shape, (len(self.frequency_hz), n_mics, n_mics))
        checks.integer("n_blocks", self.n_blocks, 1)
