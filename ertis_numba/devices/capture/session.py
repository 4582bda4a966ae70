"""Capture session: receives measurements from sensors and stores them durably."""

import queue
import secrets
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError, SonarDisconnectedError, SonarError
from ertis_numba.devices.capture.gap_reasons import gap_reason
from ertis_numba.devices.capture.readers import (
    BlockArrived,
    CounterRestarted,
    Event,
    MeasurementFailed,
    SensorEnded,
    SensorMessage,
    SensorReader,
    SensorReconnected,
    TriggerClock,
    drain,
)
from ertis_numba.devices.capture.sink import CaptureCounts, MeasurementSink
from ertis_numba.devices.capture.sync_counts import PulseAligner, SequenceState
from ertis_numba.devices.driver import SonarDriver
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.journal import JournalEntry
from ertis_numba.settings import Settings

__all__ = ["CaptureSession", "SettingsChange"]

_WAITING_BYTES = 40_000_000  # Limit on blocks that wait for the disk; sensors wait beyond it.
_DISK_FULL = "there was no room for it"
_ENDED = "the capture has ended; start it again"
_MAX_OPEN_GROUPS = 16  # Limit on open groups: sensors deliver simultaneous measurements at different times.


@dataclass(frozen=True, slots=True)
class SettingsChange:
    """Change of the settings of all sensors, between two measurements."""

    settings: Settings
    on_done: Callable[[Exception | None], None] = lambda _: None  # None, or the error that keeps former settings


