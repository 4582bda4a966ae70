"""Transforms on the host, with SciPy's pocketfft."""

from typing import cast

import numpy as np
import scipy.fft
from numpy.typing import NDArray

__all__ = ["ScipyTransforms"]


class ScipyTransforms:
    """Transforms with SciPy, also of the simulated GPU, whose arrays are NumPy arrays underneath. See `Transforms`."""

    def __init__(self, signals: NDArray[np.float32], analytic: NDArray[np.complex64]) -> None:
        self._signals, self._analytic = np.asarray(signals), np.asarray(analytic)

    def forward(self, *, threads: int) -> NDArray[np.complex64]:
        """Return the one-sided spectra of the real signals: (mic, n // 2 + 1) complex64."""
        return cast("NDArray[np.complex64]", scipy.fft.rfft(self._signals, workers=threads))

    def inverse(self, *, threads: int) -> None:
        """Transform the spectra in the array of analytic signals, (mic, phase, n), to signals in place."""
        spectra = self._analytic
        result = scipy.fft.ifft(spectra, norm="forward", overwrite_x=True, workers=threads)
        if result is not spectra and not np.shares_memory(result, spectra):
            spectra[:] = result  # overwrite_x permits in-place work, but does not guarantee it
