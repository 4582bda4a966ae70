"""Linear algebra of the matrices of many bins, on several threads."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

__all__ = ["in_parts"]

Number = TypeVar("Number", np.complex64, np.complex128)

_MIN_BINS: Final = 8  # Matrices of fewer bins take less time than the start of a thread.


def in_parts(function: Callable[..., NDArray[Number]], *of_bins: NDArray[Any], threads: int) -> NDArray[Number]:
    """Return the rows of a function of bins, called once per thread with a part of each array.

    NumPy computes linear algebra without holding the lock of the interpreter, so the parts run in parallel.
    """
    n_bins = len(of_bins[0])
    count = max(1, min(threads, n_bins // _MIN_BINS))
    if count == 1:
        return function(*of_bins)
    parts = [np.array_split(each, count) for each in of_bins]
    with ThreadPoolExecutor(count, thread_name_prefix="ertis-bins") as pool:
        return np.concatenate(list(pool.map(function, *parts)))