class CaptureSession:
    """Capture session: receives measurements from sensors, stores them durably, and reports them."""

    # Sequence numbers start at 0; a missing number is a missing measurement. `on_stored` gets durable entries.

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
        configure: Callable[[str, Settings], None] | None = None,
    ) -> None:
        checks.choice("trigger", trigger, ("command", "sync"))
        if not sonars:
            raise ArgumentError("sonars is empty; pass at least one sensor")
        self._sonars, self._settings, self._mounting = dict(sonars), settings, dict(mounting or {})
        self._synced = trigger == "sync"
        self._rate_hz = checks.between("rate", rate_hz, 1e-3, 1e3)
        self._n = None if n is None else checks.integer("n", n, 1)
        self._duration_s = None if duration_s is None else checks.positive("duration", duration_s)
        self._patience_s = checks.positive("patience", patience_s)
        self._on_stored, self._on_note, self._on_back, self._on_tick = on_stored, on_note, on_back, on_tick
        self._configure = configure
        self._has_ended = False
        self._stop = threading.Event()
        self._changes: queue.SimpleQueue[SettingsChange] = queue.SimpleQueue()
        self._errors: dict[str, Exception] = {}
        self._waiting: list[JournalEntry] = []  # Entries to store together.
        self._reset(
            settings,
            secrets.randbits(62) if session_id is None else checks.integer("session_id", session_id, 0, 2**63 - 1),
        )
        self.counts = {sensor: CaptureCounts() for sensor in sonars}
        self.complete = self.incomplete = 0
        self._armed_ns = 0  # From this time on, all sensors receive every pulse.

    def _reset(self, settings: Settings, session_id: int) -> None:
        """Begin to count measurements with these settings."""
        self._settings, self._session_id = settings, session_id
        self._record_ns = round(1e9 * settings.recording.duration_s)
        self._sequence_states = {sensor: SequenceState() for sensor in self._sonars}
        self._pulses: PulseAligner[BlockArrived] = PulseAligner(
            list(self._sonars), shortest_s=settings.recording.duration_s
        )
        self._groups: dict[int, int] = {}
        self._closed = -(2**63)  # Latest closed group.
        self._ended: set[str] = set(self._errors)
        self._first_pulse: int | None = None  # First pulse that all sensors could receive.

    def change(self, change: SettingsChange) -> None:
        """Request other settings for all sensors, from any thread: a new session after current measurements."""
        if self._configure is None:
            raise ArgumentError("this session cannot change settings; create it with configure")
        if self._has_ended:
            raise SonarError(_ENDED)
        self._changes.put(change)

    def stop(self) -> None:
        """End after the current measurement; a signal handler or another thread may call this."""
        self._stop.set()

    def run(self, sink: MeasurementSink) -> None:
        """Capture until the session ends; raise SonarError or DataError, after storing all reported ones."""
        end_s = None if self._duration_s is None else time.monotonic() + self._duration_s
        for sensor in self._sonars:
            self._register(sink, sensor, self._settings)
        if self._synced:
            for sonar in self._sonars.values():
                if not sonar.listen_only:
                    sonar.arm()
            self._armed_ns = time.monotonic_ns()
        try:
            while True:
                self._measure(sink, end_s)
                if self._changes.empty() or self._is_over(end_s) or len(self._errors) == len(self._sonars):
                    break
                self._apply(self._changes.get(), sink)
        finally:
            self._has_ended = True
            while not self._changes.empty():
                self._changes.get().on_done(SonarError(_ENDED))
        self._raise_errors()

    def _is_over(self, end_s: float | None) -> bool:
        return self._stop.is_set() or self._done() or (end_s is not None and time.monotonic() >= end_s)

    def _measure(self, sink: MeasurementSink, end_s: float | None) -> None:
        """Capture until the session ends, or a change of settings is requested."""
        n_bytes = 4 * self._settings.recording.n_samples
        events: queue.Queue[Event] = queue.Queue(max(2, _WAITING_BYTES // n_bytes))
        clock = TriggerClock(start_s=time.monotonic(), rate_hz=self._rate_hz, n=None)
        readers = []
        for sensor in (each for each in self._sonars if each not in self._errors):
            pace = None if self._synced else replace(clock, n=self._n_left(sensor))
            readers.append(
                SensorReader(sensor, self._sonars[sensor], pace=pace, patience_s=self._patience_s, events=events)
            )
        try:
            for reader in readers:
                reader.start()
            self._process_events(sink, readers, events, end_s)
        finally:
            for reader in readers:
                reader.abandon()
            for reader in readers:
                if reader.ident is not None:
                    reader.join()

    def _n_left(self, sensor: str) -> int | None:
        """Return the number of measurements that a sensor has still to make; None if it is unlimited."""
        counts = self.counts[sensor]
        return None if self._n is None else self._n - counts.stored - counts.missing[_DISK_FULL]

    def _apply(self, change: SettingsChange, sink: MeasurementSink) -> None:
        """Configure all sensors that have not failed, or keep the former settings of all of them."""
        former, failure = self._settings, None
        working = [sensor for sensor in self._sonars if sensor not in self._errors]
        pulses = [
            state.first_pulse + 1 + (-1 if state.sequence is None else state.sequence)
            for state in self._sequence_states.values()
            if state.first_pulse is not None
        ]
        registered = []
        try:
            for sensor in working:
                self._set_up(sensor, change.settings)
            for sensor in working:
                self._register(sink, sensor, change.settings)
                registered.append(sensor)
            self._armed_ns = time.monotonic_ns()
        except (ArgumentError, SonarError) as error:
            failure = error
            for sensor in working:
                self._set_up_again(sensor, former)
            for sensor in registered:
                self._register(sink, sensor, former)
        self._reset(change.settings if failure is None else former, secrets.randbits(62))
        if self._synced and self._n is not None:
            self._n = max(0, self._n - max(pulses, default=0))
        change.on_done(failure)

    def _set_up(self, sensor: str, settings: Settings) -> None:
        """Configure a sensor; errors name it, because the port that they name may be unknown to their reader."""
        try:
            for step in self._set_up_steps(sensor, settings):
                step()
        except SonarError as error:
            raise type(error)(f"sensor {sensor}: {error}") from error

    def _set_up_again(self, sensor: str, settings: Settings) -> None:
        """Configure a sensor as before; its reader does so later if it is absent or does not answer."""
        for step in self._set_up_steps(sensor, settings):
            try:
                step()
            except SonarDisconnectedError:
                pass
            except SonarError as error:
                self._sonars[sensor].hang_up(str(error))

    def _set_up_steps(self, sensor: str, settings: Settings) -> list[Callable[[], None]]:
        sonar, configure = self._sonars[sensor], self._configure
        if configure is None:
            return []
        steps: list[Callable[[], None]] = [partial(configure, sensor, settings)]
        return [sonar.disarm, *steps, sonar.arm] if self._synced else steps

    def _raise_errors(self) -> None:
        for error in self._errors.values():
            if not isinstance(error, SonarError):
                raise error
        if self._errors:
            raise SonarError("; ".join(f"{sensor}: {error}" for sensor, error in self._errors.items()))

    def _register(self, sink: MeasurementSink, sensor: str, settings: Settings) -> None:
        firmware = self._sonars[sensor].firmware
        translation_m, rotation_xyzw = self._mounting.get(sensor, (None, None))
        sink.add_sensor(sensor, settings, firmware=firmware, translation_m=translation_m, rotation_xyzw=rotation_xyzw)

    def _process_events(
        self, sink: MeasurementSink, readers: list[SensorReader], events: "queue.Queue[Event]", end_s: float | None
    ) -> None:
        n_readers = len(readers) + len(self._errors)
        while len(self._ended) < n_readers:
            if not self._changes.empty() or self._is_over(end_s):
                for reader in readers:
                    reader.stop()
            self._handle(sink, drain(events))
            self._on_tick()
        self._store(sink, self._pulses.release(time.monotonic_ns(), at_once=True))
        for sync_count in sorted(self._groups):
            self._close_group(sync_count)

    def _done(self) -> bool:
        """Return True if every remaining sensor has delivered the last pulse, or a later one."""
        if self._n is None or not self._synced:
            return False
        if self._n == 0:
            return True
        return all(self._sequence_states[sensor].passed for sensor in self._sonars if sensor not in self._errors)

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
            number = self._counted(event, number)
            if number < 0:
                return None
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

    def _counted(self, event: BlockArrived, number: int) -> int:
        """Return the number of a pulse since all sensors are armed, or a negative one for an earlier pulse."""
        if self._first_pulse is None:
            if event.block.arrived.monotonic_ns - self._record_ns < self._armed_ns:
                return -1
            self._first_pulse = number
        return number - self._first_pulse

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
