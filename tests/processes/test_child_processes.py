"""Pipes to child processes, and the supervision of a child."""

import os
import socket
import threading
import time
from pathlib import Path

import pytest

from ertis_numba.journal.storage_processes import FoundSessions, ReadSessions, StorageFailed
from ertis_numba.processes import Child, Pipe, SupervisedProcess

READER = "ertis_numba.storage.sessions_process"
KINDS = FoundSessions | StorageFailed
TIMEOUT_S = 60.0


@pytest.fixture
def pipes():
    pipes = [Pipe(end, ReadSessions) for end in socket.socketpair()]
    yield pipes
    for pipe in pipes:
        pipe.close()


def test_pipe_carries_file_names_that_are_not_text(pipes):
    request = ReadSessions([Path(os.fsdecode(b"/b\xff.h5"))])
    pipes[0].send(request)
    assert pipes[1].wait(TIMEOUT_S)
    assert pipes[1].receive() == [request]


def test_pipe_sends_large_messages_without_blocking(pipes):
    request = ReadSessions([Path("a" * 2**20)] * 8)
    pipes[0].send(request)
    assert pipes[0].waiting
    drains = threading.Thread(target=pipes[0].drain)
    drains.start()
    assert next(pipes[1].messages()) == request
    drains.join()
    assert not pipes[0].waiting


@pytest.mark.parametrize("data", [b"\x02\0\0\0\xc1\xc1", b"\xff\xff\xff\xff", b"\x01\0\0\0\x01"])
def test_invalid_message_closes_the_pipe(data):
    ours, theirs = socket.socketpair()
    pipe = Pipe(ours, ReadSessions)
    with theirs:
        theirs.send(data)
        assert list(pipe.messages()) == []
        assert pipe.closed
    pipe.close()


def test_child_answers_until_it_is_killed(tmp_path):
    child = Child(READER, KINDS, keep_stderr=True)
    for _ in range(2):
        child.pipe.send(ReadSessions([tmp_path / "none.h5"]))
        answer = next(child.pipe.messages())
        assert "none.h5" in answer.error
    child.kill()
    assert list(child.pipe.messages()) == []
    assert child.wait() == "was ended by SIGKILL, printing nothing"


def test_late_process_is_killed_and_replaced_after_growing_delays():
    process = SupervisedProcess(READER, KINDS, (0.0, 60.0))
    for after in ("due", "waiting"):
        assert process.check(time.monotonic()) == "due"
        process.start(0.0)
        assert process.check(time.monotonic() + 1.0) == "late"
        end_s = time.monotonic() + TIMEOUT_S
        while (state := process.check(time.monotonic())) == "running":
            assert time.monotonic() < end_s
        assert (state, process.receive(), process.fds) == ("ended", [], ())
        process.clear()
        assert (process.child, process.check(time.monotonic())) == (None, after)
    process.succeeded()
    assert process.restarts == 2
