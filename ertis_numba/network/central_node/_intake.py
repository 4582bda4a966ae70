"""Takes measurements in: what comes next of each run, what is settled, and who has to hear of it."""

import time
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, Protocol

import numpy as np
from numpy.typing import NDArray

from ertis_numba.errors import ArgumentError
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.journal import Entry, Sensor
from ertis_numba.journal import Gap as NotedGap
from ertis_numba.network.central_node._items import Item, Run, Stored, Twin
from ertis_numba.network.central_node._streams import SETTINGS_BYTES, Peer, Stream, Track, source_of
from ertis_numba.network.messages import Ack, Bye, Data, Gap, Hello, Message, Ping, Refused
from ertis_numba.network.status import Latencies
from ertis_numba.settings import Settings

__all__ = ["Intake", "Store", "Unwanted", "Viewer"]

_STREAMS: Final = 64  # of a peer
_SENSORS: Final = 1024
_PEERS: Final = 1024
_SETTLED_KEPT: Final = 4096  # runs, where there is no archive
_WAITING_BYTES: Final = 64_000_000  # of a peer
_ALL_WAITING_BYTES: Final = 512_000_000
_SILENT_S: Final = 4.0
_NEVER: Final = "never reached the central node"


class Unwanted(Exception):  # noqa: N818  it is an answer
    """A message that is not taken.

    Parameters
    ----------
    code : str
        As in `ertis_numba.network.messages.Refused`.
    reason : str
        The line to be told.
    kind : str
        By which it is counted.
    """

    def __init__(self, code: Any, reason: str, kind: str) -> None:
        super().__init__(reason)
        self.code, self.kind = code, kind

    def answer(self, about: Message) -> Refused:
        """Return what to tell the sender."""
        sensor, epoch = getattr(about, "sensor", ""), getattr(about, "epoch", 0)
        return Refused(code=self.code, reason=str(self)[:500], sensor=sensor, epoch=epoch)


class Store(Protocol):
    """What makes measurements durable."""

    def settled(self, run: Run) -> int:
        """Return how far a run is settled."""

    def offer(self, item: Item) -> None:
        """Have something stored; returns at once."""


class Viewer(Protocol):
    """What is shown measurements that are new."""

    def know(self, hello: Hello, settings: Settings) -> None:
        """Take note of a sensor."""

    def offer(self, data: Data, words: NDArray[np.unsignedinteger[Any]], arrived_ns: int) -> None:
        """Take a measurement; returns at once, and keeps no reference to the words."""


