"""Spool in memory: a ring buffer of unacknowledged measurements, and the base of all spools."""

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Literal

from ertis_numba.base import checks
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import SequenceGap, Stamp
from ertis_numba.journal import JournalEntry, JournalSensor, require_same_settings
from ertis_numba.network.messages import MAX_SEQUENCE
from ertis_numba.network.sensor_node._outgoing_sessions import OutgoingSession, UnackedItem

if TYPE_CHECKING:
    from ertis_numba.settings import Settings

__all__ = ["SensorCounts", "Spool"]

_NAME_CHARACTERS = 64  # Limit on a sensor's name on the wire.
_ACKED_IN_ORDER = 1000  # Number of items.


@dataclass(slots=True)
class SensorCounts:
    """Counts of one sensor's measurements at its node, including those found in the spool.

    ``accepted = stored + taken + overwritten + damaged + unacked``.
    """

    accepted: int = 0
    refused: int = 0  # the spool was full
    stored: int = 0  # acknowledged on disk
    taken: int = 0  # acknowledged in memory
    dropped: Counter[str] = field(default_factory=Counter)  # by processing, of the acknowledged ones
    overwritten: int = 0  # in memory, by later ones
    damaged: int = 0  # in the spool
    missing: Counter[str] = field(default_factory=Counter)  # numbers missing at the source, by reason
    unacked: int = 0  # kept
    unacked_bytes: int = 0


