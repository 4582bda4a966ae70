"""Progress bars and the terminals that can show them."""

import io
import os
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stderr, redirect_stdout
from typing import TYPE_CHECKING, TextIO, TypeVar

if TYPE_CHECKING:
    from rich.console import Console
    from rich.progress import Progress, TaskID

__all__ = ["bar", "bars", "drawn", "is_drawn_on"]

Item = TypeVar("Item")


def is_drawn_on(stream: TextIO) -> bool:
    """Return True for a terminal that moves its cursor, and False for files, pipes and dumb terminals."""
    return stream.isatty() and os.environ.get("TERM", "").lower() not in {"dumb", "unknown"}


def bars() -> "Progress":
    """Return a progress display on stderr, without colours if ``NO_COLOR`` is set; use it under `drawn`."""
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
        TextColumn("{task.description}", markup=False),  # Names of files may contain brackets.
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
        TextColumn("left", style="progress.remaining"),
        console=Console(file=sys.stderr),
        redirect_stdout=False,  # `drawn` redirects it.
        redirect_stderr=False,
        transient=True,
    )


@contextmanager
def drawn(progress: "Progress") -> Iterator[None]:
    """Draw bars until the block ends, and then erase them; printed lines appear above the bars."""
    # A stdout that is not this terminal stays unchanged.
    takes_stdout = _is_one_terminal()
    with progress, ExitStack() as stack:
        above = stack.enter_context(_Above(progress.console, sys.stderr))
        stack.enter_context(redirect_stderr(above))
        if takes_stdout:
            stack.enter_context(redirect_stdout(above))
        yield


@contextmanager
def bar(items: Iterable[Item], *, length: int, label: str) -> Iterator[Iterator[Item]]:
    """Draw a bar over ``items`` while they are consumed."""
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
    except (OSError, ValueError):  # One of them is not a terminal, or not a file of the system, as in tests.
        return False


class _Above(io.TextIOBase):
    """Stream whose lines appear unbroken above bars; rich has one, but click bypasses streams without an encoding."""

    encoding = "utf-8"  # The terminal's own stream encodes the text.
    errors = "backslashreplace"

    def __init__(self, console: "Console", stream: TextIO) -> None:
        self._console, self._stream = console, stream
        self._turn = threading.RLock()  # A signal handler may write, too.
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
