"""Kernel of steering in plain NumPy: reference for the compiled one, and its substitute without a compiler."""

from numpy.polynomial import chebyshev

from ertis_numba.kernels._contract.steering import Doubles, SteeringKernels
from ertis_numba.kernels._numpy import threads

__all__ = ["KERNELS"]

_AT_A_TIME = 4096  # Number of places in a block.


def sum_polynomials(places: Doubles, coefficients: Doubles, out: Doubles) -> None:
    """Sum Chebyshev polynomials of two variables."""
    flat = coefficients.reshape(-1, coefficients.shape[2])
    for first in range(0, len(places), _AT_A_TIME):
        x, y = places[first : first + _AT_A_TIME].T
        along, across = (
            chebyshev.chebvander(each, count - 1) for each, count in zip((x, y), coefficients.shape[:2], strict=True)
        )
        out[first : first + _AT_A_TIME] = (along[:, :, None] * across[:, None, :]).reshape(len(x), -1) @ flat


KERNELS = SteeringKernels(sum_polynomials=sum_polynomials, threads=threads)
