"""Event loop of the central node; never blocks on a peer."""

import os
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Final, Self

import zmq

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.network.addresses import DEFAULT_LISTEN
from ertis_numba.network.central_node._admission import ReceivedMessage, Unwanted, handlers_of, read, require_role
from ertis_numba.network.central_node._archive import Archive
from ertis_numba.network.central_node._images import Guarded
from ertis_numba.network.central_node._intake import Intake
from ertis_numba.network.central_node._poses import PoseIntake
from ertis_numba.network.central_node._received_items import (
    Forgotten,
    Remark,
    Resumed,
    SealedOne,
    SealingFailed,
    StorageFault,
    Stored,
    StoredDuplicate,
)
from ertis_numba.network.central_node._reporting import Condition, EventReporter, text_of
from ertis_numba.network.central_node._server_socket import ServerSocket
from ertis_numba.network.central_node._settings_requests import SettingsRequests
from ertis_numba.network.central_node._validation import Greeting, Greetings
from ertis_numba.network.keys import ServerKeys
from ertis_numba.network.message_fields import State, as_line
from ertis_numba.network.messages import (
    AskStatus,
    Bye,
    Configure,
    Configured,
    Data,
    Gap,
    Hello,
    Message,
    Ping,
    PlatformPose,
    Pong,
    Refused,
    Report,
    Welcome,
)
from ertis_numba.network.status import Status

if TYPE_CHECKING:
    from ertis_numba.network.processing import ImageProcessing

__all__ = ["CentralNode"]

MAX_BYTES: Final = 4 * 2**20
_TURN: Final = 32  # Limit on messages before other work has its turn.
_TICK_S: Final = 0.1
_LOG_INTERVAL_S: Final = 1.0  # Interval between events about refusals.
_STATUS_S: Final = 1.0
_FINISH_S: Final = 5.0


