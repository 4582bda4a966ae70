"""Thread that talks to the central node: sends hello, data and gaps, receives acks, and reconnects."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final, Literal

import zmq

from ertis_numba.base.errors import DataError, FormatVersionError
from ertis_numba.network import messages
from ertis_numba.network.connection import Connection
from ertis_numba.network.keys import ClientKeys
from ertis_numba.network.messages import SILENCE_LIMIT_S
from ertis_numba.network.sensor_node._memory_spool import Spool
from ertis_numba.network.sensor_node._outgoing_sessions import OutgoingSession
from ertis_numba.network.sensor_node._settings_requests import RequestQueue, SettingsRequest
from ertis_numba.network.sensor_node._wire import Acknowledged, frames_of, greeting
from ertis_numba.network.trace import mark
from ertis_numba.network.wakeup_socket import WakeupSocket

__all__ = ["Central", "Link"]

Central = Literal["away", "storage", "processing", "fault", "closing"]

_GREET_AGAIN_S = 2.0
_REFUSED_S = 5.0
_FAILED_S = 1.0
_TURN_S = 0.1
_UNDER_WAY_BYTES = 32_000_000
_AT_ONCE = 32  # Limit on messages before other work has its turn.
_LINE_CHARACTERS = 400
_MAX_REPORTED = 256
_WANTED: Final = (messages.Welcome, messages.Ack, messages.Pong, messages.Refused, messages.Configure)


class Link(threading.Thread):
    """Thread that sends a spool's items, and reconnects until it is stopped; its functions must not raise."""

    def __init__(
        self,
        address: str,
        *,
        keys: ClientKeys | None,
        spool: Spool,
        on_acked: Callable[[Acknowledged], None],
        on_note: Callable[[str], None],
        on_settings: Callable[[SettingsRequest], None] | None = None,
    ) -> None:
        super().__init__(name=f"link to {address}", daemon=True)
        self._address, self._keys, self._spool = address, keys, spool
        self._on_acked, self._on_note = on_acked, on_note
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._connection: Connection | None = None
        self._wakeup_socket = WakeupSocket()
        self._requests = RequestQueue(on_settings, self.wake)
        self._stopping = threading.Event()
        self._was_there = False
        self._reported: set[tuple[str, str]] = set()  # Subject and sensor.
        self._refusals: dict[str, str] = {}  # By sensor; "" stands for all.
        self._next_sensor = 0
        self._greeted: set[tuple[str, int]] = set()
        self.central: Central = "away"
        self.reconnects = 0
        self._connect()  # An address that cannot be used raises its error here.

    @property
    def refusal(self) -> str:
        """Reason and remedy if the central node refuses a sensor; empty if it accepts all."""
        return next(iter(self._refusals.copy().values()), "")

    def wake(self) -> None:
        """Wake the thread, because there is something to send."""
        self._wakeup_socket.wake()

    def stop(self) -> None:
        """Stop the thread and wait for its end."""
        self._stopping.set()
        self.wake()
        if self.ident is not None:
            self.join()
        self._disconnect(linger_s=_TURN_S)
        self._context.destroy(linger=0)
        self._wakeup_socket.close()

    def run(self) -> None:
        """Exchange messages with the central node until stopped."""
        while not self._stopping.is_set():
            try:
                self._turn()
            except Exception as error:  # noqa: BLE001  measurements are kept whatever happens, and sent later
                text = f"the link to {self._address} has failed ({_line(error)}); reconnecting"
                self._note(text, "link", type(error).__name__)
                self._stopping.wait(_FAILED_S)
                with suppress(Exception):
                    self._connect()
        if self._connection is not None:
            self._connection.send(messages.encode(messages.Bye()))

    def _connect(self) -> None:
        """Make a new connection: messages in the old one were acknowledged, or will be sent again."""
        self._disconnect()
        self._connection = Connection(self._context, self._address, keys=self._keys)
        self._greeted.clear()
        with self._spool.turn:
            for run in self._spool.runs.values():
                if run.stage != "waiting":
                    run.stage = "new"

    def _disconnect(self, linger_s: float = 0.0) -> None:
        if self._connection is not None:
            self._connection.close(linger_s)
        self._connection = None

    def _turn(self) -> None:
        connection = self._connection
        if connection is None:
            self._connect()
            return
        connection.wait(_TURN_S, self._wakeup_socket)
        self._wakeup_socket.clear()
        for text in connection.refusals():
            self._refusals[""] = text
            self._note(text, text)  # There are only a few of them.
        self._receive(connection)
        now_s = time.monotonic()
        if now_s - (connection.heard_s or connection.opened_s) > SILENCE_LIMIT_S:
            self._lose()
            return
        connection.ping(now_s)
        self._requests.send(connection.send)
        self._send_pending(connection, now_s)

    def _lose(self) -> None:
        if self.central != "away" or not self._was_there:
            text = f"the central node at {self._address} does not answer; measurements are kept meanwhile"
            self._note(text, "away")
        if self.central != "away":  # Its last state is no longer valid.
            self._refusals.clear()
        self.central = "away"
        self._connect()

    # Received messages

    def _receive(self, connection: Connection) -> None:
        for _ in range(_AT_ONCE):
            frames = connection.receive()
            if frames is None:
                return
            try:
                message = messages.decode(frames[0], _WANTED)
            except FormatVersionError as error:
                connection.heard_s = time.monotonic()
                self._refusals[""] = str(error)
                with self._spool.turn:
                    self._wait(list(self._spool.runs.values()), str(error), "version")
            except DataError as error:
                self._note(f"a message from the central node cannot be decoded: {error}", "message")
            else:
                connection.heard_s = time.monotonic()
                self._take(message, frames[1:])

    def _take(self, message: messages.Message, payload: list[memoryview]) -> None:
        match message:
            case messages.Refused():
                self._take_refusal(message)
            case messages.Configure():
                self._requests.take(message, payload)
            case messages.Pong():
                self._see(message.state, message.text)
            case messages.Welcome():
                self._take_welcome(message)
            case messages.Ack():
                with self._spool.turn:
                    run = self._spool.runs.get((message.sensor, message.session_id))
                    if run is None:
                        return
                    done = run.settle(message.acked_through, time.monotonic())
                    dropped = run.newly_dropped(message.dropped)
                    self._spool.settle(run, done, message.status, dropped)
                if done or dropped:
                    mark("acknowledged", run.sensor.name, run.acked_through)
                    self._on_acked(Acknowledged(*run.key, run.acked_through, message.status, dropped))

    def _take_welcome(self, message: messages.Welcome) -> None:
        with self._spool.turn:
            run = self._spool.runs.get((message.sensor, message.session_id))
            if run is None or run.stage != "asked":
                return
            for refused in ("", message.sensor):
                self._refusals.pop(refused, None)
            done = run.welcome(message.acked_through, message.window, time.monotonic())
            self._spool.settle(run, done, message.acks)
        self._see(message.state)
        if done:
            self._on_acked(Acknowledged(*run.key, run.acked_through, message.acks))

    def _see(self, state: Literal["storage", "processing", "fault", "closing"], text: str | None = None) -> None:
        """Update the state of the central node, with its reason if given."""
        before, self.central = self.central, state
        if before == "away":
            self.reconnects += self._was_there
            if self._was_there or self._reported:
                self._on_note(f"connected to the central node at {self._address}")
            self._was_there = True
            self._reported.clear()
        if state == "fault" and text is not None:
            why = text or "no reason given"
            self._note(f"the central node cannot store: {why}; measurements are kept", "fault")
        elif state != "fault" and before == "fault":
            self._on_note("the central node can store again")
            self._reported.clear()
            with self._spool.turn:
                for run in self._spool.runs.values():
                    run.go_back(time.monotonic())
        if state != "fault" and text:
            self._note(text, text)

    def _take_refusal(self, message: messages.Refused) -> None:
        with self._spool.turn:
            runs = [
                run
                for run in self._spool.runs.values()
                if message.sensor in ("", run.sensor.name)
                and (not message.sensor or message.session_id in (0, run.session_id))
            ]
        if message.code == "hello":
            for run in runs:
                if run.stage == "welcome":
                    run.stage = "new"
            return
        if message.code == "size" and self._send_bye():
            return
        self._refusals[message.sensor] = message.reason
        about = f" of sensor {message.sensor}" if message.sensor else ""
        text = f"the central node refuses measurements{about}: {message.reason}"
        self._wait(runs, text, f"refused {message.code}", message.sensor)

    def _send_bye(self) -> bool:
        """Send bye for some finished sessions, within the available room; return True if there were any."""
        connection = self._connection
        with self._spool.turn:
            going_on = {run.key for run in self._spool.runs.values() if run.items}
        if connection is None or not self._greeted - going_on:
            return False
        if not connection.send(messages.encode(messages.Bye())):
            return False
        self._greeted.clear()
        with self._spool.turn:
            for run in self._spool.runs.values():
                if run.stage != "waiting":
                    run.stage = "new"
        return True

    def _wait(self, runs: list[OutgoingSession], text: str, about: str, sensor: str = "") -> None:
        """Try a session again later, and let others continue meanwhile."""
        self._note(text, about, sensor)
        for run in runs:
            run.stage, run.since_s = "waiting", time.monotonic() + _REFUSED_S

    def _note(self, text: str, about: str, sensor: str = "") -> None:
        """Report a line once until the central node is there again, even if its numbers change."""
        if (about, sensor) not in self._reported and len(self._reported) < _MAX_REPORTED:
            self._reported.add((about, sensor))
            self._on_note(text)

    # Sent messages

    def _active(self, now_s: float) -> list[OutgoingSession]:
        """Return the sessions to send: for each accepted sensor, the oldest one with items."""
        active: dict[str, OutgoingSession] = {}
        with self._spool.turn:
            for run in self._spool.runs.values():
                if run.stage == "waiting" and now_s > run.since_s:
                    run.stage = "new"
                if run.items and run.stage != "waiting":
                    active.setdefault(run.sensor.name, run)
        return list(active.values())

    def _send_pending(self, connection: Connection, now_s: float) -> None:
        runs = self._active(now_s)
        for run in runs:
            with self._spool.turn:
                if run.stage == "welcome" and run.is_stuck(now_s):
                    run.go_back(now_s)
                    run.stage = "new"  # The central node may have less than before: it gets the present items.
            if run.stage == "new" or (run.stage == "asked" and now_s - run.since_s > _GREET_AGAIN_S):
                self._greet(connection, run, now_s)
        runs = [run for run in runs if run.stage == "welcome"]
        n_sent, before = 0, -1
        while runs and not connection.is_blocked and before < n_sent < _AT_ONCE:
            before = n_sent
            for _ in runs:  # In turn, beginning with another one each time.
                self._next_sensor += 1
                n_sent += self._send_next(connection, runs, runs[self._next_sensor % len(runs)])
        if n_sent >= _AT_ONCE:
            self.wake()

    def _greet(self, connection: Connection, run: OutgoingSession, now_s: float) -> None:
        with self._spool.turn:
            if not run.items:
                return
            frames = greeting(run)
        if connection.send(*frames):
            run.stage, run.since_s = "asked", now_s
            self._greeted.add(run.key)

    def _send_next(self, connection: Connection, runs: list[OutgoingSession], run: OutgoingSession) -> bool:
        """Send the next item of a session, and return True if one was sent."""
        window = 1 if self.central == "fault" else run.window
        with self._spool.turn:
            item = None if connection.is_blocked else run.to_send(window)
            if item is None:
                return False
            under_way = sum(sent.n_bytes for each in runs for sent in each.under_way())
            if under_way and under_way + item.n_bytes > _UNDER_WAY_BYTES:
                return False
        try:
            entry = self._spool.entry(item, run)
        except DataError as error:  # The disk of the spool fails.
            self._wait([run], str(error), "spool", run.sensor.name)
            return False
        if entry is None and not item.reason:  # The item was replaced by a gap meanwhile.
            return False
        frames, last = frames_of(run, item, entry)
        if not connection.send(*frames):
            return False
        mark("sent", run.sensor.name, last)
        with self._spool.turn:
            run.mark_sent(last, time.monotonic())
        return True


def _line(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:_LINE_CHARACTERS]
