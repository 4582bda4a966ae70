"""Delays as the kernels take them: which samples each microphone adds to a beam, and their weights."""

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import ArgumentError
from ertis_numba.stages.fitting import DelayFit

__all__ = ["DelayTable", "Zone"]


@dataclass(frozen=True, slots=True, eq=False)
class DelayTable:
    """Which samples of which phases make up a beam's first range, and their weights.

    A term is one sample of one microphone; each microphone has as many as its delays are interpolated from.

    Attributes
    ----------
    rows, samples : (beam, term) int64
        Number of microphone and phase, counted phase by phase, and the sample in it.
    weights : (beam, term) complex128
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
        *,
        n_phases: int,
        lead: int,
    ) -> Self:
        """Return the table of ``delays_s``, (beam, mic).

        Parameters
        ----------
        delays_s : (beam, mic) float64
        amplitudes : (mic,) float64
            Weight of each microphone.
        fit : DelayFit
        n_phases : int
        lead : int
            Sample that lies at the first range.
        """
        n_beams, n_mics = delays_s.shape
        first, fractions = fit.split(delays_s)
        samples, phases = np.divmod(first[:, :, None] + np.arange(fit.n_taps), n_phases)
        rows = np.arange(n_mics)[:, None] * n_phases + phases
        weights = fit.weights(fractions) * amplitudes[:, None]
        flat = (n_beams, n_mics * fit.n_taps)
        return cls(rows.reshape(flat), samples.reshape(flat) + lead, weights.reshape(flat))

    def offsets(self, width: int) -> NDArray[np.int32]:
        """Return where the first sample lies in a flat array of (mic, phase, ``width``).

        Raises
        ------
        ArgumentError
            The array has too many samples to index.
        """
        if self.samples.min() < 0:
            raise ArgumentError("delays reach before the first sample; give a later processing.range_m")
        last = int(self.rows.max() + 1) * width
        if last > np.iinfo(np.int32).max:
            raise ArgumentError(
                f"{int(self.rows.max()) + 1} rows of {width} samples, microphones times phases, are too many to index; "
                "give a shorter range or less accuracy.oversampling"
            )
        return (self.rows * width + self.samples).astype(np.int32)


@dataclass(frozen=True, slots=True, eq=False)
class Zone:
    """A part of the range axis whose beams have the same delays.

    Attributes
    ----------
    first, stop : int
        Ranges.
    table : DelayTable
    """

    first: int
    stop: int
    table: DelayTable
