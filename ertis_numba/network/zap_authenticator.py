"""Who is let in: the keys of connections, and whose message it is.

ZeroMQ asks over ZAP (RFC 27) about each key that wants in. CURVE without anybody who answers lets any key in, and a
handler that has died nobody, or everybody: the one here is served by the loop that serves the sockets, so that it lives
as long as they do, and whatever goes wrong in it is a no.
"""

import secrets
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Final

import zmq
from zmq.utils import z85
from zmq.utils.monitor import parse_monitor_message

from ertis_numba.errors import ArgumentError, NetworkError, SettingsError
from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.keys import ServerKeys
from ertis_numba.network.own_files import require_own
from ertis_numba.network.sockets import DOMAIN, HandshakeMonitor, was_chosen

__all__ = ["EVERYBODY", "ZapAuthenticator"]

EVERYBODY: Final = Permission(name="loopback", public="0" * 40, role="admin")
"""Where there are no keys, which is on loopback only."""

_ADDRESS: Final = "inproc://zeromq.zap.01"  # RFC 27
_LOOK_S: Final = 0.25
_AT_ONCE: Final = 64
_LIST_BYTES: Final = 4_000_000
_SELF_TEST_S: Final = 3.0
_NO_KEY, _UNKNOWN_KEY = "no key", "unknown key"
_SUCCEEDED: Final = int(zmq.EVENT_HANDSHAKE_SUCCEEDED)
_PROTOCOL: Final = int(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL)
_NO_DETAIL: Final = int(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL)
_AUTH: Final = int(zmq.EVENT_HANDSHAKE_FAILED_AUTH)


