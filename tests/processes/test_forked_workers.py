"""Forked processes: kernels return the same results as in the parent; GPUs and connections are refused. None waits."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import ertis_numba as ertis
from ertis_numba.base.errors import NetworkError
from ertis_numba.network.pose_publisher import PosePublisher
from ertis_numba.network.pulse_receiver import PulseReceiver
from tests.forked_workers import WAYS

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="the system has no forks")
ROOT = Path(__file__).parents[2]
TIMEOUT_S = 300.0
NOWHERE = "tcp://127.0.0.1:1"
IN_CHILD = """
import os, sys
def in_child(function):
    process_id = os.fork()
    if not process_id:
        try:
            print(function(), flush=True)
        except Exception as error:
            print(f"{type(error).__name__}: {error}", flush=True)
        os._exit(0)
    status = os.waitpid(process_id, 0)[1]
    if status:
        print("status", status)
"""


def run(program, **environment):
    """Run a program in a new interpreter, and return what it prints; a hang is an error."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", IN_CHILD + program],
        cwd=ROOT,
        env=os.environ | environment,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


def test_workers_of_every_kind_return_what_their_parent_computes():
    found = run(f"sys.argv[1:] = {list(WAYS)}\nfrom tests import forked_workers\nforked_workers.main()")
    assert found.splitlines() == [f"{way}: 14 equal" for way in WAYS]


def test_fork_before_the_first_kernel_starts_threads_of_its_own():
    program = """
from tests.forked_workers import new_pipeline
from ertis_numba.kernels._cpu import after_fork
import numba
def work():
    new_pipeline()
    return after_fork._is_forked.value, numba.threading_layer()
in_child(work)
new_pipeline()
in_child(lambda: (new_pipeline().shape, after_fork._is_forked.value))
"""
    first, second = run(program).splitlines()
    assert first == "(0, 'omp')"
    assert second.endswith(", 1)")


def test_parallel_functions_of_the_program_do_not_prevent_forks():
    program = """
import numba, numpy as np
@numba.njit(parallel=True)
def double(values):
    for index in numba.prange(len(values)):
        values[index] *= 2
double(np.ones(4))
from tests.forked_workers import new_pipeline
wanted = new_pipeline()
in_child(lambda: bool((new_pipeline() == wanted).all()))
"""
    assert run(program) == "True\n"


def test_forks_while_other_threads_process_do_not_wait_for_their_locks():
    program = """
import threading
from tests.forked_workers import measurements, new_pipeline, pipeline
wanted = new_pipeline()
end = threading.Event()
def process():
    while not end.is_set():
        pipeline().process_batch(measurements())
        new_pipeline()
threads = [threading.Thread(target=process) for _ in range(2)]
for thread in threads:
    thread.start()
def work():
    images = pipeline().process_batch(measurements())
    pipeline().close()
    return bool((images[0].amplitude == wanted).all() and (new_pipeline() == wanted).all())
for _ in range(6):
    in_child(work)
end.set()
"""
    assert run(program).split() == ["True"] * 6


def test_gpu_of_the_parent_is_refused_in_a_fork():
    program = """
import ertis_numba as ertis
from ertis_numba import kernels
kernel_set = kernels.load("cuda")
in_child(kernel_set.memory)
in_child(kernel_set.threads(1).__enter__)
"""
    lines = run(program, NUMBA_ENABLE_CUDASIM="1").splitlines()
    assert len(lines) == 2
    for line in lines:
        assert line.startswith("DeviceError: device 'cuda' cannot be used in a process that was forked")
        assert "multiprocessing.get_context('spawn')" in line


UNTURNED = (0.0, 0.0, 0.0, 1.0)
OPENED = {
    "subscriber": (lambda: ertis.Subscriber(NOWHERE), lambda each: each.receive()),
    "receiver": (lambda: PulseReceiver(NOWHERE), lambda each: each.receive()),
    "client": (lambda: ertis.CentralClient(NOWHERE), lambda each: each.status()),
    "publisher": (lambda: PosePublisher(NOWHERE, ["front"]), lambda each: each.send(1, (0, 0, 0), UNTURNED)),
    "sensor node": (lambda: ertis.SensorNode(NOWHERE), lambda each: each.append([])),
}


@pytest.mark.filterwarnings("ignore:This process:DeprecationWarning")
@pytest.mark.parametrize("name", OPENED)
def test_connection_of_the_parent_is_refused_in_a_fork(name):
    make, use = OPENED[name]
    opened = make()
    close = getattr(opened, "__exit__", lambda *_: opened.close())
    getattr(opened, "__enter__", lambda: None)()
    process_id = os.fork()
    if not process_id:
        try:
            with pytest.raises(NetworkError, match=f"{name} was opened before the process forked.* in each worker"):
                use(opened)
            close(None, None, None)
            os._exit(0)
        finally:
            os._exit(1)
    try:
        assert os.waitpid(process_id, 0)[1] == 0
    finally:
        close(None, None, None)
