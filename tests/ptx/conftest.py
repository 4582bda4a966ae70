"""What these tests need, and what there is to compile."""

import os

import pytest

from ertis_numba.errors import DeviceError
from ertis_numba.kernels._cuda import compiling
from tests.ptx import launches


@pytest.fixture(scope="session", autouse=True)
def _compilers():
    """Where there are no compilers nothing is tested, except where all of it must be."""
    try:
        compiling.require_compilers()
    except DeviceError as error:
        if os.environ.get("CI") == "true":
            raise
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def launched():
    """All launches, by name of the kernel in the contract."""
    return launches.by_contract()
