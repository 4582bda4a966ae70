"""Sockets of all nodes, and monitors of failed connections."""

import secrets
import socket as names
import struct
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from typing import Final

import zmq

from ertis_numba.base.errors import NetworkError
from ertis_numba.network import addresses
from ertis_numba.network.keys import ClientKeys, ServerKeys

__all__ = [
    "DOMAIN",
    "MAX_BYTES",
    "HandshakeMonitor",
    "Monitor",
    "bound",
    "client",
    "is_readable",
    "monitor_event",
    "server",
    "was_chosen",
]

MAX_BYTES: Final = 16 * 2**20
DOMAIN: Final = b"ertis"
"""ZAP domain (ZeroMQ RFC 27) of all connections."""

_HIGH_WATER = 8  # Limit on queued messages, per peer and direction.
_SPARE_BYTES = 256  # More than CURVE adds to a frame.
_HANDSHAKE_MS = 3000
_LONGEST_HANDSHAKE_S = 1e-3 * _HANDSHAKE_MS + 1.0  # Includes the time until its end is reported.
_SEND_TIMEOUT_MS = 30_000  # Without it, TCP resends unacknowledged data for a quarter of an hour.
_RECONNECT_MS, _MAX_RECONNECT_MS = 100, 1000
_BACKLOG = 512
_DESCRIPTORS = 8192
_NO_ACCESS = 400  # Status code of ZAP.
_HUNG_UP = (
    "the central node closed the connection before the handshake; if it requires a key, set one (keys)",
    "the central node closed the connection: its key is not the expected one, or it has none; pass its key (server)",
)
_DISAGREE = (
    "the central node requires a key; set one (keys)",
    "the central node has no keys; start it with keys, or connect without one (keys)",
)
_CLIENT_EVENTS = (
    zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
# EVENT_HANDSHAKE_FAILED_PROTOCOL is excluded: libzmq 4.3.5 loses errno while it sends that event. It then keeps
# a connection with an undecipherable message for ever, instead of closing it.
_SERVER_EVENTS = (
    zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
_READABLE = int(zmq.POLLIN)  # Operations with the enumeration itself take ten times as long.
_EVENTS_KEPT = 20_000  # An I/O thread with more events waits until they are read.
_ALL = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}  # noqa: S104  to be told from others


def server(
    context: "zmq.Context[zmq.Socket[bytes]]",
    endpoint: str,
    *,
    keys: ServerKeys | None,
    max_bytes: int = MAX_BYTES,
    option: str = "--listen",
) -> "zmq.Socket[bytes]":
    """Return a listening ROUTER; on loopback only without keys; raise NetworkError if the address is in use."""
    # With keys, its context needs a `ZapAuthenticator`. `max_bytes` bounds the memory that an unknown peer can occupy.
    endpoint = addresses.endpoint(endpoint)
    addresses.require_keys(endpoint, keys=keys)
    _allow_descriptors()
    made = context.socket(zmq.ROUTER)
    try:
        _set(made, endpoint, max_bytes)
        made.setsockopt(zmq.ROUTER_MANDATORY, 1)
        made.setsockopt(zmq.BACKLOG, _BACKLOG)
        if keys is not None:
            made.setsockopt(zmq.CURVE_SERVER, 1)
            made.setsockopt(zmq.CURVE_SECRETKEY, keys.pair.secret.encode())
            made.setsockopt(zmq.ZAP_DOMAIN, DOMAIN)
            made.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)  # Without it, a missing handler would mean no check.
        made.bind(_own(endpoint))
    except (zmq.ZMQError, OSError) as error:
        made.close(linger=0)
        if isinstance(error, zmq.ZMQError) and error.errno == zmq.EADDRINUSE:
            raise NetworkError(
                f"{endpoint} is in use by another program; end that program or choose another {option}"
            ) from error
        raise NetworkError(f"cannot listen at {endpoint} ({error}); choose another {option}") from error
    except BaseException:
        made.close(linger=0)
        raise
    return made


