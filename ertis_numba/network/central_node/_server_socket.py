"""Server socket of the central node with its authenticator."""

from collections import Counter
from collections.abc import Mapping, Set as AbstractSet
from contextlib import ExitStack
from typing import Any, Final

import zmq

from ertis_numba.network import messages, sockets
from ertis_numba.network.allow_list import Permission
from ertis_numba.network.keys import ServerKeys
from ertis_numba.network.messages import Message
from ertis_numba.network.zap_authenticator import ZapAuthenticator

__all__ = ["ServerSocket"]

_FRAMES: Final = 4  # Limit on frames per message.
_LINGER_MS: Final = 500


class ServerSocket:
    """Non-blocking socket for messages of listed keys, with its address as nodes on this machine use it."""

    def __init__(self, keys: ServerKeys | None) -> None:
        self._keys = keys
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._socket: zmq.Socket[bytes] | None = None
        self._authenticator: ZapAuthenticator | None = None
        self._last_refused: Counter[str] = Counter()  # Kept after the authenticator is closed.
        self._badges: dict[bytes, list[zmq.Frame]] = {}  # Frames by which the authenticator identifies peers later.
        self.address = ""

    @property
    def is_open(self) -> bool:
        """True if messages can be received."""
        return self._socket is not None

    @property
    def refused(self) -> Counter[str]:
        """Refusals by reason; every part that refuses something adds to it."""
        return self._last_refused if self._authenticator is None else self._authenticator.refused

    @property
    def note(self) -> str:
        """Error of the allow list; empty if the list can be used."""
        return "" if self._authenticator is None else self._authenticator.note

    def open(self, listen: str, *, max_bytes: int) -> None:
        """Listen at an address; raises the errors of `sockets.server` and `ZapAuthenticator.self_test`."""
        self._context = zmq.Context()
        self._authenticator = ZapAuthenticator(self._context, self._keys)
        self._socket = sockets.server(self._context, listen, keys=self._keys, max_bytes=max_bytes)
        self._authenticator.watch(self._socket)
        self.address = sockets.bound(self._socket)
        self._authenticator.self_test(self.address)

    def close(self) -> None:
        """Stop receiving; closing twice is harmless."""
        gate, socket, context = self._authenticator, self._socket, self._context
        with ExitStack() as stack:  # Any error leaves no part open.
            if context is not None:
                stack.callback(context.destroy, linger=0)
            if socket is not None:
                stack.callback(socket.close, linger=_LINGER_MS)  # Time for the last acks.
            if gate is not None:
                self._last_refused = gate.refused
                stack.callback(gate.close)
            self._authenticator = self._socket = self._context = None

    def register(self, poller: zmq.Poller) -> None:
        """Add the sockets to a poller."""
        if self._socket is not None:
            poller.register(self._socket, zmq.POLLIN)
        if self._authenticator is not None and self._authenticator.socket is not None:
            poller.register(self._authenticator.socket, zmq.POLLIN)

    def serve(self, ready: Mapping[Any, int]) -> bool:
        """Answer key requests, and return True if there are messages."""
        if self._authenticator is not None and self._authenticator.socket in ready:
            self._authenticator.serve()
        return self._socket in ready

    def receive(self) -> list[zmq.Frame] | None:
        """Return the frames of a message, the first of them if there are too many; None if there is no message."""
        if self._socket is None or not sockets.is_readable(self._socket):
            return None
        frames = [self._socket.recv(zmq.NOBLOCK, copy=False)]
        while frames[-1].more:
            frame = self._socket.recv(zmq.NOBLOCK, copy=False)
            if len(frames) < _FRAMES:
                frames.append(frame)
            else:
                frames[-1] = frame
        return frames

    def who(self, frames: list[zmq.Frame]) -> Permission | None:
        """Return the permissions of a message's sender; None, and counted, if its key is not listed."""
        return None if self._authenticator is None else self._authenticator.who(frames)

    def keep_badge(self, frames: list[zmq.Frame]) -> None:
        """Keep a frame of a peer, to check its key again later."""
        self._badges[frames[0].bytes] = frames[:2]

    def tick(self, peers: AbstractSet[bytes]) -> list[bytes]:
        """Reload the allow list, and return the peers whose keys were removed."""
        for peer_id in self._badges.keys() - peers:
            del self._badges[peer_id]
        gate = self._authenticator
        if gate is None or not gate.tick():
            return []
        return [peer_id for peer_id, frames in self._badges.items() if gate.who(frames) is None]

    def send(self, peer_id: bytes, message: Message, *payload: bytes) -> bool:
        """Send without blocking, important messages repeatedly; return False if the peer is gone."""
        if self._socket is None:
            return True
        parts = [peer_id, messages.encode(message), *payload]
        try:
            try:
                self._socket.send_multipart(parts, zmq.NOBLOCK)
            except zmq.Again:
                # Otherwise the socket notices only milliseconds later which messages the peer has read.
                self._socket.getsockopt(zmq.EVENTS)
                self._socket.send_multipart(parts, zmq.NOBLOCK)
        except zmq.Again:  # The peer does not read.
            return True
        except zmq.ZMQError as error:
            return error.errno != zmq.EHOSTUNREACH
        else:
            return True
