"""What all tests run under."""

import logging
import os

import numpy as np
import pytest
import threadpoolctl


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread():
    """Keep the referees' products to one thread: they are small, and threads of BLAS spin while they wait.

    That cost a third of the suite's processor time and saved nothing. Commands that tests start as processes of their
    own have the threads that everybody has.
    """
    with threadpoolctl.threadpool_limits(1, user_api="blas"):
        yield


@pytest.fixture(scope="session", autouse=True)
def _garbage_in_new_arrays_of_the_gpu():
    """Let new arrays hold what nobody would overlook: on a GPU they hold what was there before, in the simulator 0."""
    if os.environ.get("NUMBA_ENABLE_CUDASIM") != "1":
        yield
        return
    from numba import cuda  # noqa: PLC0415 - other processes do not load it

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
    """Leave the log as it was: commands that a test runs in this process show it their own way from then on."""
    log = logging.getLogger("ertis.network")
    before = log.handlers[:], log.level, log.propagate
    yield
    log.handlers[:], log.level, log.propagate = before
