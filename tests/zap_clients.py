"""A server socket with its ZAP authenticator, and clients that connect to it."""

import random
import time

import zmq

from ertis_numba.network import sockets
from ertis_numba.network.allow_list import AllowList, Permission
from ertis_numba.network.keys import ClientKeys, KeyPair, ServerKeys
from ertis_numba.network.zap_authenticator import ZapAuthenticator

CENTRAL, ROBOT, VIEWER, DESK, STRANGER = (
    KeyPair.new(name) for name in ("central", "robot", "viewer", "desk", "stranger")
)
LISTED = AllowList(
    keys=(
        Permission(name="robot", public=ROBOT.public, role="sensor", serials=("front", "left")),
        Permission(name="viewer", public=VIEWER.public, role="application"),
        Permission(name="desk", public=DESK.public, role="admin"),
    )
)
LOOPBACK = "tcp://127.0.0.1:*"
PATIENCE_S = 60.0  # timeout for events that must happen
MOMENT_S = 0.4  # wait for events that must not happen; a handshake takes a hundredth of this
_NOBODY = "tcp://127.0.0.1:1"


class Door:
    """A server socket and its ZAP authenticator in one loop, as in a central node, and clients that connect."""

    def __init__(self, folder, *, with_keys=True, gate=ZapAuthenticator, server_gate=True, max_bytes=sockets.MAX_BYTES):
        self.list = folder / "allow.toml"
        LISTED.save(self.list)
        self.keys = ServerKeys(CENTRAL, self.list) if with_keys else None
        self.context, self.outside = zmq.Context(), zmq.Context()
        self.gate = gate(self.context, self.keys if server_gate else None)
        self.server = sockets.server(self.context, LOOPBACK, keys=self.keys, max_bytes=max_bytes)
        self.gate.watch(self.server)
        self.address = sockets.bound(self.server)
        self.port = int(self.address.rpartition(":")[2])
        self.changed = 0  # number of reloads of the allow list
        self.came, self._clients, self._unsaid, self.monitors = [], [], [], {}

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.gate.close()
        for monitor in self.monitors.values():
            monitor.close()
        for client in self._clients:
            client.close(linger=0)
        self.server.close(linger=0)
        self.context.destroy(linger=0)  # also closes sockets that a failed test left open
        self.outside.destroy(linger=0)

    def turn(self):
        """Run one turn of the loop."""
        poller = zmq.Poller()
        for each in (self.server, self.gate.socket):
            if each is not None:
                poller.register(each, zmq.POLLIN)
        for client, text in self._unsaid[:]:
            if client.poll(0, zmq.POLLOUT):
                client.send(text, zmq.NOBLOCK)
                self._unsaid.remove((client, text))
        poller.poll(5)
        self.gate.serve()
        while self.server.poll(0):
            frames = self.server.recv_multipart(copy=False)
            self.came.append((frames[-1].bytes, self.gate.who(frames)))
        self.changed += self.gate.tick()

    def until(self, condition, patience_s=PATIENCE_S):
        """Serve until a condition holds or the time is over; return True if it holds."""
        end_s = time.monotonic() + patience_s
        while not (so := condition()) and time.monotonic() < end_s:
            self.turn()
        return bool(so)

    def knock(self, pair, *, server=CENTRAL.public, options=(), text=b"hello"):
        """Connect a client and queue a text that it sends once connected."""
        keys = ClientKeys(pair, server) if pair else None
        client = sockets.client(self.outside, _NOBODY if options else self.address, keys=keys)
        for option, value in options:
            client.setsockopt(option, value)
        if options:  # options apply to the next connection only
            client.disconnect(_NOBODY)
            client.connect(self.address)
        self.monitors[client] = sockets.Monitor(client)
        self._clients.append(client)
        self.say(client, text)
        return client

    def say(self, client, text):
        """Queue a text that a client sends as soon as it is connected."""
        self._unsaid.append((client, text))

    def reported(self, client):
        """Wait until the monitor of a client reports a refused connection; return the reason."""
        lines = []
        assert self.until(lambda: lines.extend(self.monitors[client].read()) or lines)
        return lines[0]

    def admits(self, pair, **options):
        """Identity of the client once its message arrives, or None once its monitor reports a refused connection."""
        text = random.randbytes(8)
        client = self.knock(pair, text=text, **options)
        assert self.until(lambda: any(came == text for came, _ in self.came) or self.monitors[client].read())
        return next((who for came, who in self.came if came == text), None)

    def hears(self, pair):
        """Return True if the message of a client arrives within ``MOMENT_S``; a refusal need not be reported."""
        text = random.randbytes(8)
        self.knock(pair, text=text)
        return self.until(lambda: any(came == text for came, _ in self.came), MOMENT_S)
