"""Sockets as all nodes make them, and what is told of connections that come to nothing."""

import secrets
import socket as names
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Final

import zmq
from zmq.utils.monitor import parse_monitor_message

from ertis_numba.errors import NetworkError
from ertis_numba.network import addresses
from ertis_numba.network.keys import ClientKeys, ServerKeys

__all__ = ["DOMAIN", "MAX_BYTES", "HandshakeMonitor", "Monitor", "bound", "client", "server", "was_chosen"]

MAX_BYTES: Final = 16 * 2**20
DOMAIN: Final = b"ertis"
"""What connections are let into, as ZAP (ZeroMQ RFC 27) names it."""

_HIGH_WATER = 8  # messages, per peer and direction
_SPARE_BYTES = 256  # what CURVE adds to a frame, and more
_HANDSHAKE_MS = 3000
_LONGEST_HANDSHAKE_S = 1e-3 * _HANDSHAKE_MS + 1.0  # and the time until its end is reported
_SEND_TIMEOUT_MS = 30_000  # without it, TCP repeats what nobody confirms for a quarter of an hour
_RECONNECT_MS, _MAX_RECONNECT_MS = 100, 1000
_BACKLOG = 512
_DESCRIPTORS = 8192
_NO_ACCESS = 400  # of ZAP
_HUNG_UP = (
    "the central node hung up before anything was said; if it wants a key, give --key and --server-key",
    "the central node hung up: it has another key than --server-key says, or none; give what it has",
)
_DISAGREE = (
    "the central node wants a key; give --key and --server-key",
    "the central node speaks without keys; start it with keys, or leave --key out",
)
_CLIENT_EVENTS = (
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
# Without EVENT_HANDSHAKE_FAILED_PROTOCOL: libzmq 4.3.5 loses errno while it sends that event, and then keeps a
# connection for ever whose message cannot be decrypted, instead of closing it.
_SERVER_EVENTS = (
    zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_HANDSHAKE_FAILED_AUTH
)
_EVENTS_KEPT = 20_000  # an I/O thread that finds more of them waits for them to be read
_ALL = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}  # noqa: S104  to be told from others


def server(
    context: "zmq.Context[zmq.Socket[bytes]]",
    endpoint: str,
    *,
    keys: ServerKeys | None,
    max_bytes: int = MAX_BYTES,
    option: str = "--listen",
) -> "zmq.Socket[bytes]":
    """Return a ROUTER that listens; with keys, its context needs a `ertis_numba.network.zap_authenticator.Gate` made before.

    Parameters
    ----------
    context : zmq.Context
    endpoint : str
    keys : ServerKeys or None
        None on loopback only.
    max_bytes : int
        Longest frame. It also bounds what a stranger can have this node keep, so give what is needed.
    option : str
        By which users give the address.

    Raises
    ------
    ArgumentError
        The address cannot be used, or not without keys.
    NetworkError
        It cannot be listened at.
    """
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
            made.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)  # without it, no handler would mean no check
        made.bind(_own(endpoint))
    except (zmq.ZMQError, OSError) as error:
        made.close(linger=0)
        if isinstance(error, zmq.ZMQError) and error.errno == zmq.EADDRINUSE:
            raise NetworkError(
                f"{endpoint} cannot be listened at, it is taken by another program; end that or give another {option}"
            ) from error
        raise NetworkError(f"{endpoint} cannot be listened at ({error}); give another {option}") from error
    except BaseException:
        made.close(linger=0)
        raise
    return made


def bound(socket: "zmq.Socket[bytes]") -> str:
    """Return where a server listens, as clients of this machine connect to it."""
    at = str(socket.getsockopt_string(zmq.LAST_ENDPOINT))
    host = addresses.host_of(at)
    return f"tcp://{_ALL[host]}:{at.rpartition(':')[2]}" if host in _ALL else at


def client(
    context: "zmq.Context[zmq.Socket[bytes]]", endpoint: str, *, keys: ClientKeys | None, max_bytes: int = MAX_BYTES
) -> "zmq.Socket[bytes]":
    """Return a DEALER that connects, and connects again after a connection was lost; a `Monitor` of it knows why.

    It does not after a server has refused it: who wants to try again makes a new one.

    Parameters
    ----------
    context : zmq.Context
    endpoint : str
    keys : ClientKeys or None
        None on loopback only.
    max_bytes : int
        Longest frame.

    Raises
    ------
    ArgumentError
        The address cannot be used, or not without keys.
    NetworkError
        It cannot be connected to, ever.
    """
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
        made.get_monitor_socket(_CLIENT_EVENTS)  # before there is anything to tell
        made.connect(endpoint)
    except zmq.ZMQError as error:
        Monitor(made).close()
        made.close(linger=0)
        raise NetworkError(f"{endpoint} cannot be connected to ({error}); give another address") from error
    except BaseException:
        Monitor(made).close()
        made.close(linger=0)
        raise
    return made


