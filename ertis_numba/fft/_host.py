"""Transforms on the host, by SciPy's pocketfft."""

from typing import cast

import numpy as np
import scipy.fft
from numpy.typing import NDArray

__all__ = ["HostTransforms"]


class HostTransforms:
    """See `Transforms`."""

    def forward(self, signals: NDArray[np.float32], *, threads: int) -> NDArray[np.complex64]:
        """See `Transforms.forward`."""
        return cast("NDArray[np.complex64]", scipy.fft.rfft(signals, workers=threads))

    def inverse(self, spectra: NDArray[np.complex64], *, threads: int) -> None:
        """See `Transforms.inverse`."""
        result = scipy.fft.ifft(spectra, overwrite_x=True, workers=threads)
        if result is not spectra and not np.shares_memory(result, spectra):
            spectra[:] = result  # overwrite_x is a permission, not a promise
