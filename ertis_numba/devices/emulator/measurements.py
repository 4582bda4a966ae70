"""Output of an emulated device: its measurements with their faults, and their log."""

import json
import threading
import time
import zlib
from collections import deque
from collections.abc import Callable, Sequence, Sized
from dataclasses import dataclass, field
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.devices.blocks import encode_block
from ertis_numba.devices.emulator.faults import Faults, Stall, Unplug

__all__ = ["Measurements", "Output", "Pieces", "Words"]

Words = NDArray[np.uint32]
Pieces = deque[memoryview | Stall | Unplug]
"""Sequence of pieces and actions."""

_LOGGING = threading.Lock()  # Devices may share a log.


@dataclass(slots=True, eq=False)
class Output:
    """Output of a device; a measurement has an entry, which is its line in the log."""

    pieces: Pieces
    entry: dict[str, Any] = field(default_factory=dict)


class Measurements:
    """Measurements to send cyclically; for the arguments see `Emulator`."""

    def __init__(
        self,
        words: Sequence[Words],
        passive: Sequence[Words] | None,
        *,
        name: str,
        faults: Faults | None,
        log: TextIO | None,
        on_measurement: Callable[[int, bool], None] | None = None,
    ) -> None:
        self._words = {True: words, False: words if passive is None else passive}
        checks.instance("words", words, Sized, "has the words of each measurement")
        for given in self._words.values():
            checks.integer("number of measurements to emulate", len(given), 1)
            if given[0].dtype != np.uint32 or given[0].ndim != 1:
                raise ArgumentError(
                    f"measurements to emulate are {given[0].ndim}-dimensional {given[0].dtype}; use one uint32 word "
                    "per sample"
                )
        self._name, self._faults, self._log = name, faults, log
        self._on_measurement = on_measurement

    def output(self, index: int, counter: int, *, active: bool, n_samples: int) -> Output:
        """Return measurement ``index`` in the requested length, with a number."""
        given = self._words[active]
        index %= len(given)
        if self._on_measurement is not None:
            self._on_measurement(index, active)
        words = given[index]
        if len(words) != n_samples:
            words = np.resize(words, n_samples)  # Cuts, or repeats from the beginning.
        entry = {"name": self._name, "index": index, "counter": counter, "active": active, "fault": ""}
        if self._log is not None:
            entry["crc32"] = zlib.crc32(np.ascontiguousarray(words, dtype="<u4").data)
        block = encode_block(counter, words)
        if self._faults is None:
            return Output(deque([memoryview(block)]), entry)
        spoilt = self._faults.spoil(block)
        pieces = (memoryview(piece) if isinstance(piece, bytes) else piece for piece in spoilt.pieces)
        return Output(deque(pieces), entry | {"fault": spoilt.note})

    def notify(self, output: Output, fault: str = "") -> None:
        """Write the line of a measurement to the log, with further events."""
        if self._log is None or not output.entry:
            return
        faults = ", ".join(filter(None, (output.entry["fault"], fault)))
        _write(self._log, output.entry | {"fault": faults})

    def note(self, event: str) -> None:
        """Write a line about the device itself to the log."""
        if self._log is not None:
            _write(self._log, {"name": self._name, "event": event})


def _write(log: TextIO, entry: dict[str, Any]) -> None:
    with _LOGGING:
        log.write(json.dumps(entry | {"time_ns": time.time_ns()}) + "\n")
        log.flush()
