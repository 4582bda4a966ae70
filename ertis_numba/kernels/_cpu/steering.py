# mypy: ignore-errors
"""Tables for other directions: sums of Chebyshev polynomials."""

import numpy as np
from numba import njit, prange

from ertis_numba.kernels._contract.steering import SteeringKernels
from ertis_numba.kernels._cpu import threads

__all__ = ["KERNELS"]

_PLACES = 64  # Number of places in a block of one thread; the innermost loops run over them.


@njit(parallel=True, nogil=True, cache=True, error_model="numpy")
def sum_polynomials(places, coefficients, out):
    """Sum Chebyshev polynomials of two variables."""
    n_places, n_values = out.shape
    n_along, n_across, _ = coefficients.shape
    for block in prange((n_places + _PLACES - 1) // _PLACES):
        first = block * _PLACES
        n_here = min(_PLACES, n_places - first)
        along = _polynomials(places[first : first + n_here, 0], n_along)
        across = _polynomials(places[first : first + n_here, 1], n_across)
        sums = np.zeros((n_values, _PLACES))
        factor = np.empty(_PLACES)
        for i in range(n_along):
            for j in range(n_across):
                for p in range(_PLACES):
                    factor[p] = along[i, p] * across[j, p]
                for v in range(n_values):
                    coefficient = coefficients[i, j, v]
                    for p in range(_PLACES):
                        sums[v, p] += coefficient * factor[p]
        for p in range(n_here):
            for v in range(n_values):
                out[first + p, v] = sums[v, p]


@njit(nogil=True, cache=True, error_model="numpy")
def _polynomials(places, count):
    """Return the polynomials at some places: (degree, place), padded with zeros."""
    found = np.zeros((count, _PLACES))
    for p in range(len(places)):
        before, here = places[p], 1.0
        for k in range(count):
            found[k, p] = here
            before, here = here, 2.0 * places[p] * here - before
    return found


KERNELS = SteeringKernels(sum_polynomials=sum_polynomials, threads=threads)
