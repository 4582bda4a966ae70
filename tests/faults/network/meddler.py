"""Proxy between nodes that loses, repeats and delays whole messages, or goes silent without notice to either end."""

import contextlib
import random
import socket
import threading
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Literal, Self

from tests.faults.network.zmtp import GREETING, ZmtpFrame, ZmtpFrameParser, host_and_port

__all__ = ["ACKS", "Direction", "Meddler", "Odds"]

Direction = Literal["to target", "from target"]
_READ_BYTES: Final = 262_144
_HEAD_BYTES: Final = 26  # length, command and nonce of a CURVE message
_SHARE_OF_HEAD: Final = 0.25


@dataclass(frozen=True, slots=True, kw_only=True)
class Odds:
    """Effects on one kind of message: shares that are lost, repeated, and delayed by up to ``max_s``."""

    lose: float = 0.0
    repeat: float = 0.0
    delay: float = 0.0
    max_s: float = 0.3


ACKS: Final = {"ack": Odds(lose=0.25, repeat=0.25, delay=0.25), "welcome": Odds(lose=0.1, repeat=0.1)}
"""Odds with which acknowledgements are lost, repeated and reordered."""


class Meddler:
    """Proxy of an address that loses, repeats and delays messages; use it in a ``with`` statement.

    Parameters
    ----------
    target : str
        ``tcp://HOST:PORT``. Odds apply only to a node without keys, because other messages cannot be read.
    seed : int
    odds : mapping of str to Odds
        Effects by kind of message.

    Attributes
    ----------
    address : str
        Address to which clients of the target connect.
    did : Counter of str
        Numbers of effects by name, such as ``ack lose``.
    """

    def __init__(self, target: str, *, seed: int = 0, odds: Mapping[str, Odds] | None = None) -> None:
        self._target, self._odds = target, dict(odds or {})
        self._random = random.Random(seed)
        self.did: Counter[str] = Counter()
        self._sockets: list[socket.socket] = []
        self._plugged = threading.Event()
        self._plugged.set()
        self._flips: Counter[Direction] = Counter()
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"tcp://127.0.0.1:{self._server.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def cut(self) -> None:
        """Forward nothing, without notice to either end, as an unplugged cable."""
        self._plugged.clear()

    def mend(self) -> None:
        """Forward waiting and later messages without faults."""
        self._plugged.set()

    def drop(self) -> None:
        """Close all connections."""
        for each in self._sockets:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)

    def flip(self, direction: Direction) -> None:
        """Flip a bit of the next message in a direction. ``did`` counts it."""
        self._flips[direction] += 1

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._server.accept()
            except OSError:  # The socket is closed.
                return
            if not self._plugged.is_set():
                near.close()
                continue
            try:
                far = socket.create_connection(host_and_port(self._target), timeout=5.0)
                far.settimeout(None)
            except OSError:
                near.close()
                continue
            self._sockets = [each for each in self._sockets if each.fileno() >= 0] + [near, far]
            ways: tuple[tuple[socket.socket, socket.socket, Direction], ...] = (
                (near, far, "to target"),
                (far, near, "from target"),
            )
            for end in (near, far):  # Shut the sockets down before a thread may close them.
                end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            for way in ways:
                threading.Thread(target=self._relay, args=way, daemon=True).start()

    def _relay(self, source: socket.socket, sink: socket.socket, direction: Direction) -> None:
        """Forward one direction of a connection until it ends."""
        frames, greeted, body, turn = ZmtpFrameParser(), 0, list[ZmtpFrame](), threading.Lock()
        with contextlib.suppress(OSError):
            while data := source.recv(_READ_BYTES):
                self._plugged.wait()
                head, data = data[: len(GREETING) - greeted], data[len(GREETING) - greeted :]
                greeted += len(head)
                _send(sink, head, turn)
                for frame in frames.feed(data):
                    body.append(frame)
                    if frame.is_command:
                        _send(sink, body.pop().encode(), turn)
                    elif not frame.more:
                        self._pass(sink, body, turn, direction)
                        body = []
        for each in (source, sink):
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

    def _pass(self, sink: socket.socket, body: list[ZmtpFrame], turn: threading.Lock, direction: Direction) -> None:
        data = b"".join(frame.encode() for frame in body)
        if self._flips[direction] > 0:
            self._flips[direction] -= 1
            _send(sink, self._flipped(data), turn)
            self.did[f"flip {direction}"] += 1
            return
        kind = _kind(body[0].body)
        odds = self._odds.get(kind)
        if odds is None:
            _send(sink, data, turn)
            return
        for what, share in (("lose", odds.lose), ("delay", odds.delay), ("repeat", odds.repeat)):
            if self._random.random() >= share:
                continue
            self.did[f"{kind} {what}"] += 1
            if what == "lose":
                return
            if what == "delay":
                _later(self._random.uniform(0.0, odds.max_s), sink, data, turn)
                return
            _send(sink, data, turn)
        _send(sink, data, turn)

    def _flipped(self, data: bytes) -> bytes:
        """Return a message with one flipped bit, in its head in a quarter of the cases, and anywhere otherwise."""
        head = min(len(data), _HEAD_BYTES) if self._random.random() < _SHARE_OF_HEAD else len(data)
        place = self._random.randrange(8 * head)
        flipped = bytearray(data)
        flipped[place // 8] ^= 1 << place % 8
        return bytes(flipped)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._plugged.set()
        self._server.close()
        self.drop()


def _kind(header: bytes) -> str:
    """Return the kind of message to which a header belongs, or an empty string if there is none."""
    _, found, rest = header.partition(b"\xa4kind")
    return rest[1 : 1 + (rest[0] & 0x1F)].decode() if found and rest else ""


def _later(delay_s: float, sink: socket.socket, data: bytes, turn: threading.Lock) -> None:
    timer = threading.Timer(delay_s, _send, args=(sink, data, turn))
    timer.daemon = True
    timer.start()


def _send(sink: socket.socket, data: bytes, turn: threading.Lock) -> None:
    """Send data in one piece. Messages to a closed socket are lost."""
    if not data:
        return
    with turn, contextlib.suppress(OSError):
        sink.sendall(data)
