"""What all tests run under."""

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
