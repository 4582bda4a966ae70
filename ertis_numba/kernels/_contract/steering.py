"""Contract of the kernel that computes tables for other directions."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.kernels._device_protocols import Threads

__all__ = ["Doubles", "SteeringKernels"]

Doubles = NDArray[np.float64]


class SumPolynomials(Protocol):
    """Sum Chebyshev polynomials ``Σ c[i, j] T_i(x) T_j(y)`` of (place, 2) from −1 to 1: (place, value).

    With one degree along the second axis of ``coefficients`` (degree, degree, value), the sum does not depend on y.
    """

    def __call__(self, places: Doubles, coefficients: Doubles, out: Doubles) -> None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class SteeringKernels:
    """Kernels that compute tables for other directions, within the context manager ``threads``."""

    sum_polynomials: SumPolynomials
    threads: Threads
