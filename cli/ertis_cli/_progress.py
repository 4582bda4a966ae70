"""Progress bars and status lines on a terminal."""

import io
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from typing import TYPE_CHECKING, TextIO, TypeVar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

__all__ = ["StatusLine", "bar", "bars", "drawn", "is_drawn_on"]

Item = TypeVar("Item")

_CLEAR = "\r\x1b[K"  # not by rich, whose live display makes a central node wait for a slow terminal
_COLUMNS = 80  # of a terminal that does not tell its width


def is_drawn_on(stream: TextIO) -> bool:
    """Return True if a stream is a terminal with cursor control, and not a file, a pipe or a dumb terminal."""
    return stream.isatty() and os.environ.get("TERM", "").lower() not in {"dumb", "unknown"}


def bars() -> "Progress":
    """Return progress bars for stderr, coloured unless ``NO_COLOR`` is set; use them under `drawn`."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    return Progress(
        TextColumn("{task.description}", markup=False),  # file names may contain brackets
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("left", style="progress.remaining"),
        console=Console(file=sys.stderr),
        redirect_stdout=False,  # `drawn` does this
        redirect_stderr=False,
        transient=True,
    )


@contextmanager
def drawn(progress: "Progress") -> Iterator[None]:
    """Draw bars until the block ends, then remove them; text printed on that terminal appears above them."""
    # Only a stdout on the same terminal is redirected; a file or a pipe keeps its output.
    takes_stdout = _is_one_terminal()
    with progress, ExitStack() as stack:
        above = stack.enter_context(_Above(progress.console, sys.stderr))
        stack.enter_context(redirect_stderr(above))
        if takes_stdout:
            stack.enter_context(redirect_stdout(above))
        yield


@contextmanager
def bar(items: Iterable[Item], *, length: int, label: str) -> Iterator[Iterator[Item]]:
    """Draw a bar that advances while ``items`` are consumed."""
    progress = bars()
    task = progress.add_task(label, total=length)
    with drawn(progress):
        yield _followed(items, progress, task)


def _followed(items: Iterable[Item], progress: "Progress", task: "TaskID") -> Iterator[Item]:
    for item in items:
        yield item
        progress.advance(task)


def _is_one_terminal() -> bool:
    """Return True if stdout and stderr are the same terminal."""
    try:
        return os.ttyname(sys.stdout.fileno()) == os.ttyname(sys.stderr.fileno())
    except (OSError, ValueError):  # one of them is not a terminal or, as in tests, has no file descriptor
        return False


class StatusLine:
    """Line on stderr that is drawn again in its place; nothing is drawn if ``quiet`` or off a terminal."""

    def __init__(self, write: Callable[[str], object], *, quiet: bool) -> None:
        self.is_drawn = not quiet and is_drawn_on(sys.stderr)
        self._write = write

    def draw(self, text: str) -> None:
        """Replace the line. Text beyond the width of the terminal would start a second line, and is cut off."""
        if self.is_drawn:
            self._write(self.above(text[: _columns() - 1]))

    def clear(self) -> None:
        """Remove the line."""
        if self.is_drawn:
            self._write(self.above(""))

    def above(self, text: str) -> str:
        """Return text that replaces the line where it is written."""
        return _CLEAR + text if self.is_drawn else text


def _columns() -> int:
    try:
        return os.get_terminal_size(sys.stderr.fileno()).columns or _COLUMNS
    except (OSError, ValueError):  # the terminal is gone
        return _COLUMNS


class _Above(io.TextIOBase):
    """Stream whose complete lines appear above bars; rich has one without an encoding, which click bypasses."""

    encoding = "utf-8"  # not used, because the terminal's own stream encodes
    errors = "backslashreplace"

    def __init__(self, console: "Console", stream: TextIO) -> None:
        self._console, self._stream = console, stream
        self._turn = threading.RLock()  # a signal handler may write as well
        self._begun = ""

    def write(self, text: str) -> int:
        with self._turn:
            *lines, self._begun = (self._begun + text).split("\n")
            for line in lines:
                self._console.out(line, highlight=False)
        return len(text)

    def close(self) -> None:
        if self._begun:
            self.write("\n")
        super().close()

    def fileno(self) -> int:
        return self._stream.fileno()
