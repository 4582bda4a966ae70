"""Loading of compiled kernels from Numba's cache, in processes of their own."""

import subprocess
import sys

LOAD = """
import sys
import numba
import numpy as np
from ertis_numba import kernels

bits = np.zeros((1, 64), np.float32)
kernels.load("cpu").unpack_bits(np.full((64, 1), 5, np.uint32), np.array([2], np.int32), bits)
assert (bits == 1).all()
print("numba.np.arraymath" in sys.modules)

@numba.njit
def product(a):
    return np.dot(a, a)

assert product(np.ones(3)) == 3.0
"""


def test_cached_kernels_load_without_the_compiler_and_leave_it_usable():
    first, second = (
        subprocess.run([sys.executable, "-c", LOAD], check=True, capture_output=True, text=True).stdout
        for _ in range(2)
    )
    assert first in {"True\n", "False\n"}  # The first process compiles the kernel unless an earlier one has.
    assert second == "False\n"
