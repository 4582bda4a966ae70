"""Node that kills itself before a line of its own code: ``python -m ertis_bench.network.trap LINES COMMAND …``.

A node spends most of its time inside few calls. A kill at a random time therefore rarely comes between two lines.
"""

import os
import runpy
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any, Final

import ertis_numba

__all__ = ["set_trap"]

_PACKAGE: Final = Path(ertis_numba.__file__).parent
_OURS: Final = tuple(str(_PACKAGE / name) for name in ("network", "journal", "atomic.py"))


def set_trap(max_lines: int) -> None:
    """Kill this process after ``max_lines`` lines of nodes and journals.

    The count includes this thread and all later threads.
    """
    count = 0

    def line(_frame: FrameType, event: str, _argument: object) -> Callable[..., Any]:
        nonlocal count
        count += event == "line"
        if count > max_lines:
            os.kill(os.getpid(), signal.SIGKILL)
        return line

    def call(frame: FrameType, _event: str, _argument: object) -> Callable[..., Any] | None:
        return line if frame.f_code.co_filename.startswith(_OURS) else None

    threading.settrace(call)
    sys.settrace(call)


def _main() -> None:
    max_lines = int(sys.argv[1])
    sys.argv[:2] = ["ertis"]
    set_trap(max_lines)
    runpy.run_module("ertis_cli", run_name="__main__")


if __name__ == "__main__":
    _main()