def was_chosen(routing_id: bytes) -> bool:
    """Whether a peer has given itself its routing id, which it then could give to another, too."""
    return not routing_id.startswith(b"\0")


class _Events:
    """Events of a socket's connections."""

    def __init__(self, watched: "zmq.Socket[bytes]", socket: "zmq.Socket[bytes]") -> None:
        self._watched, self.socket = watched, socket

    def _events(self) -> Iterator[tuple[int, int]]:
        """Yield event and value of what has happened since."""
        while True:
            try:
                frames = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            event = parse_monitor_message(frames)
            yield int(event["event"]), int(event["value"])

    def close(self) -> None:
        """End it; close it before the socket that it watches."""
        with suppress(zmq.ZMQError):  # which may be closed already
            self._watched.disable_monitor()
        self.socket.close(linger=0)


class Monitor(_Events):
    """Says why a client's connection comes to nothing.

    Attributes
    ----------
    socket : zmq.Socket
        To be polled; `read` when it can be read.
    final : bool
        The client has given up: only a new socket tries again.
    """

    def __init__(self, client: "zmq.Socket[bytes]") -> None:
        # `client` has made the monitor before it connected: a refusal may come at once.
        super().__init__(client, client.get_monitor_socket(_CLIENT_EVENTS))
        self.final = False

    def read(self) -> list[str]:
        """Return what went wrong since, each once, as lines."""
        return list(dict.fromkeys(self._reported(event, value) for event, value in self._events()))

    def _reported(self, event: int, value: int) -> str:
        with_keys = self._watched.getsockopt(zmq.MECHANISM) == zmq.CURVE
        if event == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            self.final = True
            if value != _NO_ACCESS:
                return f"the central node cannot check keys now (status {value}); look at its log"
            return "the central node does not know this key; have it listed there by 'ertis keys allow'"
        if event == zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL:
            return _HUNG_UP[with_keys]
        self.final = True
        if value == zmq.PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH:
            return _DISAGREE[with_keys]
        return "what answers does not speak this protocol; give the address of a central node"


class HandshakeMonitor(_Events):
    """Counter of connections to a server that closed before the peer had presented a key.

    libzmq does not report which connection a finished handshake belongs to. A connection therefore counts only once the
    open connections younger than the longest handshake can no longer account for the missing handshakes.
    """

    def __init__(self, server: "zmq.Socket[bytes]") -> None:
        super().__init__(server, _server_monitor(server))
        self._open: dict[int, float] = {}  # when each connection was accepted, by descriptor
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
            else:  # the peer was let in, or its key was refused
                self._n_unfinished -= 1
        n_shaking_hands = sum(now_s - accepted_s < _LONGEST_HANDSHAKE_S for accepted_s in self._open.values())
        found = max(0, self._n_unfinished - n_shaking_hands - self._n_counted)
        self._n_counted += found
        return found

    def discount(self) -> None:
        """Leave out one connection that fails: that of the server's own self-test."""
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
    """Set what clients and servers have in common."""
    options = {
        zmq.SNDHWM: _HIGH_WATER,
        zmq.RCVHWM: _HIGH_WATER,
        zmq.MAXMSGSIZE: max_bytes + _SPARE_BYTES,
        zmq.LINGER: 0,
        zmq.HANDSHAKE_IVL: _HANDSHAKE_MS,
        # libzmq 4.3.5 aborts the process when a heartbeat is due on a connection that was closed while its messages
        # waited to be read. Nodes ping each other, and TCP finds peers that are gone.
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
    """Have this process accept more connections than strangers are likely to make.

    At the usual 1024, a thousand that say nothing would keep everybody else out until they are hung up on.
    """
    if sys.platform == "win32":
        return
    import resource  # noqa: PLC0415  it is not there on Windows

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _DESCRIPTORS if hard == resource.RLIM_INFINITY else min(_DESCRIPTORS, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _own(endpoint: str) -> str:
    """Return an address to listen at, of which ZeroMQ wants the host as a number."""
    host, port = addresses.host_of(endpoint), endpoint.rpartition(":")[2]
    if host == "*" or ":" in host:
        return endpoint
    if host == "localhost":  # whatever else a file of hosts may say
        return f"tcp://127.0.0.1:{port}"
    found = names.getaddrinfo(host, None, names.AF_INET, names.SOCK_STREAM)
    return f"tcp://{found[0][4][0]}:{port}"
