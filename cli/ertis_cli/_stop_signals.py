"""Signals that ask a command to end: SIGINT (Ctrl-C), SIGTERM and SIGHUP."""

import atexit
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, Final, NoReturn

__all__ = [
    "Interruption",
    "Signals",
    "broken_off_by_signals",
    "interruption",
    "is_detached",
    "leave",
    "obey_signals",
    "stopped_by_signals",
]

_SIGNALS: Final = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
_TWICE_S = 0.5  # minimum interval; an earlier signal is a duplicate of the first
_RETRY_INTERVAL_S = 0.05
_ENDED = 128  # plus the number of the signal


class Interruption:
    """Signal handler that ends the command like Ctrl-C, and repeats the signal if a library swallows it.

    Python raises the exception in whatever code runs, where a callback, a finaliser or a bare ``except`` may catch it.
    A thread therefore sends the signal again until the main thread unwinds. It is delayed in Python's own code for
    imports, which would keep its locks.
    """

    def __init__(self) -> None:
        self.asked = False
        self._errors: list[BaseException] = []
        self._over = threading.Event()
        self._threads: list[threading.Thread] = []

    def __call__(self, number: int, frame: FrameType | None) -> None:
        if self._over.is_set():
            return
        self.asked = True
        error = KeyboardInterrupt() if number == signal.SIGINT else SystemExit(_ENDED + number)
        self._errors.append(error)
        thread = threading.Thread(target=self._insist, args=(error, number), name="ertis-signal", daemon=True)
        self._threads.append(thread)
        thread.start()
        if frame is None or not frame.f_code.co_filename.startswith("<frozen importlib"):
            raise error

    @property
    def code(self) -> int | None:
        """Exit code of the first signal; None if no signal came."""
        if not self._errors:
            return None
        error = self._errors[0]
        return int(str(error.code)) if isinstance(error, SystemExit) else _ENDED + signal.SIGINT

    def end(self) -> None:
        """Stop repeating signals; a later one ends the process, and no handler runs during finalisation."""
        self._over.set()
        for thread in self._threads:
            thread.join()
        self._threads.clear()
        for number in _SIGNALS:
            if signal.getsignal(number) is self:
                signal.signal(number, signal.SIG_DFL)

    def caused(self, error: BaseException | None) -> bool:
        """Return True if a signal caused an exception: the handler raised it, or its unwinding led to it."""
        pending, seen = [error], set[int]()
        while pending:
            each = pending.pop()
            if each is None or id(each) in seen:
                continue
            if any(each is own for own in self._errors):
                return True
            seen.add(id(each))
            pending += [each.__context__, each.__cause__]
        return False

    def hide_swallowed(self, swallowed: "sys.UnraisableHookArgs") -> None:
        """Print exceptions that Python cannot raise, except those of this handler."""
        if not self.caused(swallowed.exc_value):
            sys.__unraisablehook__(swallowed)

    def _insist(self, error: BaseException, number: int) -> None:
        """Repeat a signal once the main thread no longer handles its exception, unless a later signal has arrived."""
        main = threading.main_thread().ident or 0
        while not self._over.wait(_RETRY_INTERVAL_S) and error is self._errors[-1]:
            handled: Any = sys._current_exceptions().get(main)  # noqa: SLF001  no public function reports the exception
            if isinstance(handled, tuple):  # until Python 3.11
                handled = handled[1]
            if self.caused(handled):  # the clean-up has no time limit
                continue
            if hasattr(signal, "pthread_kill"):
                signal.pthread_kill(main, number)
            else:
                signal.raise_signal(number)
            return


interruption: Final = Interruption()
"""Handler of the whole command."""


def obey_signals() -> None:
    """Let signals end the command like Ctrl-C, unless ignored as by ``nohup``; no half-written file remains."""
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, interruption)
    sys.unraisablehook = interruption.hide_swallowed


def leave(code: int) -> NoReturn:
    """End the process like `sys.exit`, but without finalising the interpreter, as processes of multiprocessing do."""
    # Libraries that a signal has interrupted, in an import for example, may crash when they are finalised.
    try:
        threading._shutdown()  # type: ignore[attr-defined]  # noqa: SLF001
        atexit._run_exitfuncs()  # noqa: SLF001
        for stream in (sys.stdout, sys.stderr):
            with suppress(OSError, ValueError):
                stream.flush()
    finally:
        os._exit(code)


class Signals:
    """Signals that have arrived, and the function that stops the program, given to `obey` even afterwards."""

    # It never interrupts running code, because a library that is loading would swallow the exception or fail.

    def __init__(self) -> None:
        self.came: list[int] = []
        self._stop: Callable[[], None] | None = None
        self._first_s = math.inf

    def __call__(self, number: int, _: object) -> None:
        self.came.append(number)
        interruption.asked = True
        now_s = time.monotonic()
        if self._stop is None:
            return
        if now_s - self._first_s > _TWICE_S:  # a repeated request ends the program at once
            self.end()
        self._first_s = min(self._first_s, now_s)
        self._stop()

    def obey(self, stop: Callable[[], None]) -> None:
        """Raise KeyboardInterrupt or SystemExit if a signal has arrived; call ``stop`` at each later signal."""
        self._stop = stop
        if self.came:
            self.end()

    def end(self) -> NoReturn:
        """End the program with the exception of the first signal."""
        if self.came[0] == signal.SIGINT:
            raise KeyboardInterrupt
        sys.exit(_ENDED + self.came[0])


@contextmanager
def stopped_by_signals() -> Iterator[Signals]:
    """Yield an object that records the signals that ask this program to end."""
    asked = Signals()
    with _handled_by(asked):
        yield asked


@contextmanager
def broken_off_by_signals() -> Iterator[None]:
    """Let signals interrupt the block, so that it cleans up, even signals that shells ignore for background jobs."""
    with _handled_by(interruption):
        yield


@contextmanager
def _handled_by(handler: Callable[[int, Any], Any]) -> Iterator[None]:
    before = {number: signal.signal(number, handler) for number in _SIGNALS if not is_detached(number)}
    try:
        yield
    finally:
        for number, earlier in before.items():
            signal.signal(number, earlier)


def is_detached(number: int) -> bool:
    """Return True if the process outlives its terminal, because ``nohup`` has set SIGHUP to be ignored."""
    return number == getattr(signal, "SIGHUP", None) and signal.getsignal(number) is signal.SIG_IGN
