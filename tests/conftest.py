"""Fixtures that apply to all tests."""

import gc
import logging
import os
import random
import signal
import threading
import types

import hypothesis
import numpy as np
import pytest
import threadpoolctl

# The load of a machine must not decide whether a law holds.
hypothesis.settings.register_profile("any_load", deadline=None, suppress_health_check=[hypothesis.HealthCheck.too_slow])
hypothesis.settings.load_profile("any_load")

# `nohup` and background jobs of scripts start this process with ignored signals, which its children would inherit.
# A handler replaces them: children start with the default then, and a hangup still ends no tests.
for _number, _handler in {
    signal.SIGINT: signal.default_int_handler,
    signal.SIGQUIT: signal.SIG_DFL,
    signal.SIGHUP: lambda *_: None,
}.items():
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection():
    """Exclude everything that lives until the end of the session from garbage collection.

    The modules and tests are a million objects. The collections that pass over all of them took 2 s while tests were
    collected, and 5 % of the processor time of the tests.
    """
    gc.disable()
    collected = yield
    gc.freeze()
    gc.enable()
    return collected


@pytest.fixture(scope="session", autouse=True)
def _one_blas_thread():
    """Limit BLAS to one thread in this process.

    The matrix products of the reference implementations are small, and BLAS threads spin while they wait. More
    threads took a third of the suite's processor time and saved nothing. Commands that tests start in their own
    processes keep the default number of threads.
    """
    import scipy.linalg  # noqa: F401, PLC0415 - it has a BLAS of its own, which can be limited once it is loaded

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


@pytest.fixture(scope="session", autouse=True)
def _simulated_gpu_threads_in_turn():
    """Run the threads of a simulated GPU block one after another, in an arbitrary order.

    The simulator starts a thread of Python for each of them, and polls them while they run: five times as long. Turns
    suffice because no kernel waits for other threads of its block. An arbitrary order shows dependences on the order.
    """
    if os.environ.get("NUMBA_ENABLE_CUDASIM") != "1":
        yield
        return
    from numba.cuda.simulator import kernel, kernelapi  # noqa: PLC0415 - only the simulator's process has them

    running = threading.local()
    order = random.Random(1)

    def run(block, place, *arguments):
        function, shape, debug = (vars(block)[name] for name in ("_f", "_block_dim", "_debug"))
        points = list(np.ndindex(*shape))
        order.shuffle(points)
        for point in points:
            thread = kernel.BlockThread(lambda: function(*arguments), block, place, point, debug)
            running.thread = thread
            thread.run()
            if thread.exception:
                error, traceback = thread.exception
                raise error.with_traceback(traceback)

    def wait(_):
        raise NotImplementedError("a kernel waits for other threads of its block; tests/conftest.py runs them in turn")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernelapi, "threading", types.SimpleNamespace(current_thread=lambda: running.thread))
        patch.setattr(kernel.BlockManager, "run", run)
        patch.setattr(kernel.BlockThread, "syncthreads", wait)
        yield


@pytest.fixture(scope="module")
def _driven_processing():
    """Run image processing for all tests of a module that need no other options: its processes start slowly."""
    from tests.driven import driven  # noqa: PLC0415 - only these tests need ZeroMQ

    with driven() as loop:
        yield loop


@pytest.fixture
def loop(_driven_processing):
    """Return a loop over image processing that other tests have used; use sensors with other names."""
    return _driven_processing.fresh()


@pytest.fixture
def sound_unchecked(monkeypatch):
    """Compare no sound with its settings: a third of the time of tests that make one image per pipeline or command.

    `tests/analysis` tests these comparisons.
    """
    from ertis_numba.analysis.call_match import CallMatch  # noqa: PLC0415 - other tests do not need it

    monkeypatch.setattr("ertis_numba.analysis.sound_checks.SoundChecks.check", lambda *_: [])
    agrees = "", "", CallMatch("matches"), None
    monkeypatch.setattr("ertis_numba.campaign.recording_job._check", lambda *_, **__: agrees)


@pytest.fixture(autouse=True)
def _log_as_before():
    """Restore the log's handlers, because commands that a test runs in this process replace them."""
    log = logging.getLogger("ertis.network")
    before = log.handlers[:], log.level, log.propagate
    yield
    log.handlers[:], log.level, log.propagate = before
