"""Pulses to emulated devices arrive at a steady rate, at all devices, with equal numbers."""

import queue
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError
from ertis_numba.devices.emulator import Emulator, SyncChain
from tests.emulated import TIMEOUT_S, Numbered, ask, block, opened


class Listener:
    """Device of a chain that notes its pulses."""

    def __init__(self, *, takes):
        self.takes = takes
        self.came = queue.Queue()

    def trigger(self, pulse, *, at_ns):
        self.came.put((pulse, at_ns))
        return self.takes


def test_pulses_are_steady_and_pass_from_device_to_device():
    devices, pulses, periods = [Listener(takes=False), Listener(takes=True)], [], []
    with SyncChain(devices, 50.0):
        # A busy machine may miss most pulses, but never all.
        while len(pulses) < 10 or 1 not in periods:
            pulses.append([device.came.get(timeout=TIMEOUT_S) for device in devices])
            periods = np.diff([at_ns for (_, at_ns), _ in pulses]) / 20e6
    assert [number for (number, _), _ in pulses] == [number for _, (number, _) in pulses] == list(range(len(pulses)))
    assert {late - early for (_, early), (_, late) in pulses} == {400}
    assert np.all(periods == np.rint(periods))  # one that is missed is left out, and none is moved


def test_missed_pulses_are_skipped():
    class Slow(Listener):
        """Device that delays the chain at its first pulse by some periods."""

        def trigger(self, pulse, *, at_ns):
            if not pulse:
                threading.Event().wait((at_ns + 3.5e8 - time.monotonic_ns()) / 1e9)
            return super().trigger(pulse, at_ns=at_ns)

    device = Slow(takes=True)
    with SyncChain([device], 10.0):
        (_, first_ns), (pulse, second_ns) = (device.came.get(timeout=TIMEOUT_S) for _ in range(2))
    assert pulse == 1
    assert second_ns - first_ns >= 4e8
    assert (second_ns - first_ns) % 1e8 == 0


def test_pulse_numbers_start_at_the_first_pulse():
    device = Listener(takes=False)
    with SyncChain([device], 500.0) as chain:
        assert [device.came.get(timeout=TIMEOUT_S)[0] for _ in range(3)] == [0, 0, 0]
        device.takes = True
        pulses = [device.came.get(timeout=TIMEOUT_S)[0] for _ in range(20)]
        chain.start()  # it runs already
    assert pulses[-1] > 10
    assert set(np.diff(pulses)) == {0, 1} or set(np.diff(pulses)) == {1}


def test_invalid_pulse_rate_is_refused():
    with pytest.raises(ArgumentError, match=r"rate_hz is 0; use a number from 0\.001 to 1000"):
        SyncChain([], 0.0)


class ReadDevice:
    """Device of a chain that delays each pulse until the host has read the previous measurement."""

    def __init__(self, device):
        self._device = device
        self._is_free = threading.Semaphore()
        self.ended = False

    def trigger(self, pulse, *, at_ns):
        if self.ended:
            return False
        assert self._is_free.acquire(timeout=TIMEOUT_S)
        taken = self._device.trigger(pulse, at_ns=at_ns)
        if not taken:  # it is not armed
            self._is_free.release()
        return taken

    def release(self, *, ended):
        self.ended = ended
        self._is_free.release()


def test_four_devices_on_a_chain_measure_at_the_same_time():
    begun = [threading.Event() for _ in range(5)]
    begun[0].set()

    def listen(place, port):
        """Start sensors one after the other; later ones miss pulses."""
        assert begun[place].wait(TIMEOUT_S)
        ask(port, b"!J,1,1,0\n")
        for number in range(6):
            yield block(port)
            begun[place + 1].set()
            chained[place].release(ended=number == 5)

    with ExitStack() as stack:
        devices = [stack.enter_context(Emulator(Numbered())) for _ in range(4)]
        ports = [stack.enter_context(opened(device)) for device in devices]
        for place, port in enumerate(ports):
            ask(port, b"!G,131072,0,0\n")
            ask(port, b"!B,%d,0,0\n" % (100 * place))
        chained = [ReadDevice(device) for device in devices]
        stack.enter_context(SyncChain(chained, 50.0))
        hosts = stack.enter_context(ThreadPoolExecutor(4))
        came = list(hosts.map(lambda place, port: list(listen(place, port)), range(4), ports))
    assert [[counter for counter, _ in blocks] for blocks in came] == [
        list(range(100 * place, 100 * place + 6)) for place in range(4)
    ]
    assert all(np.all(words == words[0]) for blocks in came for _, words in blocks)
    pulses = [[int(words[0]) for _, words in blocks] for blocks in came]
    assert all(np.all(np.diff(row) == 1) for row in pulses)
    firsts = [row[0] for row in pulses]
    assert firsts[0] == 0
    assert firsts == sorted(set(firsts))  # each hears what the others hear then
