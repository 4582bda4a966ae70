"""A capture: sensors in, a journal out."""

import queue
import secrets
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from ertis_numba import checks
from ertis_numba.capture.readers import Arrived, Ended, Event, Failed, Note, Pace, Reader, Returned
from ertis_numba.capture.sync_counts import SyncCounts
from ertis_numba.devices.sonar import Sonar
from ertis_numba.errors import ArgumentError, SonarError
from ertis_numba.frames import Measurement, Stamp
from ertis_numba.journal import Entry, Journal
from ertis_numba.settings import Settings

__all__ = ["Counts", "Session"]

_WAITING = 64  # blocks that wait for the disk, some 40 MB; then sensors wait
_RECENT_S = 3.0  # over which the rate is told
_GROUPS = 16  # that are still open: sensors deliver what they measured together at different times
_TURNS = 2**32  # of the counter


@dataclass(slots=True)
class Counts:
    """What became of one sensor's measurements so far.

    Attributes
    ----------
    stored : int
        Durable in the journal.
    missing : Counter of str
        Sequence numbers that are missing, by reason.
    failed : int
        Measurements that were asked for and did not come.
    unplugged : int
    """

    stored: int = 0
    missing: Counter[str] = field(default_factory=Counter)
    failed: int = 0
    unplugged: int = 0
    _recent: deque[float] = field(default_factory=deque)

    @property
    def lost(self) -> int:
        """All that is missing."""
        return sum(self.missing.values()) + self.failed

    @property
    def rate_hz(self) -> float:
        """Measurements per second, lately."""
        while self._recent and self._recent[0] < time.monotonic() - _RECENT_S:
            self._recent.popleft()
        if len(self._recent) < 2:
            return 0.0
        return (len(self._recent) - 1) / max(self._recent[-1] - self._recent[0], 1e-9)

    def count(self) -> None:
        """Count a stored measurement."""
        self.stored += 1
        self._recent.append(time.monotonic())


@dataclass(slots=True)
class _Track:
    """Where one sensor's numbers are."""

    counter: int | None = None  # of its latest block
    count: int = 0  # of its measurements; whether a counter that was set to 0 starts there is up to the firmware
    sequence: int | None = None
    away: bool = False
    rejected: int = 0


