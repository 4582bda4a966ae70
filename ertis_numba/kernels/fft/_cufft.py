"""Transforms of Numba's arrays on an NVIDIA GPU, with cuFFT through CuPy."""

from collections.abc import Callable
from typing import Any

import cupy
import numpy as np
from cupy.cuda import cufft
from numpy.typing import DTypeLike, NDArray

from ertis_numba.base.errors import DeviceError

__all__ = ["CufftTransforms"]


class CufftTransforms:
    """Transforms with cuFFT, with plans, work areas and views created once, and no copies. See `Transforms`."""

    def __init__(
        self,
        signals: NDArray[np.float32],
        analytic: NDArray[np.complex64],
        *,
        zeros: Callable[[tuple[int, ...], DTypeLike], NDArray[Any]],
        stream: Any,
    ) -> None:
        n_mics, n = signals.shape
        n_rows, n_out = analytic.shape[0] * analytic.shape[1], analytic.shape[2]
        self._spectra = zeros((n_mics, n // 2 + 1), np.complex64)
        self._stream = cupy.cuda.Stream.from_external(stream)
        # CuPy's views keep Numba's arrays alive, and cuFFT's plans accept no other arrays.
        self._real, self._bins, self._both = (cupy.asarray(array) for array in (signals, self._spectra, analytic))
        try:
            # CuPy's memory pool is bypassed, because it would keep the work areas after the plans are deleted.
            with self._stream, cupy.cuda.using_allocator(None):
                self._forward = cufft.Plan1d(n, cufft.CUFFT_R2C, n_mics)
                self._inverse = cufft.Plan1d(n_out, cufft.CUFFT_C2C, n_rows)
        except (cupy.cuda.memory.OutOfMemoryError, cupy.cuda.runtime.CUDARuntimeError, cufft.CuFFTError) as error:
            raise DeviceError(
                f"device 'cuda' has too little memory for transforms of {n_rows} rows of {n_out} samples "
                f"({error}); use a shorter processing.range_m or a lower accuracy.oversampling, or use device 'cpu'"
            ) from error

    def forward(self, *, threads: int) -> NDArray[np.complex64]:  # noqa: ARG002
        """Return the one-sided spectra of the real signals: (mic, n // 2 + 1) complex64."""
        with self._stream:
            self._forward.fft(self._real, self._bins, cufft.CUFFT_FORWARD)
        return self._spectra

    def inverse(self, *, threads: int) -> None:  # noqa: ARG002
        """Transform the spectra in the array of analytic signals, (mic, phase, n), to signals in place."""
        with self._stream:
            self._inverse.fft(self._both, self._both, cufft.CUFFT_INVERSE)
