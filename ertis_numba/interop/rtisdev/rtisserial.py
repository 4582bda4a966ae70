"""Serial port of an eRTIS, with the functions of the closed module ``rtisserial``."""

import errno
import logging
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ertis_numba.base.errors import ArgumentError, SonarError
from ertis_numba.devices.commands import Command
from ertis_numba.devices.dialogue import Dialogue
from ertis_numba.devices.line import SerialLine
from ertis_numba.devices.ports import resolve
from ertis_numba.interop.rtisdev import arguments

__all__ = ["close", "command", "connect", "flush", "getdata"]

_ANSWER_BYTES: Final = 4
_ANSWER_S: Final = 2.0
_MEASUREMENT_S: Final = 5.0  # Longest time from a command to the first byte of a measurement.
_MIN_BYTES_S: Final = 2e5  # Slowest USB connection; an eRTIS sends 1e6 bytes per second.

_log = logging.getLogger("ertis_numba")
_line: SerialLine | None = None
_awaits_triggers = False  # after the command that switches external triggers on


def connect(port: str, baud: int) -> None:  # noqa: ARG001  USB ignores the rate
    """Open a serial port, or that of ERTIS_RTISDEV_PORT, and close the former; drop bytes for a former program."""
    # Raises ConnectionRefusedError if another program uses it, otherwise ConnectionError. USB has no `baud`.
    global _line  # noqa: PLW0603  one connection per process
    with _errors_translated():
        arguments.text("port", port)
    if _line is not None:
        close()
    name = os.environ.get("ERTIS_RTISDEV_PORT") or port
    try:
        _line = _quiet(resolve(name).path)
    except SonarError as error:
        _log.error("%s", error)
        kind = ConnectionRefusedError if error.errno == errno.EBUSY else ConnectionError
        raise kind(str(error)) from error


def _quiet(path: str) -> Dialogue:
    """Return the line to a sensor after it has ended the answers and measurements for a former program."""
    global _awaits_triggers  # noqa: PLW0603  one connection per process
    line = Dialogue(path, timeout_s=_ANSWER_S, stop=lambda: False)
    _awaits_triggers = False
    try:
        line.quieten(Command("J", 0, 1), within_s=_ANSWER_S)
        line.ask_twice(Command("Y"))
    except SonarError as error:
        # Opening succeeds as in the original; the next command fails if the sensor is still silent.
        _log.warning("%s", error)
    return line


def command(text: str, wants_answer: bool) -> int | None:  # noqa: FBT001  as the original has it
    """Send a line; return the number that answers it, or None if none is wanted.

    Raises ConnectionRefusedError without an open port, ConnectionError if unplugged, TimeoutError without an answer.
    """
    global _awaits_triggers  # noqa: PLW0603  one connection per process
    line = _connected()
    with _errors_translated():
        arguments.text("command", text)
    if text.startswith("!J,"):
        _awaits_triggers = text.startswith("!J,1")
    with _errors_translated():
        line.send(text.encode())
    if not wants_answer:
        return None
    return int.from_bytes(_received(line, _ANSWER_BYTES, within_s=_ANSWER_S, what=repr(text)), "little")


def getdata(n_bytes: int) -> NDArray[np.uint8]:
    """Return bytes (n_bytes,) as soon as they have arrived, without a limit of time while external triggers are on.

    Raises ConnectionRefusedError without an open port, ConnectionError if unplugged, TimeoutError without measurement.
    """
    with _errors_translated():
        n_bytes = arguments.whole("n_bytes", n_bytes, 0)
    within_s = None if _awaits_triggers else _MEASUREMENT_S + n_bytes / _MIN_BYTES_S
    return np.frombuffer(_received(_connected(), n_bytes, within_s=within_s, what="a measurement"), np.uint8)


def flush() -> None:
    """Drop received bytes; raise ConnectionRefusedError or ConnectionError as `command` does."""
    line = _connected()
    with _errors_translated():
        while waiting := line.waiting:
            line.receive(waiting)


def close() -> None:
    """Close the port; raise ConnectionRefusedError if none is open."""
    global _line  # noqa: PLW0603  one connection per process
    _connected().close()
    _line = None


def _connected() -> SerialLine:
    if _line is None:
        text = "no sensor is connected; call rtisdev.open_connection first"
        _log.error("%s", text)
        raise ConnectionRefusedError(text)
    return _line


def _received(line: SerialLine, n_bytes: int, *, within_s: float | None, what: str) -> bytes:
    """Return bytes; raise TimeoutError if they do not arrive in time."""
    data, latest_s = bytearray(), None if within_s is None else time.monotonic() + within_s
    with _errors_translated():
        while len(data) < n_bytes:
            data += line.receive(n_bytes - len(data))[0]
            if latest_s is not None and time.monotonic() > latest_s and len(data) < n_bytes:
                reported = f"{line.path} did not answer {what} within {within_s:.3g} s; is it an eRTIS?"
                _log.error("%s", reported)
                raise TimeoutError(reported)
    return bytes(data)


@contextmanager
def _errors_translated() -> Iterator[None]:
    """Log errors of arguments and of the line, and raise those of the line as the original does."""
    try:
        yield
    except ArgumentError as error:
        _log.error("%s", error)
        raise
    except SonarError as error:
        _log.error("%s", error)
        raise ConnectionError(str(error)) from error
