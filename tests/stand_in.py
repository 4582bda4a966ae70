"""A small central node for tests of sensor nodes, which can lose and reorder its acks, and stop."""

import queue
import random
import threading
import zlib

import zmq

from ertis_numba.base.errors import ErtisError
from ertis_numba.network import messages, sockets
from ertis_numba.network.zap_authenticator import ZapAuthenticator
from tests.ports import reserved_address

TURN_MS = 20


class StandIn:
    """A central node that accepts the next sequence number, or a gap that begins there, as the wire format requires.

    Attributes
    ----------
    held : dict of (sensor, session) to dict
        Header and samples of each measurement by its sequence number.
    gaps : dict of (sensor, session) to list
        First number, last number and reason of each gap.
    wrong : list of str
        Violations of the protocol by sensor nodes.
    """

    def __init__(self, *, seed=0, acks="stored", window=16, keys=None, max_bytes=sockets.MAX_BYTES):
        self.random = random.Random(seed)
        self.held, self.gaps, self.acked_through, self.wrong = {}, {}, {}, []
        self.acks, self.window, self.state, self.text = acks, window, "storage", ""
        self.dropped = ()  # reported with the next ack
        self.max_runs, self.forget_peers = 1000, threading.Event()
        self.silent, self.version = False, messages.VERSION
        self.ignored = 0.0  # share of measurements that are ignored
        self.lost = self.repeated = self.late = 0.0  # shares of acks that are lost, repeated or delayed
        self.refusal = lambda _message: None
        self.hellos, self.seen = queue.Queue(), set()
        self.taken = self.resent = self.connections = 0
        self.keys, self.max_bytes = keys, max_bytes
        self._reserved = reserved_address()  # until this object is deleted
        self.address = self._reserved.__enter__()
        self._kept_back = []
        self._thread = None

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        self.stop()

    def start(self):
        """Start to listen, after a restart at the same port."""
        self._end, ready = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._serve, args=(ready,))
        self._thread.start()
        assert ready.wait(60)

    def stop(self, *, forget=False):
        """Stop without any message; stored data stays, and ``forget`` clears the acknowledged numbers."""
        if self._thread is not None:
            self._end.set()
            self._thread.join()
            self._thread = None
        if forget:
            self.acked_through.clear()

    def _serve(self, ready):
        context = zmq.Context()
        gate = ZapAuthenticator(context, self.keys)
        router = sockets.server(context, self.address, keys=self.keys, max_bytes=self.max_bytes)
        self._peers, self._kept_back = {}, []
        poller = zmq.Poller()
        for each in filter(None, (router, gate.socket)):
            poller.register(each, zmq.POLLIN)
        ready.set()
        while not self._end.is_set():
            events = dict(poller.poll(TURN_MS))
            if gate.socket in events:
                gate.serve()
            if router in events:
                peer, *frames = router.recv_multipart()
                if not self.silent:
                    self._take(router, peer, frames)
        context.destroy(linger=0)

    def _say(self, router, peer, message):
        try:
            header = messages.encode(message)
            router.send_multipart([peer, header[:4] + bytes([self.version]) + header[5:]], zmq.NOBLOCK)
        except zmq.ZMQError:
            pass

    def _take(self, router, peer, frames):  # noqa: C901  a case for each message
        try:
            message = messages.decode(frames[0])
        except ErtisError as error:
            self.wrong.append(str(error))
            return
        if self.forget_peers.is_set():
            self._peers.clear()
            self.forget_peers.clear()
        if peer not in self._peers:
            self._peers[peer] = set()
            self.connections += 1
        refusal = self.refusal(message)
        if refusal is not None:
            self._say(router, peer, refusal)
            return
        match message:
            case messages.Hello():
                self._greet(router, peer, message, frames[1])
            case messages.Ping():
                self._say(router, peer, messages.Pong(state=self.state, text=self.text))
                for key in self._peers[peer]:
                    self._ack(router, peer, key)
            case messages.Data() | messages.Gap():
                key = message.sensor, message.session_id
                if key not in self._peers[peer]:
                    refused = messages.Refused(code="hello", reason="who?", sensor=key[0], session_id=key[1])
                    self._say(router, peer, refused)
                    return
                self.seen.add(getattr(message, "sequence", None))
                if self.state != "fault" and self.random.random() >= self.ignored:
                    self._store(key, message, frames[1:])
                    self._ack(router, peer, key)
            case messages.Bye():
                self._peers.pop(peer)
            case _:
                self.wrong.append(f"it says {message}")

    def _greet(self, router, peer, message, settings):
        key = message.sensor, message.session_id
        if zlib.crc32(settings) != message.settings_crc32:
            self.wrong.append("settings")
        if len(self._peers[peer] | {key}) > self.max_runs:
            refused = messages.Refused(code="size", reason="so many runs; say bye", sensor=key[0], session_id=key[1])
            self._say(router, peer, refused)
            return
        self._peers[peer].add(key)
        before = self.acked_through.setdefault(key, message.next_sequence - 1)
        if message.next_sequence > before + 1:
            self.gaps.setdefault(key, []).append((before + 1, message.next_sequence - 1, "never came"))
            self.acked_through[key] = message.next_sequence - 1
        welcome = messages.Welcome(
            sensor=key[0],
            session_id=key[1],
            state=self.state,
            acks=self.acks,
            window=self.window,
            acked_through=self.acked_through[key],
        )
        self._say(router, peer, welcome)
        self.hellos.put((message, settings))

    def _store(self, key, message, payload):
        acked_through = self.acked_through[key]
        if isinstance(message, messages.Gap):
            if message.first <= acked_through + 1 and message.last > acked_through:
                self.gaps.setdefault(key, []).append(
                    (max(message.first, acked_through + 1), message.last, message.reason)
                )
                self.acked_through[key] = message.last
            return
        if zlib.crc32(payload[0]) != message.crc32:
            self.wrong.append(f"CRC-32 of {message.sequence}")
        if message.sequence <= acked_through:
            self.resent += 1
        elif message.sequence == acked_through + 1:
            self.held.setdefault(key, {})[message.sequence] = (message, payload[0])
            self.acked_through[key] = message.sequence
            self.taken += 1

    def _ack(self, router, peer, key):
        ack = messages.Ack(
            sensor=key[0],
            session_id=key[1],
            acked_through=self.acked_through[key],
            status=self.acks,
            dropped=self.dropped,
        )
        chance = self.random.random
        if chance() < self.lost:
            return
        if chance() < self.late:
            self._kept_back.append(ack)
            return
        self._say(router, peer, ack)
        if chance() < self.repeated:
            self._say(router, peer, ack)
        while self._kept_back and chance() < 0.5:
            self._say(router, peer, self._kept_back.pop(self.random.randrange(len(self._kept_back))))
