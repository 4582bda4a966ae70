"""Intake of measurements: order within each session, acknowledgements, and notifications."""

import time
from collections import OrderedDict
from collections.abc import Callable, Iterable
from typing import Final

from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import SequenceGap
from ertis_numba.journal import JournalEntry, JournalSensor
from ertis_numba.network.central_node._admission import Unwanted, entry_in, require_room, require_same, source_in
from ertis_numba.network.central_node._archive import Archive
from ertis_numba.network.central_node._images import Guarded
from ertis_numba.network.central_node._received_items import ReceivedItem, SensorSession, Stored, StoredDuplicate
from ertis_numba.network.central_node._streams import Acks, PeerConnection, SensorTrack, Sharing, Stream
from ertis_numba.network.message_fields import as_line
from ertis_numba.network.messages import PING_INTERVAL_S, SILENCE_LIMIT_S, Data, Gap, Hello, Message, Refused
from ertis_numba.network.trace import mark

__all__ = ["Intake"]

_LEFT_KEPT: Final = 4096  # Limit on inactive sessions.
_WAITING_BYTES: Final = 64_000_000  # Limit per peer.
_ALL_WAITING_BYTES: Final = 512_000_000
# One ping longer than a node waits, so that the node connects again before it is removed.
_SILENT_S: Final = SILENCE_LIMIT_S + PING_INTERVAL_S
_NEVER: Final = "never reached the central node"


