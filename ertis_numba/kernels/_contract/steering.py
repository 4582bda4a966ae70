"""Contract of the kernel that computes tables for other directions."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels._device_protocols import Threads

__all__ = ["Doubles", "SteeringKernels"]

Doubles = NDArray[np.float64]


class SumPolynomials(Protocol):
    """Sum Chebyshev polynomials of two variables, ``Σ c[i, j] T_i(x) T_j(y)``.

    Parameters
    ----------
    places : (place, 2) float64
        Variables x and y, from −1 to 1.
    coefficients : (degree, degree, value) float64
        Coefficients of each value. With one degree along the second axis, the sum does not depend on y.
    out : (place, value) float64
    """

    def __call__(self, places: Doubles, coefficients: Doubles, out: Doubles) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringKernels:
    """Kernels that compute tables for other directions.

    Attributes
    ----------
    sum_polynomials : callable
        See `SumPolynomials`.
    threads : callable
        Context manager that limits the number of threads; see `Threads`. Kernels run within it.
    """

    sum_polynomials: SumPolynomials
    threads: Threads
