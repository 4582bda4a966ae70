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
    """Return the forward and inverse transforms for two arrays.

    Parameters
    ----------
    library : {"scipy", "cufft"}
        Library that computes the transforms.
    signals : (mic, n) float32
        Input of the forward transform.
    analytic : (mic, phase, n_out) complex64
        Input and output of the inverse transform.
    zeros : callable
        Returns a new array of zeros of a given shape and type on the device.
    stream : numba.cuda.Stream or None
        Stream of the GPU; None on the host.

    Returns
    -------
    Transforms

    Raises
    ------
    DeviceError
        The GPU has too little memory.
    """
    if library == "scipy":
        from ertis_numba.kernels.fft._scipy import ScipyTransforms  # noqa: PLC0415 - scipy.fft takes long to import

        return ScipyTransforms(signals, analytic)
    from ertis_numba.kernels.fft._cufft import CufftTransforms  # noqa: PLC0415 - CuPy is installed only with GPU support

    return CufftTransforms(signals, analytic, zeros=zeros, stream=stream)
