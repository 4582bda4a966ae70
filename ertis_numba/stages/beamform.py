"""From analytic signals to the envelopes of beams, by delay-and-sum."""

import math

import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import ArgumentError
from ertis_numba.geometry import Layout
from ertis_numba.kernels import KernelSet
from ertis_numba.settings import Settings
from ertis_numba.stages.window import TimeWindow

__all__ = ["Beamform"]


class Beamform:
    """Analytic signals to the energy of every direction and range.

    A delay is rounded to the nearest phase of the analytic signals; the carrier's phase over the
    remainder goes into the weight, so that only the envelope is off by it.
    """

    def __init__(
        self,
        settings: Settings,
        layout: Layout,
        window: TimeWindow,
        kernels: KernelSet,
        *,
        delays_s: NDArray[np.float64],
        centre_hz: float,
    ) -> None:
        n_mics = delays_s.shape[1]
        n_phases = settings.processing.oversampling
        if n_mics * n_phases * window.n_outputs > np.iinfo(np.int32).max:
            raise ArgumentError(
                f"{n_mics} microphones, {n_phases} phases and {window.n_outputs} samples are too many to index; "
                "give a shorter range or less oversampling"
            )
        fine_rate_hz = settings.output_rate_hz * n_phases
        steps = np.rint(delays_s * fine_rate_hz)
        remainder_s = delays_s - steps / fine_rate_hz
        samples, phases = np.divmod(steps.astype(np.int64), n_phases)
        rows = np.arange(n_mics) * n_phases + phases
        self._offsets = (rows * window.n_outputs + samples + window.lead).astype(np.int32)
        carrier = np.exp(2j * math.pi * centre_hz * remainder_s)
        self._weights = (carrier / (layout.gain[layout.enabled] * n_mics)).astype(np.complex64)
        self._kernel = kernels.delay_and_sum_envelope

    def __call__(self, analytic: NDArray[np.complex64], out: NDArray[np.float32]) -> None:
        """Fill ``out``, (direction, range) float32, from ``analytic``, (mic, phase, sample) complex64."""
        self._kernel(analytic, self._offsets, self._weights, out)