class Intake:
    """Receiver of measurements, each number once and in order; without a store, acks are immediate."""

    def __init__(
        self,
        *,
        store: Archive | None,
        viewer: Guarded | None,
        send: Callable[[bytes, Message], object],
        notify: Callable[..., None],
        on_stored: Callable[[list[ReceivedItem]], None] | None,
        max_bytes: int,
    ) -> None:
        self._store, self._viewer, self._send, self._emit_event = store, viewer, send, notify
        self._on_stored = on_stored
        self._max_bytes = max_bytes
        self._streams: dict[SensorSession, Stream] = {}
        self._left: OrderedDict[SensorSession, int] = (
            OrderedDict()
        )  # Numbers that were acknowledged or shown, unknown to the store.
        self._waiting_bytes = 0
        self._sharing = Sharing(notify)
        self.tracks: dict[str, SensorTrack] = {}
        self.peers: dict[bytes, PeerConnection] = {}
        self.acks = Acks(send, "accepted" if store is None else "stored")

    # Messages from nodes

    def read(self, hello: Hello, payload: list[bytes]) -> JournalSensor:
        """Return the sensor of a hello; any thread may call this."""
        return source_in(hello, payload, max_bytes=self._max_bytes)

    def greet(self, peer_id: bytes, hello: Hello, source: JournalSensor, key: str = "") -> Stream:
        """Accept a hello with the sensor from `read`, and return the session; peers per key are limited strictly."""
        run = SensorSession(hello.sensor, hello.session_id)
        peer = self.peers.get(peer_id)
        require_room(self.peers, self.tracks, peer, run, key)
        require_same(self.peers, self.tracks, peer_id, source)
        if peer is None:
            peer = self.peers[peer_id] = PeerConnection(key=key)
        stream = self._streams.get(run)
        if stream is None:
            stream = self._streams[run] = self._begin(run, source, hello)
        before, stream.owner = stream.owner, peer_id
        if before != peer_id and before in self.peers:  # The node has reconnected before it was missed.
            self._leave(before, self.peers[before], stream)
        stream.use(source)
        stream.begins = max(stream.begins, hello.next_sequence)
        peer.heard_s = time.monotonic()
        if run not in peer.streams:
            peer.streams[run] = stream
            self._emit_event("joined", sensor=run.sensor, session_id=run.session_id, acked_through=stream.acked_through)
        self._sharing.joins(stream.track, peer_id, peer.heard_s)
        stream.track.session_id, stream.track.acked_through = run.session_id, stream.acked_through
        self._reach(stream)
        if self._viewer is not None:
            self._viewer.register(hello, source.settings)
        return stream

    def _begin(self, run: SensorSession, source: JournalSensor, hello: Hello) -> Stream:
        shown = self._left.pop(run, hello.next_sequence - 1 if self._store is None else -1)
        acked_through = shown if self._store is None else self._store.acked_through(run)
        track = self.tracks.setdefault(run.sensor, SensorTrack())
        return Stream(
            run,
            source,
            track,
            acked_through=acked_through,
            taken=acked_through,
            shown=shown,
            begins=hello.next_sequence,
            owner=b"",
        )

    def _reach(self, stream: Stream) -> None:
        """Register numbers as missing that the node does not have any more."""
        if stream.begins > stream.taken + 1:
            first, last = stream.taken + 1, stream.begins - 1
            self._take_gap(stream, SequenceGap(stream.run.sensor, first, last, _NEVER, stream.run.session_id))

    def _stream(self, peer_id: bytes, message: Data | Gap) -> Stream:
        peer = self.peers.get(peer_id)
        stream = None if peer is None else peer.streams.get(SensorSession(message.sensor, message.session_id))
        if peer is None or stream is None:
            raise Unwanted("hello", f"sensor {message.sensor} is not registered here; send hello first", "hello")
        peer.heard_s = time.monotonic()
        return stream

    def measure(self, peer_id: bytes, data: Data, payload: list[memoryview], arrived_ns: int) -> None:
        """Accept a measurement."""
        stream = self._stream(peer_id, data)
        mark("arrived", data.sensor, data.sequence)
        entry, source = entry_in(stream, data, payload), stream.source
        mark("checked", data.sensor, data.sequence)
        item = ReceivedItem(
            stream.run, data.sequence, data.sequence, entry, source, 1e-9 * arrived_ns, peer_id, stream.turn
        )
        self._reach(stream)
        if data.sequence <= stream.taken:
            self._again(stream, item, data)
        elif data.sequence > stream.taken + 1 or not self._has_room(peer_id, item):
            self.acks.owe(stream)
        else:
            stream.remember(data.sequence, data.crc32)
            self._take(stream, item)
            if data.sequence > stream.shown:  # A repeated transmission is not a new measurement.
                stream.shown = data.sequence
                stream.track.took(
                    source.n_bytes,
                    stream.run.session_id,
                    arrived_s=item.arrived_s,
                    measured_s=1e-9 * data.monotonic_ns,
                )
                if self._viewer is not None:
                    self._viewer.offer(data, entry.measurement.data, arrived_ns)

    def _has_room(self, peer_id: bytes, item: ReceivedItem) -> bool:
        if self._store is None:
            return True
        bytes_ = self.peers[peer_id].waiting_bytes + item.n_bytes
        return bytes_ <= max(_WAITING_BYTES, item.n_bytes) and self._waiting_bytes <= _ALL_WAITING_BYTES

    def _again(self, stream: Stream, item: ReceivedItem, data: Data) -> None:
        """Process a measurement whose number was accepted before."""
        known = stream.recent.get(data.sequence)
        if self._store is None or known == data.crc32 or not self._has_room(stream.owner, item):
            stream.track.repeated += 1
            differs = known is not None and known != data.crc32
            if differs and self._store is None:
                stream.track.conflicts += 1
                self._emit_event(
                    "conflict", sensor=stream.run.sensor, session_id=stream.run.session_id, sequence=data.sequence
                )
            self.acks.owe(stream)
            return
        item.again = True
        self._wait(item, stream)

    def miss(self, peer_id: bytes, gap: Gap) -> None:
        """Register missing numbers."""
        stream = self._stream(peer_id, gap)
        self._reach(stream)
        if gap.last <= stream.taken or gap.first > stream.taken + 1:
            self.acks.owe(stream)
        else:
            try:
                noted = SequenceGap(gap.sensor, stream.taken + 1, gap.last, gap.reason, gap.session_id)
            except ArgumentError as error:
                raise Unwanted("message", str(error), "message") from error
            self._take_gap(stream, noted)

    def _take_gap(self, stream: Stream, gap: SequenceGap) -> None:
        item = ReceivedItem(
            stream.run, gap.first, gap.last, gap, stream.source, time.monotonic(), stream.owner, stream.turn
        )
        if not self._has_room(stream.owner, item):
            self.acks.owe(stream)
            return
        self._take(stream, item)
        if self._store is None:
            stream.track.miss(gap.reason, gap.n_missing)

    def _take(self, stream: Stream, item: ReceivedItem) -> None:
        stream.taken = item.last
        if self._store is not None:
            self._wait(item, stream)
            return
        stream.acked_through = stream.track.acked_through = item.last
        self.acks.owe(stream)
        self.acks.acked_through(item.arrived_s)

    def _wait(self, item: ReceivedItem, stream: Stream) -> None:
        if self._store is None:
            return
        stream.track.waiting += 1
        self._waiting_bytes += item.n_bytes
        peer = self.peers.get(item.owner)
        if peer is not None:
            peer.waiting_bytes += item.n_bytes
        self._store.offer(item)

    def ping(self, peer_id: bytes) -> None:
        """Register that a node is alive, and schedule acks that it may have missed."""
        peer = self.peers.get(peer_id)
        if peer is not None:
            peer.heard_s = time.monotonic()
            for stream in peer.streams.values():
                if stream.owner == peer_id:
                    self.acks.owe(stream)

    def remark(self, peer_id: bytes) -> str:
        """Return a remark for a node, one line; empty if there is none."""
        return self._sharing.remark(self.peers.get(peer_id))

    def nodes_of(self, sensor: str) -> list[bytes]:
        """Return the nodes that send a sensor."""
        track = self.tracks.get(sensor)
        return [] if track is None else [peer_id for peer_id in track.peers if peer_id in self.peers]

    def bye(self, peer_id: bytes) -> None:
        """Remove a node."""
        peer = self.peers.pop(peer_id, None)
        for stream in list(peer.streams.values()) if peer is not None else ():
            self._leave(peer_id, peer, stream)

    def _leave(self, peer_id: bytes, peer: PeerConnection | None, stream: Stream) -> None:
        """Detach a session from a peer."""
        if peer is not None:
            peer.streams.pop(stream.run, None)
        if peer is None or not any(run.sensor == stream.run.sensor for run in peer.streams):
            self._sharing.leaves(stream.track, stream.run.sensor, peer_id)
        if stream.owner == peer_id:
            stream.owner = b""
            self._emit_event(
                "left", sensor=stream.run.sensor, session_id=stream.run.session_id, acked_through=stream.acked_through
            )
        self._forget(stream)

    def _forget(self, stream: Stream) -> None:
        """Discard the state of old sessions."""
        if stream.owner or stream.taken != stream.acked_through:
            return
        self.acks.forget(stream)
        known = self._store is not None and stream.shown <= stream.acked_through
        if self._streams.pop(stream.run, None) is not None and not known:
            self._left[stream.run] = max(stream.acked_through, stream.shown)
            if len(self._left) > _LEFT_KEPT:
                self._left.popitem(last=False)
        track = stream.track
        if not (track.received or track.missing or track.repeated or track.peers):
            self.tracks.pop(stream.run.sensor, None)

    def tick(self, now_s: float) -> None:
        """Remove silent nodes, and report sensors that several nodes send."""
        for peer_id in [peer_id for peer_id, peer in self.peers.items() if now_s - peer.heard_s > _SILENT_S]:
            self.bye(peer_id)
        self._sharing.tick(self.tracks, self.peers)

    # Results from the archive

    def stored(self, event: Stored) -> None:
        """Process stored items."""
        for item in event.items:
            stream = self._done(item)
            track = self.tracks.get(item.run.sensor) or self.tracks.setdefault(item.run.sensor, SensorTrack())
            if isinstance(item.content, JournalEntry):
                mark("stored", item.run.sensor, item.first)
                track.stored += 1
                self.acks.acked_through(item.arrived_s)
            else:
                track.miss(item.content.reason, item.last - item.first + 1)
            if stream is not None:
                stream.acked_through = max(stream.acked_through, item.last)
                stream.taken = max(stream.taken, stream.acked_through)
                track.acked_through = stream.acked_through
                self.acks.owe(stream)
                self._forget(stream)
        if self._on_stored is not None:
            self._on_stored([item for item in event.items if isinstance(item.content, JournalEntry)])

    def twin(self, event: StoredDuplicate) -> None:
        """Process a duplicate."""
        stream = self._done(event.item)
        track = self.tracks.setdefault(event.item.run.sensor, SensorTrack())
        track.repeated += 1
        if event.differs:
            track.conflicts += 1
            run = event.item.run
            self._emit_event("conflict", sensor=run.sensor, session_id=run.session_id, sequence=event.item.first)
        if stream is not None:
            self.acks.owe(stream)

    def forgotten(self, item: ReceivedItem, reason: str) -> None:
        """Request an item again."""
        stream = self._done(item)
        if stream is None:
            return
        if item.turn == stream.turn:  # Otherwise it is under way again.
            stream.go_back()
        self.acks.owe(stream)
        if reason and stream.owner:
            run, line = item.run, as_line(reason)
            self._send(
                stream.owner, Refused(code="settings", reason=line, sensor=run.sensor, session_id=run.session_id)
            )
        self._forget(stream)

    def _done(self, item: ReceivedItem) -> Stream | None:
        self._waiting_bytes -= item.n_bytes
        peer = self.peers.get(item.owner)
        if peer is not None:
            peer.waiting_bytes -= item.n_bytes
        stream = self._streams.get(item.run)
        track = self.tracks.get(item.run.sensor)
        if track is not None:
            track.waiting -= 1
        return stream

    def dropped(self, drops: Iterable[tuple[str, int, int, str]]) -> None:
        """Register measurements discarded by processing: sensor, session_id, sequence and reason of each."""
        for sensor, session_id, sequence, reason in drops:
            stream = self._streams.get(SensorSession(sensor, session_id))
            if stream is not None:
                stream.dropped.append((sequence, reason))

    def acknowledge(self) -> None:
        """Send acks that are due."""
        self.acks.send()