def bound(socket: "zmq.Socket[bytes]") -> str:
    """Return the address of a server, as clients on this machine connect to it."""
    at = str(socket.getsockopt_string(zmq.LAST_ENDPOINT))
    host = addresses.host_of(at)
    return f"tcp://{_ALL[host]}:{at.rpartition(':')[2]}" if host in _ALL else at


def client(
    context: "zmq.Context[zmq.Socket[bytes]]", endpoint: str, *, keys: ClientKeys | None, max_bytes: int = MAX_BYTES
) -> "zmq.Socket[bytes]":
    """Return a DEALER that reconnects, but not after a refusal, which a `Monitor` of it reports."""
    # Without `keys`, it connects on loopback only. Raises NetworkError if the address can never be connected to.
    endpoint = addresses.endpoint(endpoint)
    addresses.require_keys(endpoint, keys=keys)
    made = context.socket(zmq.DEALER)
    try:
        _set(made, endpoint, max_bytes)
        made.setsockopt(zmq.IMMEDIATE, 1)
        made.setsockopt(zmq.RECONNECT_IVL, _RECONNECT_MS)
        made.setsockopt(zmq.RECONNECT_IVL_MAX, _MAX_RECONNECT_MS)
        if keys is not None:
            made.setsockopt(zmq.CURVE_SERVERKEY, keys.server.encode())
            made.setsockopt(zmq.CURVE_PUBLICKEY, keys.pair.public.encode())
            made.setsockopt(zmq.CURVE_SECRETKEY, keys.pair.secret.encode())
        made.get_monitor_socket(_CLIENT_EVENTS)  # The monitor must exist before the first event.
        made.connect(endpoint)
    except zmq.ZMQError as error:
        Monitor(made).close()
        made.close(linger=0)
        raise NetworkError(f"cannot connect to {endpoint} ({error}); choose another address") from error
    except BaseException:
        Monitor(made).close()
        made.close(linger=0)
        raise
    return made


def is_readable(socket: "zmq.Socket[bytes]") -> bool:
    """Return True if a message can be received. This is faster than the exception of an attempt without a message."""
    return bool(int(socket.getsockopt(zmq.EVENTS)) & _READABLE)


def was_chosen(routing_id: bytes) -> bool:
    """Return True if a peer has chosen its own routing id, which another peer could choose, too."""
    return not routing_id.startswith(b"\0")


def monitor_event(frames: Sequence[bytes]) -> tuple[int, int]:
    """Return event and value of a message from a monitor socket."""
    # `zmq.utils.monitor` does the same, but loads asyncio.
    event, value = struct.unpack("=hi", frames[0])  # A 16-bit event and a 32-bit value, without padding.
    return event, value


class _Events:
    """Connection events of a socket."""

    def __init__(self, watched: "zmq.Socket[bytes]", socket: "zmq.Socket[bytes]") -> None:
        self._watched, self.socket = watched, socket

    def _events(self) -> Iterator[tuple[int, int]]:
        """Yield event and value of all new events."""
        while is_readable(self.socket):
            yield monitor_event(self.socket.recv_multipart(zmq.NOBLOCK))

    def close(self) -> None:
        """Close the monitor; close it before its socket."""
        with suppress(zmq.ZMQError):  # The socket may be closed already.
            self._watched.disable_monitor()
        self.socket.close(linger=0)


class Monitor(_Events):
    """Monitor of a client's failed and interrupted connections: `read` its readable socket."""

    def __init__(self, client: "zmq.Socket[bytes]") -> None:
        # `client` has made the monitor before it connected: a refusal may come at once.
        super().__init__(client, client.get_monitor_socket(_CLIENT_EVENTS))
        self.final = False
        self.n_disconnections = 0

    def read(self) -> list[str]:
        """Return new failures as lines, each once."""
        failures = []
        for event, value in self._events():
            if event == zmq.EVENT_DISCONNECTED:
                self.n_disconnections += 1
            else:
                failures.append(self._reported(event, value))
        return list(dict.fromkeys(failures))

    def _reported(self, event: int, value: int) -> str:
        with_keys = self._watched.getsockopt(zmq.MECHANISM) == zmq.CURVE
        if event == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            self.final = True
            if value != _NO_ACCESS:
                return f"the central node cannot check keys now (status {value}); see its log"
            return "the central node does not know this key; add it there with 'ertis keys allow'"
        if event == zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL:
            return _HUNG_UP[with_keys]
        self.final = True
        if value == zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH:
            return _DISAGREE[with_keys]
        return "the peer does not use this protocol; choose the address of a central node"


