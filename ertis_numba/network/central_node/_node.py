"""The loop of the central node: it waits for nobody but for whoever sends something."""

import os
import socket as names
import threading
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack, suppress
from importlib.metadata import version
from types import TracebackType
from typing import Any, Final, Literal, Self

import zmq

from ertis_numba import checks
from ertis_numba.errors import ArgumentError
from ertis_numba.network import messages, sockets
from ertis_numba.network.addresses import DEFAULT_LISTEN
from ertis_numba.network.central_node._archive import Archive
from ertis_numba.network.central_node._images import Guarded, Images
from ertis_numba.network.central_node._intake import Intake
from ertis_numba.network.central_node._items import Failed, Fault, Forgotten, Item, Resumed, SealedOne, Stored, Twin
from ertis_numba.network.central_node._reading import read, receive, require_role
from ertis_numba.network.central_node._roles import Unwanted
from ertis_numba.network.central_node._telling import Telling, text_of
from ertis_numba.network.gate import Gate
from ertis_numba.network.keys import Permission, ServerKeys
from ertis_numba.network.messages import (
    AskStatus,
    Bye,
    Data,
    Gap,
    Hello,
    Message,
    Ping,
    Pong,
    Refused,
    Report,
    Welcome,
)
from ertis_numba.network.status import Status

__all__ = ["CentralNode"]

State = Literal["storage", "processing", "fault", "closing"]

MOST_BYTES: Final = 4 * 2**20
_TURN: Final = 32  # messages, before something else has its turn
_TICK_S: Final = 0.1
_LINGER_MS: Final = 500
_TOLD_S: Final = 1.0  # between two events about what was refused
_STATUS_S: Final = 1.0
_REPORT_S: Final = 0.2  # that a status may be old which somebody asks for
_FINISH_S: Final = 5.0
_VERSION: Final = version("ertis-numba")


