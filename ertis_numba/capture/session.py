"""Capture session: receives measurements from sensors and stores them durably."""

import queue
import secrets
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from ertis_numba import checks
from ertis_numba.capture.gap_reasons import gap_reason
from ertis_numba.capture.readers import (
    BlockArrived,
    CounterRestarted,
    Event,
    MeasurementFailed,
    SensorEnded,
    SensorMessage,
    SensorReader,
    SensorReconnected,
    TriggerClock,
)
from ertis_numba.capture.sync_counts import PulseAligner
from ertis_numba.devices.driver import SonarDriver
from ertis_numba.errors import ArgumentError, SonarError
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.journal import JournalEntry
from ertis_numba.settings import Settings

__all__ = ["CaptureCounts", "CaptureSession", "MeasurementSink"]

_WAITING_BYTES = 40_000_000  # Limit on blocks that wait for the disk; sensors wait beyond it.
_RECENT_S = 3.0  # Interval of the reported rate.
_DISK_FULL = "there was no room for it"
_MAX_OPEN_GROUPS = 16  # Limit on open groups: sensors deliver simultaneous measurements at different times.


class MeasurementSink(Protocol):
    """Destination of measurements: a `Journal`, or a buffer that keeps them until another node has stored them."""

    def add_sensor(
        self,
        name: str,
        settings: Settings,
        *,
        firmware: str = "",
        translation_m: Sequence[float] | None = ...,
        rotation_xyzw: Sequence[float] | None = ...,
    ) -> None:
        """Register a sensor before its first measurement."""

    def append(self, entries: Sequence[JournalEntry]) -> Sequence[JournalEntry] | None:
        """Store measurements; None means that all of them are stored, otherwise return the stored ones."""

    def note_gap(self, sensor: str, first: int, last: int, reason: str, *, session_id: int) -> None:
        """Store why numbers of a sensor are missing, ``first`` and ``last`` included."""


@dataclass(slots=True)
class CaptureCounts:
    """Counts of one sensor's measurements.

    Attributes
    ----------
    stored : int
        Number of stored measurements.
    missing : Counter of str
        Number of missing measurements, by reason.
    unplugged : int
        Number of times that the sensor was unplugged.
    skipped : int
        Number of commands that were skipped because the sensor was still busy.
    """

    stored: int = 0
    missing: Counter[str] = field(default_factory=Counter)
    unplugged: int = 0
    skipped: int = 0
    times_s: deque[float] = field(default_factory=lambda: deque(maxlen=64))
    """Times of the latest stored measurements by `time.monotonic`, in seconds."""

    @property
    def lost(self) -> int:
        """Number of all missing measurements."""
        return sum(self.missing.values())

    @property
    def rate_hz(self) -> float:
        """Recent rate of stored measurements, in Hz."""
        now_s = time.monotonic()
        recent_s = [time_s for time_s in self.times_s if now_s - time_s < _RECENT_S]
        return (len(recent_s) - 1) / max(recent_s[-1] - recent_s[0], 1e-9) if len(recent_s) > 1 else 0.0


@dataclass(slots=True)
class _SequenceState:
    """Sequence numbers of one sensor."""

    sequence: int | None = None  # Number of the latest measurement, stored or missing.
    first_pulse: int | None = None
    tick: int = -1  # Number of the latest command.
    why: str = ""  # Reason for missing measurements, if known.
    passed: bool = False  # True once a pulse beyond the last requested one has arrived.


