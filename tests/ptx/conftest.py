"""Fixtures that require the compilers and record all kernel launches."""

import os

import pytest

from ertis_numba.base.errors import DeviceError
from tests.ptx import launches, offline_compilation


@pytest.fixture(scope="session", autouse=True)
def _compilers():
    """Skip all tests without compilers, but fail in continuous integration."""
    try:
        offline_compilation.require_compilers()
    except DeviceError as error:
        if os.environ.get("CI") == "true":
            raise
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def launched():
    """Kernel launches by the name of the kernel in the contract."""
    return launches.by_contract()