class Spool:
    """Measurements in memory up to max_bytes; the oldest become gaps if there is no more room."""

    def __init__(self, max_bytes: int) -> None:
        self._max_bytes = checks.integer("ring_bytes", max_bytes, 1)
        self._held_bytes = 0
        self.turn = threading.RLock()
        self.acked = threading.Condition(self.turn)
        self.runs: dict[tuple[str, int], OutgoingSession] = {}
        self.counts: dict[str, SensorCounts] = {}
        self._sensors: dict[str, JournalSensor] = {}
        self._accepted: dict[str, Settings] = {}
        self._order: deque[tuple[OutgoingSession, UnackedItem]] = deque()  # Order of arrival.

    def add_sensor(self, sensor: JournalSensor) -> None:
        """Register a sensor before its first measurement, or with settings for the following sessions."""
        if len(sensor.name) > _NAME_CHARACTERS:
            raise ArgumentError(
                f"sensor name {sensor.name!r} has {len(sensor.name)} characters; the limit is {_NAME_CHARACTERS}"
            )
        if sensor.n_bytes > self._max_bytes:
            raise ArgumentError(
                f"a measurement of sensor {sensor.name} has {sensor.n_bytes} bytes, but the memory has room for "
                f"{self._max_bytes}; use a larger ring_bytes"
            )
        with self.turn:
            self._sensors[sensor.name] = sensor
            self._accepted.pop(sensor.name, None)
            self.counts.setdefault(sensor.name, SensorCounts())

    def append(self, entries: Sequence[JournalEntry]) -> list[JournalEntry]:
        """Keep measurements, and return the kept ones, whose CRC-32 may still be None."""
        with self.turn:
            self.check(entries)
            for entry in entries:
                run = self._run(entry.measurement.stamp.sensor, entry.measurement.stamp.session_id)
                self._keep(run, entry)
            self._forget_oldest()
            self._tidy()
        return list(entries)

    def check(self, entries: Iterable[JournalEntry]) -> None:
        """Refuse measurements that do not match their sensors, or whose numbers do not rise."""
        last: dict[tuple[str, int], int] = {}
        for entry in entries:
            settings = entry.measurement.settings
            sensor = self._known(entry.measurement.stamp.sensor)
            if settings is not self._accepted.get(sensor.name):
                require_same_settings(sensor, settings)
                self._accepted[sensor.name] = settings
            # The encoder requires contiguous little-endian data and Python integers.
            session_id, number, sync_count, time_ns, uncertainty_ns, *rest, behaviour, crc32, words = (
                sensor.entry_values(entry, fill=False)
            )
            checks.integer("sequence", number, 0, MAX_SEQUENCE)
            stamp = Stamp(
                sensor=sensor.name,
                sequence=number,
                sync_count=sync_count,
                timestamp_ns=time_ns,
                timestamp_uncertainty_ns=uncertainty_ns,
                session_id=session_id,
                behaviour=behaviour,
            )
            entry.measurement = type(entry.measurement)(words, settings, stamp)
            entry.monotonic_ns, entry.crc32 = rest[0], crc32
            key = stamp.sensor, stamp.session_id
            if stamp.sequence <= last.get(key, -1):
                raise ArgumentError(
                    f"measurement {stamp.sequence} of sensor {sensor.name} follows {last[key]}; pass increasing "
                    "numbers, or another session_id"
                )
            if key in self.runs:
                self.runs[key].require_above(stamp.sequence)
            last[key] = stamp.sequence

    def _known(self, name: str) -> JournalSensor:
        if name not in self._sensors:
            raise ArgumentError(f"sensor {name!r} is not registered at this sensor node; add it first")
        return self._sensors[name]

    def _run(self, sensor: str, session_id: int) -> OutgoingSession:
        """Return a session, created if it is new; empty earlier sessions of this sensor are then finished."""
        key = sensor, session_id
        if key not in self.runs:
            for run in [run for run in self.runs.values() if run.sensor.name == sensor and not run.items]:
                del self.runs[run.key]
            self.runs[key] = OutgoingSession(self._known(sensor), session_id)
        return self.runs[key]

    def _keep(self, run: OutgoingSession, entry: JournalEntry) -> UnackedItem:
        """Add a measurement in memory to its session, and count it."""
        n_bytes = entry.measurement.data.nbytes
        item = run.add_measurement(entry.measurement.stamp.sequence, n_bytes, entry=entry)
        self._held_bytes += n_bytes
        self._order.append((run, item))
        self._count_kept(run, n_bytes)
        return item

    def _count_kept(self, run: OutgoingSession, n_bytes: int) -> None:
        counts = self.counts[run.sensor.name]
        counts.accepted += 1
        counts.unacked += 1
        counts.unacked_bytes += n_bytes

    def _forget_oldest(self) -> None:
        """Replace the oldest measurements by gaps, until the others have room."""
        while self._held_bytes > self._max_bytes:
            run, item = self._order.popleft()
            if item.entry is None:  # Acknowledged already.
                continue
            run.forget_oldest()  # The oldest is this one: both are in order of arrival.
            item.entry = None
            self._held_bytes -= item.n_bytes
            counts = self.counts[run.sensor.name]
            counts.overwritten += 1
            counts.unacked -= 1
            counts.unacked_bytes -= item.n_bytes

    def _tidy(self) -> None:
        """Discard the order of acknowledged items, which a refused sensor would keep for ever."""
        if len(self._order) > 2 * sum(counts.unacked for counts in self.counts.values()) + _ACKED_IN_ORDER:
            self._order = deque(pair for pair in self._order if pair[1].entry is not None)

    def note_gap(self, gap: SequenceGap) -> None:
        """Register missing numbers of a sensor, with their reason."""
        with self.turn:
            self._run(gap.sensor, gap.session_id).add_gap(gap.first, gap.last, gap.reason)
            self.counts[gap.sensor].missing[gap.reason] += gap.n_missing

    def entry(self, item: UnackedItem, run: OutgoingSession) -> JournalEntry | None:  # noqa: ARG002  another spool has to ask the run
        """Return the measurement of an item; None if it has become a gap."""
        return item.entry

    def settle(
        self,
        run: OutgoingSession,
        done: Iterable[UnackedItem],
        status: Literal["stored", "accepted"],
        dropped: Sequence[tuple[int, str]] = (),
    ) -> None:
        """Release and count acknowledged items."""
        with self.turn:
            counts = self.counts[run.sensor.name]
            counts.dropped.update(reason for _, reason in dropped)
            for item in done:
                if item.reason:
                    continue
                if status == "stored":
                    counts.stored += 1
                else:
                    counts.taken += 1
                counts.unacked -= 1
                counts.unacked_bytes -= item.n_bytes
                self._discard(item)
            while self._order and self._order[0][1].entry is None:
                self._order.popleft()
            self.acked.notify_all()

    def _discard(self, item: UnackedItem) -> None:
        if item.entry is not None:
            item.entry = None
            self._held_bytes -= item.n_bytes

    def wait(self, timeout_s: float, stop: Callable[[], bool]) -> bool:
        """Wait until everything is acknowledged, and return True if it is."""
        with self.turn:
            end_s = time.monotonic() + timeout_s
            while any(run.items for run in self.runs.values()):
                left_s = end_s - time.monotonic()
                if left_s <= 0 or stop():
                    return False
                self.acked.wait(min(left_s, 0.1))
            return True

    @property
    def is_durable(self) -> bool:
        """True if measurements outlive this process."""
        return False

    def counts_now(self) -> dict[str, SensorCounts]:
        """Return a copy of the counts."""
        with self.turn:
            return {
                name: replace(counts, dropped=counts.dropped.copy(), missing=counts.missing.copy())
                for name, counts in self.counts.items()
            }

    def open(self) -> None:
        """Open measurements left by earlier nodes."""

    def close(self) -> None:
        """Close the spool; measurements kept only in memory are lost."""
