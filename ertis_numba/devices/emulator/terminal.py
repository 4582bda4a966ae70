"""Pseudo terminal of an emulated device, and its input."""

import array
import os
import re
from contextlib import suppress

with suppress(ImportError):  # Not available outside POSIX: see `links.require_terminals`.
    import fcntl
    import termios
    import tty

__all__ = ["CommandReader", "Terminal"]

_LONGEST_LINE = 256  # A longer text without a line end is not a command.
_LINE = re.compile(rb"[^!\n]+(?=!)|!?[^!\n]*\n|![^!\n]*(?=!)")


class Terminal:
    """Raw pseudo terminal: ``master`` is a descriptor that never waits, ``port`` the path for a host."""

    # The host's side stays open here, so that a host may open and close it for every command.

    def __init__(self) -> None:
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.port = os.ttyname(self._slave)

    def read(self) -> bytes:
        """Return available bytes, perhaps none."""
        try:
            return os.read(self.master, 65_536)
        except BlockingIOError:
            return b""

    def write(self, data: memoryview) -> int:
        """Write without waiting, and return the number of written bytes."""
        try:
            return os.write(self.master, data)
        except BlockingIOError:
            return 0

    @property
    def unread(self) -> int:
        """Number of bytes that the host could read now."""
        count = array.array("i", [0])
        fcntl.ioctl(self._slave, termios.FIONREAD, count)
        return count[0]

    def close(self) -> None:
        """Hang up: a program with the open port notices."""
        os.close(self.master)
        os.close(self._slave)


class CommandReader:
    """Splitter of input into command lines."""

    # The authors' code for Windows sends a measurement command without a line end.

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the complete lines, without their ends."""
        self._rest += data
        lines = []
        while found := _LINE.match(self._rest):
            lines.append(found.group())
            self._rest = self._rest[found.end() :]
        if len(self._rest) > _LONGEST_LINE:
            lines.append(self.take())
        return [line.strip() for line in lines if line.strip()]

    @property
    def unfinished(self) -> bytes:
        """Beginning of the next line."""
        return self._rest.strip()

    def take(self) -> bytes:
        """Return the beginning of the next line as if it had ended."""
        line, self._rest = self._rest, b""
        return line.strip()