class CentralNode:
    """Receiver of sensor nodes' measurements; use it in a ``with`` statement, and call `run`.

    Addresses that other machines can reach require ``keys``; with an ``archive``, acks confirm storage. ``max_bytes``
    limits a measurement, and ``window`` the unacknowledged measurements of a session. ``on_event`` gets dicts whose
    ``event`` is listening, joined, left, fault, resumed, sealed, unsealed, conflict, configure (an admin changes
    settings), refused, keys (state of the allow list), shared (two nodes send one sensor) or internal (an internal
    error). ``on_stored`` gets sensor, session_id, sequence and CRC-32. Other threads may read ``latest``.
    """

    def __init__(
        self,
        listen: str = DEFAULT_LISTEN,
        *,
        keys: ServerKeys | None = None,
        archive: Archive | None = None,
        processing: "ImageProcessing | None" = None,
        max_bytes: int = MAX_BYTES,
        window: int = 16,
        on_event: Callable[[dict[str, Any]], None] = lambda _: None,
        on_stored: Callable[[str, int, int, int], None] | None = None,
    ) -> None:
        if archive is None and processing is None:
            raise ArgumentError("a central node has neither archive nor processing; pass at least one of them")
        self._listen, self._keys, self._archive = listen, keys, archive
        self._images = None if processing is None else Guarded(processing, self._internal)
        self._window = checks.integer("window", window, 1, 1024)
        self._max_bytes = checks.integer("max_bytes", max_bytes, 4096, 2**31)
        self._event_reporter = EventReporter(on_event, on_stored)
        self._server = ServerSocket(keys)
        self._intake = Intake(
            store=archive,
            viewer=self._images,
            send=self._server.send,
            notify=self._event_reporter.notify,
            on_stored=self._event_reporter.stored,
            max_bytes=max_bytes,
        )
        self._condition = Condition(
            listen, self._server, self._intake, archive=archive, images=self._images, keys=keys is not None
        )
        self._settings_requests = SettingsRequests(
            self._server.send,
            self._intake.nodes_of,
            max_bytes=max_bytes,
            require=None if self._images is None else self._images.require_usable,
        )
        self._poses = PoseIntake(archive)
        self._handlers = handlers_of(self)
        self._greetings = Greetings(self._intake.read)
        self._archive_fd = self._greetings_fd = self._requests_fd = -1
        self._poller = zmq.Poller()
        self._polled: set[int] = set()  # Descriptors of image processing, which change as its processes do.
        self._stopping = threading.Event()
        self._next_tick_s = self._next_log_s = self._next_status_s = 0.0
        self.latest = self.status()

    def __enter__(self) -> Self:
        self._condition.begun_s = time.monotonic()
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
            self._images.start(self._stopping.is_set)
            if self._stopping.is_set():
                return
        self._greetings_fd, self._requests_fd = self._greetings.open(), self._settings_requests.open()
        self._server.open(self._listen, max_bytes=self._max_bytes)
        self._server.register(self._poller)
        if self._archive is not None:
            self._poller.register(self._archive_fd, zmq.POLLIN)
        for fd in (self._greetings_fd, self._requests_fd):
            if fd >= 0:
                self._poller.register(fd, zmq.POLLIN)
        self._event_reporter.notify("listening", address=self._condition.address, pid=os.getpid())

    def __exit__(self, *_: object) -> None:
        self.close()

    def _note_status(self) -> None:
        self.latest = self.status()

    def close(self) -> None:
        """Stop receiving, and make recordings of all stored measurements; closing twice is harmless."""
        with ExitStack() as stack:  # Any error leaves no part open.
            stack.callback(self._note_status)
            if self._archive is not None:
                stack.callback(self._hear)
                stack.callback(self._archive.close)
            if self._images is not None:
                stack.callback(self._images.close, _FINISH_S)
            stack.callback(self._greetings.close)
            stack.callback(self._settings_requests.close)
            stack.callback(self._server.close)
            self._event_reporter.refused(self._server.refused)

    def stop(self) -> None:
        """End `run` within a tenth of a second, or the start of processes in ``with``; any thread may call this."""
        self._stopping.set()

    def run(self, duration_s: float | None = None) -> None:
        """Receive measurements until `stop` is called, and then wait until they are on disk."""
        if not self._server.is_open and not self._stopping.is_set():
            raise ArgumentError("the central node is not open; use it in a with statement")
        end_s = None if duration_s is None else time.monotonic() + checks.positive("duration", duration_s)
        while not self._stopping.is_set() and (end_s is None or time.monotonic() < end_s):
            self._turn()
        self._condition.closing = True
        for peer_id in self._intake.peers:
            self._server.send(peer_id, Pong(state=self.state))
        if self._archive is not None and not self._archive.fault:
            self._archive.finish(_FINISH_S)
            self._hear()
            self._intake.acknowledge()

    # Event loop

    def _turn(self) -> None:
        """Wait for an event, and process it."""
        self._follow_processes()
        ready = dict(self._poller.poll(max(0, round(1e3 * (self._next_tick_s - time.monotonic())))))
        called = self._server.serve(ready)
        if self._archive_fd in ready:
            self._hear()
        if self._greetings_fd in ready:
            for greeting in self._greetings.take():
                self._answer_greeting(greeting)
        if self._requests_fd in ready:
            self._settings_requests.take()
        if self._images is not None:
            for fd in ready.keys() & self._polled:
                self._images.ready(fd)
            self._intake.dropped(self._images.drain_dropped())
        if called:
            self._receive()
        self._intake.acknowledge()
        if time.monotonic() >= self._next_tick_s:
            self._tick()

    def _follow_processes(self) -> None:
        """Poll the processes that exist now."""
        others = set() if self._images is None else set(self._images.fds())
        for fd in self._polled - others:
            self._poller.unregister(fd)
        for fd in others - self._polled:
            self._poller.register(fd, zmq.POLLIN)
        self._polled = others

    def _receive(self) -> None:
        for _ in range(_TURN):
            frames = self._server.receive()
            if frames is None:
                return
            self._handle(frames)

    def _internal(self, error: Exception) -> None:
        """Count and report an internal error."""
        self._server.refused["internal"] += 1
        self._event_reporter.internal(error)

    def _handle(self, frames: list[zmq.Frame]) -> None:
        """Process a message or refuse it; never raises for a message."""
        arrived_ns = time.monotonic_ns()
        sender = frames[0].bytes
        message: Message | None = None
        try:
            who = self._server.who(frames)
            if who is None:
                # The server socket counts messages of keys that are not listed.
                self._greetings.forget(sender)
                self._intake.bye(sender)
                reason = "this key is not in the allow list; add it"
                self._server.send(sender, Refused(code="role", reason=reason))
                return
            message = read(frames)
            require_role(who, message)
            self._handlers[type(message)](message, ReceivedMessage(frames, who, arrived_ns))
        except Exception as error:  # noqa: BLE001  whatever somebody sends, the others are served
            self._fail(sender, error, message)
        else:
            self._note_peer(frames)

    def _fail(self, sender: bytes, error: Exception, message: Message | None) -> None:
        """Answer a failed message, so that its sender does not wait in vain."""
        if isinstance(error, Unwanted):
            self._refuse(sender, error, message)
            return
        self._internal(error)
        text = (
            f"the central node has an internal error ({text_of(error)}); send the message again, and report the error"
        )
        self._server.send(sender, Unwanted("message", text, "internal").answer(message or Bye()))

    def _note_peer(self, frames: list[zmq.Frame]) -> None:
        if frames[0].bytes in self._intake.peers:
            self._server.keep_badge(frames)

    def _refuse(self, sender: bytes, error: Unwanted, message: Message | None) -> None:
        self._server.refused[error.kind] += 1
        self._server.send(sender, error.answer(message or Bye()))

    def _answer_greeting(self, greeting: Greeting) -> None:
        """Accept or refuse a hello; never raises for a hello."""
        try:
            self._greet(greeting)
        except Exception as error:  # noqa: BLE001  as in _handle
            self._fail(greeting.peer_id, error, greeting.hello)
        else:
            self._note_peer(greeting.frames)

    def _greet(self, greeting: Greeting) -> None:
        """Accept or refuse a hello whose settings were read."""
        if isinstance(greeting.result, Exception):
            raise greeting.result
        if greeting.result is None or self._server.who(greeting.frames) is None:  # Its key was removed meanwhile.
            return
        sender, hello = greeting.peer_id, greeting.hello
        stream = self._intake.greet(sender, hello, greeting.result, greeting.key)
        self._server.send(
            sender,
            Welcome(
                sensor=hello.sensor,
                session_id=hello.session_id,
                state=self.state,
                acks="accepted" if self._archive is None else "stored",
                window=self._window,
                acked_through=stream.acked_through,
            ),
        )

    def _on_data(self, data: Data, received: ReceivedMessage) -> None:
        self._intake.measure(received.sender, data, [frame.buffer for frame in received.payload], received.arrived_ns)

    def _on_gap(self, gap: Gap, received: ReceivedMessage) -> None:
        self._intake.miss(received.sender, gap)

    def _on_ping(self, _: Ping, received: ReceivedMessage) -> None:
        self._intake.ping(received.sender)
        text = self._condition.trouble or self._intake.remark(received.sender)
        self._server.send(received.sender, self._sign_of_life(text))

    def _sign_of_life(self, text: str) -> Pong:
        return Pong(state=self.state, text=as_line(text))

    def _on_hello(self, hello: Hello, received: ReceivedMessage) -> None:
        key = "" if self._keys is None else received.who.public
        payload = [frame.bytes for frame in received.payload]
        self._greetings.offer(Greeting(received.frames[:2], hello, payload, key))

    def _on_platformpose(self, pose: PlatformPose, received: ReceivedMessage) -> None:
        self._poses.add(received.sender, pose, received.who)

    def _on_bye(self, _: Bye, received: ReceivedMessage) -> None:
        self._greetings.forget(received.sender)
        self._intake.bye(received.sender)
        self._poses.bye(received.sender)

    def _on_configure(self, request: Configure, received: ReceivedMessage) -> None:
        self._settings_requests.forward(received.sender, request, [frame.bytes for frame in received.payload])
        name = received.who.name
        self._event_reporter.notify("configure", sensor=request.sensor, text=f"new settings requested by key {name}")

    def _on_configured(self, answer: Configured, _: ReceivedMessage) -> None:
        self._settings_requests.answer(answer)

    def _on_askstatus(self, _: AskStatus, received: ReceivedMessage) -> None:
        self._server.send(received.sender, Report(), self._condition.report())

    def _hear(self) -> None:
        """Process the results of the archive."""
        for event in () if self._archive is None else self._archive.read():
            match event:
                case Stored():
                    self._intake.stored(event)
                case StoredDuplicate():
                    self._intake.twin(event)
                case Forgotten(item, reason):
                    self._intake.forgotten(item, reason)
                case StorageFault(text):
                    self._condition.fault = text
                    self._event_reporter.fault(self._condition.trouble)
                case Resumed():
                    self._condition.fault = ""
                    self._event_reporter.fault(self._condition.trouble)
                case SealedOne(sealed):
                    self._event_reporter.sealed(sealed)
                case SealingFailed(text):
                    self._event_reporter.notify("unsealed", text=text)
                case Remark(text):
                    self._event_reporter.notify("damage", text=text)

    def _tick(self) -> None:
        now_s = time.monotonic()
        self._next_tick_s = now_s + _TICK_S
        for peer_id in self._server.tick(self._intake.peers.keys()):
            self._intake.bye(peer_id)
        self._intake.tick(now_s)
        self._settings_requests.tick(self._intake.peers, self._sign_of_life(self._condition.trouble))
        if self._images is not None:
            self._images.tick(now_s)
        self._event_reporter.fault(self._condition.trouble)
        self._event_reporter.keys(self._server.note)
        if now_s >= self._next_status_s:
            self._next_status_s = now_s + _STATUS_S
            self._note_status()
            if self._images is not None:
                self._images.publish_status(self.latest)
        if now_s >= self._next_log_s:
            self._next_log_s = now_s + _LOG_INTERVAL_S
            self._event_reporter.refused(self._server.refused)

    @property
    def address(self) -> str:
        """Actual address, in the form that nodes on this machine use."""
        return self._server.address

    @property
    def state(self) -> State:
        """Current state."""
        return self._condition.state

    def status(self) -> Status:
        """Return the status."""
        return self._condition.status()
