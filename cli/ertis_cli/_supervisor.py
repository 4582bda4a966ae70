"""Supervisor that restarts the process of a central node after a signal has ended it.

A library that aborts ends its process. Acknowledged measurements are then in journals, and sensor nodes keep all
others. The next process recovers the journals and listens at the same address.
"""

import os
import signal
import sys
import time
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final, NamedTuple, NoReturn

import click

from ertis_cli._stop_signals import is_detached

__all__ = ["Life", "allow", "end_with", "supervised"]

RETRY_INTERVALS_S: Final = (0.0, 0.2, 0.5, 1.0, 2.0, 5.0)
"""Pause before each restart; the last is repeated."""
MAX_FAILED_STARTS: Final = 10
"""Limit on successive restarts that end before they listen; the command then fails."""
STABLE_S: Final = 60.0
"""Age of a process from which its end starts a new series of restarts."""

_STOPPING: Final = (signal.SIGINT, signal.SIGTERM, *([signal.SIGHUP] if hasattr(signal, "SIGHUP") else []))
_PR_SET_PDEATHSIG: Final = 1  # of prctl(2)
_SI_USER: Final = 0  # of sigaction(2): sent by kill to this process only, and not to its group

_allowed = False


class Life(NamedTuple):
    """One process of a central node."""

    restarts: int = 0  # processes before it
    reason: str = ""  # end of the process before it, such as SIGABRT
    addresses: Mapping[str, str] = MappingProxyType({})  # former ones: address for sensors, publish for applications
    elapsed_s: float = 0.0
    report_fd: int = -1  # descriptor to the supervisor; −1: none

    def note(self, event: dict[str, Any]) -> None:
        """Report to the supervisor that the central node listens."""
        import json

        if event["event"] == "listening" and self.report_fd >= 0:
            addresses = {name: event[name] for name in ("address", "publish") if name in event}
            os.write(self.report_fd, json.dumps(addresses).encode())

    def remaining_s(self, duration_s: float | None) -> float | None:
        """Return the remaining part of a duration."""
        return None if duration_s is None else max(1e-3, duration_s - self.elapsed_s)


def allow() -> None:
    """Allow commands to fork, because this process runs only the command line and has no threads."""
    global _allowed  # noqa: PLW0603  a property of the process
    _allowed = sys.platform == "linux"


def supervised() -> Life:
    """Return in a child process, once per start; the parent waits, and exits with the last child's code."""
    if not _allowed:
        return Life()
    supervisor = _Supervisor()
    while True:
        life = supervisor.start()
        if life is not None:
            return life
        supervisor.wait()


class _Supervisor:
    """Parent of the central node's process; forwards signals, and restarts the child or exits."""

    def __init__(self) -> None:
        self._waited_for = {each for each in (*_STOPPING, signal.SIGCHLD) if not is_detached(each)}
        self._mask_before = signal.pthread_sigmask(signal.SIG_BLOCK, self._waited_for)
        # An ignored signal would not be delivered to sigwaitinfo; a handler that never runs prevents that.
        self._handlers_before = {each: signal.signal(each, lambda *_: None) for each in self._waited_for}
        self._pid = self._reports = -1
        self._stopping = False
        self._before_fork: set[int] = set()
        self._restarts = self._in_a_row = self._failed_starts = 0
        self._reason = ""
        self._addresses: dict[str, str] = {}
        self._begun_s = self._started_s = time.monotonic()

    def start(self) -> Life | None:
        """Fork; return a life in the child, and None in the parent."""
        self._reports, report_fd = os.pipe()
        self._started_s = time.monotonic()
        sys.stdout.flush()
        sys.stderr.flush()
        self._before_fork = {int(each) for each in signal.sigpending()}
        parent, self._pid = os.getpid(), os.fork()
        if self._pid:
            os.close(report_fd)
            return None
        os.close(self._reports)
        end_with(parent, signal.SIGKILL)
        for each, handler in self._handlers_before.items():
            signal.signal(each, handler)
        signal.pthread_sigmask(signal.SIG_SETMASK, self._mask_before)
        if self._restarts:
            time.sleep(RETRY_INTERVALS_S[min(self._in_a_row, len(RETRY_INTERVALS_S)) - 1])
        return Life(self._restarts, self._reason, self._addresses, time.monotonic() - self._begun_s, report_fd)

    def wait(self) -> None:
        """Wait until the child has ended; return if it needs a restart, and otherwise exit with its code."""
        while True:
            came = signal.sigwaitinfo(self._waited_for)
            if came.si_signo in _STOPPING:
                self._stopping = True
                # A terminal sends its signals to the child as well, if there is one.
                if came.si_code <= _SI_USER or came.si_signo in self._before_fork:
                    os.kill(self._pid, came.si_signo)
                self._before_fork.discard(came.si_signo)
                continue
            pid, status = os.waitpid(self._pid, os.WNOHANG)
            if pid:
                self._judge(os.waitstatus_to_exitcode(status))
                return

    def _judge(self, code: int) -> None:
        """Return if a child that ended with this code needs a restart; exit otherwise."""
        import json

        report = os.read(self._reports, 4096)
        os.close(self._reports)
        listened = bool(report)
        if listened:
            self._addresses, self._failed_starts = json.loads(report), 0
        elif self._restarts:
            self._failed_starts += 1
        failed_restart = code > 0 and self._restarts > 0 and not listened
        if code >= 0 and not (failed_restart and not self._stopping):
            sys.exit(code)
        self._reason = signal.Signals(-code).name if code < 0 else f"exit code {code}"
        if self._stopping:
            _fail(f"{self._reason} ended the central node's process before it had stopped")
        if not self._addresses:
            _fail(f"{self._reason} ended the central node's process before it listened")
        if self._failed_starts >= MAX_FAILED_STARTS:
            _fail(f"the central node's process failed to start {self._failed_starts} times in a row ({self._reason})")
        stable = listened and time.monotonic() - self._started_s > STABLE_S
        self._in_a_row = 1 if stable else self._in_a_row + 1
        self._restarts += 1


def end_with(parent: int, number: signal.Signals) -> None:
    """Have Linux send this process a signal when its parent ends for any reason."""
    import ctypes

    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, number)
    if os.getppid() != parent:
        os._exit(1)


def _fail(text: str) -> NoReturn:
    remedy = "all acknowledged measurements are stored; run 'ertis import journals' to seal them into recordings"
    click.echo(f"ertis: error: {text}; {remedy}", err=True)
    sys.exit(1)