class CaptureSession:
    """Capture session: receives measurements from sensors, stores them durably, and reports them.

    Sequence numbers are those of the commands to a sensor, or of the SYNC pulses since its first one. They start at 0,
    and a missing number is a missing measurement.

    Parameters
    ----------
    sonars : dict of str to SonarDriver
        Configured drivers by their names in the recording. They are armed one after the other in this order, except
        passive ones.
    settings : Settings
        Settings of all sensors.
    trigger : {"command", "sync"}
        Source of triggers: commands of this computer, or pulses of the SYNC chain.
    rate_hz : float
        Rate of commands in Hz, by default 10.
    n : int, optional
        Number of measurements of each sensor, or of pulses; unlimited by default.
    duration_s : float, optional
        Duration of the session in seconds; unlimited by default.
    patience_s : float
        Timeout for a silent or unplugged sensor in seconds, by default 30.
    mounting : dict of str to (translation_m, rotation_xyzw), optional
        Mountings by name of the sensor, as in `ertis_numba.journal.Journal.add_sensor`; unknown by default.
    session_id : int, optional
        Identifier that distinguishes the sequence numbers of sessions; random by default.
    on_stored : callable, optional
        Called with the entries of each commit, once they are durable.
    on_note : callable, optional
        Called with the sensor's name and a message about it.
    on_back : callable, optional
        Called with the sensor's name and the seconds that it was unplugged.
    on_tick : callable, optional
        Called about ten times a second.

    Attributes
    ----------
    counts : dict of str to CaptureCounts
        Counts of each sensor.
    complete, incomplete : int
        Number of pulses with measurements of all sensors, and of some sensors only.
    """

    def __init__(  # noqa: PLR0913  trigger, limits and callbacks
        self,
        sonars: Mapping[str, SonarDriver],
        settings: Settings,
        *,
        trigger: str,
        rate_hz: float = 10.0,
        n: int | None = None,
        duration_s: float | None = None,
        patience_s: float = 30.0,
        mounting: Mapping[str, tuple[Sequence[float], Sequence[float]]] | None = None,
        session_id: int | None = None,
        on_stored: Callable[[list[JournalEntry]], None] = lambda _: None,
        on_note: Callable[[str, str], None] = lambda _sensor, _text: None,
        on_back: Callable[[str, float], None] = lambda _sensor, _away_s: None,
        on_tick: Callable[[], None] = lambda: None,
    ) -> None:
        checks.choice("trigger", trigger, ("command", "sync"))
        if not sonars:
            raise ArgumentError("sonars is empty; give at least one sensor")
        self._sonars, self._settings, self._mounting = dict(sonars), settings, dict(mounting or {})
        self._synced = trigger == "sync"
        self._rate_hz = checks.between("rate", rate_hz, 1e-3, 1e3)
        self._n = None if n is None else checks.integer("n", n, 1)
        self._duration_s = None if duration_s is None else checks.positive("duration", duration_s)
        self._patience_s = checks.positive("patience", patience_s)
        self._on_stored, self._on_note, self._on_back, self._on_tick = on_stored, on_note, on_back, on_tick
        self._session_id = (
            secrets.randbits(62) if session_id is None else checks.integer("session_id", session_id, 0, 2**63 - 1)
        )
        self._record_ns = round(1e9 * settings.recording.duration_s)
        self._stop = threading.Event()
        self._errors: dict[str, Exception] = {}
        self._sequence_states = {sensor: _SequenceState() for sensor in sonars}
        self._pulses: PulseAligner[BlockArrived] = PulseAligner(list(sonars), shortest_s=settings.recording.duration_s)
        self._waiting: list[JournalEntry] = []  # Entries to store together.
        self._groups: dict[int, int] = {}
        self._closed = -(2**63)  # Latest closed group.
        self._ended: set[str] = set()
        self.counts = {sensor: CaptureCounts() for sensor in sonars}
        self.complete = self.incomplete = 0

    def stop(self) -> None:
        """End after the current measurement; a signal handler or another thread may call this."""
        self._stop.set()

    def run(self, sink: MeasurementSink) -> None:
        """Capture until the session ends.

        Raises
        ------
        SonarError
            Sensors have failed permanently; the measurements of the others are stored.
        DataError
            Further measurements cannot be stored; reported measurements are durable.
        """
        n_bytes = 4 * self._settings.recording.n_samples
        events: queue.Queue[Event] = queue.Queue(max(2, _WAITING_BYTES // n_bytes))
        readers: list[SensorReader] = []
        try:
            self._begin(sink, readers, events)
            self._process_events(sink, readers, events)
        finally:
            for reader in readers:
                reader.abandon()
            for reader in readers:
                if reader.ident is not None:
                    reader.join()
        self._raise_errors()

    def _raise_errors(self) -> None:
        for error in self._errors.values():
            if not isinstance(error, SonarError):
                raise error
        if self._errors:
            raise SonarError("; ".join(f"{sensor}: {error}" for sensor, error in self._errors.items()))

    def _begin(self, sink: MeasurementSink, readers: list[SensorReader], events: "queue.Queue[Event]") -> None:
        for sensor, sonar in self._sonars.items():
            translation_m, rotation_xyzw = self._mounting.get(sensor, (None, None))
            sink.add_sensor(
                sensor,
                self._settings,
                firmware=sonar.firmware,
                translation_m=translation_m,
                rotation_xyzw=rotation_xyzw,
            )
        if self._synced:
            for sonar in self._sonars.values():
                if not sonar.listen_only:
                    sonar.arm()
        pace = None if self._synced else TriggerClock(start_s=time.monotonic(), rate_hz=self._rate_hz, n=self._n)
        for sensor, sonar in self._sonars.items():
            readers.append(SensorReader(sensor, sonar, pace=pace, patience_s=self._patience_s, events=events))
        for reader in readers:
            reader.start()

    def _process_events(self, sink: MeasurementSink, readers: list[SensorReader], events: "queue.Queue[Event]") -> None:
        end_s = None if self._duration_s is None else time.monotonic() + self._duration_s
        while len(self._ended) < len(readers):
            if self._stop.is_set() or self._done() or (end_s is not None and time.monotonic() >= end_s):
                for reader in readers:
                    reader.stop()
            self._handle(sink, _drain(events))
            self._on_tick()
        self._store(sink, self._pulses.release(time.monotonic_ns(), at_once=True))
        for sync_count in sorted(self._groups):
            self._close_group(sync_count)

    def _done(self) -> bool:
        """Return True if every remaining sensor has delivered the last pulse, or a later one."""
        if self._n is None or not self._synced:
            return False
        return all(self._sequence_states[sensor].passed for sensor in self._sonars if sensor not in self._ended)

    def _handle(self, sink: MeasurementSink, events: Iterable[Event]) -> None:
        ready: list[tuple[BlockArrived, int]] = []
        for event in events:
            match event:
                case BlockArrived(tick=None):
                    ready += self._pulses.add(event.sensor, event, event.count, event.block.arrived.monotonic_ns)
                case BlockArrived(tick=int(tick)):
                    self._note_tick(event.sensor, tick)
                    ready.append((event, tick))
                case MeasurementFailed():
                    self._note_tick(event.sensor, event.tick)
                    self._store(sink, ready)
                    ready = []
                    self._record_gap_before(sink, event.sensor, event.count + 1, event.reason)
                    self._on_note(event.sensor, event.text)
                case SensorMessage(sensor, text):
                    self._on_note(sensor, text)
                case CounterRestarted(sensor):
                    ready += self._realign(sensor, "the sensor restarted")
                    self._on_note(sensor, "has restarted its counter")
                case SensorReconnected(sensor, away_s):
                    self.counts[sensor].unplugged += 1
                    ready += self._realign(sensor, "the sensor was unplugged")
                    self._on_back(sensor, away_s)
                case SensorEnded(sensor, error):
                    self._ended.add(sensor)
                    if error is not None:
                        self._errors[sensor] = error
                        self._on_note(sensor, str(error))
        ready += self._pulses.release(time.monotonic_ns())
        self._store(sink, ready)

    def _note_tick(self, sensor: str, tick: int) -> None:
        track = self._sequence_states[sensor]
        self.counts[sensor].skipped += tick - track.tick - 1
        track.tick = tick

    def _realign(self, sensor: str, why: str) -> list[tuple[BlockArrived, int]]:
        """Align the counter of a sensor with the others again, and return its held blocks."""
        self._sequence_states[sensor].why = why
        return self._pulses.reset(sensor)

    def _store(self, sink: MeasurementSink, ready: list[tuple[BlockArrived, int]]) -> None:
        """Store measurements durably, then report them."""
        for event, number in ready:
            entry = self._entry(sink, event, number)
            if entry is not None:
                self._waiting.append(entry)
        self._append(sink)

    def _append(self, sink: MeasurementSink) -> None:
        """Store waiting entries durably."""
        entries, self._waiting = self._waiting, []
        if not entries:
            return
        stored = sink.append(entries)
        if stored is not None:
            for sensor in (entry.measurement.stamp.sensor for entry in entries if entry not in stored):
                self.counts[sensor].missing[_DISK_FULL] += 1
            entries = list(stored)
        for entry in entries:
            stamp = entry.measurement.stamp
            counts = self.counts[stamp.sensor]
            counts.stored += 1
            counts.times_s.append(time.monotonic())
            self._group(stamp.sync_count)
        self._on_stored(entries)

    def _entry(self, sink: MeasurementSink, event: BlockArrived, number: int) -> JournalEntry | None:
        """Return the entry of a block, None beyond the last pulse; store the gap before it."""
        track, block = self._sequence_states[event.sensor], event.block
        sequence = event.count
        if self._synced:
            if track.first_pulse is None:
                track.first_pulse = number
            sequence = number - track.first_pulse
            end = sequence + 1 if self._n is None else self._n - track.first_pulse
            track.passed = self._n is not None and sequence >= end - 1
            self._record_gap_before(sink, event.sensor, min(sequence, end), track.why or gap_reason(event))
            if sequence >= end:
                return None
        if track.sequence is not None:
            sequence = max(sequence, track.sequence + 1)  # A number is never used twice.
        track.sequence, track.why = sequence, ""
        stamp = Stamp(
            sensor=event.sensor,
            sequence=sequence,
            sync_count=number,
            session_id=self._session_id,
            timestamp_ns=block.arrived.realtime_ns - self._record_ns,  # A block arrives when all of it is recorded.
            timestamp_uncertainty_ns=min(block.arrived.uncertainty_ns, 2**32 - 1),
            behaviour=block.behaviour,
        )
        measurement = Measurement(block.data, self._settings, stamp)
        return JournalEntry(measurement=measurement, monotonic_ns=block.arrived.monotonic_ns)

    def _record_gap_before(self, sink: MeasurementSink, sensor: str, stop: int, why: str) -> None:
        """Store a gap for the missing numbers below ``stop``."""
        track = self._sequence_states[sensor]
        first = 0 if track.sequence is None else track.sequence + 1
        if first < stop:
            self._append(sink)  # Earlier measurements come before the gap.
            sink.note_gap(sensor, first, stop - 1, why, session_id=self._session_id)
            self.counts[sensor].missing[why] += stop - first
            track.sequence = stop - 1

    def _group(self, sync_count: int) -> None:
        if sync_count <= self._closed:
            return  # It was counted when it was closed.
        self._groups[sync_count] = self._groups.get(sync_count, 0) + 1
        while len(self._groups) > _MAX_OPEN_GROUPS:
            self._close_group(min(self._groups))

    def _close_group(self, sync_count: int) -> None:
        self._closed = max(self._closed, sync_count)
        if self._groups.pop(sync_count) == len(self._sonars):
            self.complete += 1
        else:
            self.incomplete += 1


def _drain(events: "queue.Queue[Event]") -> list[Event]:
    """Wait up to 0.1 s for an event, and return all events that have arrived."""
    found: list[Event] = []
    try:
        found.append(events.get(timeout=0.1))
        while True:
            found.append(events.get_nowait())
    except queue.Empty:
        return found
