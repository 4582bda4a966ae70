"""Add delayed and filtered copies of a call's spectrum.

Eight bins are computed in parallel, and each advances by eight, which shortens the chain of multiplications.
"""

import math

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._scalar import between

__all__ = ["add_paths"]

_LANES = 8


@njit(parallel=True, nogil=True, cache=True)
def add_paths(call, turns, amplitude, first_bin, nodes_per_bin, out):
    """Add delayed and filtered copies of a call to the spectrum of each microphone."""
    n_bins = out.shape[1]
    n_nodes = amplitude.shape[2]
    for mic in prange(out.shape[0]):
        row = np.int64(mic) if call.shape[0] > 1 else np.int64(0)
        re = np.empty(_LANES)
        im = np.empty(_LANES)
        for path in range(turns.shape[0]):
            turn = turns[path, mic]
            jump = 2.0 * math.pi * ((turn * _LANES) % 1.0)
            jump_re, jump_im = math.cos(jump), -math.sin(jump)
            for lane in range(_LANES):
                angle = 2.0 * math.pi * ((turn * (first_bin + lane)) % 1.0)
                re[lane] = math.cos(angle)
                im[lane] = -math.sin(angle)
            for begin in range(0, n_bins, _LANES):
                for lane in range(min(_LANES, n_bins - begin)):
                    k = begin + lane
                    place = (first_bin + k) * nodes_per_bin
                    node = min(int(place), n_nodes - 1)
                    low, high = amplitude[path, mic, node], amplitude[path, mic, min(node + 1, n_nodes - 1)]
                    gain = between(low, high, place - node)
                    out[mic, k] += complex(gain * re[lane], gain * im[lane]) * call[row, k]
                for lane in range(_LANES):
                    turned = re[lane] * jump_re - im[lane] * jump_im
                    im[lane] = re[lane] * jump_im + im[lane] * jump_re
                    re[lane] = turned
