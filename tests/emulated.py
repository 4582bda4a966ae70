"""Commands to emulated devices, and parsers of their replies."""

import json
import queue
import sys

import numpy as np
import pytest
import serial

from ertis_numba.devices.blocks import FOOTER, HEADER
from ertis_numba.devices.emulator import SyncChain

N_SAMPLES = 32_768
WORDS = [np.random.default_rng(index).integers(0, 2**32, N_SAMPLES, dtype=np.uint32) for index in range(3)]
TIMEOUT_S = 60.0


class Log(queue.Queue):
    """A log with a method that waits for lines."""

    def write(self, text):
        self.put(json.loads(text))

    def flush(self):
        pass

    def lines(self, count):
        return [self.get(timeout=TIMEOUT_S) for _ in range(count)]


class Numbered:
    """Measurements whose samples all equal their number."""

    def __len__(self):
        return 1_000_000

    def __getitem__(self, index):
        return np.full(N_SAMPLES, index, np.uint32)


@pytest.fixture
def patient(monkeypatch):
    """Let drivers wait for measurements as long as a busy machine needs."""
    monkeypatch.setattr("ertis_numba.devices.driver._MARGIN_S", TIMEOUT_S)


PATIENT = pytest.mark.usefixtures("patient")
PATIENT_ERTIS = (
    sys.executable,
    "-c",
    f"from ertis_numba.devices import driver; driver._MARGIN_S = {TIMEOUT_S}; from ertis_cli.main import main; main()",
)
"""Command that runs ``ertis`` with such drivers in its own process."""


class PacedChain(SyncChain):
    """SYNC line whose pulses wait until the hosts have read all measurements, so that none is dropped.

    The first pulse waits until all devices are armed, so that their counters agree.
    """

    def _pulse(self, due_ns):
        while any(map(has_unread, self._devices)) or not (self.pulses or all(map(is_armed, self._devices))):
            if self._stopped.wait(0.001):
                return
        super()._pulse(due_ns)


def has_unread(device):
    """Return True while an emulated device records, or while the host has not read all bytes."""
    with device._changed:  # noqa: SLF001  hosts see bytes only
        board, terminal = device._board, device._terminal  # noqa: SLF001
        return terminal is not None and bool(board.due_ns is not None or board.outputs or terminal.unread)


def is_armed(device):
    return bool(device.registers.armed)


def opened(device):
    return serial.Serial(device.port, 115_200, timeout=TIMEOUT_S)


def ask(port, line):
    port.write(line)
    return int.from_bytes(port.read(4), "little")


def block(port, n_samples=N_SAMPLES):
    data = np.frombuffer(port.read(4 * n_samples + 12), "<u4")
    assert (data[0], data[-1], len(data)) == (HEADER, FOOTER, n_samples + 3)
    return int(data[1]), data[2:-1]


def is_block(came, counter, words):
    return came[0] == counter and np.array_equal(came[1], words)
