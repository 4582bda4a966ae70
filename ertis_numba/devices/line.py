"""An open serial port: bytes with their times of arrival."""

import errno
import logging
import os
import select
import threading
import time
from collections.abc import Callable
from contextlib import suppress

import serial

from ertis_numba.base.errors import SonarDisconnectedError, SonarError
from ertis_numba.devices.blocks import Instant

try:
    import fcntl
    import termios

    _CANNOT_OPEN: tuple[type[Exception], ...] = (OSError, termios.error)
except ImportError:  # Not available outside POSIX.
    _CANNOT_OPEN = (OSError,)

__all__ = ["SerialLine", "closed_error", "sonar_error"]

_BAUD = 115_200  # USB ignores it.
_PIECE = 65_536  # Bytes.
# Limit on reads per piece: a system returns 4095 bytes at a time, and single bytes must not add up to seconds.
_CHUNKS = 16
_SLICE_S = 0.005  # Timeout of a read, and therefore the longest time that a byte waits unread.
_USB_FRAME_NS = 1_000_000  # Longest time that a device waits before the host polls it.
_WRITE_S = 1.0
_IN_USE = (errno.EBUSY, "is in use by another program; end that program")
_MISSING = (errno.ENOENT, "does not exist any more; plug the device in again")
_NOT_ALLOWED = (
    errno.EACCES,
    "requires permission; join its group ('sudo usermod -a -G dialout $USER') and log in again",
)
_OPEN_ERRORS = {
    errno.EBUSY: _IN_USE,
    errno.EAGAIN: _IN_USE,
    errno.EACCES: _NOT_ALLOWED,
    errno.EPERM: _NOT_ALLOWED,
    errno.ENOENT: _MISSING,
    errno.ENODEV: _MISSING,
    errno.ENXIO: _MISSING,
    errno.EIO: _MISSING,
}

_log = logging.getLogger("ertis_numba")


class SerialLine:
    """Serial port for exclusive use; other threads may call only `close`."""

    # Once `stop` returns True, reads and writes raise an error. Opening raises SonarError with its `errno`.

    def __init__(self, path: str, *, stop: Callable[[], bool]) -> None:
        self.path = path
        self.stop = stop
        self._lock = threading.Lock()
        self._port = _opened(path)
        self._buffer = memoryview(bytearray(_PIECE))
        self._empty_ns = time.monotonic_ns()  # Last time without waiting bytes.
        self._is_hung_up = False
        self._why_hung_up = ""

    @property
    def waiting(self) -> int:
        """Number of waiting bytes."""
        with self._lock:
            self._check()
            try:
                return self._port.in_waiting
            except OSError as error:
                raise self._gone() from error

    def receive(self, missing: int) -> tuple[bytes, Instant]:
        """Return bytes that arrive within some milliseconds, perhaps none, and the time of the first."""
        # `missing` is the number of bytes missing of a block or answer; 0 returns the first byte of a new one alone.
        with self._lock:
            self._check()
            try:
                wanted = min(missing or self._port.in_waiting, _PIECE)
                if not wanted:
                    wanted = 1
                    self._empty_ns = time.monotonic_ns()
                data = self._read(wanted)
                now_ns, realtime_ns = time.monotonic_ns(), time.time_ns()
                arrived = Instant(realtime_ns, now_ns, now_ns - self._empty_ns + _USB_FRAME_NS)
                if len(data) < wanted or not self._port.in_waiting:
                    self._empty_ns = now_ns
            except (OSError, EOFError) as error:
                raise self._gone() from error
        return data, arrived

    def send(self, data: bytes) -> None:
        """Write all data; raise SonarDisconnectedError, or SonarError if stopped, closed, or not read."""
        with self._lock:
            self._check()
            try:
                self._write(data)
            except serial.SerialTimeoutException:
                raise sonar_error(
                    f"{self.path} accepts no commands; unplug it and plug it in again", errno.ETIMEDOUT
                ) from None
            except OSError as error:
                raise self._gone() from error

    def close(self, last: bytes = b"") -> None:
        """Close the port, after sending some last bytes if possible."""
        with self._lock:
            try:
                if last and self._port.is_open:
                    self._write(last)
            except OSError as error:
                _log.debug("%s: %r was not sent: %s", self.path, last, error)
            finally:
                if os.name == "posix" and self._port.is_open:
                    # Children that were forked meanwhile keep their copy of the descriptor, and with it the lock.
                    with suppress(OSError):
                        fcntl.flock(self._port.fileno(), fcntl.LOCK_UN)
                self._port.close()

    def hang_up(self, why: str | None = None) -> None:
        """Close the port; later uses raise `SonarDisconnectedError` with why, or the message of an earlier call."""
        self._is_hung_up = True
        self._why_hung_up = self._why_hung_up if why is None else why
        self.close()

    def _read(self, size: int) -> bytes:
        """Return bytes that arrive without a pause; a file descriptor saves a sixth of pyserial's CPU time."""
        if os.name != "posix":
            return bytes(self._port.read(size))
        here, read = self._port.fileno(), 0
        for _ in range(_CHUNKS):
            if not _is_ready(here, to_write=False, within_s=_SLICE_S):
                break
            came = os.readv(here, [self._buffer[read:size]])
            if not came:
                raise EOFError
            read += came
            if read == size:
                break
        return bytes(self._buffer[:read])

    def _write(self, data: bytes) -> None:
        """Write all bytes with this module's own loop: pyserial's fails from the 1024th open file on."""
        if os.name != "posix":
            self._port.write(data)
            return
        here, rest, latest_s = self._port.fileno(), memoryview(data), time.monotonic() + _WRITE_S
        while rest:
            left_s = latest_s - time.monotonic()
            if left_s <= 0 or not _is_ready(here, to_write=True, within_s=left_s):
                raise serial.SerialTimeoutException
            with suppress(BlockingIOError):
                rest = rest[os.write(here, rest) :]

    def _check(self) -> None:
        if self.stop():
            raise closed_error(self.path)
        if self._is_hung_up:
            raise SonarDisconnectedError(self._why_hung_up) if self._why_hung_up else self._gone()
        if not self._port.is_open:
            raise closed_error(self.path)

    def _gone(self) -> SonarDisconnectedError:
        return SonarDisconnectedError(f"{self.path} was unplugged; plug it in again")


def sonar_error(text: str, code: int) -> SonarError:
    """Return an error whose ``errno`` states for programs the reason in its text."""
    error = SonarError(text)
    error.errno = code
    return error


def closed_error(path: str) -> SonarError:
    """Return the error for using a closed port."""
    return SonarError(f"{path} was closed; open it again")


def _is_ready(descriptor: int, *, to_write: bool, within_s: float) -> bool:
    """Return True if the descriptor is readable or writable, or has failed."""
    if hasattr(select, "poll"):
        poll = select.poll()
        poll.register(descriptor, select.POLLOUT if to_write else select.POLLIN)
        return bool(poll.poll(1000 * within_s))
    # select supports only the first 1024 descriptors.
    readers, writers = ([], [descriptor]) if to_write else ([descriptor], [])
    return any(select.select(readers, writers, [], within_s))


def _opened(path: str) -> serial.Serial:
    try:
        return serial.Serial(
            path, _BAUD, timeout=_SLICE_S, write_timeout=_WRITE_S, exclusive=True if os.name == "posix" else None
        )
    except _CANNOT_OPEN as error:
        unknown = (errno.EINVAL, f"is not a usable serial port ({error}); choose another one")
        code, text = _OPEN_ERRORS.get(getattr(error, "errno", None) or 0, unknown)
        raise sonar_error(f"{path} {text}", code) from error
