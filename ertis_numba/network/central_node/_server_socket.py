"""Where a central node hears others and answers them: its socket, and the gate that knows who they are."""

from collections import Counter
from collections.abc import Mapping
from collections.abc import Set as AbstractSet
from contextlib import ExitStack, suppress
from typing import Any, Final

import zmq

from ertis_numba.network import messages, sockets
from ertis_numba.network.allow_list import Permission
from ertis_numba.network.keys import ServerKeys
from ertis_numba.network.messages import Message
from ertis_numba.network.zap_authenticator import ZapAuthenticator

__all__ = ["ServerSocket"]

_FRAMES: Final = 4  # of a message, that are looked at
_LINGER_MS: Final = 500


class ServerSocket:
    """Hears whoever is listed, and waits for nobody.

    Parameters
    ----------
    keys : ServerKeys or None

    Attributes
    ----------
    address : str
        Where it listens, as nodes of this machine connect to it.
    """

    def __init__(self, keys: ServerKeys | None) -> None:
        self._keys = keys
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._socket: zmq.Socket[bytes] | None = None
        self._authenticator: ZapAuthenticator | None = None
        self._last_refused: Counter[str] = Counter()  # once the gate is closed
        self._badges: dict[bytes, list[zmq.Frame]] = {}  # by which peers are looked up again
        self.address = ""

    @property
    def is_open(self) -> bool:
        """Whether anybody can be heard."""
        return self._socket is not None

    @property
    def refused(self) -> Counter[str]:
        """What was refused, by reason; whoever refuses something adds it."""
        return self._last_refused if self._authenticator is None else self._authenticator.refused

    @property
    def note(self) -> str:
        """Why the list of keys cannot be used; empty where it can."""
        return "" if self._authenticator is None else self._authenticator.note

    def open(self, listen: str, *, max_bytes: int) -> None:
        """Listen at an address; raises what `sockets.server` and `ZapAuthenticator.self_test` do."""
        self._context = zmq.Context()
        self._authenticator = ZapAuthenticator(self._context, self._keys)
        self._socket = sockets.server(self._context, listen, keys=self._keys, max_bytes=max_bytes)
        self._authenticator.watch(self._socket)
        self.address = sockets.bound(self._socket)
        self._authenticator.self_test(self.address)

    def close(self) -> None:
        """Hear nobody any more; closing twice does no harm."""
        gate, socket, context = self._authenticator, self._socket, self._context
        with ExitStack() as stack:  # whatever fails, the rest is closed
            if context is not None:
                stack.callback(context.destroy, linger=0)
            if socket is not None:
                stack.callback(socket.close, linger=_LINGER_MS)  # the last acks
            if gate is not None:
                self._last_refused = gate.refused
                stack.callback(gate.close)
            self._authenticator = self._socket = self._context = None

    def register(self, poller: zmq.Poller) -> None:
        """Have it polled."""
        if self._socket is not None:
            poller.register(self._socket, zmq.POLLIN)
        if self._authenticator is not None and self._authenticator.socket is not None:
            poller.register(self._authenticator.socket, zmq.POLLIN)

    def serve(self, ready: Mapping[Any, int]) -> bool:
        """Let in who asks for it, and return whether there are messages."""
        if self._authenticator is not None and self._authenticator.socket in ready:
            self._authenticator.serve()
        return self._socket in ready

    def receive(self) -> list[zmq.Frame] | None:
        """Return the frames of a message, the first of them if there are too many; None if there is no message."""
        if self._socket is None:
            return None
        try:
            frames = [self._socket.recv(zmq.NOBLOCK, copy=False)]
        except zmq.Again:
            return None
        while frames[-1].more:
            frame = self._socket.recv(zmq.NOBLOCK, copy=False)
            if len(frames) < _FRAMES:
                frames.append(frame)
            else:
                frames[-1] = frame
        return frames

    def who(self, frames: list[zmq.Frame]) -> Permission | None:
        """Return what the sender of a message may do; None if it is not listed, which is counted."""
        return None if self._authenticator is None else self._authenticator.who(frames)

    def keep_badge(self, frames: list[zmq.Frame]) -> None:
        """Remember by what a peer was known, to look whether it still is."""
        self._badges[frames[0].bytes] = frames[:2]

    def tick(self, peers: AbstractSet[bytes]) -> list[bytes]:
        """Look at the list of keys, and return those of the peers who are not on it any more."""
        for peer_id in self._badges.keys() - peers:
            del self._badges[peer_id]
        gate = self._authenticator
        if gate is None or not gate.tick():
            return []
        return [peer_id for peer_id, frames in self._badges.items() if gate.who(frames) is None]

    def send(self, peer_id: bytes, message: Message, *payload: bytes) -> None:
        """Send something if that is possible at once: whatever matters is said again."""
        if self._socket is None:
            return
        parts = [peer_id, messages.encode(message), *payload]
        with suppress(zmq.ZMQError):  # the peer is gone, or does not read
            try:
                self._socket.send_multipart(parts, zmq.NOBLOCK)
            except zmq.Again:
                self._socket.getsockopt(zmq.EVENTS)  # sees now what the peer has read, or only some milliseconds later
                self._socket.send_multipart(parts, zmq.NOBLOCK)
