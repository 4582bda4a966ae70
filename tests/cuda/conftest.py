"""Tests of the CUDA kernels, on a GPU or in a process that uses Numba's simulator."""

import pytest

from ertis_numba import kernels


@pytest.fixture(scope="session", autouse=True)
def _cuda():
    if "cuda" not in kernels.usable():
        pytest.skip("no GPU here, and NUMBA_ENABLE_CUDASIM=1 is not set; 'make test' runs these tests under it")
