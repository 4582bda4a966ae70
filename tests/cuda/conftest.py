"""These tests run where there is a GPU, and everywhere else in a process of Numba's simulator."""

import pytest

from ertis_numba import kernels


@pytest.fixture(scope="session", autouse=True)
def _cuda():
    if "cuda" not in kernels.usable():
        pytest.skip("no GPU here, and NUMBA_ENABLE_CUDASIM=1 is not set; 'make test' runs these tests under it")
