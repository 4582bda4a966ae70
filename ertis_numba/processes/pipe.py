"""Pipes between processes, for small messages and descriptors of memory; sending never blocks."""

import os
import selectors
import socket
import struct
import sys
import tempfile
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, Generic, TypeVar

import msgspec

__all__ = ["Pipe", "anonymous_memory", "wait_for"]

Kind = TypeVar("Kind")

_LENGTH: Final = struct.Struct("<I")
_MAX_BYTES: Final = 64 * 2**20  # Limit on a message; a process of this package sends no longer one.
_READ_BYTES: Final = 1 << 18
_FILES: Final = 8  # Limit on descriptors per message.
# epoll would open a descriptor for each wait; Windows has only select.
_Selector: Final = getattr(selectors, "PollSelector", selectors.SelectSelector)


class Pipe(Generic[Kind]):
    """One end of a connection between two processes, for messages that are tagged `msgspec.Struct` of ``kinds``.

    Messages are MessagePack, never pickle: a corrupted child cannot make its parent run code. Paths travel as bytes,
    because names of files need not be valid text. ``files`` are received descriptors, in the order of their messages.
    ``closed`` is true if the other process has ended, or has sent an invalid message.
    """

    def __init__(self, end: socket.socket, kinds: Any) -> None:
        end.settimeout(0)
        self._end = end
        self._encoder = msgspec.msgpack.Encoder(enc_hook=os.fsencode)
        self._decoder: msgspec.msgpack.Decoder[Kind] = msgspec.msgpack.Decoder(kinds, dec_hook=_decoded)
        self._in = bytearray()
        self._out: deque[tuple[memoryview, Sequence[int]]] = deque()
        self.files: deque[int] = deque()
        self.closed = False

    def fileno(self) -> int:
        """Return the descriptor to poll."""
        return self._end.fileno()

    def send(self, message: msgspec.Struct, *, files: Sequence[int] = ()) -> None:
        """Send a message, with descriptors, as soon as the other process reads it; the caller may close them."""
        body = self._encoder.encode(message)
        self._out.append((memoryview(_LENGTH.pack(len(body)) + body), [os.dup(each) for each in files]))
        self.flush()

    @property
    def waiting(self) -> bool:
        """True if a message waits to be sent."""
        return bool(self._out)

    def flush(self) -> None:
        """Send waiting messages as far as possible now."""
        while self._out:
            data, files = self._out[0]
            try:
                sent = socket.send_fds(self._end, [data], files) if files else self._end.send(data)
            except BlockingIOError:
                return
            except OSError:  # The other process is gone; reading reports it.
                self._drop()
                return
            _close(files)
            if sent < len(data):
                self._out[0] = (data[sent:], ())
            else:
                self._out.popleft()

    def receive(self) -> list[Kind]:
        """Return received messages; `closed` is set when no more will come."""
        self.flush()
        while not self.closed:
            try:
                if sys.platform == "win32":
                    data, files = self._end.recv(_READ_BYTES), []
                else:
                    data, files, _, _ = socket.recv_fds(self._end, _READ_BYTES, _FILES)
            except BlockingIOError:
                break
            except OSError:
                data, files = b"", []
            self.files.extend(files)
            self._in += data
            self.closed = not data
        return self._messages()

    def messages(self) -> Iterator[Kind]:
        """Yield messages as they arrive, until the other process closes the pipe."""
        while not self.closed:
            self.wait(None)
            yield from self.receive()

    def _messages(self) -> list[Kind]:
        found: list[Kind] = []
        begin, size = 0, len(self._in)
        while size - begin >= _LENGTH.size:
            (length,) = _LENGTH.unpack_from(self._in, begin)
            stop = begin + _LENGTH.size + length
            if length > _MAX_BYTES:
                self.closed = True
                break
            if size < stop:
                break
            try:
                found.append(self._decoder.decode(self._in[begin + _LENGTH.size : stop]))
            except (msgspec.MsgspecError, UnicodeDecodeError):
                self.closed = True
                break
            begin = stop
        del self._in[:begin]
        return found

    def wait(self, timeout_s: float | None) -> bool:
        """Wait until there is something to `receive`, and send meanwhile."""
        ready = wait_for([self], timeout_s)
        self.flush()
        return bool(ready)

    def drain(self) -> None:
        """Wait until all messages are sent, or the other process is gone."""
        while self._out:
            self.wait(None)

    def close(self) -> None:
        """Close the pipe; the other process notices."""
        self.closed = True
        self._end.close()
        self._drop()
        _close(self.files)
        self.files.clear()

    def _drop(self) -> None:
        for _, files in self._out:
            _close(files)
        self._out.clear()


def wait_for(pipes: Iterable[Pipe[Any]], timeout_s: float | None) -> list[Pipe[Any]]:
    """Wait until pipes have something to `Pipe.receive` or can send, and return those with something to receive."""
    with _Selector() as selector:
        for pipe in pipes:
            selector.register(pipe, selectors.EVENT_READ | (selectors.EVENT_WRITE if pipe.waiting else 0), pipe)
        return [key.data for key, events in selector.select(timeout_s) if events & selectors.EVENT_READ]


def anonymous_memory(n_bytes: int) -> int:
    """Return the descriptor of new memory that processes can share, and that the system frees with the last of them."""
    # Memory with a name, as of `multiprocessing.shared_memory`, is left behind if every process is killed at once.
    if hasattr(os, "memfd_create"):
        descriptor = os.memfd_create("ertis")
    else:
        with tempfile.TemporaryFile() as file:  # Systems without anonymous memory get a deleted file.
            descriptor = os.dup(file.fileno())
    try:
        os.ftruncate(descriptor, n_bytes)
    except BaseException:
        os.close(descriptor)
        raise
    return descriptor


def _decoded(kind: type, value: Any) -> Any:
    if kind is Path:
        return Path(os.fsdecode(value))
    raise NotImplementedError(f"messages cannot contain {kind}")  # the error that msgspec expects


def _close(files: Iterable[int]) -> None:
    for each in files:
        os.close(each)
