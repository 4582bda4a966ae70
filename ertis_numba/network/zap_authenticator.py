"""ZAP authenticator: checks the keys of connections, and attributes messages to keys.

ZeroMQ asks a handler over ZAP (RFC 27) about each new key; without one, CURVE accepts any key. This one runs in the
event loop of the sockets, and any error inside it refuses the key.
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

from ertis_numba.base.errors import ArgumentError, NetworkError, SettingsError
from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.keys import ServerKeys
from ertis_numba.network.private_files import require_own
from ertis_numba.network.sockets import DOMAIN, HandshakeMonitor, is_readable, monitor_event, was_chosen

__all__ = ["EVERYBODY", "ZapAuthenticator"]

EVERYBODY: Final = Permission(name="loopback", public="0" * 40, role="admin")
"""Permission of all peers without keys, on loopback only."""

_ADDRESS: Final = "inproc://zeromq.zap.01"  # Address of RFC 27.
_POLL_INTERVAL_S: Final = 0.25
_AT_ONCE: Final = 64
_LIST_BYTES: Final = 4_000_000
_SELF_TEST_S: Final = 10.0  # The test takes some milliseconds, but longer on a busy machine.
_NO_KEY, _UNKNOWN_KEY = "no key", "unknown key"
_SUCCEEDED: Final = int(zmq.EVENT_HANDSHAKE_SUCCEEDED)
_PROTOCOL: Final = int(zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL)
_NO_DETAIL: Final = int(zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL)
_AUTH: Final = int(zmq.EVENT_HANDSHAKE_FAILED_AUTH)


class ZapAuthenticator:
    """Handler that accepts listed keys and identifies the sender of a message.

    Make it before any server, `watch` each server, and call `self_test`; then `serve`, `tick` and `who`. Without
    ``keys``, every peer has all permissions. ``note`` is the error of the allow list, which keeps all nodes out.
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
        # A forged User-Id, however it was sent, has no permissions.
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
            raise ArgumentError("the context has an authenticator already; create one per context") from error

    def watch(self, server: "zmq.Socket[bytes]") -> None:
        """Also count peers that a server turned away before they presented a key."""
        self._handshakes.append(HandshakeMonitor(server))

    def serve(self) -> None:
        """Answer pending requests; never raises for their content."""
        if self.socket is None:
            return
        for _ in range(_AT_ONCE):
            if not is_readable(self.socket):
                return
            request = self.socket.recv_multipart(zmq.NOBLOCK)
            # Routing id, delimiter, version, request, domain, address, identity, mechanism, credentials.
            if len(request) < 4 or request[1] != b"":
                continue  # It cannot be answered; the peer waits in vain.
            try:
                user, reason = self._decide(request[2:])
            except Exception as error:  # noqa: BLE001  whatever it is, the answer is no
                user, reason = "", f"gate: {type(error).__name__}"
            status, text = (b"200", b"OK") if user else (b"400", b"NO ACCESS")
            if not user:
                self.refused[reason] += 1
            with suppress(zmq.ZMQError):  # The peer may have disconnected.
                self.socket.send_multipart([*request[:2], b"1.0", request[3], status, text, user.encode(), b""])

    def _decide(self, request: Sequence[bytes]) -> tuple[str, str]:
        """Return the User-Id of an accepted key, or nothing and the reason."""
        version, _, domain, _, _, mechanism, *credentials = request
        if version != b"1.0" or domain != DOMAIN or mechanism != b"CURVE":
            return "", _NO_KEY
        (key,) = credentials
        self._look()
        permission = self._allowed.get(z85.encode(key).decode())
        return (self._mark + permission.public, "") if permission else ("", _UNKNOWN_KEY)

    def who(self, frames: Sequence[zmq.Frame]) -> Permission | None:
        """Return the permissions of the sender of uncopied ROUTER frames; None, and counted, without any."""
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
        """Reload the allow list, and count peers that were turned away; return True if the list has changed."""
        for handshakes in self._handshakes:
            if found := handshakes.read():
                self.refused[_NO_KEY] += found
        self._look()
        changed, self._changed = self._changed, False
        return changed

    def _look(self) -> None:
        """Read the list if due; refuse all keys if it fails twice, as an editor may be writing it."""
        now_s = time.monotonic()
        if self._keys is None or now_s < self._next_look_s:
            return
        path, before, self._next_look_s = self._keys.allow, self._allowed, now_s + _POLL_INTERVAL_S
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
            self.note = str(error) if isinstance(error, SettingsError) else f"{path}: {error}; correct the allow list"
        self._changed = self._changed or self._allowed != before

    def self_test(self, endpoint: str) -> None:
        """Raise NetworkError unless connections with an unknown key, and without a key, are refused."""
        if self._keys is None:
            return
        self._try(endpoint, _NO_KEY)
        self._try(endpoint, _UNKNOWN_KEY)

    def _try(self, endpoint: str, reason: str) -> None:
        """Verify that one attempt to connect is refused; it is not counted."""
        unknown = reason == _UNKNOWN_KEY
        before, reported, end_s = self.refused.copy(), False, time.monotonic() + _SELF_TEST_S
        if not unknown:
            for handshakes in self._handshakes:
                handshakes.discount()
        with zmq.Context(io_threads=1) as context, context.socket(zmq.DEALER) as stranger:
            stranger.setsockopt(zmq.LINGER, 0)
            # It connects once, so that the server's count can be corrected by one.
            stranger.setsockopt(zmq.RECONNECT_IVL, -1)
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
                        event, _ = monitor_event(monitor.recv_multipart())
                        if event == _SUCCEEDED:
                            raise NetworkError(f"{endpoint} accepts a node with {reason}; do not use this installation")
                        # Either side may detect first that only one has keys, and close the connection.
                        reported = reported or event in ((_AUTH,) if unknown else (_PROTOCOL, _NO_DETAIL))
                    if reported and not unknown:
                        return
                    if reported and self.refused[reason] > before[reason]:
                        self.refused.subtract([reason])
                        self.refused += Counter()  # Removes zeros.
                        return
        raise NetworkError(
            f"{endpoint} did not refuse a node with {reason} within {_SELF_TEST_S:g} s; start it when the "
            "machine is less busy"
        )

    def close(self) -> None:
        """Refuse all keys from now on; close it before its sockets."""
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
        raise SettingsError(f"{path} exceeds {_LIST_BYTES // 1_000_000} MB; use an allow list")
    return text
