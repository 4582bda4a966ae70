"""What goes between the processes of a central node: small messages and files, and nobody ever waits to send one."""

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
_MAX_BYTES: Final = 64 * 2**20  # of a message; what is longer has not been sent by a process of ours
_READ_BYTES: Final = 1 << 18
_FILES: Final = 8  # with one message


class Pipe(Generic[Kind]):
    """One end of a connection of two processes.

    Messages are MessagePack, never pickle: a worker that has gone wrong cannot make the central node run anything.

    Parameters
    ----------
    end : socket.socket
        Of a pair.
    kinds : type
        Of what comes in: a union of tagged `msgspec.Struct`.

    Attributes
    ----------
    files : deque of int
        Descriptors that have come, in the order of the messages that they belong to.
    closed : bool
        The other process has ended, or has sent what is no message.
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
        """Return what is to be polled."""
        return self._end.fileno()

    def send(self, message: msgspec.Struct, *, files: Sequence[int] = ()) -> None:
        """Send a message as soon as the other process takes it, and files with it, which may be closed at once."""
        body = self._encoder.encode(message)
        self._out.append((memoryview(_LENGTH.pack(len(body)) + body), [os.dup(each) for each in files]))
        self.flush()

    @property
    def waiting(self) -> bool:
        """Whether something could not be sent yet."""
        return bool(self._out)

    def flush(self) -> None:
        """Send what could not be sent before, as far as that is possible now."""
        while self._out:
            data, files = self._out[0]
            try:
                sent = socket.send_fds(self._end, [data], files) if files else self._end.send(data)
            except BlockingIOError:
                return
            except OSError:  # the other process is gone, which reading tells
                self._drop()
                return
            _close(files)
            if sent < len(data):
                self._out[0] = (data[sent:], ())
            else:
                self._out.popleft()

    def receive(self) -> list[Kind]:
        """Return what has come; `closed` is set when no more will."""
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
        """Close it; the other process notices."""
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
