"""SYNC line: pulses at a steady rate to emulated devices, one after the other."""

import threading
import time
from collections.abc import Callable, Sequence
from typing import Self

from ertis_numba.base import checks
from ertis_numba.base.constants import SYNC_STEP_S
from ertis_numba.devices.emulator.device import Emulator

__all__ = ["SyncChain"]

_SECOND_NS = 1_000_000_000


class SyncChain:
    """Trigger of emulated devices at a steady rate; use it in a ``with`` statement, or `start` it."""

    # Deadlines are absolute, and late pulses are skipped. The `SYNC_STEP_S` between devices is in timestamps only,
    # because samples from a scene contain it.

    def __init__(
        self, devices: Sequence[Emulator], rate_hz: float, *, before: Callable[[int], None] = lambda _: None
    ) -> None:
        self._devices, self._before = tuple(devices), before
        self._period_ns = _SECOND_NS / checks.between("rate_hz", rate_hz, 1e-3, 1e3)
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None
        self.pulses = 0

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Send the first pulse after one period; starting twice is harmless."""
        if self._thread is None:
            self._stopped.clear()
            self._thread = threading.Thread(target=self._run, name="SYNC chain", daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Send no more pulses."""
        self._stopped.set()
        if self._thread is not None:
            self._thread.join()
            self._thread = None

    def _run(self) -> None:
        began_ns = time.monotonic_ns()
        number = 1
        while True:
            due_ns = began_ns + round(number * self._period_ns)
            if self._stopped.wait(max(0.0, (due_ns - time.monotonic_ns()) / _SECOND_NS)):
                return
            self._before(self.pulses)
            late_ns = time.monotonic_ns() - due_ns
            if late_ns > self._period_ns:
                number += int(late_ns // self._period_ns)
                continue
            self._pulse(due_ns)
            late = int((time.monotonic_ns() - due_ns) // self._period_ns)
            number += 1 + late

    def _pulse(self, due_ns: int) -> None:
        steps_ns = (round(place * SYNC_STEP_S * _SECOND_NS) for place in range(len(self._devices)))
        taken = [
            device.trigger(self.pulses, at_ns=due_ns + step_ns)
            for device, step_ns in zip(self._devices, steps_ns, strict=True)
        ]
        self.pulses += any(taken)
