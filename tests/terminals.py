"""Commands in a pseudo terminal, and the text visible on its screen."""

import fcntl
import os
import re
import struct
import subprocess
import sys
import termios
import time
from contextlib import suppress

from tests.pages import environment

__all__ = ["Terminal", "seen"]

PATIENCE_S = 60.0
# Ctrl-C only reaches processes whose controlling terminal this is.
BEGIN = "import fcntl, termios; fcntl.ioctl(2, termios.TIOCSCTTY, 0)\n"


class Terminal:
    """Python code in a process: stderr is a terminal, stdin a pipe, and stdout the same terminal or a pipe."""

    def __init__(self, code, place, *arguments, columns=100, piped=False, **variables):
        self._columns, self._read_so_far = columns, b""
        self._end, inner = os.openpty()
        fcntl.ioctl(inner, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
        kept = {name: value for name, value in environment(place).items() if name not in {"NO_COLOR", "COLUMNS"}}
        self._process = subprocess.Popen(
            [sys.executable, "-c", BEGIN + code, *map(str, arguments)],
            cwd=place,
            env=kept | {"TERM": "xterm"} | variables,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE if piped else inner,
            stderr=inner,
            start_new_session=True,
            text=True,
        )
        os.close(inner)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.kill()
        self._process.communicate()
        os.close(self._end)

    def until(self, pattern):
        """Read until the output matches a pattern."""
        end_s = time.monotonic() + PATIENCE_S
        while not re.search(pattern, self.shown):
            assert self._read(), self.shown
            assert time.monotonic() < end_s, self.shown

    def go_on(self):
        """Send a line to the code's stdin."""
        self._process.stdin.write("\n")
        self._process.stdin.flush()

    def press(self, key):
        os.write(self._end, key)

    def end(self):
        self._process.terminate()

    def finish(self):
        """Wait for the process to end; return the exit code, and stdout if that is a pipe."""
        while self._read():
            pass
        reported, _ = self._process.communicate(timeout=PATIENCE_S)
        return self._process.returncode, reported

    @property
    def shown(self):
        return self._read_so_far.decode(errors="replace")

    @property
    def lines(self):
        return seen(self.shown, self._columns)

    def _read(self):
        with suppress(OSError):  # raised when the terminal is closed
            octets = os.read(self._end, 65_536)
            self._read_so_far += octets
            return bool(octets)
        return False


def seen(shown, columns):
    """Return the lines of the screen after all output, without colours and trailing empty lines."""
    lines, row, column = [""], 0, 0
    for match in re.finditer(r"\x1b\[([?\d;]*)([A-Za-z])|.", shown, re.DOTALL):
        character, (number, order) = match[0], match.groups()
        if order == "A":
            row -= int(number or 1)
        elif order == "K":
            lines[row] = "" if number == "2" else lines[row][:column]
        elif order:
            assert order in {"m", "h", "l"}, character
        elif character == "\r":
            column = 0
        elif character == "\n":
            row += 1
        else:
            if column == columns:
                row, column = row + 1, 0
            lines += [""] * (row + 1 - len(lines))
            lines[row] = lines[row][:column].ljust(column) + character + lines[row][column + 1 :]
            column += 1
        lines += [""] * (row + 1 - len(lines))
    return "\n".join(line.rstrip() for line in lines).rstrip("\n").split("\n")
