"""Fourier transforms with one interface for all devices."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ertis_numba.kernels.fft._protocol import Transforms

__all__ = ["Transforms", "plan"]


def plan(
    library: str,
    signals: NDArray[np.float32],
    analytic: NDArray[np.complex64],
    *,
    zeros: Callable[[tuple[int, ...], DTypeLike], NDArray[Any]],
    stream: Any,
) -> Transforms:
    """Return the transforms of ``signals`` (mic, n) and ``analytic`` (mic, phase, n_out) in memory of ``zeros``."""
    if library == "scipy":
        from ertis_numba.kernels.fft._scipy import ScipyTransforms  # noqa: PLC0415 - scipy.fft takes long to import

        return ScipyTransforms(signals, analytic)
    from ertis_numba.kernels.fft._cufft import CufftTransforms  # noqa: PLC0415 - CuPy is installed only with GPU support

    return CufftTransforms(signals, analytic, zeros=zeros, stream=stream)
