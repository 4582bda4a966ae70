"""Lines for somebody who may be slow to read them, or has stopped."""

import os
import queue
import threading
from typing import IO

__all__ = ["JsonLines"]

_MAX = 65_536
_CLOSED_S = 5.0


class JsonLines:
    """A stream whose writer never waits for its reader: a thread writes, in order.

    When too many wait, new ones are left out and counted. A stream that is no file of the system, as in tests, is
    written to at once.

    Parameters
    ----------
    stream : file
    largest : int
        Texts that may wait.

    Attributes
    ----------
    lost : int
        Texts that were left out.
    """

    def __init__(self, stream: IO[str], *, largest: int = _MAX) -> None:
        self._stream = stream
        self._waiting: queue.Queue[str | None] = queue.Queue(largest)
        self.lost = 0
        try:
            stream.flush()
            self._descriptor: int | None = stream.fileno()
        except (OSError, ValueError):  # it has none
            self._descriptor = None
        self._writer = threading.Thread(target=self._write, name="lines", daemon=True)
        if self._descriptor is not None:
            self._writer.start()

    def write(self, text: str) -> int:
        """Take text; returns at once."""
        if self._descriptor is None:
            return self._stream.write(text)
        try:
            self._waiting.put_nowait(text)
        except queue.Full:
            self.lost += 1
        return len(text)

    def flush(self) -> None:
        """Do nothing: text is written as soon as it can be."""

    def close(self, timeout_s: float = _CLOSED_S) -> None:
        """Wait until all is written, but not for ever."""
        if self._writer.ident is None:
            return
        try:
            self._waiting.put(None, timeout=timeout_s)
        except queue.Full:
            return
        self._writer.join(timeout_s)

    def _write(self) -> None:
        # Not by the stream itself: its lock would be held for ever where the reader has stopped.
        descriptor = -1 if self._descriptor is None else self._descriptor
        while (text := self._waiting.get()) is not None:
            data = memoryview(text.encode(errors="backslashreplace"))
            try:
                while data:
                    data = data[os.write(descriptor, data) :]
            except OSError:  # nobody reads any more
                continue
