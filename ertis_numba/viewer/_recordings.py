"""HTML recordings of the view: one for the command line, and one for each browser that requests it."""

import math
import threading
from collections.abc import Callable, Hashable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol

from ertis_numba.base.atomic_files import atomic_write, check_target

__all__ = ["MAX_BYTES", "Recordings", "ToBrowser", "ToFile"]

MAX_BYTES: Final = 256_000_000
"""Limit on a recording. Its page contains it as text, a third longer, and Chromium accepts no text above 512 MB."""
_PLAIN_BYTES: Final = 8
_NOTICE_S: Final = 10.0


class RecordingReceiver(Protocol):
    """Destination of a recording."""

    def full(self) -> None:
        """Report that the recording has ended at its size limit."""

    def deliver(self, page: str, n_frames: int) -> None:
        """Receive the page; a separate thread calls this."""

    def failed(self, error: Exception) -> None:
        """Report a failure."""


class ToFile:
    """File for a recording; never overwrites the displayed sources; n_frames is None until it is written."""

    def __init__(
        self, path: Path, *, overwrite: bool, on_note: Callable[[str], None], sources: tuple[Path, ...] = ()
    ) -> None:
        check_target(path, overwrite=overwrite, sources=sources)
        self.n_frames: int | None = None
        self._path, self._overwrite, self._on_note = path, overwrite, on_note
        self._failure: Exception | None = None

    def full(self) -> None:
        """Report the full recording."""
        self._on_note(f"{self._path} is full at {MAX_BYTES / 1e6:g} MB: the view up to now is written")

    def deliver(self, page: str, n_frames: int) -> None:
        """Write the file."""
        with atomic_write(self._path, overwrite=self._overwrite) as part:
            part.write_text(page, encoding="utf-8")
        self.n_frames = n_frames

    def failed(self, error: Exception) -> None:
        """Keep the error for `check`."""
        self._failure = error

    def check(self) -> None:
        """Raise the error, if any."""
        if self._failure is not None:
            raise self._failure


class ToBrowser:
    """Browser that requested a recording."""

    def __init__(self, client: Any, name: str) -> None:
        self._client, self._name = client, name

    def full(self) -> None:
        """Show a notification."""
        self._emit_event("The HTML recording is full", f"at {MAX_BYTES / 1e6:g} MB; the view up to now is saved")

    def deliver(self, page: str, _: int) -> None:
        """Send the file."""
        self._client.send_file_download(self._name, page.encode(), save_immediately=True)

    def failed(self, error: Exception) -> None:
        """Show a notification: a failure in one browser does not end the view."""
        self._emit_event("Nothing is saved", str(error))

    def _emit_event(self, title: str, text: str) -> None:
        with suppress(Exception):  # The browser may have disconnected.
            self._client.add_notification(title, text, auto_close_seconds=_NOTICE_S, color="red")


@dataclass(slots=True)
class _PageRecording:
    """State of a recording: serializer, counted frames, and time since the last frame."""

    serializer: Any
    receiver: RecordingReceiver
    shown_s: float
    n_frames: int = 0
    n_bytes: int = 0
    n_messages: int = 0
    n_buffers: int = 0
    finished: Callable[[str], str] = str

    def pass_to(self, now_s: float) -> None:
        """Extend the last frame up to now."""
        if now_s > self.shown_s:
            self.serializer.insert_sleep(now_s - self.shown_s)
        self.shown_s = now_s

    def count(self) -> None:
        """Add the frames since the last call; viser does not report them."""
        messages, buffers = self.serializer._messages, self.serializer._binary_buffers  # noqa: SLF001
        self.n_bytes += sum(_size(message) for _, message in messages[self.n_messages :])
        self.n_bytes += sum(buffer.nbytes for buffer in buffers[self.n_buffers :])
        self.n_messages, self.n_buffers = len(messages), len(buffers)

    def finish(self) -> None:
        """Build the page and deliver it."""
        try:
            self.receiver.deliver(self.finished(str(self.serializer.as_html(dark_mode=True))), self.n_frames)
        except Exception as error:  # noqa: BLE001  the receiver is to know
            self.receiver.failed(error)


class Recordings:
    """Recordings in progress, by one clock; time starts when the first frame is drawn."""

    # A thread delivers pages, which takes seconds. `serializer` returns what viser keeps, and `finished` a page.

    def __init__(
        self, serializer: Callable[[], Any], finished: Callable[[], Callable[[str], str]] = lambda: str
    ) -> None:
        self._serializer, self._finished = serializer, finished
        self._made: dict[Hashable, _PageRecording] = {}
        self._threads: list[threading.Thread] = []

    def __contains__(self, key: Hashable) -> bool:
        return key in self._made

    def n_bytes(self) -> dict[Hashable, int]:
        """Return the size of each recording."""
        return {key: recording.n_bytes for key, recording in self._made.items()}

    def begin(self, key: Hashable, receiver: RecordingReceiver, now_s: float = math.inf) -> None:
        """Begin a recording; it starts with the present frame, if there is one."""
        self._made[key] = _PageRecording(self._serializer(), receiver, now_s)

    def end(self, key: Hashable, now_s: float) -> None:
        """End a recording and deliver it, if it exists."""
        recording = self._made.pop(key, None)
        if recording is not None:
            recording.pass_to(now_s)
            recording.finished = self._finished()
            thread = threading.Thread(target=recording.finish, name="ertis-html", daemon=True)
            thread.start()
            self._threads.append(thread)

    def drop(self, key: Hashable) -> None:
        """Discard a recording."""
        recording = self._made.pop(key, None)
        if recording is not None:
            handler = recording.serializer._handler  # noqa: SLF001  viser would first make all of a page
            with handler._record_lock:  # noqa: SLF001
                handler._record_handles.remove(recording.serializer)  # noqa: SLF001

    def add(self, *, frames: int) -> None:
        """Add drawn objects and the number of new frames; end recordings that are full."""
        for key, recording in [*self._made.items()]:
            recording.n_frames += frames
            recording.count()
            if recording.n_bytes >= MAX_BYTES:
                recording.receiver.full()
                self.end(key, recording.shown_s)

    def pass_to(self, now_s: float) -> None:
        """Extend the last frame up to now, before the next is drawn."""
        for recording in self._made.values():
            recording.pass_to(now_s)

    def wait(self) -> None:
        """Wait until all ended recordings are delivered."""
        for thread in self._threads:
            thread.join()
        self._threads.clear()


def _size(value: object) -> int:
    """Return the approximate size of a message without its arrays, which are stored separately."""
    if isinstance(value, dict):
        return sum(len(name) + _size(each) for name, each in value.items())
    if isinstance(value, list | tuple):
        return sum(_size(each) for each in value)
    return len(value) if isinstance(value, bytes | str) else _PLAIN_BYTES
