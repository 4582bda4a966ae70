"""Central node that falls behind with reading on demand: ``python -m tests.faults.network.busy COMMAND …``.

SIGUSR1 blocks its event loop, as a slow disk or a long computation would. The threads of ZeroMQ continue.
"""

import runpy
import signal
import sys
import time
from types import FrameType
from typing import Final

__all__ = ["BUSY_ERTIS", "BUSY_S"]

BUSY_ERTIS: Final = (sys.executable, "-m", "tests.faults.network.busy")
"""Command that runs ``ertis`` so."""
BUSY_S: Final = 3.5
"""Blocking time per signal in seconds. A kill and two heartbeats of one second fit in."""


def _wait(_number: int, _frame: FrameType | None) -> None:
    time.sleep(BUSY_S)


def _main() -> None:
    sys.argv[:1] = ["ertis"]
    signal.signal(signal.SIGUSR1, _wait)
    runpy.run_module("ertis_cli", run_name="__main__")


if __name__ == "__main__":
    _main()