class HandshakeMonitor(_Events):
    """Counter of connections to a server that closed before the peer had presented a key."""

    # libzmq does not report whose handshake finished: a connection counts once younger ones cannot account for it.

    def __init__(self, server: "zmq.Socket[bytes]") -> None:
        super().__init__(server, _server_monitor(server))
        self._open: dict[int, float] = {}  # Time of acceptance of each connection, by descriptor.
        self._n_unfinished = self._n_counted = 0

    def read(self) -> int:
        """Return the number of connections turned away since the last call."""
        now_s = time.monotonic()
        for event, value in self._events():
            if event == zmq.EVENT_ACCEPTED:
                self._open[value] = now_s
                self._n_unfinished += 1
            elif event == zmq.EVENT_DISCONNECTED:
                self._open.pop(value, None)
            else:  # The peer was accepted, or its key was refused.
                self._n_unfinished -= 1
        n_shaking_hands = sum(now_s - accepted_s < _LONGEST_HANDSHAKE_S for accepted_s in self._open.values())
        found = max(0, self._n_unfinished - n_shaking_hands - self._n_counted)
        self._n_counted += found
        return found

    def discount(self) -> None:
        """Exclude one failed connection: that of the server's own self-test."""
        self._n_counted += 1


def _server_monitor(server: "zmq.Socket[bytes]") -> "zmq.Socket[bytes]":
    """Return a socket that receives the events of a server."""
    address = f"inproc://connections.{secrets.token_hex(8)}"
    server.monitor(address, _SERVER_EVENTS)
    made: zmq.Socket[bytes] = server.context.socket(zmq.PAIR)
    made.setsockopt(zmq.LINGER, 0)
    made.setsockopt(zmq.RCVHWM, _EVENTS_KEPT)
    made.connect(address)
    return made


def _set(socket: "zmq.Socket[bytes]", endpoint: str, max_bytes: int) -> None:
    """Set the options of both clients and servers."""
    options = {
        zmq.SNDHWM: _HIGH_WATER,
        zmq.RCVHWM: _HIGH_WATER,
        zmq.MAXMSGSIZE: max_bytes + _SPARE_BYTES,
        zmq.LINGER: 0,
        zmq.HANDSHAKE_IVL: _HANDSHAKE_MS,
        # libzmq 4.3.5 aborts the process if a heartbeat is due on a closed connection with unread messages. The nodes
        # send their own pings, and TCP detects lost peers.
        zmq.HEARTBEAT_IVL: 0,
        zmq.TCP_MAXRT: _SEND_TIMEOUT_MS,
        zmq.TCP_KEEPALIVE: 1,
        zmq.TCP_KEEPALIVE_IDLE: 10,
        zmq.TCP_KEEPALIVE_INTVL: 5,
        zmq.TCP_KEEPALIVE_CNT: 3,
        zmq.IPV6: int(":" in addresses.host_of(endpoint)),
    }
    for option, value in options.items():
        socket.setsockopt(option, value)


def _allow_descriptors() -> None:
    """Let this process accept more connections than unauthenticated peers are likely to open.

    At the usual limit of 1024, a thousand silent connections would block all others until their timeout.
    """
    if sys.platform == "win32":
        return
    import resource  # noqa: PLC0415  it is not there on Windows

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(_DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _own(endpoint: str) -> str:
    """Return an address to listen at, with the numeric host that ZeroMQ requires."""
    host, port = addresses.host_of(endpoint), endpoint.rpartition(":")[2]
    if host == "*" or ":" in host:
        return endpoint
    if host == "localhost":  # The file of hosts may map it elsewhere.
        return f"tcp://127.0.0.1:{port}"
    found = names.getaddrinfo(host, None, names.AF_INET, names.SOCK_STREAM)
    return f"tcp://{found[0][4][0]}:{port}"