class Session:
    """Takes measurements of sensors into a journal, durably and in groups.

    Parameters
    ----------
    sonars : dict of str to Sonar
        Configured, by the names that the recording is to have; armed one after the other in this order, but for those
        that are only listened to.
    settings : Settings
        Of all of them.
    trigger : {"command", "sync"}
    rate_hz : float
        Of commands.
    n : int, optional
        Measurements of each sensor; until it is stopped by default.
    duration_s : float, optional
    patience_s : float
        How long a sensor may be silent or unplugged before it is given up.
    on_stored : callable, optional
        Called with the entries of each commit, when they are durable.
    on_note : callable, optional
        Called with the sensor's name and a line about it.
    on_back : callable, optional
        Called with the sensor's name and the seconds that it was unplugged.

    Attributes
    ----------
    counts : dict of str to Counts
    complete, incomplete : int
        Pulses of which all sensors have delivered, and others; of several sensors only.
    """

    def __init__(
        self,
        sonars: dict[str, Sonar],
        settings: Settings,
        *,
        trigger: str,
        rate_hz: float = 10.0,
        n: int | None = None,
        duration_s: float | None = None,
        patience_s: float = 30.0,
        on_stored: Callable[[list[Entry]], None] = lambda _: None,
        on_note: Callable[[str, str], None] = lambda _sensor, _text: None,
        on_back: Callable[[str, float], None] = lambda _sensor, _away_s: None,
    ) -> None:
        checks.choice("trigger", trigger, ("command", "sync"))
        if not sonars:
            raise ArgumentError("no sensor is given to capture from; give at least one")
        self._sonars, self._settings = sonars, settings
        self._journal: Journal
        self._synced = trigger == "sync"
        self._rate_hz = checks.between("rate", rate_hz, 1e-3, 1e3)
        self._n = None if n is None else checks.whole("n", n, 1)
        self._duration_s = None if duration_s is None else checks.positive("duration", duration_s)
        self._patience_s = checks.positive("patience", patience_s)
        self._on_stored, self._on_note, self._on_back = on_stored, on_note, on_back
        self._epoch = secrets.randbits(63)
        self._stop = threading.Event()
        self._errors: dict[str, Exception] = {}
        self._tracks = {sensor: _Track() for sensor in sonars}
        self._pulses: SyncCounts[Arrived] = SyncCounts(list(sonars), shortest_s=settings.recording.duration_s)
        self._groups: dict[int, int] = {}
        self._ended: set[str] = set()
        self.counts = {sensor: Counts() for sensor in sonars}
        self.complete = self.incomplete = 0

    def stop(self) -> None:
        """End after the measurement that has begun; may be called from a signal handler or another thread."""
        self._stop.set()

    def run(self, journal: Journal) -> None:
        """Capture into a journal until it is done.

        Raises
        ------
        SonarError
            Sensors were given up; what the others delivered is in the journal.
        DataError
            The journal cannot be written; what was reported is in it.
        """
        self._journal = journal
        events: queue.Queue[Event] = queue.Queue(_WAITING)
        readers = self._begin(events)
        try:
            self._take(readers, events)
        finally:
            for reader in readers:
                reader.abandon()
            for reader in readers:
                reader.join()
        for sensor, error in self._errors.items():
            raise SonarError(f"{sensor}: {error}") if isinstance(error, SonarError) else error

    def _begin(self, events: "queue.Queue[Event]") -> list[Reader]:
        for sensor, sonar in self._sonars.items():
            self._journal.add_sensor(sensor, self._settings, firmware=sonar.firmware)
        if self._synced:
            for sonar in self._sonars.values():
                if not sonar.passive:
                    sonar.arm()
        pace = None if self._synced else Pace(start_s=time.monotonic(), rate_hz=self._rate_hz, n=self._n)
        readers = [
            Reader(sensor, sonar, pace=pace, patience_s=self._patience_s, events=events)
            for sensor, sonar in self._sonars.items()
        ]
        for reader in readers:
            reader.start()
        return readers

    def _take(self, readers: list[Reader], events: "queue.Queue[Event]") -> None:
        end_s = None if self._duration_s is None else time.monotonic() + self._duration_s
        while len(self._ended) < len(readers):
            if self._stop.is_set() or self._done() or (end_s is not None and time.monotonic() >= end_s):
                for reader in readers:
                    reader.stop()
            self._handle(_all_of(events))
        self._store(self._pulses.release(time.monotonic_ns(), at_once=True))
        for sensors in self._groups.values():
            self._close_group(sensors)

    def _done(self) -> bool:
        """Whether every sensor that is still there has passed the last pulse."""
        if self._n is None or not self._synced:
            return False
        sequences = [self._tracks[sensor].sequence for sensor in self._sonars if sensor not in self._ended]
        return all(sequence is not None and sequence >= self._n - 1 for sequence in sequences)

    def _handle(self, events: Iterable[Event]) -> None:
        ready: list[tuple[Arrived, int]] = []
        for event in events:
            match event:
                case Arrived(tick=None):
                    counter = self._unwrapped(event)
                    ready += self._pulses.add(event.sensor, event, counter, event.block.arrived.monotonic_ns)
                case Arrived(tick=int(tick)):
                    ready.append((event, tick))
                case Failed(sensor, reason):
                    self.counts[sensor].failed += 1
                    self._on_note(sensor, reason)
                case Note(sensor, text):
                    self._on_note(sensor, text)
                case Returned(sensor, away_s):
                    self.counts[sensor].unplugged += 1
                    self._tracks[sensor].away = True
                    self._pulses.forget(sensor)
                    self._on_back(sensor, away_s)
                case Ended(sensor, error):
                    self._ended.add(sensor)
                    if error is not None:
                        self._errors[sensor] = error
                        self._on_note(sensor, str(error))
        ready += self._pulses.release(time.monotonic_ns())
        self._store(ready)

    def _unwrapped(self, event: Arrived) -> int:
        """Return the sensor's own count, from 0 and without end."""
        track, counter = self._tracks[event.sensor], event.block.counter
        if track.counter is not None:
            step = (counter - track.counter) % _TURNS
            if step >= _TURNS // 2:  # it has begun anew, as after a power cut that nobody has noticed
                self._pulses.forget(event.sensor)
                track.away, step = True, 1
            track.count += step
        track.counter = counter
        return track.count

    def _store(self, ready: list[tuple[Arrived, int]]) -> None:
        """Commit measurements, then tell of them."""
        entries: list[Entry] = []
        for event, number in ready:
            if self._synced and self._n is not None and number >= self._n:
                continue
            sequence = number if self._synced else self._unwrapped(event)
            entries.append(self._entry(event, number, sequence))
        if not entries:
            return
        self._journal.append(entries)
        for entry in entries:
            stamp = entry.measurement.stamp
            self.counts[stamp.sensor].count()
            self._group(stamp.sync_count)
        self._on_stored(entries)

    def _entry(self, event: Arrived, number: int, sequence: int) -> Entry:
        track, block = self._tracks[event.sensor], event.block
        rejected = sum(self._sonars[event.sensor].receiver.rejected_blocks.values())
        if track.sequence is not None:
            sequence = max(sequence, track.sequence + 1)  # a number is never given twice
            if sequence > track.sequence + 1:
                reason = "the sensor was unplugged" if track.away else "it never arrived"
                if rejected > track.rejected and not track.away:
                    reason = "it was damaged on the wire"
                self.counts[event.sensor].missing[reason] += sequence - track.sequence - 1
                self._journal.note_gap(event.sensor, track.sequence + 1, sequence - 1, reason)
        track.sequence, track.away, track.rejected = sequence, False, rejected
        stamp = Stamp(
            sensor=event.sensor,
            sequence=sequence,
            sync_count=number,
            timestamp_ns=block.arrived.realtime_ns,
            timestamp_uncertainty_ns=min(block.arrived.uncertainty_ns, 2**32 - 1),
        )
        measurement = Measurement(block.words, self._settings, stamp)
        return Entry(measurement=measurement, epoch=self._epoch, monotonic_ns=block.arrived.monotonic_ns)

    def _group(self, sync_count: int) -> None:
        self._groups[sync_count] = self._groups.get(sync_count, 0) + 1
        while len(self._groups) > _GROUPS:
            self._close_group(self._groups.pop(min(self._groups)))

    def _close_group(self, n_sensors: int) -> None:
        if n_sensors == len(self._sonars):
            self.complete += 1
        else:
            self.incomplete += 1


def _all_of(events: "queue.Queue[Event]") -> list[Event]:
    """Return what has come, or what comes within a tenth of a second."""
    found: list[Event] = []
    try:
        found.append(events.get(timeout=0.1))
        while True:
            found.append(events.get_nowait())
    except queue.Empty:
        return found
