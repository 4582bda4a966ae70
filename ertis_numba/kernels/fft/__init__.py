"""Fourier transforms with one interface for all devices."""

from collections.abc import Callable
from typing import Any, Protocol

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ertis_numba.kernels.fft._scipy import ScipyTransforms

__all__ = ["Transforms", "plan"]


class Transforms(Protocol):
    """Transforms of two fixed arrays along the last axis, in single precision, not normalised in either direction."""

    def forward(self, *, threads: int) -> NDArray[np.complex64]:
        """Return the one-sided spectra of the real signals: (mic, n // 2 + 1) complex64."""
        ...

    def inverse(self, *, threads: int) -> None:
        """Transform the spectra in the array of analytic signals, (mic, phase, n), to signals in place."""
        ...


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
        return ScipyTransforms(signals, analytic)
    from ertis_numba.kernels.fft._cufft import CufftTransforms  # noqa: PLC0415 - CuPy is installed only with GPU support

    return CufftTransforms(signals, analytic, zeros=zeros, stream=stream)
