"""ZMTP 3.1, the protocol of ZeroMQ, over plain sockets and without keys, for messages that no honest node sends.

The code follows https://rfc.zeromq.org/spec/37, and shares nothing with the tested code.
"""

import socket
import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Final, NamedTuple, Self

__all__ = ["GREETING", "ZmtpFrame", "ZmtpFrameParser", "ZmtpPeer", "greeting", "host_and_port", "message", "ready"]

_MORE, _LONG, _COMMAND = 1, 2, 4
_SIGNATURE: Final = b"\xff" + bytes(8) + b"\x7f"


def greeting(mechanism: bytes = b"NULL", *, as_server: bool = False) -> bytes:
    """Return the first 64 bytes that a peer sends."""
    return _SIGNATURE + b"\x03\x01" + mechanism.ljust(20, b"\0") + bytes([as_server]) + bytes(31)


GREETING: Final = greeting()


class ZmtpFrame(NamedTuple):
    """Frame as it is on the wire."""

    flags: int
    body: bytes

    @property
    def more(self) -> bool:
        """True if another frame of the same message follows."""
        return bool(self.flags & _MORE)

    @property
    def is_command(self) -> bool:
        """True for a command between sockets."""
        return bool(self.flags & _COMMAND)

    def encode(self) -> bytes:
        """Return the bytes of the frame."""
        flags = self.flags & ~_LONG
        if len(self.body) > 255:
            return struct.pack(">BQ", flags | _LONG, len(self.body)) + self.body
        return struct.pack(">BB", flags, len(self.body)) + self.body


@dataclass(slots=True)
class ZmtpFrameParser:
    """Incremental parser of frames."""

    _data: bytearray = field(default_factory=bytearray)

    def feed(self, data: bytes) -> list[ZmtpFrame]:
        """Return the frames that are complete after adding bytes."""
        self._data += data
        found, place = [], 0
        while len(self._data) - place >= 2:
            flags = self._data[place]
            head = 9 if flags & _LONG else 2
            if len(self._data) - place < head:
                break
            size = struct.unpack_from(">Q", self._data, place + 1)[0] if flags & _LONG else self._data[place + 1]
            if len(self._data) - place < head + size:
                break
            found.append(ZmtpFrame(flags, bytes(self._data[place + head : place + head + size])))
            place += head + size
        del self._data[:place]
        return found


def message(frames: Sequence[bytes]) -> bytes:
    """Return the bytes of a message."""
    last = len(frames) - 1
    return b"".join(ZmtpFrame(_MORE * (number < last), body).encode() for number, body in enumerate(frames))


def ready(socket_type: bytes = b"DEALER", identity: bytes = b"", extra: Iterable[tuple[bytes, bytes]] = ()) -> bytes:
    """Return the command that ends a handshake without keys."""
    pairs = ((b"Socket-Type", socket_type), (b"Identity", identity), *extra)
    body = b"\x05READY" + b"".join(
        bytes([len(name)]) + name + struct.pack(">I", len(value)) + value for name, value in pairs
    )
    return ZmtpFrame(_COMMAND, body).encode()


def host_and_port(address: str) -> tuple[str, int]:
    """Return host and port of ``tcp://HOST:PORT``."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    return host, int(port)


class ZmtpPeer:
    """Socket with a finished handshake as a DEALER without keys; use it in a ``with`` statement.

    Parameters
    ----------
    address : str
    identity : bytes
        Routing id that the peer requests.
    timeout_s : float
        Time limit for sending and receiving.

    Raises
    ------
    OSError
        The other side has closed the connection, or does not answer.
    """

    def __init__(self, address: str, *, identity: bytes = b"", timeout_s: float = 10.0) -> None:
        self._frames = ZmtpFrameParser()
        self._came: list[ZmtpFrame] = []
        self.socket = socket.create_connection(host_and_port(address), timeout=timeout_s)
        try:
            self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self.socket.sendall(GREETING + ready(identity=identity))
            greeted = b""
            while len(greeted) < len(GREETING):
                greeted += self._read(len(GREETING) - len(greeted))
            while not self._came:
                self._came = self._frames.feed(self._read())
            del self._came[0]
        except BaseException:
            self.socket.close()
            raise

    def _read(self, largest: int = 65_536) -> bytes:
        data = self.socket.recv(largest)
        if not data:
            raise ConnectionResetError("the other side has closed the connection")
        return data

    def send(self, *messages: Sequence[bytes]) -> None:
        """Send messages, each a list of frames."""
        self.socket.sendall(b"".join(map(message, messages)))

    def receive(self) -> list[bytes]:
        """Return the next message. Commands between sockets are answered."""
        body: list[bytes] = []
        while True:
            while self._came:
                frame = self._came.pop(0)
                if frame.is_command:
                    self._answer(frame)
                    continue
                body.append(frame.body)
                if not frame.more:
                    return body
            self._came = self._frames.feed(self._read())

    def _answer(self, frame: ZmtpFrame) -> None:
        if frame.body.startswith(b"\x04PING"):
            self.socket.sendall(ZmtpFrame(_COMMAND, b"\x04PONG" + frame.body[7:]).encode())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()
