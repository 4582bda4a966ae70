"""Fixtures that apply to all tests."""

import logging
import os

import numpy as np
import pytest
import threadpoolctl


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread():
    """Limit BLAS to one thread in this process.

    The matrix products of the reference implementations are small, and BLAS threads spin while they wait. More
    threads took a third of the suite's processor time and saved nothing. Commands that tests start in their own
    processes keep the default number of threads.
    """
    with threadpoolctl.threadpool_limits(1, user_api="blas"):
        yield


@pytest.fixture(scope="session", autouse=True)
def _garbage_in_new_arrays_of_the_gpu():
    """Fill new device arrays with garbage: a GPU leaves old memory in them, but the simulator fills them with 0."""
    if os.environ.get("NUMBA_ENABLE_CUDASIM") != "1":
        yield
        return
    from numba import cuda  # noqa: PLC0415 - only the simulator's process needs this slow import

    make = cuda.device_array

    def filled(*arguments, **options):
        array = make(*arguments, **options)
        np.asarray(array).reshape(-1).view(np.uint8)[:] = 0x7F
        return array

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cuda, "device_array", filled)
        yield


@pytest.fixture(autouse=True)
def _log_as_before():
    """Restore the log's handlers, because commands that a test runs in this process replace them."""
    log = logging.getLogger("ertis.network")
    before = log.handlers[:], log.level, log.propagate
    yield
    log.handlers[:], log.level, log.propagate = before
