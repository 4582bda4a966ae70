"""Delay-and-sum beamforming with exact delays, which are phase shifts of spectra."""

from collections.abc import Iterable, Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.chain.beamform import Buffers
from ertis_numba.chain.matched_filter import MatchedFilter
from ertis_numba.chain.time_window import TimeWindow
from ertis_numba.kernels import KernelSet, Memory
from ertis_numba.kernels.fft import Transforms

__all__ = ["SHIFT_BYTES", "SHIFT_TABLE_BYTES", "PhaseShifts", "rows_at_a_time"]

SHIFT_BYTES: Final = 8
"""Bytes of the phase shift of a microphone for a direction and a focal zone."""
SHIFT_TABLE_BYTES: Final = 40
"""Bytes of a delay while the phase shifts of a focal zone are computed."""

_BEAMS_BYTES = 2**24  # Beams that are transformed at a time. Larger blocks are no faster.
_TURN = 2**32  # Phases are stored in fractions of a turn of this number.


def rows_at_a_time(n_directions: int, n_outputs: int) -> int:
    """Return the number of beams of ``n_outputs`` samples that are transformed at a time."""
    n_blocks = -(-n_directions * n_outputs * 8 // _BEAMS_BYTES)
    return -(-n_directions // max(1, n_blocks))


class PhaseShifts:
    """Delay-and-sum beamformer that delays spectra by phase shifts; the filter's gains include microphone weights."""

    # `zones`: ranges `first … stop - 1` and delays (direction, mic) in s; `shape`: beams (direction, 1, sample).

    def __init__(
        self,
        kernels: KernelSet,
        memory: Memory,
        window: TimeWindow,
        matched_filter: MatchedFilter,
        n_directions: int,
        zones: Iterable[tuple[int, int, NDArray[np.float64]]],
    ) -> None:
        self._kernels, self._memory, self._lead = kernels, memory, window.lead
        self._matched_filter = matched_filter
        self.shape = (rows_at_a_time(n_directions, window.n_outputs), 1, window.n_outputs)
        self._zones = [(first, stop, self._tables(delays_s)) for first, stop, delays_s in zones]

    def _tables(self, delays_s: NDArray[np.float64]) -> list[tuple[NDArray[np.uint32], NDArray[np.uint32]]]:
        """Return the phases at the first bin and their steps, for each block of directions."""
        frequency_hz = self._matched_filter.frequency_hz
        middle = len(frequency_hz) // 2
        spacing_hz = float(frequency_hz[1] - frequency_hz[0]) if len(frequency_hz) > 1 else 0.0
        steps = _phases(delays_s * spacing_hz)
        # Phases are exact in the middle of the band, so that the rounding of the steps matters least.
        starts = _phases(delays_s * frequency_hz[middle]) - np.uint32(middle) * steps
        table, block = self._memory.table, self.shape[0]
        return [
            (table(starts[first : first + block]), table(steps[first : first + block]))
            for first in range(0, len(delays_s), block)
        ]

    def new_buffers(self) -> Buffers:
        """Return the spectra of the microphones for one call at a time."""
        n_outputs = self.shape[2]
        n_folds = -(-len(self._matched_filter.frequency_hz) // n_outputs)
        return (self._memory.zeros((self._matched_filter.shape[0], 1, n_folds * n_outputs), np.complex64),)

    def __call__(
        self,
        transforms: Transforms,
        beams: NDArray[np.complex64],
        buffers: Buffers,
        out: NDArray[np.float32],
        *,
        threads: int,
    ) -> None:
        """Fill ``out`` (direction, range), with the work array ``beams`` of `shape` and buffers of `new_buffers`."""
        for part, (first, stop), rows in self._parts(transforms, beams, buffers, threads=threads):
            self._kernels.envelope_rows(part, self._lead, first, stop, out[rows])

    def fill_beams(
        self,
        transforms: Transforms,
        beams: NDArray[np.complex64],
        buffers: Buffers,
        out: NDArray[np.complex64],
        *,
        threads: int,
    ) -> None:
        """Fill ``out``, (direction, range) complex64, on a processor; other parameters as for `__call__`."""
        for part, (first, stop), rows in self._parts(transforms, beams, buffers, threads=threads):
            out[rows, first:stop] = part[:, 0, self._lead + first : self._lead + stop]

    def _parts(
        self, transforms: Transforms, beams: NDArray[np.complex64], buffers: Buffers, *, threads: int
    ) -> Iterator[tuple[NDArray[np.complex64], tuple[int, int], slice]]:
        """Yield the beams of each block of directions, with the ranges and the directions for which they are."""
        kernels, matched_filter = self._kernels, self._matched_filter
        (spectra,) = buffers
        matched_filter.fill_spectra(transforms, spectra, threads=threads)
        first_bin, n_bins = matched_filter.first_bin, len(matched_filter.frequency_hz)
        for first, stop, tables in self._zones:
            for block, (starts, steps) in enumerate(tables):
                begin = block * self.shape[0]
                kernels.sum_spectra(spectra, starts, steps, first_bin, n_bins, beams[: len(starts)])
                transforms.inverse(threads=threads)
                yield beams[: len(starts)], (first, stop), slice(begin, begin + len(starts))


def _phases(turns: NDArray[np.float64]) -> NDArray[np.uint32]:
    """Return numbers of turns in 2⁻³² of a turn, without whole turns."""
    return np.rint(_TURN * (turns - np.floor(turns))).astype(np.uint64).astype(np.uint32)
