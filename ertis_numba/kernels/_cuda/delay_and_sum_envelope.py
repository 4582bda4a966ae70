"""Delay-and-sum and envelope in one pass, with the sums in registers."""

from numba import cuda

from ertis_numba.kernels._cuda.beam_sums import BLOCK, beam_grid, complexes, fill_beams
from ertis_numba.kernels._cuda.lane import launch
from ertis_numba.kernels._scalar import magnitude

__all__ = ["delay_and_sum_envelope"]


@cuda.jit(cache=True)
def _fill(signals, offsets, weights, n_terms, first, stop, out):
    fill_beams(magnitude, signals, offsets, weights, n_terms, 0, first, stop, stop, out)


def delay_and_sum_envelope(signals, offsets, weights, first, stop, out):
    """`DelayAndSum` and `Envelope` in one pass over some ranges, without writing beams to memory."""
    grid, tables = beam_grid(out.shape[0], stop - first), (offsets.reshape(-1), complexes(weights))
    launch(_fill, grid, BLOCK, complexes(signals), *tables, offsets.shape[1], first, stop, out)
