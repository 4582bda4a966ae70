"""Delay tables of the kernels: indices and weights of the samples that each microphone adds to a beam."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError
from ertis_numba.chain.interpolation_fit import DelayFit
from ertis_numba.kernels import SteeringKernels

__all__ = ["DelayTable", "Zone"]


@dataclass(frozen=True, slots=True, eq=False)
class DelayTable:
    """Samples that contribute to the first range of each beam, and their weights: (beam, term), one term per tap.

    ``rows`` are ``microphone · n_phases + phase``, and ``samples`` the index in that row.
    """

    rows: NDArray[np.int64]
    samples: NDArray[np.int64]
    weights: NDArray[np.complex128]

    @classmethod
    def of(
        cls,
        delays_s: NDArray[np.float64],
        amplitudes: NDArray[np.float64],
        fit: DelayFit,
        steering: SteeringKernels | None = None,
        *,
        n_phases: int,
        lead: int,
    ) -> Self:
        """Return the delay table of ``delays_s`` (beam, mic); ``lead`` is the sample at the first range.

        ``amplitudes`` are those of microphones, (mic,), or of terms, (beam, mic).
        """
        n_beams, n_mics = delays_s.shape
        first, fractions = fit.split(delays_s)
        samples, phases = np.divmod(first[:, :, None] + np.arange(fit.n_taps), n_phases)
        rows = np.arange(n_mics)[:, None] * n_phases + phases
        weights = fit.weights(fractions, steering) * amplitudes[..., None]
        flat = (n_beams, n_mics * fit.n_taps)
        return cls(rows.reshape(flat), samples.reshape(flat) + lead, weights.reshape(flat))

    def offsets(self, width: int) -> NDArray[np.int32]:
        """Return the indices of first samples in a flattened (mic, phase, ``width``); refuse negative and huge ones."""
        if self.samples.min() < 0:
            raise ArgumentError(
                "delays reach before the first sample of the record; start processing.range_m at a larger range"
            )
        last = int(self.rows.max() + 1) * width
        if last > np.iinfo(np.int32).max:
            raise ArgumentError(
                f"the signals have {int(self.rows.max()) + 1} rows (microphones times phases) of {width} samples, too "
                "many for 32-bit indices; use a shorter processing.range_m or a lower accuracy.oversampling"
            )
        return (self.rows * width + self.samples).astype(np.int32)


@dataclass(frozen=True, slots=True, eq=False)
class Zone:
    """Focal zone: ranges from index ``first`` up to, but without, ``stop`` that share one set of delays."""

    first: int
    stop: int
    table: DelayTable
