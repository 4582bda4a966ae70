"""Reader threads, one per sensor, so that no sensor waits for another or for the disk."""

import math
import queue
import threading
import time
from dataclasses import dataclass

from ertis_numba.base.errors import SonarDisconnectedError, SonarError
from ertis_numba.devices.blocks import COUNTERS, Block
from ertis_numba.devices.driver import SonarDriver

__all__ = [
    "BlockArrived",
    "CounterRestarted",
    "Event",
    "MeasurementFailed",
    "SensorEnded",
    "SensorMessage",
    "SensorReader",
    "SensorReconnected",
    "TriggerClock",
    "drain",
]


@dataclass(frozen=True, slots=True)
class BlockArrived:
    """A received measurement."""

    sensor: str
    block: Block
    count: int  # number of the command, or the sensor's counter without wrap-around
    tick: int | None  # number of the command, common to all sensors; None with SYNC pulses
    skipped: int = 0  # measurements counted since the previous block that did not arrive
    damaged: bool = False  # blocks were rejected since the previous one
    waited_s: float = 0.0  # wait for the disk


@dataclass(frozen=True, slots=True)
class MeasurementFailed:
    """A commanded measurement that did not arrive."""

    sensor: str
    count: int
    tick: int
    reason: str
    """Short reason, for the recording."""

    text: str
    """Full message, for users."""


@dataclass(frozen=True, slots=True)
class SensorMessage:
    """Message about a sensor, for users."""

    sensor: str
    text: str


@dataclass(frozen=True, slots=True)
class CounterRestarted:
    """A sensor's counter has restarted, for example after an unnoticed power cut."""

    sensor: str


@dataclass(frozen=True, slots=True)
class SensorReconnected:
    """A sensor is connected again, after it was unplugged."""

    sensor: str
    away_s: float


@dataclass(frozen=True, slots=True)
class SensorEnded:
    """A reader has ended; ``error`` is None unless its sensor has failed."""

    sensor: str
    error: Exception | None


Event = BlockArrived | MeasurementFailed | SensorMessage | CounterRestarted | SensorReconnected | SensorEnded


@dataclass(frozen=True, slots=True, kw_only=True)
class TriggerClock:
    """Times of commands: ticks that all sensors share."""

    start_s: float  # first tick, by time.monotonic
    rate_hz: float
    n: int | None  # measurements of each sensor; None: unlimited


class SensorReader(threading.Thread):
    """Thread that receives the blocks of one sensor, and reconnects after it was unplugged."""

    def __init__(
        self,
        sensor: str,
        sonar: SonarDriver,
        *,
        pace: TriggerClock | None,
        patience_s: float,
        events: "queue.Queue[Event]",
    ) -> None:
        super().__init__(name=f"reader of {sensor}", daemon=True)
        self._sensor, self._sonar, self._pace = sensor, sonar, pace
        self._patience_s, self._events = patience_s, events
        self._stop_asked = threading.Event()
        self._abandoned = threading.Event()
        self._counter: int | None = None  # Counter of the latest block.
        self._count = 0
        self._rejected = 0
        self._waited_s = 0.0  # Time spent waiting for room in the queue since the latest block.

    def stop(self) -> None:
        """Stop after the current measurement."""
        self._stop_asked.set()

    def abandon(self) -> None:
        """Stop, and discard undelivered events, which no thread reads any more."""
        self._stop_asked.set()
        self._abandoned.set()

    def run(self) -> None:
        """Receive blocks until stopped, or until the sensor has failed permanently."""
        error: Exception | None = None
        try:
            if self._pace is None:
                self._listen()
            else:
                self._trigger_by_command(self._pace)
        except Exception as failure:  # noqa: BLE001  the session reports any error
            error = failure
        self._put(SensorEnded(self._sensor, error))

    def _listen(self) -> None:
        while not self._stop_asked.is_set():
            try:
                for block in self._sonar.listen(stop=self._may_stop, timeout_s=self._patience_s):
                    skipped = self._advance_count(block)
                    waited_s, self._waited_s = self._waited_s, 0.0
                    self._put(
                        BlockArrived(
                            self._sensor,
                            block,
                            self._count,
                            None,
                            skipped=skipped,
                            damaged=self._was_damaged(),
                            waited_s=waited_s,
                        )
                    )
            except SonarDisconnectedError as error:
                self._put(SensorMessage(self._sensor, str(error)))
                self._reconnect()
            else:
                return

    def _may_stop(self) -> bool:
        """Return True if listening may stop; a measurement in progress is received first, unless it is overdue."""
        return self._abandoned.is_set() or (self._stop_asked.is_set() and not self._sonar.receiver.missing)

    def _trigger_by_command(self, pace: TriggerClock) -> None:
        tick = taken = 0
        latest_s = time.monotonic()
        while pace.n is None or taken < pace.n:
            due_s = pace.start_s + tick / pace.rate_hz
            if self._stop_asked.wait(max(0.0, due_s - time.monotonic())):
                return
            try:
                block = self._sonar.measure()
            except SonarDisconnectedError as error:
                self._put(MeasurementFailed(self._sensor, self._count, tick, "the sensor was unplugged", str(error)))
                self._reconnect()
                latest_s = time.monotonic()
            except SonarError as error:
                self._put(MeasurementFailed(self._sensor, self._count, tick, "it did not arrive in time", str(error)))
                if time.monotonic() - latest_s > self._patience_s:
                    raise
            else:
                latest_s, taken = time.monotonic(), taken + 1
                self._put(BlockArrived(self._sensor, block, self._count, tick))
            self._count += 1
            late = math.ceil((time.monotonic() - pace.start_s) * pace.rate_hz - 1e-3)
            tick = max(tick + 1, late)

    def _advance_count(self, block: Block) -> int:
        """Update the count from the sensor's own counter, and return the number of skipped measurements."""
        step = 1
        if self._counter is not None:
            step = (block.counter - self._counter) % COUNTERS
            if step >= COUNTERS // 2:
                self._put(CounterRestarted(self._sensor))
                step = 1
            self._count += step
        self._counter = block.counter
        return max(0, step - 1)

    def _was_damaged(self) -> bool:
        before, self._rejected = self._rejected, sum(self._sonar.receiver.rejected_blocks.values())
        return self._rejected > before

    def _reconnect(self) -> None:
        gone_s = time.monotonic()
        self._sonar.reconnect(within_s=self._patience_s, stop=self._stop_asked.is_set)
        if not self._stop_asked.is_set():
            self._put(SensorReconnected(self._sensor, time.monotonic() - gone_s))

    def _put(self, event: Event) -> None:
        begin_s = time.monotonic()
        while not self._abandoned.is_set():
            try:
                self._events.put(event, timeout=0.2)
            except queue.Full:
                continue
            break
        self._waited_s += time.monotonic() - begin_s


def drain(events: "queue.Queue[Event]") -> list[Event]:
    """Wait up to 0.1 s for an event, and return all events that have arrived."""
    found: list[Event] = []
    try:
        found.append(events.get(timeout=0.1))
        while True:
            found.append(events.get_nowait())
    except queue.Empty:
        return found
