"""Adaptive beamformers: coherence factor, DMAS and Capon."""

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import ArgumentError
from ertis_numba.kernels import KernelSet, Memory
from ertis_numba.settings import Processing

__all__ = ["AdaptiveBeamform", "require_order"]

_Combine = Callable[[NDArray[np.complex64], NDArray[np.float32]], None]


class AdaptiveBeamform:
    """Adaptive beamformer: amplitude of every direction and range by coherence factor, DMAS or Capon.

    An echo that reaches all microphones alike has the same level as with delay-and-sum. `kernels` defines the
    computation of each beamformer. The object holds no buffers, so several threads may call it at the same time.

    Parameters
    ----------
    processing : Processing
        Settings with a ``beamformer`` other than ``delay_and_sum``.
    kernels : KernelSet
    memory : Memory
    offsets : (direction, mic) int32
        Index of each microphone's first sample in a flattened array of (mic, phase, sample).
    weights : (direction, mic) complex64
        Phase of the carrier and calibration; the magnitudes of a direction add up to about 1.

    Raises
    ------
    ArgumentError
        ``dmas_order`` exceeds the number of microphones.
    """

    def __init__(
        self,
        processing: Processing,
        kernels: KernelSet,
        memory: Memory,
        offsets: NDArray[np.int32],
        weights: NDArray[np.complex64],
    ) -> None:
        n_mics = offsets.shape[1]
        places = memory.table(offsets)
        combine: dict[str, Callable[[], _Combine]] = {
            "coherence_factor": lambda: _coherence_factor(kernels, places, memory.table(weights)),
            "dmas": lambda: _dmas(
                kernels, places, memory.table(_roots(n_mics * weights, processing.dmas_order)), processing.dmas_order
            ),
            "capon": lambda: _capon(kernels, places, memory.table(n_mics * weights), processing),
        }
        self._combine = combine[processing.beamformer]()

    def __call__(self, analytic: NDArray[np.complex64], out: NDArray[np.float32]) -> None:
        """Fill ``out``, (direction, range) float32, from ``analytic``, (mic, phase, sample) complex64."""
        self._combine(analytic, out)


def _coherence_factor(kernels: KernelSet, offsets: NDArray[np.int32], weights: NDArray[np.complex64]) -> _Combine:
    return lambda analytic, out: kernels.combine_coherence(analytic, offsets, weights, out)


def _dmas(kernels: KernelSet, offsets: NDArray[np.int32], roots: NDArray[np.complex64], order: int) -> _Combine:
    return lambda analytic, out: kernels.combine_dmas(analytic, offsets, roots, order, out)


def require_order(order: int, n_mics: int) -> None:
    """Check that the order of DMAS does not exceed the number of microphones.

    Raises
    ------
    ArgumentError
        The order exceeds the number of microphones.
    """
    if n_mics < order:
        raise ArgumentError(
            f"processing.dmas_order is {order}, but the array has {n_mics} microphone{'s' * (n_mics != 1)}; "
            "the order must not exceed the number of microphones. Give a lower order or another processing.beamformer"
        )


def _roots(weights: NDArray[np.complex64], order: int) -> NDArray[np.complex64]:
    """Return the weights of DMAS: roots of the weights, divided by a root of the number of products in the sum."""
    n_mics = weights.shape[1]
    require_order(order, n_mics)
    exact = weights.astype(np.complex128)
    level = np.abs(exact)
    shrunk = np.power(level, 1 / order - 1, out=np.zeros_like(level), where=level != 0)
    # Every product has ``order`` factors, and each factor carries that root of the divisor. No sum overflows float32.
    roots = exact * shrunk * math.comb(n_mics, order) ** (-1 / order)
    return np.asarray(roots, dtype=np.complex64)


def _capon(
    kernels: KernelSet, offsets: NDArray[np.int32], weights: NDArray[np.complex64], processing: Processing
) -> _Combine:
    snapshots, loading = processing.snapshots, processing.diagonal_loading
    return lambda analytic, out: kernels.combine_capon(analytic, offsets, weights, snapshots, loading, out)
