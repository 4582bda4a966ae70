"""The pseudo terminal of an emulated device, and what comes in through it."""

import array
import os
import re
from contextlib import suppress

with suppress(ImportError):  # not POSIX: see `links.require_terminals`
    import fcntl
    import termios
    import tty

__all__ = ["CommandReader", "Terminal"]

_LONGEST_LINE = 256  # more without an end is no command
_LINE = re.compile(rb"[^!\n]+(?=!)|!?[^!\n]*\n|![^!\n]*(?=!)")


class Terminal:
    """A pseudo terminal that does nothing to the bytes.

    The side of the host stays open here, so that a host may open and close it for every command. What nobody has read
    then waits in the system's buffer, some 12 kB; that of a real port would be gone.

    Attributes
    ----------
    master : int
        File descriptor to read and write without waiting.
    port : str
        Path that a host opens.
    """

    def __init__(self) -> None:
        self.master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self.master, False)
        self.port = os.ttyname(self._slave)

    def read(self) -> bytes:
        """Return what came, perhaps nothing."""
        try:
            return os.read(self.master, 65_536)
        except BlockingIOError:
            return b""

    def write(self, data: memoryview) -> int:
        """Write what goes without waiting, and return how many bytes that was."""
        try:
            return os.write(self.master, data)
        except BlockingIOError:
            return 0

    @property
    def unread(self) -> int:
        """Bytes that the host could read now."""
        count = array.array("i", [0])
        fcntl.ioctl(self._slave, termios.FIONREAD, count)
        return count[0]

    def close(self) -> None:
        """Hang up: whoever has the port open notices."""
        os.close(self.master)
        os.close(self._slave)


class CommandReader:
    """Cuts what comes into command lines.

    A command ends with its line. The authors' code for Windows sends a measurement without an end: that is one as soon
    as the next begins, or when it has been left for a while.
    """

    def __init__(self) -> None:
        self._rest = b""

    def feed(self, data: bytes) -> list[bytes]:
        """Return the lines that are complete, without their ends."""
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
        """What has come of the next line."""
        return self._rest.strip()

    def take(self) -> bytes:
        """Return what has come of the next line, as if it had ended."""
        line, self._rest = self._rest, b""
        return line.strip()
