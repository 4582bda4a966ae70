"""Sum the delayed and weighted signals of all microphones for every direction and range."""

import numpy as np
from numba import cuda

from ertis_numba.kernels._cuda.beam_sums import BLOCK, beam_grid, complexes, fill_beams
from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._scalar import sample_of

__all__ = ["beams_from", "delay_and_sum"]


@cuda.jit(cache=True)
def _fill(signals, offsets, weights, n_terms, first, n_ranges, out):
    """Fill ``out``, (direction, range) uint64, whose first range is ``first``; beyond ``n_ranges`` it becomes 0."""
    fill_beams(sample_of, signals, offsets, weights, n_terms, first, 0, n_ranges, out.shape[1], out)


def beams_from(signals, offsets, weights, first, n_ranges, out):
    """Run `delay_and_sum` for ``n_ranges`` from ``first`` on; the rest of the tile in ``out`` becomes 0."""
    grid, tables = beam_grid(out.shape[0], n_ranges), (offsets.reshape(-1), complexes(weights))
    launch(_fill, grid, BLOCK, complexes(signals), *tables, offsets.shape[1], first, n_ranges, out)


def delay_and_sum(signals, offsets, weights, out):
    """Sum the delayed and weighted signals of all microphones for every direction and range."""
    beams_from(signals, offsets, weights, 0, out.shape[1], out.view(np.uint64))
