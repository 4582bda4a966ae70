"""Exchange of commands and answers with a sensor that may still send other data."""

import errno
import logging
import time
from collections.abc import Callable, Sequence

from ertis_numba.base.errors import SonarError
from ertis_numba.devices.commands import Command, CustomCommand, decode_answer
from ertis_numba.devices.line import SerialLine, sonar_error
from ertis_numba.devices.setup import Setup, call_hash

__all__ = ["Dialogue"]

_ANSWER_BYTES = 4
_GROUP = 16  # Number of commands sent at once: their 250 bytes fit into the smallest buffer.
_QUIET_S = 0.1  # Time without a byte after which a sensor has finished its measurement.
_MAX_BYTES = 2**30

_log = logging.getLogger("ertis_numba")


class Dialogue(SerialLine):
    """Serial line with commands and answers, which differ from data only in that nothing follows them."""

    def __init__(self, path: str, *, timeout_s: float, stop: Callable[[], bool]) -> None:
        super().__init__(path, stop=stop)
        self.dropped = 0
        self._timeout_s = timeout_s

    def drain(self, *, within_s: float, repeat: Command | None = None) -> int:
        """Drop bytes until none arrive; return their number without the answers to ``repeat``."""
        count = n_answers = 0
        began = last = reported = time.monotonic()
        while True:
            data, arrived = self.receive(_MAX_BYTES)
            now = arrived.monotonic_ns / 1e9
            if data:
                count, last = count + len(data), now
            elif now - last >= _QUIET_S:
                count = max(0, count - _ANSWER_BYTES * n_answers)
                self.dropped += count
                return count
            if now - began > within_s:
                raise sonar_error(f"{self.path} keeps sending after a stop command; is it an eRTIS?", errno.ETIMEDOUT)
            if repeat is not None and now - reported > 2 * _QUIET_S:
                self.send(repeat.encode())
                reported, n_answers = now, n_answers + 1

    def quieten(self, command: Command, *, within_s: float) -> None:
        """Send the command that ends a stream, and drop all bytes that still arrive, including its answer."""
        before = self.dropped
        self.send(command.encode())
        count = self.drain(within_s=max(within_s, 4 * _QUIET_S), repeat=command)
        self.dropped = before + max(0, count - _ANSWER_BYTES)

    def ask(self, command: Command | CustomCommand, *, alone: bool = True) -> int:
        """Send a command and return its answer; alone is false where measurements may follow it."""
        # Earlier bytes are dropped. If more than an answer arrives, the command is sent again.
        deadline = time.monotonic() + self._timeout_s
        while True:
            if self.waiting:
                self.drain(within_s=self._timeout_s)
            self.send(command.encode())
            data = self._answers(1)
            if len(data) < _ANSWER_BYTES:
                raise self._no_answer(command, data)
            if not (alone and self.waiting):
                _log.debug("%s: %s: %d", self.path, command.about, decode_answer(data))
                return decode_answer(data)
            self.dropped += len(data)
            if time.monotonic() > deadline:
                raise sonar_error(
                    f"{self.path} answers {command.about!r} with more than a number, first {data!r}; is it an eRTIS?",
                    errno.ETIMEDOUT,
                )

    def ask_twice(self, command: Command) -> int:
        """Return an answer that arrived twice: four other bytes may look like an answer once, but not twice."""
        first, second = self.ask(command), self.ask(command)
        if first != second:
            raise sonar_error(
                f"{self.path} answers {command.about!r} with {first} and then with {second}; is it an eRTIS?",
                errno.ETIMEDOUT,
            )
        return first

    def ask_all(self, commands: Sequence[Command]) -> None:
        """Send many commands, a few at a time, and receive their answers."""
        for start in range(0, len(commands), _GROUP):
            group = commands[start : start + _GROUP]
            self.send(b"".join(command.encode() for command in group))
            n_answers, rest = divmod(len(data := self._answers(len(group))), _ANSWER_BYTES)
            if n_answers < len(group):
                raise self._no_answer(group[n_answers], data[len(data) - rest :])

    def notify(self, setup: Setup, *, counter: int) -> None:
        """Send the setup, including the call if the sensor has another one, and the number of the next measurement."""
        for command in setup.before_call():
            self.ask(command)
        wanted = call_hash(setup.codes)
        if self.ask(Command("L")) != wanted:
            self.ask_all(setup.call())
            held = self.ask(Command("L"))
            if held != wanted:
                raise SonarError(
                    f"{self.path} was sent a call with hash {wanted:#06x} but has one with {held:#06x}; unplug "
                    "it, plug it in again and retry (for an emulated one, 'ertis sensors emulate' prints the reason)"
                )
            _log.info("%s: a call of %d samples was sent", self.path, len(setup.codes))
        for command in (*setup.after_call(), Command("B", counter)):
            self.ask(command)

    def _answers(self, count: int) -> bytes:
        """Return the requested number of answers, or fewer after a timeout."""
        data = b""
        latest, is_late = time.monotonic(), False
        while len(data) < count * _ANSWER_BYTES and not is_late:
            is_late = time.monotonic() - latest > self._timeout_s  # Answers that arrived meanwhile are still read.
            piece, _ = self.receive(count * _ANSWER_BYTES - len(data))
            if piece:
                data, latest, is_late = data + piece, time.monotonic(), False
        return data

    def _no_answer(self, command: Command | CustomCommand, data: bytes) -> SonarError:
        instead = f", but sends {data!r}" if data else ""
        return sonar_error(
            f"{self.path} does not answer {command.about!r} within {self._timeout_s:g} s{instead}; is it an "
            "eRTIS, and is its power on?",
            errno.ETIMEDOUT,
        )