class ZapAuthenticator:
    """Lets in the keys that are listed, and says whose a message is.

    ::

        gate = Gate(context, keys)                      # before any server
        socket = sockets.server(context, address, keys=keys)
        gate.watch(socket)                              # counts what never came to show a key
        gate.self_test(sockets.bound(socket))
        # in the loop: gate.serve() when gate.socket can be read; gate.tick() some times a second;
        # gate.who(frames) of each message.

    Parameters
    ----------
    context : zmq.Context
    keys : ServerKeys or None
        None where nodes have no keys; then everybody may do everything.

    Attributes
    ----------
    socket : zmq.Socket or None
        To be polled.
    refused : Counter of str
        By reason: who was not let in, and messages of those who may not send them, which callers add.
    note : str
        Why the list of keys cannot be used, so that nobody is let in; empty where it can.

    Raises
    ------
    SettingsError
        The list of keys cannot be read or used.
    ArgumentError
        There is a gate in this context already.
    """

    def __init__(self, context: "zmq.Context[zmq.Socket[bytes]]", keys: ServerKeys | None) -> None:
        self.socket: zmq.Socket[bytes] | None = None
        self.refused: Counter[str] = Counter()
        self._keys = keys
        self._handshakes: list[HandshakeMonitor] = []
        self._allowed: dict[str, Permission] = {}
        self._text: bytes | None = None
        self._next_look_s = 0.0
        self._changed = self._doubted = False
        # A User-Id that did not come from here, whoever may have found a way to send one, is nobody's.
        self._mark = secrets.token_hex(16)
        self.note = ""
        if keys is None:
            return
        self._look()
        self._changed = False
        if self.note:
            raise SettingsError(self.note)
        self.socket = context.socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.LINGER, 0)
        try:
            self.socket.bind(_ADDRESS)
        except zmq.ZMQError as error:
            self.close()
            raise ArgumentError("a context has a gate already; make one for each") from error

    def watch(self, server: "zmq.Socket[bytes]") -> None:
        """Count also those whom a server turns away before they have shown a key."""
        self._handshakes.append(HandshakeMonitor(server))

    def serve(self) -> None:
        """Answer those who want in; never raises for what they send."""
        if self.socket is None:
            return
        for _ in range(_AT_ONCE):
            try:
                request = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            # Routing id, delimiter, version, request, domain, address, identity, mechanism, credentials.
            if len(request) < 4 or request[1] != b"":
                continue  # nothing that could be answered: whoever it is, waits in vain
            try:
                user, reason = self._decide(request[2:])
            except Exception as error:  # noqa: BLE001  whatever it is, the answer is no
                user, reason = "", f"gate: {type(error).__name__}"
            status, text = (b"200", b"OK") if user else (b"400", b"NO ACCESS")
            if not user:
                self.refused[reason] += 1
            with suppress(zmq.ZMQError):  # who asked may be gone
                self.socket.send_multipart([*request[:2], b"1.0", request[3], status, text, user.encode(), b""])

    def _decide(self, request: Sequence[bytes]) -> tuple[str, str]:
        """Return the User-Id of who is let in, or nothing and why."""
        version, _, domain, _, _, mechanism, *credentials = request
        if version != b"1.0" or domain != DOMAIN or mechanism != b"CURVE":
            return "", _NO_KEY
        (key,) = credentials
        self._look()
        permission = self._allowed.get(z85.encode(key).decode())
        return (self._mark + permission.public, "") if permission else ("", _UNKNOWN_KEY)

    def who(self, frames: Sequence[zmq.Frame]) -> Permission | None:
        """Return what the sender of a message may do by the list as it is now; None, and counted, if nothing.

        Parameters
        ----------
        frames : sequence of zmq.Frame
            As received from a ROUTER without copying: the routing id, then the message.
        """
        if not frames or was_chosen(frames[0].bytes):
            self.refused["chosen routing id"] += 1
            return None
        if self._keys is None:
            return EVERYBODY
        try:
            user = str(frames[-1].get("User-Id"))
        except zmq.ZMQError:
            user = ""
        if not user.startswith(self._mark):
            self.refused[_NO_KEY] += 1
            return None
        self._look()
        permission = self._allowed.get(user.removeprefix(self._mark))
        if permission is None:
            self.refused["removed key"] += 1
        return permission

    def tick(self) -> bool:
        """Look at the list again, and count who was turned away; True if the list has changed since it last was."""
        for handshakes in self._handshakes:
            if found := handshakes.read():
                self.refused[_NO_KEY] += found
        self._look()
        changed, self._changed = self._changed, False
        return changed

    def _look(self) -> None:
        """Read the list if it is time; nobody is in one that cannot be read, twice as an editor may be writing it."""
        now_s = time.monotonic()
        if self._keys is None or now_s < self._next_look_s:
            return
        path, before, self._next_look_s = self._keys.allow, self._allowed, now_s + _LOOK_S
        try:
            text = _read(path)
            if text == self._text:
                self._doubted = False
                return
            listed = AllowList.from_toml(text.decode("utf-8-sig"), str(path))
            self._allowed = {permission.public: permission for permission in listed.keys}
            self._text, self.note, self._doubted = text, "", False
        except Exception as error:  # noqa: BLE001  whatever it is, nobody is let in
            if self._text is not None and not self._doubted:
                self._doubted = True
                return
            self._allowed, self._text, self._doubted = {}, None, False
            self.note = str(error) if isinstance(error, SettingsError) else f"{path}: {error}; correct the list of keys"
        self._changed = self._changed or self._allowed != before

    def self_test(self, endpoint: str) -> None:
        """Try to get in with a key that nobody knows and without any, and see that it fails.

        Parameters
        ----------
        endpoint : str
            Where a server of this context listens.

        Raises
        ------
        NetworkError
            It does not fail, or nothing answers.
        """
        if self._keys is None:
            return
        self._try(endpoint, _NO_KEY)
        self._try(endpoint, _UNKNOWN_KEY)

    def _try(self, endpoint: str, reason: str) -> None:
        """See that an attempt to get in fails as it should; it is not counted."""
        unknown = reason == _UNKNOWN_KEY
        before, reported, end_s = self.refused.copy(), False, time.monotonic() + _SELF_TEST_S
        if not unknown:
            for handshakes in self._handshakes:
                handshakes.discount()
        with zmq.Context(io_threads=1) as context, context.socket(zmq.DEALER) as stranger:
            stranger.setsockopt(zmq.LINGER, 0)
            stranger.setsockopt(zmq.RECONNECT_IVL, -1)  # once: what the server counts of it is to be taken back
            stranger.setsockopt(zmq.IPV6, int("[" in endpoint))
            if unknown and self._keys is not None:
                stranger.curve_publickey, stranger.curve_secretkey = zmq.curve_keypair()
                stranger.curve_serverkey = self._keys.pair.public.encode()
            with stranger.get_monitor_socket(_SUCCEEDED | _AUTH | _PROTOCOL | _NO_DETAIL) as monitor:
                stranger.connect(endpoint)
                while time.monotonic() < end_s:
                    monitor.poll(2)
                    self.serve()
                    self.tick()
                    while monitor.poll(0):
                        event = int(parse_monitor_message(monitor.recv_multipart())["event"])
                        if event == _SUCCEEDED:
                            raise NetworkError(f"{endpoint} lets in a node with {reason}; do not use this installation")
                        # Who finds first that only one has keys hangs up on the other.
                        reported = reported or event in ((_AUTH,) if unknown else (_PROTOCOL, _NO_DETAIL))
                    if reported and not unknown:
                        return
                    if reported and self.refused[reason] > before[reason]:
                        self.refused.subtract([reason])
                        self.refused += Counter()  # without zeros
                        return
        raise NetworkError(
            f"{endpoint} did not refuse a node with {reason} within {_SELF_TEST_S:g} s; start it when the machine is "
            "less busy"
        )

    def close(self) -> None:
        """Let nobody in any more; close it before the sockets that it watches."""
        for handshakes in self._handshakes:
            handshakes.close()
        self._handshakes.clear()
        if self.socket is not None:
            self.socket.close(linger=0)
            self.socket = None


def _read(path: Path) -> bytes:
    require_own(path)
    with path.open("rb") as file:
        text = file.read(_LIST_BYTES + 1)
    if len(text) > _LIST_BYTES:
        raise SettingsError(f"{path} has more than {_LIST_BYTES // 1_000_000} MB; give the list of keys")
    return text
