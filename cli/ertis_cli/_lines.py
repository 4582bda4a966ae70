"""Non-blocking output stream for readers that are slow or have stopped."""

import os
import queue
import threading
from typing import IO

__all__ = ["JsonLines"]

_MAX = 65_536
_CLOSED_S = 5.0


class JsonLines:
    """Stream whose writer never waits for the reader, because a thread writes the texts in order."""

    # At most `largest` texts wait; further ones are dropped. A stream without a descriptor is written directly.

    def __init__(self, stream: IO[str], *, largest: int = _MAX) -> None:
        self._stream = stream
        self._waiting: queue.Queue[str | None] = queue.Queue(largest)
        self.lost = 0
        try:
            stream.flush()
            self._descriptor: int | None = stream.fileno()
        except (OSError, ValueError):  # no file descriptor
            self._descriptor = None
        self._writer = threading.Thread(target=self._write, name="lines", daemon=True)
        if self._descriptor is not None:
            self._writer.start()

    def write(self, text: str) -> int:
        """Queue a text, or drop it if the queue is full; return at once."""
        if self._descriptor is None:
            return self._stream.write(text)
        try:
            self._waiting.put_nowait(text)
        except queue.Full:
            self.lost += 1
        return len(text)

    def flush(self) -> None:
        """Do nothing, because the thread writes texts as soon as possible."""

    def close(self, timeout_s: float = _CLOSED_S) -> None:
        """Wait until all texts are written, up to ``timeout_s`` for the queue and again for the thread."""
        if self._writer.ident is None:
            return
        try:
            self._waiting.put(None, timeout=timeout_s)
        except queue.Full:
            return
        self._writer.join(timeout_s)

    def _write(self) -> None:
        # Bypass the stream: if the reader has stopped, the stream's lock would be held for ever.
        descriptor = -1 if self._descriptor is None else self._descriptor
        while (text := self._waiting.get()) is not None:
            data = memoryview(text.encode(errors="backslashreplace"))
            try:
                while data:
                    data = data[os.write(descriptor, data) :]
            except OSError:  # the reader has gone
                continue
