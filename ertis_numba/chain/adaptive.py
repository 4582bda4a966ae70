"""Adaptive beamformers and weightings: all combinations that the registry declares except delay-and-sum alone."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.beamform import Buffers
from ertis_numba.kernels import KernelSet, Memory
from ertis_numba.settings import Processing
from ertis_numba.settings.beamformers import BEAMFORMERS, WEIGHTINGS

__all__ = ["AdaptiveBeamform"]

_NEGLIGIBLE = 0.01  # share of the budget


class AdaptiveBeamform:
    """Adaptive beamformer: amplitude of every direction and range; implements `Beamform`, and is thread-safe.

    ``offsets`` (direction, mic) index each microphone's first sample in a flattened (mic, phase, sample); ``weights``
    (direction, mic) are the phase of the carrier and the calibration. ``budget`` is the permitted error power; 0
    requires the highest precision.
    """

    def __init__(
        self,
        processing: Processing,
        kernels: KernelSet,
        memory: Memory,
        offsets: NDArray[np.int32],
        weights: NDArray[np.complex64],
        *,
        budget: float = 0.0,
    ) -> None:
        beamformer = BEAMFORMERS[processing.beamformer]
        self._options = beamformer.values(processing)
        n_mics = offsets.shape[1]
        beamformer.check(n_mics, *self._options)
        weighting = WEIGHTINGS[processing.weighting]
        self._combine: Any = getattr(kernels, beamformer.kernel) if beamformer.kernel else self._delay_and_sum
        self._weight = getattr(kernels, weighting.kernel) if weighting.kernel else None
        self._kernels = kernels
        self._offsets, self._plain = memory.table(offsets), memory.table(weights)
        single = beamformer.single_precision(n_mics, *self._options) <= _NEGLIGIBLE * budget
        scaled = beamformer.weights(weights, *self._options) if beamformer.kernel else weights
        self._weights = memory.table(scaled.astype(np.complex64 if single else np.complex128))

    def new_buffers(self) -> Buffers:
        """Return an empty tuple, since the kernels need no work arrays."""
        return ()

    def __call__(
        self,
        analytic: NDArray[np.complex64],
        buffers: Buffers,  # noqa: ARG002
        out: NDArray[np.float32],
    ) -> None:
        """Fill ``out``, (direction, range) float32, from ``analytic``, (mic, phase, sample) complex64."""
        self._combine(analytic, self._offsets, self._weights, *self._options, out)
        if self._weight is not None:
            self._weight(analytic, self._offsets, self._plain, out)

    def _delay_and_sum(
        self,
        analytic: NDArray[np.complex64],
        offsets: NDArray[np.int32],
        weights: NDArray[np.complex64],
        out: NDArray[np.float32],
    ) -> None:
        self._kernels.delay_and_sum_envelope(analytic, offsets, weights, 0, out.shape[1], out)
