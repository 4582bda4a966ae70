"""Non-blocking output to streams with slow or absent readers."""

import os
import queue
import threading
from typing import IO

__all__ = ["JsonLines"]

_MAX = 65_536
_CLOSED_S = 5.0


class JsonLines:
    """Stream whose writer never waits for its reader: a thread writes the lines in order.

    The stream discards and counts new lines if too many wait. A stream without a file descriptor, as in tests, is
    written directly.

    Parameters
    ----------
    stream : file
    largest : int
        Limit on waiting texts.

    Attributes
    ----------
    lost : int
        Number of discarded texts.
    """

    def __init__(self, stream: IO[str], *, largest: int = _MAX) -> None:
        self._stream = stream
        self._waiting: queue.Queue[str | None] = queue.Queue(largest)
        self.lost = 0
        try:
            stream.flush()
            self._descriptor: int | None = stream.fileno()
        except (OSError, ValueError):  # It has no descriptor.
            self._descriptor = None
        self._writer = threading.Thread(target=self._write, name="lines", daemon=True)
        if self._descriptor is not None:
            self._writer.start()

    def write(self, text: str) -> int:
        """Queue text, and return at once."""
        if self._descriptor is None:
            return self._stream.write(text)
        try:
            self._waiting.put_nowait(text)
        except queue.Full:
            self.lost += 1
        return len(text)

    def flush(self) -> None:
        """Do nothing: the thread writes text as soon as possible."""

    def close(self, timeout_s: float = _CLOSED_S) -> None:
        """Wait, with a timeout, until all text is written."""
        if self._writer.ident is None:
            return
        try:
            self._waiting.put(None, timeout=timeout_s)
        except queue.Full:
            return
        self._writer.join(timeout_s)

    def _write(self) -> None:
        # The stream itself would hold its lock for ever if its reader has stopped.
        descriptor = -1 if self._descriptor is None else self._descriptor
        while (text := self._waiting.get()) is not None:
            data = memoryview(text.encode(errors="backslashreplace"))
            try:
                while data:
                    data = data[os.write(descriptor, data) :]
            except OSError:  # The reader has closed the stream.
                continue