class Intake:
    """Takes what greeted nodes send, each number once and in order.

    Parameters
    ----------
    store : Store or None
        None where nothing is stored: what is taken is settled then.
    viewer : Viewer or None
    send : callable
        Called with a peer and a message to it.
    tell : callable
        Called with the name of an event and what there is to say about it.
    on_stored : callable
        Called with items that are durable.
    most_bytes : int
        Longest measurement.

    Attributes
    ----------
    tracks : dict of str to Track
    peers : dict of bytes to Peer
    acks : Latencies
        From the arrival of a measurement to its ack.
    """

    def __init__(
        self,
        *,
        store: Store | None,
        viewer: Viewer | None,
        send: Callable[[bytes, Message], None],
        tell: Callable[..., None],
        on_stored: Callable[[list[Item]], None] | None,
        most_bytes: int,
    ) -> None:
        self._store, self._viewer, self._send, self._tell = store, viewer, send, tell
        self._on_stored = on_stored
        self._most_bytes = most_bytes
        self._streams: dict[Run, Stream] = {}
        self._forgotten: OrderedDict[Run, int] = OrderedDict()
        self._due: dict[Run, Stream] = {}
        self._arrived_s: list[float] = []
        self._waiting_bytes = 0
        self.tracks: dict[str, Track] = {}
        self.peers: dict[bytes, Peer] = {}
        self.acks = Latencies()

    # What comes from nodes

    def greet(self, peer_id: bytes, hello: Hello, payload: list[bytes]) -> Stream:
        """Take a greeting, and return the run.

        Raises
        ------
        Unwanted
            It cannot be taken.
        """
        if len(payload) != 1 or len(payload[0]) > SETTINGS_BYTES:
            raise Unwanted("settings", f"a hello has no settings of at most {SETTINGS_BYTES} bytes; send them", "size")
        if zlib.crc32(payload[0]) != hello.settings_crc32:
            raise Unwanted("settings", "settings have another CRC-32 than their hello says; send them again", "crc")
        try:
            source = source_of(hello, payload[0], most_bytes=self._most_bytes)
        except (ArgumentError, OSError) as error:
            raise Unwanted("settings", " ".join(str(error).split()), "settings") from error
        run = Run(hello.sensor, hello.epoch)
        peer = self.peers.get(peer_id)
        self._require_room(peer, run)
        if peer is None:
            peer = self.peers[peer_id] = Peer()
        stream = self._streams.get(run)
        if stream is None:
            stream = self._streams[run] = self._begin(run, source, hello)
        before, stream.owner = stream.owner, peer_id
        if before != peer_id and before in self.peers:  # a node that has come back, before it was missed
            self._leave(before, self.peers[before], stream)
        stream.use(source)
        stream.begins = max(stream.begins, hello.next_sequence)
        peer.heard_s = time.monotonic()
        if run not in peer.streams:
            peer.streams[run] = stream
            self._tell("joined", sensor=run.sensor, epoch=run.epoch, settled=stream.settled)
        stream.track.peers.add(peer_id)
        stream.track.epoch, stream.track.settled = run.epoch, stream.settled
        self._reach(stream)
        if self._viewer is not None:
            self._viewer.know(hello, source.settings)
        return stream

    def _require_room(self, peer: Peer | None, run: Run) -> None:
        if peer is None and len(self.peers) >= _PEERS:
            raise Unwanted("size", f"this central node has {_PEERS} sensor nodes; use another", "too many")
        if peer is not None and run not in peer.streams and len(peer.streams) >= _STREAMS:
            raise Unwanted("size", f"a sensor node has {_STREAMS} runs; say bye to those that are over", "too many")
        if run.sensor not in self.tracks and len(self.tracks) >= _SENSORS:
            raise Unwanted("size", f"this central node has {_SENSORS} sensors; use another", "too many")

    def _begin(self, run: Run, source: Sensor, hello: Hello) -> Stream:
        if self._store is not None:
            settled = self._store.settled(run)
        else:
            settled = self._forgotten.pop(run, hello.next_sequence - 1)
        track = self.tracks.setdefault(run.sensor, Track())
        return Stream(run, source, track, settled=settled, taken=settled, begins=hello.next_sequence, owner=b"")

    def _reach(self, stream: Stream) -> None:
        """Note that what the node does not have any more has never come."""
        if stream.begins > stream.taken + 1:
            first, last = stream.taken + 1, stream.begins - 1
            self._take_gap(stream, NotedGap(stream.run.sensor, first, last, _NEVER, stream.run.epoch))

    def _stream(self, peer_id: bytes, message: Data | Gap) -> Stream:
        peer = self.peers.get(peer_id)
        stream = None if peer is None else peer.streams.get(Run(message.sensor, message.epoch))
        if peer is None or stream is None:
            raise Unwanted("hello", f"sensor {message.sensor} is not known here; say hello first", "hello")
        peer.heard_s = time.monotonic()
        return stream

    def measure(self, peer_id: bytes, data: Data, payload: list[memoryview], arrived_ns: int) -> None:
        """Take a measurement.

        Raises
        ------
        Unwanted
            It cannot be taken.
        """
        stream = self._stream(peer_id, data)
        source = stream.source
        if len(payload) != 1 or len(payload[0]) != source.n_bytes:
            sizes = ", ".join(str(len(part)) for part in payload[:4]) or "no"
            raise Unwanted("message", f"a measurement has {sizes} bytes, its settings say {source.n_bytes}", "size")
        if zlib.crc32(payload[0]) != data.crc32:
            raise Unwanted("message", f"measurement {data.sequence} has another CRC-32 than it says; send again", "crc")
        try:
            settings = stream.settings(data)
        except ArgumentError as error:
            raise Unwanted("message", str(error), "message") from error
        words = np.frombuffer(payload[0], dtype=source.dtype).reshape(source.shape)
        stamp = Stamp(
            sensor=data.sensor,
            sequence=data.sequence,
            sync_count=data.sync_count,
            timestamp_ns=data.timestamp_ns,
            timestamp_uncertainty_ns=data.uncertainty_ns,
            epoch=data.epoch,
        )
        entry = Entry(Measurement(words, settings, stamp), data.monotonic_ns, data.crc32)
        item = Item(stream.run, data.sequence, data.sequence, entry, source, 1e-9 * arrived_ns, peer_id)
        self._reach(stream)
        if data.sequence <= stream.taken:
            self._again(stream, item, data)
        elif data.sequence > stream.taken + 1 or not self._has_room(peer_id, item):
            stream.hole = True
            self._due[stream.run] = stream
        else:
            stream.remember(data.sequence, data.crc32)
            stream.track.took(item.n_bytes, item.arrived_s)
            self._take(stream, item)
            if self._viewer is not None:
                self._viewer.offer(data, words, arrived_ns)

    def _has_room(self, peer_id: bytes, item: Item) -> bool:
        if self._store is None:
            return True
        bytes_ = self.peers[peer_id].waiting_bytes + item.n_bytes
        return bytes_ <= max(_WAITING_BYTES, item.n_bytes) and self._waiting_bytes <= _ALL_WAITING_BYTES

    def _again(self, stream: Stream, item: Item, data: Data) -> None:
        """Take note of a measurement whose number was taken before."""
        known = stream.recent.get(data.sequence)
        if self._store is None or known == data.crc32 or not self._has_room(stream.owner, item):
            stream.track.repeated += 1
            differs = known is not None and known != data.crc32
            if differs and self._store is None:
                stream.track.conflicts += 1
                self._tell("conflict", sensor=stream.run.sensor, epoch=stream.run.epoch, sequence=data.sequence)
            self._due[stream.run] = stream
            return
        item.again = True
        self._wait(item, stream)

    def miss(self, peer_id: bytes, gap: Gap) -> None:
        """Take note of numbers that no measurement has.

        Raises
        ------
        Unwanted
            It cannot be taken.
        """
        stream = self._stream(peer_id, gap)
        self._reach(stream)
        if gap.last <= stream.taken:
            self._due[stream.run] = stream
        elif gap.first > stream.taken + 1:
            stream.hole = True
            self._due[stream.run] = stream
        else:
            try:
                noted = NotedGap(gap.sensor, stream.taken + 1, gap.last, gap.reason, gap.epoch)
            except ArgumentError as error:
                raise Unwanted("message", str(error), "message") from error
            self._take_gap(stream, noted)

    def _take_gap(self, stream: Stream, gap: NotedGap) -> None:
        item = Item(stream.run, gap.first, gap.last, gap, stream.source, time.monotonic(), stream.owner)
        self._take(stream, item)
        if self._store is None:
            stream.track.missing[gap.reason] += gap.last - gap.first + 1

    def _take(self, stream: Stream, item: Item) -> None:
        stream.taken = item.last
        if self._store is not None:
            self._wait(item, stream)
            return
        stream.settled = stream.track.settled = item.last
        self._due[stream.run] = stream
        self._arrived_s.append(item.arrived_s)

    def _wait(self, item: Item, stream: Stream) -> None:
        if self._store is None:
            return
        stream.track.waiting += 1
        self._waiting_bytes += item.n_bytes
        peer = self.peers.get(item.owner)
        if peer is not None:
            peer.waiting_bytes += item.n_bytes
        self._store.offer(item)

    def ping(self, peer_id: bytes, _: Ping) -> None:
        """Note that a node is alive; it is to hear again what it may have missed."""
        peer = self.peers.get(peer_id)
        if peer is not None:
            peer.heard_s = time.monotonic()
            for run, stream in peer.streams.items():
                if stream.owner == peer_id:
                    self._due[run] = stream

    def bye(self, peer_id: bytes, _: Bye | None = None) -> None:
        """Forget a node."""
        peer = self.peers.pop(peer_id, None)
        for stream in list(peer.streams.values()) if peer is not None else ():
            self._leave(peer_id, peer, stream)

    def _leave(self, peer_id: bytes, peer: Peer | None, stream: Stream) -> None:
        """Forget that a run comes from a peer."""
        if peer is not None:
            peer.streams.pop(stream.run, None)
        if peer is None or not any(run.sensor == stream.run.sensor for run in peer.streams):
            stream.track.peers.discard(peer_id)
        if stream.owner == peer_id:
            stream.owner = b""
            self._tell("left", sensor=stream.run.sensor, epoch=stream.run.epoch, settled=stream.settled)
        self._forget(stream)

    def _forget(self, stream: Stream) -> None:
        """Drop what nobody will ask for."""
        if stream.owner or stream.taken != stream.settled:
            return
        self._due.pop(stream.run, None)
        if self._streams.pop(stream.run, None) is not None and self._store is None:
            self._forgotten[stream.run] = stream.settled
            if len(self._forgotten) > _SETTLED_KEPT:
                self._forgotten.popitem(last=False)
        track = stream.track
        if not (track.received or track.missing or track.repeated or track.peers):
            self.tracks.pop(stream.run.sensor, None)

    def tick(self, now_s: float) -> None:
        """Forget nodes that are silent."""
        for peer_id in [peer_id for peer_id, peer in self.peers.items() if now_s - peer.heard_s > _SILENT_S]:
            self.bye(peer_id)

    # What comes from the archive

    def stored(self, event: Stored) -> None:
        """Take note of what is durable."""
        for item in event.items:
            stream = self._done(item)
            track = self.tracks.setdefault(item.run.sensor, Track())
            if isinstance(item.what, Entry):
                track.stored += 1
                self._arrived_s.append(item.arrived_s)
            else:
                track.missing[item.what.reason] += item.last - item.first + 1
            if stream is not None:
                stream.settled = max(stream.settled, item.last)
                stream.taken = max(stream.taken, stream.settled)
                track.settled = stream.settled
                self._due[stream.run] = stream
                self._forget(stream)
        if self._on_stored is not None:
            self._on_stored([item for item in event.items if isinstance(item.what, Entry)])

    def twin(self, event: Twin) -> None:
        """Take note of a number that has come again."""
        stream = self._done(event.item)
        track = self.tracks.setdefault(event.item.run.sensor, Track())
        track.repeated += 1
        if event.differs:
            track.conflicts += 1
            run = event.item.run
            self._tell("conflict", sensor=run.sensor, epoch=run.epoch, sequence=event.item.first)
        if stream is not None:
            self._due[stream.run] = stream

    def forgotten(self, item: Item, reason: str) -> None:
        """Have an item sent again."""
        stream = self._done(item)
        if stream is None:
            return
        stream.taken = stream.settled
        stream.recent.pop(item.first, None)
        stream.hole = True
        self._due[stream.run] = stream
        if isinstance(item.what, Entry):
            stream.track.received -= 1
            stream.track.received_bytes -= item.n_bytes
        if reason and stream.owner:
            run = item.run
            self._send(stream.owner, Refused(code="settings", reason=reason[:500], sensor=run.sensor, epoch=run.epoch))
        self._forget(stream)

    def _done(self, item: Item) -> Stream | None:
        self._waiting_bytes -= item.n_bytes
        peer = self.peers.get(item.owner)
        if peer is not None:
            peer.waiting_bytes -= item.n_bytes
        stream = self._streams.get(item.run)
        track = self.tracks.get(item.run.sensor)
        if track is not None:
            track.waiting -= 1
        return stream

    def acknowledge(self, drops: Mapping[Run, Iterable[tuple[int, str]]] | None = None) -> None:
        """Tell nodes what is settled, where that is due."""
        for run, stream in self._due.items():
            if not stream.owner:
                continue
            dropped = tuple(drops.get(run, ()))[:32] if drops else ()
            ack = Ack(
                sensor=run.sensor,
                epoch=run.epoch,
                settled=stream.settled,
                status="accepted" if self._store is None else "stored",
                dropped=dropped,
            )
            self._send(stream.owner, ack)
            if stream.hole and stream.settled == stream.taken:
                stream.hole = False
        self._due.clear()
        if self._arrived_s:
            now_s = time.monotonic()
            for arrived_s in self._arrived_s:
                self.acks.add(1e3 * (now_s - arrived_s))
            self._arrived_s.clear()
