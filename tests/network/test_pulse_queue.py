"""Queue of pulses for a slow application."""

import pytest

from ertis_numba.network import pulse_queue
from ertis_numba.network.pulse_queue import MAX_KEPT_BYTES, PulseQueue


def test_slow_application_gets_the_latest_pulses():
    queue = PulseQueue()
    for number in range(5):
        queue.put(number, 1)
    assert [queue.take(0.0) for _ in range(3)] == [3, 4, None]
    assert queue.n_skipped == 3


def test_ended_queue_returns_the_pulses_that_wait():
    queue = PulseQueue()
    queue.put(1, 1)
    queue.end()
    assert (queue.take(), queue.take()) == (1, None)


def test_pulses_are_kept_within_the_limits_of_size_and_time(monkeypatch):
    now_s = 100.0
    monkeypatch.setattr(pulse_queue.time, "monotonic", lambda: now_s)
    queue = PulseQueue()
    with queue.keeping():
        for number in range(9):
            queue.put(number, MAX_KEPT_BYTES // 6)
        now_s += 2.0
    assert queue.n_skipped == 3
    now_s += 3.9
    assert queue.take() == 3
    queue.put(9, 1)
    assert queue.n_skipped == 3
    now_s += 0.2
    queue.put(10, 1)
    assert [queue.take(), queue.take(), queue.take(0.0), queue.n_skipped] == [9, 10, None, 8]


def test_application_that_has_caught_up_gets_the_latest_pulses():
    queue = PulseQueue()
    with queue.keeping():
        for number in range(4):
            queue.put(number, 1)
    assert [queue.take() for _ in range(4)] == [0, 1, 2, 3]
    for number in range(4, 8):
        queue.put(number, 1)
    assert [queue.take(), queue.take(), queue.n_skipped] == [6, 7, 2]


def test_failure_and_end_wake_the_application():
    queue = PulseQueue()
    queue.put(0, 1)
    queue.close()
    assert queue.take() is None
    queue.fail(OSError("gone"))
    with pytest.raises(OSError, match="gone"):
        queue.take()
