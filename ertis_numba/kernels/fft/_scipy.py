"""Transforms on the host, with SciPy's pocketfft."""

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import fourier

__all__ = ["ScipyTransforms"]


class ScipyTransforms:
    """Transforms with SciPy, also of the simulated GPU, whose arrays are NumPy arrays underneath. See `Transforms`."""

    def __init__(self, signals: NDArray[np.float32], analytic: NDArray[np.complex64]) -> None:
        self._signals, self._analytic = np.asarray(signals), np.asarray(analytic)

    def forward(self, *, threads: int) -> NDArray[np.complex64]:
        """Return the one-sided spectra of the real signals: (mic, n // 2 + 1) complex64."""
        return fourier.rfft(self._signals, workers=threads)

    def inverse(self, *, threads: int) -> None:
        """Transform the spectra in the array of analytic signals, (mic, phase, n), to signals in place."""
        spectra = self._analytic
        result = fourier.ifft(spectra, normalised=False, overwrite=True, workers=threads)
        if result is not spectra and not np.shares_memory(result, spectra):
            spectra[:] = result  # permitted, but not guaranteed, to be in place
