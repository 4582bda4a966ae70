"""Signals that ask a command to end: SIGINT (Ctrl-C), SIGTERM and SIGHUP."""

import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Final, NoReturn

__all__ = [
    "Interruption",
    "Signals",
    "broken_off_by_signals",
    "interrupt_later",
    "interruption",
    "is_detached",
    "obey_signals",
    "stopped_by_signals",
]

_SIGNALS: Final = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
_TWICE_S = 0.5  # between two signals of which the second is not an echo of the first
_RETRY_INTERVAL_S = 0.05
_ENDED = 128  # and the number of the signal


class Interruption:
    """Signal handler that ends the command as Ctrl-C does, and does so again where a library swallows that.

    Python raises in whatever runs when a signal comes. A callback of a library, a finaliser, or an ``except`` clause
    without a class may catch it and go on. So a thread looks whether the main thread still unwinds, and sends the
    signal again if not.
    """

    def __init__(self) -> None:
        self._errors: list[BaseException] = []
        self._over = threading.Event()

    def __call__(self, number: int, _: object) -> NoReturn:
        error = KeyboardInterrupt() if number == signal.SIGINT else SystemExit(_ENDED + number)
        self._errors.append(error)
        threading.Thread(target=self._insist, args=(error, number), name="ertis-signal", daemon=True).start()
        raise error

    @property
    def code(self) -> int | None:
        """Exit code of the first signal; None if no signal came."""
        if not self._errors:
            return None
        error = self._errors[0]
        return int(str(error.code)) if isinstance(error, SystemExit) else _ENDED + signal.SIGINT

    def end(self) -> None:
        """Send no signal again: the command has ended."""
        self._over.set()

    def caused(self, error: BaseException | None) -> bool:
        """Return whether an exception is due to a signal: it is the handler's own, or was raised while that unwound."""
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
        """Print exceptions that Python cannot raise, but for those of this handler."""
        if not self.caused(swallowed.exc_value):
            sys.__unraisablehook__(swallowed)

    def _insist(self, error: BaseException, number: int) -> None:
        """Send a signal again as soon as the main thread neither handles its exception nor has got a later one."""
        main = threading.main_thread().ident or 0
        while not self._over.wait(_RETRY_INTERVAL_S) and error is self._errors[-1]:
            handled: Any = sys._current_exceptions().get(main)  # noqa: SLF001  nothing else says what unwinds
            if isinstance(handled, tuple):  # until Python 3.11
                handled = handled[1]
            if self.caused(handled):  # clearing up takes as long as it takes
                continue
            if hasattr(signal, "pthread_kill"):
                signal.pthread_kill(main, number)
            else:
                signal.raise_signal(number)
            return


interruption: Final = Interruption()
"""Handler of the whole command."""


def obey_signals() -> None:
    """Let signals end the command like Ctrl-C, so that no half-written file is left behind.

    A signal that the process was started with ignoring, as by ``nohup``, stays ignored.
    """
    for number in _SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, interruption)
    sys.unraisablehook = interruption.hide_swallowed


class Signals:
    """What asked this program to end, and what is to be done about it.

    A signal never breaks into what runs: libraries that are being loaded would swallow it, or break over it. What was
    asked for is done by `obey`, or by what is to be called from then on.
    """

    def __init__(self) -> None:
        self.came: list[int] = []
        self._stop: Callable[[], None] | None = None
        self._first_s = math.inf

    def __call__(self, number: int, _: object) -> None:
        self.came.append(number)
        now_s = time.monotonic()
        if self._stop is None:
            return
        if now_s - self._first_s > _TWICE_S:  # who asks again means it
            self.end()
        self._first_s = min(self._first_s, now_s)
        self._stop()

    def obey(self, stop: Callable[[], None]) -> None:
        """End if that was asked for meanwhile; call ``stop`` where it is from now on.

        Raises
        ------
        KeyboardInterrupt, SystemExit
            It was.
        """
        self._stop = stop
        if self.came:
            self.end()

    def end(self) -> NoReturn:
        """End as the first signal asked."""
        if self.came[0] == signal.SIGINT:
            raise KeyboardInterrupt
        sys.exit(_ENDED + self.came[0])


@contextmanager
def stopped_by_signals() -> Iterator[Signals]:
    """Yield what remembers the signals that ask this program to end."""
    asked = Signals()
    with _handled_by(asked):
        yield asked


@contextmanager
def broken_off_by_signals() -> Iterator[None]:
    """Have signals that ask this program to end break into the block, so that it clears up.

    Also those that it was begun with ignoring, as a shell's script begins its background jobs.
    """
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
    """Return whether the process outlives its terminal, as ``nohup`` asks by ignoring SIGHUP."""
    return number == getattr(signal, "SIGHUP", None) and signal.getsignal(number) is signal.SIG_IGN


@contextmanager
def interrupt_later() -> Iterator[None]:
    """Keep Ctrl-C until the block ends: the compiler's callbacks would swallow it, or break over it."""
    came: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: came.append(number))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came:
        raise KeyboardInterrupt
