"""Child processes of a central node, each with a pipe; they end with the central node, even if it is killed."""

import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from typing import Any, Final, Generic, TypeVar

from ertis_numba.network.processing.pipe import Pipe

__all__ = ["Child", "pipe_of_child"]

Kind = TypeVar("Kind")
_REAPED_S: Final = 5.0


class Child(Generic[Kind]):
    """Python process that runs a module of this package.

    It is a new interpreter rather than a fork, which OpenMP and ZeroMQ would not survive. Unlike a process of
    `multiprocessing`, it does not import the main program.

    Parameters
    ----------
    module : str
        Module to run; it begins with `pipe_of_child`.
    kinds : type
        Messages that it sends.
    arguments : sequence of str
        Arguments of the module; every user of the machine can read them.
    environment : dict, optional
        Variables in addition to those of this process.

    Attributes
    ----------
    pipe : Pipe
    pid : int
    """

    def __init__(
        self, module: str, kinds: Any, arguments: Sequence[str] = (), environment: Mapping[str, str] | None = None
    ) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            try:
                self._process = subprocess.Popen(  # noqa: S603  this very package
                    [sys.executable, "-P", "-m", module, str(theirs.fileno()), *arguments],
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    pass_fds=[theirs.fileno()],
                    env={**os.environ, **(environment or {})},
                    process_group=0,  # Ctrl-C in a terminal is meant for the central node.
                )
            except BaseException:
                ours.close()
                raise
        self.pipe: Pipe[Kind] = Pipe(ours, kinds)
        self.pid = self._process.pid

    def kill(self) -> None:
        """Kill the process at once."""
        with suppress(OSError):
            self._process.kill()

    @property
    def ended(self) -> bool:
        """True if the process is gone, and can write to no memory any more."""
        return self._process.poll() is not None

    def close(self, timeout_s: float = 0.0) -> None:
        """Let the process end by itself, kill it after a timeout, and wait until it is gone."""
        self.pipe.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout_s)
        self.kill()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(_REAPED_S)


def pipe_of_child(arguments: list[str], kinds: Any) -> "Pipe[Any]":
    """Return the pipe to the parent process; this process ends with the parent from now on.

    Parameters
    ----------
    arguments : list of str
        ``sys.argv``.
    kinds : type
        Messages that the parent sends.
    """
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # The parent decides when this process ends.
        signal.signal(getattr(signal, name), signal.SIG_IGN)
    end = socket.socket(fileno=int(arguments[1]))
    threading.Thread(target=_end_with, args=(end.fileno(),), daemon=True).start()
    return Pipe(end, kinds)


def _end_with(descriptor: int) -> None:
    """End this process when the other end of a socket is closed."""
    poll = select.poll()
    poll.register(descriptor, select.POLLHUP | getattr(select, "POLLRDHUP", 0))
    while not any(
        event & (select.POLLHUP | select.POLLERR | getattr(select, "POLLRDHUP", 0)) for _, event in poll.poll()
    ):
        time.sleep(0.1)
    os._exit(0)
