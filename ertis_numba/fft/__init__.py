"""Fourier transforms, behind one protocol."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ertis_numba.fft._protocol import Transforms
from ertis_numba.fft._scipy import ScipyTransforms

__all__ = ["Transforms", "plan"]


def plan(
    library: str,
    signals: NDArray[np.float32],
    analytic: NDArray[np.complex64],
    *,
    zeros: Callable[[tuple[int, ...], DTypeLike], NDArray[Any]],
    stream: Any,
) -> Transforms:
    """Return the transforms of two arrays.

    Parameters
    ----------
    library : {"scipy", "cufft"}
    signals : (mic, n) float32
        What the forward transform reads.
    analytic : (mic, phase, n_out) complex64
        What the inverse transform reads and writes.
    zeros, stream
        How to make arrays on a GPU, and where it runs.

    Raises
    ------
    DeviceError
        A GPU has too little memory.
    """
    if library == "scipy":
        return ScipyTransforms(signals, analytic)
    from ertis_numba.fft._cufft import CufftTransforms  # noqa: PLC0415 - CuPy is installed with a GPU only

    return CufftTransforms(signals, analytic, zeros=zeros, stream=stream)