class CentralNode:
    """Takes what sensor nodes send; use it in a ``with`` statement, and `run` it.

    Parameters
    ----------
    listen : str
        Where sensor nodes find it, as ``tcp://HOST:PORT``.
    keys : ServerKeys, optional
        Needed on addresses that other machines can reach.
    archive : Archive, optional
        What stores measurements; then an ack says that they are.
    processing : Images, optional
        What makes images of them.
    most_bytes : int
        Longest measurement that is taken.
    window : int
        Measurements of a run that may be under way.
    on_event : callable, optional
        Called with each event, a dict whose ``event`` says which: listening, joined, left, fault, resumed, sealed,
        unsealed, conflict, refused, shared (two nodes send one sensor), keys (how the list of keys is), internal (a
        mistake in this package).
    on_stored : callable, optional
        Called with measurements that are durable: sensor, epoch, sequence and CRC-32 of each.

    Attributes
    ----------
    address : str
        Where it listens, as nodes of this machine connect to it.
    latest : Status
        How it was a moment ago; for other threads than that of `run`.
    """

    def __init__(
        self,
        listen: str = DEFAULT_LISTEN,
        *,
        keys: ServerKeys | None = None,
        archive: Archive | None = None,
        processing: Images | None = None,
        most_bytes: int = MOST_BYTES,
        window: int = 16,
        on_event: Callable[[dict[str, Any]], None] = lambda _: None,
        on_stored: Callable[[str, int, int, int], None] | None = None,
    ) -> None:
        if archive is None and processing is None:
            raise ArgumentError("a central node has neither archive nor processing; give at least one")
        self._listen, self._keys, self._archive = listen, keys, archive
        self._images = None if processing is None else Guarded(processing, self._internal)
        self._window = checks.whole("window", window, 1, 1024)
        self._most_bytes = checks.whole("most_bytes", most_bytes, 4096, 2**31)
        self._telling, self._on_stored = Telling(on_event), on_stored
        self._intake = Intake(
            store=archive,
            viewer=self._images,
            send=self._send,
            tell=self._telling.tell,
            on_stored=None if on_stored is None else self._every,
            most_bytes=most_bytes,
        )
        self._context: zmq.Context[zmq.Socket[bytes]] | None = None
        self._socket: zmq.Socket[bytes] | None = None
        self._gate: Gate | None = None
        self._archive_fd = -1
        self._begun_s = self._next_tick_s = self._next_told_s = self._next_status_s = 0.0
        self._last_refused: Counter[str] = Counter()  # once the gate is closed
        self._badges: dict[bytes, list[zmq.Frame]] = {}
        self._fault = ""
        self._report: tuple[float, bytes] = -1.0, b""
        self._closing = False
        self.address = ""
        self.latest = self.status()

    # Its life

    def __enter__(self) -> Self:
        self._begun_s = time.monotonic()
        try:
            self._open()
        except BaseException:
            self.close()
            raise
        return self

    def _open(self) -> None:
        if self._archive is not None:
            self._archive_fd = self._archive.open()
        if self._images is not None:
            self._images.start()
        self._context = zmq.Context()
        self._gate = Gate(self._context, self._keys)
        self._socket = sockets.server(self._context, self._listen, keys=self._keys, most_bytes=self._most_bytes)
        self._gate.watch(self._socket)
        self.address = sockets.bound(self._socket)
        self._gate.self_test(self.address)
        self._telling.tell("listening", address=self.address, pid=os.getpid())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Take nothing more in, and make recordings of what is stored; closing twice does no harm."""
        gate, socket, context = self._gate, self._socket, self._context
        with ExitStack() as stack:  # whatever fails, the rest is closed
            stack.callback(self._note_status)
            if self._archive is not None:
                stack.callback(self._hear)
                stack.callback(self._archive.close)
            if self._images is not None:
                stack.callback(self._images.close, _FINISH_S)
            if context is not None:
                stack.callback(context.destroy, linger=0)
            if socket is not None:
                stack.callback(socket.close, linger=_LINGER_MS)  # the last acks
            if gate is not None:
                self._last_refused = gate.refused
                self._telling.refused(gate.refused)
                stack.callback(gate.close)
            self._gate = self._socket = self._context = None

    def run(self, stop: Callable[[], bool] | threading.Event, duration_s: float | None = None) -> None:
        """Take measurements in until it is to stop, and then wait until those are durable.

        Parameters
        ----------
        stop : callable or threading.Event
            Looked at ten times a second.
        duration_s : float, optional
        """
        if self._socket is None:
            raise ArgumentError("a central node is not open; use it in a with statement")
        ends = stop.is_set if isinstance(stop, threading.Event) else stop
        end_s = None if duration_s is None else time.monotonic() + checks.positive("duration", duration_s)
        while not ends() and (end_s is None or time.monotonic() < end_s):
            self._turn(self._socket)
        self._closing = True
        for peer_id in self._intake.peers:
            self._send(peer_id, Pong(state=self.state))
        if self._archive is not None and not self._archive.fault:
            self._archive.finish(_FINISH_S)
            self._hear()
            self._intake.acknowledge()

    # The loop

    def _turn(self, socket: "zmq.Socket[bytes]") -> None:
        """Wait for something, and do what it asks."""
        poller = zmq.Poller()
        poller.register(socket, zmq.POLLIN)
        others = set() if self._images is None else set(self._images.fds())
        if self._archive is not None:
            poller.register(self._archive_fd, zmq.POLLIN)
        if self._gate is not None and self._gate.socket is not None:
            poller.register(self._gate.socket, zmq.POLLIN)
        for fd in others:
            poller.register(fd, zmq.POLLIN)
        ready = dict(poller.poll(max(0, round(1e3 * (self._next_tick_s - time.monotonic())))))
        if self._gate is not None and self._gate.socket in ready:
            self._gate.serve()
        if self._archive_fd in ready:
            self._hear()
        if self._images is not None:
            for fd in ready.keys() & others:
                self._images.ready(fd)
            self._intake.dropped(self._images.drain_dropped())
        if socket in ready:
            self._receive(socket)
        self._intake.acknowledge()
        if time.monotonic() >= self._next_tick_s:
            self._tick()

    def _receive(self, socket: "zmq.Socket[bytes]") -> None:
        for _ in range(_TURN):
            try:
                frames = receive(socket)
            except zmq.Again:
                return
            try:
                self._handle(frames)
            except Exception as error:  # noqa: BLE001  whatever somebody sends, the others are served
                self._internal(error)

    def _internal(self, error: Exception) -> None:
        """Count a mistake in this package, and tell of it."""
        self._refused["internal"] += 1
        self._telling.internal(error)

    @property
    def _refused(self) -> Counter[str]:
        return self._last_refused if self._gate is None else self._gate.refused

    def _handle(self, frames: list[zmq.Frame]) -> None:
        """Do what a message asks, or say why not."""
        arrived_ns = time.monotonic_ns()
        if self._gate is None:
            return
        sender = frames[0].bytes
        who = self._gate.who(frames)
        if who is None:  # counted there
            self._drop(sender)
            self._send(sender, Refused(code="role", reason="this key is not listed (any more); have it listed"))
            return
        message: Message | None = None
        try:
            message = read(frames)
            require_role(who, message)
            self._take(sender, who, message, frames, arrived_ns)
        except Unwanted as error:
            self._refused[error.kind] += 1
            self._send(sender, error.answer(message or Bye()))
        except Exception as error:
            text = f"the central node has made a mistake ({text_of(error)}); send it again, and report it"
            self._send(sender, Unwanted("message", text, "internal").answer(message or Bye()))
            raise
        else:
            if sender in self._intake.peers:
                self._badges[sender] = frames[:2]

    def _take(
        self, sender: bytes, who: Permission, message: Message, frames: Sequence[zmq.Frame], arrived_ns: int
    ) -> None:
        match message:
            case Data():
                self._intake.measure(sender, message, [frame.buffer for frame in frames[2:]], arrived_ns)
            case Gap():
                self._intake.miss(sender, message)
            case Ping():
                self._intake.ping(sender)
                self._send(sender, Pong(state=self.state, text=self._trouble[:500]))
            case Hello():
                key = "" if self._keys is None else who.public
                stream = self._intake.greet(sender, message, [frame.bytes for frame in frames[2:]], key)
                self._send(
                    sender,
                    Welcome(
                        sensor=message.sensor,
                        epoch=message.epoch,
                        state=self.state,
                        acks="accepted" if self._archive is None else "stored",
                        window=self._window,
                        settled=stream.settled,
                    ),
                )
            case Bye():
                self._drop(sender)
            case AskStatus():
                now_s = time.monotonic()
                if now_s - self._report[0] > _REPORT_S:
                    self._report = now_s, self.status().encode()
                self._send(sender, Report(), self._report[1])

    def _drop(self, peer_id: bytes) -> None:
        self._badges.pop(peer_id, None)
        self._intake.bye(peer_id)

    def _send(self, peer_id: bytes, message: Message, *payload: bytes) -> None:
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

    def _hear(self) -> None:
        """Take note of what the archive has done."""
        for event in () if self._archive is None else self._archive.read():
            match event:
                case Stored():
                    self._intake.stored(event)
                case Twin():
                    self._intake.twin(event)
                case Forgotten(item, reason):
                    self._intake.forgotten(item, reason)
                case Fault(text):
                    self._fault = text
                    self._telling.fault(self._trouble)
                case Resumed():
                    self._fault = ""
                    self._telling.fault(self._trouble)
                case SealedOne(sealed):
                    self._telling.tell(
                        "sealed",
                        recording=None if sealed.recording is None else str(sealed.recording),
                        measurements=sealed.measurements,
                        missing=sealed.missing,
                        text=sealed.remark,
                    )
                case Failed(text):
                    self._telling.tell("unsealed", text=text)

    def _tick(self) -> None:
        now_s = time.monotonic()
        self._next_tick_s = now_s + _TICK_S
        if self._gate is not None and self._gate.tick():
            for peer_id, frames in list(self._badges.items()):
                if self._gate.who(frames) is None:
                    self._drop(peer_id)
        self._intake.tick(now_s)
        for peer_id in self._badges.keys() - self._intake.peers.keys():
            del self._badges[peer_id]
        if self._images is not None:
            self._images.tick(now_s)
        self._telling.fault(self._trouble)
        self._telling.keys("" if self._gate is None else self._gate.note)
        if now_s >= self._next_status_s:
            self._next_status_s = now_s + _STATUS_S
            self._note_status()
            if self._images is not None:
                self._images.publish_status(self.latest)
        if now_s >= self._next_told_s:
            self._next_told_s = now_s + _TOLD_S
            self._telling.refused(self._refused)

    # What is told of it

    @property
    def state(self) -> State:
        """What it does at present."""
        if self._closing:
            return "closing"
        if self._trouble:
            return "fault"
        return "storage" if self._images is None else "processing"

    @property
    def _trouble(self) -> str:
        """Why nothing can be stored at present; empty where it can."""
        return self._fault or ("" if self._archive is None else self._archive.stuck)

    def status(self) -> Status:
        """Return how it is."""
        status = Status(
            version=_VERSION,
            pid=os.getpid(),
            host=names.gethostname(),
            address=self.address,
            state=self.state,
            fault=self._trouble,
            uptime_s=round(time.monotonic() - self._begun_s, 3),
            time_ns=time.time_ns(),
            memory_bytes=_memory_bytes(),
            peers=len(self._intake.peers),
            keys=self._keys is not None,
            keys_note="" if self._gate is None else self._gate.note,
            refused=dict(self._refused + (Counter() if self._images is None else self._images.refused())),
            sensors={name: track.status() for name, track in self._intake.tracks.items()},
        )
        if self._archive is not None:
            status.archive = self._archive.status()
            status.archive.ack = self._intake.acks.percentiles()
        if self._images is not None:
            self._images.fill(status)
        return status

    def _note_status(self) -> None:
        self.latest = self.status()

    def _every(self, items: list[Item]) -> None:
        if self._on_stored is not None:
            with suppress(OSError):  # the same
                for item in items:
                    self._on_stored(item.run.sensor, item.run.epoch, item.first, getattr(item.what, "crc32", 0))


def _memory_bytes() -> int:
    try:
        with open("/proc/self/statm", "rb") as file:  # noqa: PTH123  a second, ten thousand times
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, ValueError, IndexError):
        return 0
