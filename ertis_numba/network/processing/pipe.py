"""Pipes between the processes of a central node, for small messages and descriptors; sending never blocks."""

import os
import select
import socket
import struct
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any, Final, Generic, TypeVar

import msgspec

__all__ = ["Pipe"]

Kind = TypeVar("Kind")

_LENGTH: Final = struct.Struct("<I")
_MAX_BYTES: Final = 64 * 2**20  # Limit on a message; a process of this package sends no longer one.
_READ_BYTES: Final = 1 << 18
_FILES: Final = 8  # Limit on descriptors per message.


class Pipe(Generic[Kind]):
    """One end of a connection between two processes.

    Messages are MessagePack, never pickle: a corrupted worker cannot make the central node run code.

    Parameters
    ----------
    end : socket.socket
        One socket of a pair.
    kinds : type
        Received messages: a union of tagged `msgspec.Struct`.

    Attributes
    ----------
    files : deque of int
        Received descriptors, in the order of their messages.
    closed : bool
        The other process has ended, or has sent an invalid message.
    """

    def __init__(self, end: socket.socket, kinds: Any) -> None:
        end.settimeout(0)
        self._end = end
        self._encoder = msgspec.msgpack.Encoder()
        self._decoder: msgspec.msgpack.Decoder[Kind] = msgspec.msgpack.Decoder(kinds)
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
                data, files, _, _ = socket.recv_fds(self._end, _READ_BYTES, _FILES)
            except BlockingIOError:
                break
            except OSError:
                data, files = b"", []
            self.files.extend(files)
            self._in += data
            self.closed = not data
        return self._messages()

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
        poll = select.poll()
        poll.register(self._end, select.POLLIN | (select.POLLOUT if self._out else 0))
        ready = poll.poll(None if timeout_s is None else 1000 * timeout_s)
        self.flush()
        return any(event & ~select.POLLOUT for _, event in ready)

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


def _close(files: Iterable[int]) -> None:
    for each in files:
        os.close(each)
