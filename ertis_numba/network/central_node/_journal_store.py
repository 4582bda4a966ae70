"""Journal store: the journals of a folder, and the acknowledged numbers of each session."""

import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Final

from ertis_numba.base.errors import ArgumentError, DataError, DiskFullError
from ertis_numba.journal import SUFFIX, Journal, JournalEntry, JournalPose
from ertis_numba.network.central_node._ledger import Ledger, read_acked_through
from ertis_numba.network.central_node._received_items import (
    Event,
    Forgotten,
    ReceivedItem,
    Remark,
    SensorSession,
    Stored,
    StoredDuplicate,
)
from ertis_numba.network.central_node._recent_poses import RecentPoses
from ertis_numba.network.central_node._volumes import Checksums, UnrecordedGaps, Volume, journal_name, sessions_in

__all__ = ["JournalStore"]

_MAX_DUPLICATES: Final = 4096


class JournalStore:
    """Journals in a locked folder that store each item once and in order."""

    # An item is stored only if it follows the acknowledged ones.

    def __init__(self, folder: Path, name: str, ledger: Ledger, notify: Callable[[Event], None]) -> None:
        self._folder, self._name, self._ledger, self._emit_event = folder, name, ledger, notify
        self.acked_through: dict[SensorSession, int] = dict(ledger.acked_through)
        self._by_age = dict.fromkeys(ledger.acked_through)
        self.volume: Volume | None = None
        self._duplicates: Volume | None = None
        self._checksums = Checksums(ledger.tails)
        self._known_duplicates: dict[tuple[SensorSession, int, int], None] = {}
        self._unsealed: set[str] = set(ledger.unsealed)
        self._unrecorded = UnrecordedGaps(ledger.gaps)
        self._failed: list[Volume] = []  # Closed, but not yet durably abandoned.
        self._is_saved = False  # True once the ledger contains the content of the journals to hand on.
        self.to_hand_on: list[Path] = []
        self._poses = RecentPoses()
        self._take_up()

    def _take_up(self) -> None:
        """Read journals that a crash has left, and queue them for sealing."""
        damage = self._ledger.damage
        if damage:
            self._emit_event(Remark(damage))
        if self._ledger.is_new or damage:
            self._settle(read_acked_through(sorted(self._folder.glob("*.h5"))))
            names = sorted(path.name for path in self._folder.glob(f"*.h5{SUFFIX}"))
        else:
            names = self._ledger.open
        for name in names:
            self._learn(self._folder / name)
        for name in dict.fromkeys([*self._ledger.unsealed, *names]):
            if (self._folder / name).exists():
                self._retire(self._folder / name)
        if damage:
            with suppress(OSError, DataError):  # Otherwise the next start repeats it.
                self._save(open_=[])

    def _learn(self, path: Path) -> None:
        """Read a journal, or the recording that another process has made of it meanwhile."""
        recording = path.with_name(path.name.removesuffix(SUFFIX))
        if path.exists():
            with Journal.open(path) as journal:
                self._settle(sessions_in(journal))
                self._unrecorded.learn(journal)
                if "_conflicts" not in path.name:  # Conflicting measurements are the second ones under their numbers.
                    self._checksums.learn(journal)
                if journal.damage:
                    self._emit_event(Remark(f"the log of {path.name} was damaged; measurements lost: {journal.damage}"))
        elif recording.exists():
            self._settle(read_acked_through([recording]))

    def _settle(self, runs: dict[SensorSession, int]) -> None:
        for run, last in runs.items():
            self._grow(run, last)

    def _grow(self, run: SensorSession, last: int) -> None:
        """Raise the acknowledged number of a session, which becomes the newest."""
        self.acked_through[run] = max(last, self.acked_through.get(run, -1))  # Other threads read it meanwhile.
        self._by_age.pop(run, None)
        self._by_age[run] = None

    def store(self, items: list[ReceivedItem]) -> None:
        """Store items durably and report them; after an error, call it again: reported items are durable."""
        try:
            self._abandon_failed()
            self._store(items)
        except DiskFullError:  # Nothing was written, so the journals are sound.
            self._free_logs()
            raise
        except Exception:
            self._fail()
            raise

    def _store(self, items: list[ReceivedItem]) -> None:
        batch: list[ReceivedItem] = []
        ahead: dict[SensorSession, int] = {}  # Acknowledged once the batch is stored.

        def flush() -> None:
            self._append(batch)
            batch.clear()
            ahead.clear()

        for item in items:
            if item.done:
                continue
            if item.again:
                flush()
                self._store_duplicate(item)
                continue
            last = ahead.get(item.run, self.acked_through.get(item.run, -1))
            if item.last <= last:  # A commit that seemed to fail had succeeded.
                self._report_stored([item], 0.0)
            elif item.first != last + 1:
                self._send_back(item)
            else:
                if batch and isinstance(item.content, JournalEntry) != isinstance(batch[-1].content, JournalEntry):
                    flush()
                self._fit(item, flush)
                batch.append(item)
                ahead[item.run] = item.last
        flush()

    def _send_back(self, item: ReceivedItem, reason: str = "") -> None:
        item.done = True
        self._emit_event(Forgotten(item, reason))

    def _fit(self, item: ReceivedItem, flush: Callable[[], None]) -> None:
        """Ensure that a journal for an item is open."""
        if self.volume is not None and not self.volume.fits(item):
            flush()
            self.rotate()
        if self.volume is None:
            name = journal_name(self._folder, self._name, taken=self._unsealed)
            # The ledger lists the journal before it exists, so that a crash leaves no unlisted journal.
            self._save(open_=[name])
            self.volume = Volume.create(self._folder / name)
        self.volume.register(item.source)

    def _append(self, batch: list[ReceivedItem]) -> None:
        """Store measurements, or gaps, in one transaction; one by one if that fails."""
        if not batch or self.volume is None:
            return
        begun_s = time.monotonic()
        try:
            self.volume.append(batch)
        except ArgumentError as error:
            if len(batch) == 1:
                self._send_back(batch[0], " ".join(str(error).split()))
                return
            # One item that no journal can hold must not affect the others, except those that follow it.
            for item in batch:
                if item.first == self.acked_through.get(item.run, -1) + 1:
                    self._append([item])
                else:
                    self._send_back(item)
            return
        self._report_stored(list(batch), 1e3 * (time.monotonic() - begun_s))
        if isinstance(batch[0].content, JournalEntry):
            unrecorded = self._unrecorded.of(item.run.sensor for item in batch)
            if unrecorded:
                self.volume.note_gaps(unrecorded)
                self._unrecorded.reported(unrecorded)

    def _report_stored(self, items: list[ReceivedItem], took_ms: float) -> None:
        for item in items:
            self._grow(item.run, item.last)
            item.done = True
            if isinstance(item.content, JournalEntry):
                self._checksums.add(item.run, item.first, item.content.crc32 or 0)
        self._emit_event(Stored(items, took_ms))

    def _store_duplicate(self, item: ReceivedItem) -> None:
        """Store a duplicate with other content as a conflict; discard equal ones."""
        if not isinstance(item.content, JournalEntry):
            return
        key = (item.run, item.first, item.content.crc32 or 0)
        differs = key not in self._known_duplicates and self._differs(item, item.content)
        if differs:
            if self._duplicates is not None and not self._duplicates.fits(item):
                self._retire_volume(self._duplicates)
                self._duplicates = None
            if self._duplicates is None:
                name = journal_name(self._folder, self._name, end="_conflicts", taken=self._unsealed)
                self._save(open_=self._open, also=[name])
                self._duplicates = Volume.create(self._folder / name)
            self._duplicates.append([item])
            self._known_duplicates[key] = None
            for old in list(islice(self._known_duplicates, max(0, len(self._known_duplicates) - _MAX_DUPLICATES))):
                del self._known_duplicates[old]
        item.done = True
        self._emit_event(StoredDuplicate(item, differs=differs))

    def _differs(self, item: ReceivedItem, entry: JournalEntry) -> bool:
        """Return True if a number holds another measurement, or one that cannot be compared any more."""
        held = self._checksums.find(item.run, item.first)
        if held is None and self.volume is not None:
            held = self.volume.crc32_of(entry)
        if held is None:
            return item.first <= self.acked_through.get(item.run, -1)
        return held != entry.crc32

    @property
    def _open(self) -> list[str]:
        """Names of journals that contain more than the ledger."""
        volumes = [*self._failed, *([] if self.volume is None else [self.volume])]
        return [volume.path.name for volume in volumes]

    def _save(self, *, open_: list[str], also: Iterable[str] = ()) -> None:
        self._unsealed = {name for name in self._unsealed if (self._folder / name).exists()}
        unsealed = sorted({*self._unsealed, *also})
        acked_through = {run: self.acked_through[run] for run in self._by_age}
        tails = self._checksums.tails(acked_through)
        self._ledger.save(acked_through, open_=open_, unsealed=unsealed, gaps=self._unrecorded.gaps, tails=tails)
        self._unsealed.update(also)
        self._is_saved = True

    def needs_poses(self) -> bool:
        """Return True if it is time to call `store_poses`."""
        return self.volume is not None and self._poses.is_due(self.volume)

    def add_poses(self, poses: Iterable[JournalPose]) -> None:
        """Add poses that have arrived; `store_poses` stores them."""
        self._poses.add(poses, self.volume)

    def store_poses(self) -> None:
        """Store poses durably: in this journal once there is room, after another error in the next one."""
        if self.volume is not None:
            try:
                self._poses.store(self.volume)
            except DiskFullError:  # Nothing was written.
                self._free_logs()
                raise
            except Exception:
                self._fail()
                raise

    def rotate(self) -> None:
        """Begin new recordings with the next item; the next start recovers a journal that still fails."""
        self._abandon_failed()
        volumes, self.volume, self._duplicates = (self.volume, self._duplicates), None, None
        for volume in volumes:
            if volume is not None:
                self._retire_volume(volume)

    def _retire_volume(self, volume: Volume) -> None:
        self._retire(volume.path)
        self._poses.retire(volume)
        with suppress(DataError):  # Committed items are safe, regardless of errors here.
            self._unrecorded.learn(volume.journal)
        with suppress(DataError):
            volume.close()

    def _retire(self, path: Path) -> None:
        self._unsealed.add(path.name)
        self.to_hand_on.append(path)
        self._is_saved = False

    def hand_on(self) -> list[Path]:
        """Return journals to seal, once the ledger durably contains them; after an error, call this again."""
        if not self._is_saved:
            self._save(open_=self._open)
        found = [path for path in self.to_hand_on if not self._poses.waits(path)]
        for path in found:
            self._poses.complete(path)
        self.to_hand_on = [path for path in self.to_hand_on if path not in found]
        return found

    @property
    def has_finished(self) -> bool:
        """Return True if `hand_on` would return a journal."""
        return any(not self._poses.waits(path) for path in self.to_hand_on)

    def hurry(self) -> None:
        """Wait for no further poses, because no more will arrive."""
        self._poses.hurry()

    def _free_logs(self) -> None:
        """Free the space of logs, which the next measurements need on a small disk."""
        try:
            for volume in (self.volume, self._duplicates):
                if volume is not None:
                    volume.journal.free_log()
        except (DataError, OSError):
            self._fail()

    def _fail(self) -> None:
        """Close the open journals: after a failed sync, their visible content may never reach the disk."""
        volumes, self.volume, self._duplicates = (self.volume, self._duplicates), None, None
        for volume in volumes:
            if volume is not None:
                self._failed.append(volume)
                with suppress(Exception):
                    volume.close()

    def _abandon_failed(self) -> None:
        """Limit failed journals to acknowledged measurements, to seal them; call again after an error."""
        while self._failed:
            volume = self._failed[0]
            if volume.path.exists():
                acked = {(run.sensor, run.session_id): last for run, last in volume.acked.items()}
                Journal.abandon(volume.path, acked)
                if volume.acked:
                    self._retire(volume.path)
            else:  # It was removed, or sealed by another process.
                self._learn(volume.path)
            del self._failed[0]

    def close(self) -> None:
        """Close all journals."""
        self.rotate()
