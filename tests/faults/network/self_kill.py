"""Node that kills itself before a line of its own code: ``python -m tests.faults.network.self_kill LINES MODULE …``.

A node spends most of its time inside few calls. A kill at a random time therefore rarely comes between two lines.
"""

import importlib
import os
import runpy
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, Final

import ertis_numba

__all__ = ["in_trap"]

_PACKAGE: Final = Path(ertis_numba.__file__).parent
_OURS: Final = tuple(str(_PACKAGE / name) for name in ("network", "journal", "base/atomic_files.py"))


def in_trap(max_lines: int | None, command: Sequence[str]) -> list[str]:
    """Return a command ``python -m MODULE …`` that kills itself after ``max_lines`` lines, unless it is None."""
    python, _, *rest = command
    return (
        list(command) if max_lines is None else [python, "-m", "tests.faults.network.self_kill", str(max_lines), *rest]
    )


def _set_trap(max_lines: int) -> None:
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
    max_lines, module = int(sys.argv[1]), sys.argv[2]
    sys.argv[:3] = [module]
    importlib.import_module(module)  # so that the lines of imports do not count
    del sys.modules[module]
    _set_trap(max_lines)
    runpy.run_module(module, run_name="__main__")


if __name__ == "__main__":
    _main()
