"""Child processes, each a new interpreter with a pipe: both ends of their start and of their end."""

import atexit
import gc
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from contextlib import nullcontext, suppress
from typing import Any, Final, Generic, TypeAlias, TypeVar

from ertis_numba.processes.pipe import Pipe

__all__ = ["Child", "connect", "is_child"]

Kind = TypeVar("Kind")
_Process: TypeAlias = "subprocess.Popen[bytes]"
_OPTION: Final = "--pipe="
_REAPED_S: Final = 5.0
_WATCH_INTERVAL_S: Final = 0.1

# By default, the GNU C library returns the memory of large blocks and requests it again, with a page fault for
# each 4 KiB: 3600 for an image of 14 MB, or 5 of its 12 ms. Keeping the memory leaves 100 page faults.
_KEEP_MEMORY: Final = {
    "MALLOC_MMAP_THRESHOLD_": str(32 * 2**20),
    "MALLOC_TRIM_THRESHOLD_": str(256 * 2**20),
    "MALLOC_ARENA_MAX": "1",
}


class Child(Generic[Kind]):
    """Python process that runs a module of this package, which calls `connect` and sends messages of ``kinds``."""

    # It is no fork, which OpenMP, HDF5 and ZeroMQ would not survive, and has a session of its own: Ctrl-C does not
    # reach it. `keep_stderr` keeps the last line of its stderr for `wait`.

    def __init__(
        self, module: str, kinds: Any, environment: Mapping[str, str] | None = None, *, keep_stderr: bool = False
    ) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            try:
                stderr = subprocess.PIPE if keep_stderr else None
                self._process = _started(module, theirs, {**_KEEP_MEMORY, **os.environ, **(environment or {})}, stderr)
            except BaseException:
                ours.close()
                raise
        self.pipe: Pipe[Kind] = Pipe(ours, kinds)
        self.pid = self._process.pid
        self._stderr: deque[str] = deque(maxlen=1)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        if keep_stderr:
            self._listener.start()

    def _listen(self) -> None:
        with self._process.stderr or nullcontext(()) as stream:
            lines = (line.decode(errors="backslashreplace").strip() for line in stream)
            self._stderr.extend(filter(None, lines))

    @property
    def ended(self) -> bool:
        """True if the process has ended, so that it cannot write to shared memory."""
        return self._process.poll() is not None

    def interrupt(self) -> None:
        """Interrupt the process, so that it ends cleanly if the system allows that."""
        self._process.send_signal(signal.SIGINT if os.name == "posix" else signal.SIGTERM)

    def kill(self) -> None:
        """Kill the process at once."""
        with suppress(OSError):
            self._process.kill()

    def wait(self) -> str:
        """Wait until the process is gone, and return how it ended, with the last line of a kept stderr."""
        code = self._process.wait()
        self.close()
        if self._process.stderr is None:
            return _exit_text(code)
        return f"{_exit_text(code)}, printing {repr(self._stderr[0]) if self._stderr else 'nothing'}"

    def close(self, timeout_s: float = 0.0) -> None:
        """Let the process end by itself, kill it after a timeout, and wait until it is gone."""
        self.pipe.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout_s)
        self.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_REAPED_S)
        if self._listener.is_alive():
            self._listener.join(_REAPED_S)


def _started(module: str, end: socket.socket, environment: dict[str, str], stderr: int | None) -> _Process:
    system: dict[str, Any]
    if sys.platform == "win32":  # It has process groups instead of sessions.
        system = {"stdin": subprocess.PIPE, "creationflags": subprocess.CREATE_NEW_PROCESS_GROUP}
    else:
        system = {"stdin": subprocess.DEVNULL, "pass_fds": [end.fileno()], "start_new_session": True}
    process: _Process = subprocess.Popen(  # noqa: S603  this very package
        # -P: Python must not import a file of the current folder in place of a standard module.
        [sys.executable, "-P", "-m", module, f"{_OPTION}{end.fileno()}"],
        stdout=subprocess.DEVNULL,
        stderr=stderr,
        env=environment,
        **system,
    )
    if sys.platform == "win32" and process.stdin is not None:
        with process.stdin as stdin:
            stdin.write(end.share(process.pid))
    return process


def _exit_text(code: int) -> str:
    if code < 0:
        with suppress(ValueError):
            return f"was ended by {signal.Signals(-code).name}"
    return f"ended with {code}"


def is_child() -> bool:
    """Return True in a process that `Child` has started."""
    return len(sys.argv) > 1 and sys.argv[1].startswith(_OPTION)


def connect(
    kinds: Any, *, outlives_parent: bool = False, on_parent_end: Callable[[], None] = lambda: None
) -> "Pipe[Any]":
    """Return the pipe to the parent process, in a process that `Child` has started."""
    # By default, this process ends with the parent, after `on_parent_end`, and ignores signals that ask it to end. With
    # `outlives_parent`, it continues.
    # Registered first, so it runs after all other exit handlers. Without it, Python's last garbage collection scans all
    # modules, which takes 0.1 to 0.3 s.
    atexit.register(gc.freeze)
    if sys.platform == "win32":
        end = socket.fromshare(sys.stdin.buffer.read())
    else:
        end = socket.socket(fileno=int(sys.argv[1].removeprefix(_OPTION)))
    if not outlives_parent:
        for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # The parent decides when this process ends.
            if hasattr(signal, name):
                signal.signal(getattr(signal, name), signal.SIG_IGN)
        threading.Thread(target=_end_with_parent, args=(end, on_parent_end), daemon=True).start()
    return Pipe(end, kinds)


def _end_with_parent(end: socket.socket, on_parent_end: Callable[[], None]) -> None:
    """End this process when the other end of a socket is closed."""
    while not _is_closed(end):
        time.sleep(_WATCH_INTERVAL_S)
    with suppress(Exception):
        on_parent_end()
    os._exit(0)


def _is_closed(end: socket.socket) -> bool:
    """Wait for an event of a socket, and return True if its other end is closed, even with unread messages."""
    if sys.platform == "win32":  # It has no poll, so that unread messages hide the end.
        try:
            select.select([end], [], [])
            return not end.recv(1, socket.MSG_PEEK)
        except OSError as error:
            return not isinstance(error, BlockingIOError)
    hung_up = select.POLLHUP | getattr(select, "POLLRDHUP", 0)
    poll = select.poll()
    poll.register(end, hung_up)
    return any(event & (hung_up | select.POLLERR) for _, event in poll.poll())
