"""Reader of the settings in Hello messages, in a separate thread: TOML of 256 kB takes a tenth of a second."""

import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import zmq

from ertis_numba.journal import JournalSensor
from ertis_numba.network.central_node._admission import Unwanted
from ertis_numba.network.messages import Hello
from ertis_numba.network.wakeup_socket import WakeupSocket

__all__ = ["Greeting", "Greetings"]

MAX_WAITING_OF_PEER: Final = 128
MAX_WAITING_BYTES: Final = 64_000_000


@dataclass(slots=True, eq=False)
class Greeting:
    """Hello message, with its result: the sensor of the settings, or the error."""

    frames: list[zmq.Frame]  # identify the sender again
    hello: Hello
    payload: list[bytes]
    key: str  # public; empty without keys
    result: JournalSensor | Exception | None = None

    @property
    def peer_id(self) -> bytes:
        """Identifier of the sender."""
        return self.frames[0].bytes

    @property
    def n_bytes(self) -> int:
        """Size of the payload."""
        return sum(map(len, self.payload))


class Greetings:
    """Reader of settings in Hello messages, peers in turn; read runs in the thread and may raise errors."""

    def __init__(self, read: Callable[[Hello, list[bytes]], JournalSensor]) -> None:
        self._read = read
        self._change = threading.Condition()
        self._waiting: dict[bytes, deque[Greeting]] = {}  # By peer, in the order of their turns.
        self._done: deque[Greeting] = deque()
        self._current: Greeting | None = None  # Hello that the thread reads.
        self._bytes = 0
        self._ends = False
        self._thread: threading.Thread | None = None
        self._wakeup_socket: WakeupSocket | None = None

    def open(self) -> int:
        """Start the thread, and return a descriptor to poll; call `take` when it is readable."""
        self._wakeup_socket = WakeupSocket()
        self._thread = threading.Thread(target=self._run, args=(self._wakeup_socket,), name="greetings", daemon=True)
        self._thread.start()
        return self._wakeup_socket.fileno()

    def close(self) -> None:
        """End the thread; closing twice does no harm."""
        with self._change:
            self._ends = True
            self._change.notify()
        if self._thread is not None:
            self._thread.join()
            self._thread = None
        if self._wakeup_socket is not None:
            self._wakeup_socket.close()
            self._wakeup_socket = None

    def offer(self, greeting: Greeting) -> None:
        """Queue a greeting; never blocks."""
        with self._change:
            waiting = self._waiting.setdefault(greeting.peer_id, deque())
            if len(waiting) >= MAX_WAITING_OF_PEER or self._bytes + greeting.n_bytes > MAX_WAITING_BYTES:
                if not waiting:
                    del self._waiting[greeting.peer_id]
                raise Unwanted("message", "too many hellos are waiting; send hello again in a few seconds", "too many")
            self._bytes += greeting.n_bytes
            waiting.append(greeting)
            self._change.notify()

    def forget(self, peer_id: bytes) -> None:
        """Discard the greetings of a peer that has left."""
        with self._change:
            self._bytes -= sum(greeting.n_bytes for greeting in self._waiting.pop(peer_id, ()))
            if self._current is not None and self._current.peer_id == peer_id:
                self._current = None
            for greeting in [each for each in self._done if each.peer_id == peer_id]:
                self._done.remove(greeting)

    def take(self) -> list[Greeting]:
        """Return the greetings that were read since the last call; never blocks."""
        if self._wakeup_socket is not None:
            self._wakeup_socket.clear()
        with self._change:
            found = list(self._done)
            self._done.clear()
        return found

    def _run(self, wakeup_socket: WakeupSocket) -> None:
        while True:
            with self._change:
                self._change.wait_for(lambda: self._ends or self._waiting)
                if self._ends:
                    return
                peer_id = next(iter(self._waiting))
                waiting = self._waiting.pop(peer_id)
                greeting = self._current = waiting.popleft()
                self._bytes -= greeting.n_bytes
                if waiting:
                    self._waiting[peer_id] = waiting  # The peer goes to the end of the queue.
            try:
                greeting.result = self._read(greeting.hello, greeting.payload)
            except Exception as error:  # noqa: BLE001  the loop answers whatever it is
                greeting.result = error
            with self._change:
                if self._current is not greeting:  # The peer has left meanwhile.
                    continue
                self._current = None
                self._done.append(greeting)
            wakeup_socket.wake()
