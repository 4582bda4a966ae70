"""Archive that stores measurements in a thread of its own, so that only this thread waits for the disk."""

import collections
import queue
import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from ertis_numba.base import checks
from ertis_numba.base.atomic_files import make_folder
from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.journal import SUFFIX, JournalPose, SealingResult
from ertis_numba.network.central_node._journal_store import JournalStore
from ertis_numba.network.central_node._ledger import Ledger, Lock
from ertis_numba.network.central_node._received_items import (
    Event,
    ReceivedItem,
    Resumed,
    SealedOne,
    SealingFailed,
    SensorSession,
    StorageFault,
)
from ertis_numba.network.central_node._sealing import Sealing
from ertis_numba.network.status import ArchiveStatus, Latencies
from ertis_numba.network.wakeup_socket import WakeupSocket

__all__ = ["Archive"]

_GROUP: Final = 64
_GROUP_BYTES: Final = 40_000_000
_POSES: Final = 20_000  # Takes about 15 MB.
_POLL_INTERVAL_S: Final = 0.5
_AGAIN_S: Final = 1.0
_STUCK_S: Final = 5.0


class Archive:
    """Storage of measurements in journals, which become recordings; one archive can use a folder at a time."""

    # A recording is full after `rotate_bytes` or `rotate_s`. `ertis import journals` seals journals later.

    def __init__(
        self,
        folder: str | Path,
        name: str = "recording",
        *,
        rotate_bytes: float = 2e9,
        rotate_s: float = 600.0,
        seal: bool = True,
    ) -> None:
        self.folder = Path(folder)
        self._name = checks.sensor_name(name)
        self._rotate_bytes = checks.between("size of a recording", rotate_bytes, 1e6, 1e15)
        self._rotate_s = checks.between("time of a recording", rotate_s, 1.0, 1e9)
        self._seal = seal
        self._queue: queue.SimpleQueue[ReceivedItem | None] = queue.SimpleQueue()
        self._poses: collections.deque[JournalPose] = collections.deque(maxlen=_POSES)
        self._n_poses = 0
        self._events: collections.deque[Event] = collections.deque()
        self._stop = threading.Event()
        self._lock: Lock | None = None
        self._journal_store: JournalStore | None = None
        self._sealing: Sealing | None = None
        self._thread: threading.Thread | None = None
        self._wakeup_socket: WakeupSocket | None = None
        self._commits = Latencies()
        self._snapshot = ArchiveStatus(folder=str(folder))
        self._busy_since_s: float | None = None
        self._next_look_s = 0.0
        self._ends = False
        self.fault = ""

    def open(self) -> int:
        """Open the folder, recover journals left by a crash, and return a descriptor: call `read` when readable."""
        try:
            make_folder(self.folder)
        except OSError as error:
            raise DataError(f"{self.folder}: {error.strerror}; choose a writable folder") from error
        self._lock = Lock(self.folder)
        try:
            self._journal_store = JournalStore(self.folder, self._name, Ledger(self.folder), self._emit_event)
        except BaseException:
            self._lock.release()
            raise
        self._wakeup_socket = WakeupSocket()
        if self._seal:
            self._sealing = Sealing(self._sealed, self._not_sealed)
        self._look()
        self._thread = threading.Thread(target=self._run, args=(self._journal_store,), name="archive", daemon=True)
        self._thread.start()
        return self._wakeup_socket.fileno()

    def acked_through(self, run: SensorSession) -> int:
        """Return the number up to which a session is stored or known to be missing; -1 if there is none."""
        return -1 if self._journal_store is None else self._journal_store.acked_through.get(run, -1)

    def offer(self, item: ReceivedItem) -> None:
        """Queue an item to be stored; never blocks."""
        self._queue.put(item)

    def offer_pose(self, pose: JournalPose) -> None:
        """Queue a pose to be stored; never blocks. If the disk is too slow, the oldest poses are discarded."""
        self._poses.append(pose)
        self._n_poses += 1

    def read(self) -> list[Event]:
        """Return new events; never blocks."""
        if self._wakeup_socket is not None:
            self._wakeup_socket.clear()
        found = []
        while self._events:
            found.append(self._events.popleft())
        return found

    @property
    def stuck(self) -> str:
        """Reason why the archive reports nothing any more; empty while it works."""
        since_s = self._busy_since_s
        if self._thread is not None and not self._thread.is_alive() and not self._ends:
            return "the storage thread has ended because of an internal error; start the central node again"
        if since_s is not None and time.monotonic() - since_s > _STUCK_S:
            return "the disk does not answer"
        return ""

    def status(self) -> ArchiveStatus:
        """Return the status without blocking, with numbers up to half a second old."""
        sealing = self._sealing
        if sealing is None:
            return replace(self._snapshot, poses=self._n_poses)
        return replace(
            self._snapshot,
            poses=self._n_poses,
            sealed=sealing.sealed,
            sealing=sealing.left,
            sealing_failed=sealing.failed,
            set_aside=sealing.set_aside,
        )

    def finish(self, timeout_s: float) -> bool:
        """Store queued items, end the thread, and return True if that took no longer than the timeout."""
        if self._thread is None:
            return True
        self._ends = True
        self._queue.put(None)
        self._thread.join(0 if self.fault else timeout_s)
        self._stop.set()
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def close(self) -> None:
        """Finish, make recordings of all stored measurements, and release the folder."""
        if self._sealing is not None:
            self._sealing.hurry()
        finished = self.finish(30.0)
        if self._sealing is not None and finished:
            self._sealing.close()
        if self._wakeup_socket is not None and finished:
            self._wakeup_socket.close()
            self._wakeup_socket = None
        if self._lock is not None and finished:
            self._lock.release()

    def _emit_event(self, event: Event) -> None:
        self._events.append(event)
        if self._wakeup_socket is not None:
            self._wakeup_socket.wake()

    def _sealed(self, sealed: SealingResult) -> None:
        self._emit_event(SealedOne(sealed))

    def _not_sealed(self, text: str) -> None:
        self._emit_event(SealingFailed(text))

    def _run(self, journal_store: JournalStore) -> None:
        while True:
            items, ends = self._next()
            if items and not self._store(journal_store, items):
                ends = True  # No ack was sent for the remaining items.
            self._tend(journal_store, ends=ends)
            if ends:
                break
            self._look()
        self._attempt(journal_store.close)

    def _next(self) -> tuple[list[ReceivedItem], bool]:
        """Return the items to store together, and True if they are the last."""
        items: list[ReceivedItem] = []
        n_bytes = 0
        try:
            item = self._queue.get(timeout=_POLL_INTERVAL_S)
            while item is not None:
                items.append(item)
                n_bytes += item.n_bytes
                if len(items) >= _GROUP or n_bytes >= _GROUP_BYTES:
                    return items, False
                item = self._queue.get_nowait()
        except queue.Empty:
            return items, False
        return items, True

    def _store(self, journal_store: JournalStore, items: list[ReceivedItem]) -> bool:
        """Store items, repeating after errors; return False if the archive was closed before."""
        while not self._attempt(lambda: journal_store.store(items)):
            if self._stop.wait(_AGAIN_S):
                return False
            self._look()
        return True

    def _tend(self, journal_store: JournalStore, *, ends: bool) -> None:
        """Store poses, and seal full journals."""
        journal_store.add_poses([self._poses.popleft() for _ in range(len(self._poses))])
        if ends or journal_store.needs_poses():
            self._attempt(journal_store.store_poses)
        volume = journal_store.volume
        full = volume is not None and (
            volume.n_bytes >= self._rotate_bytes or time.monotonic() - volume.begun_s >= self._rotate_s
        )
        if full or ends or journal_store.has_finished:
            self._attempt(lambda: self._hand_on(journal_store, rotate=full or ends, ends=ends))

    def _hand_on(self, journal_store: JournalStore, *, rotate: bool, ends: bool) -> None:
        if rotate:
            journal_store.rotate()
            if not ends:  # The next item begins a journal, and the ledger is written then.
                return
        if ends:
            journal_store.hurry()
        for path in journal_store.hand_on():
            if self._sealing is not None:
                self._sealing.give(path)

    def _attempt(self, act: Callable[[], None]) -> bool:
        """Run a disk operation; this thread survives any error of it."""
        begun_s = self._busy_since_s = time.monotonic()
        try:
            act()
        except Exception as error:  # noqa: BLE001  a disk can fail in any way
            text = " ".join(str(error).split()) or type(error).__name__
            if text != self.fault:
                self.fault = text
                self._emit_event(StorageFault(text))
            return False
        finally:
            self._busy_since_s = None
        self._commits.add(1e3 * (time.monotonic() - begun_s))
        if self.fault and not self._ends:
            self.fault = ""
            self._emit_event(Resumed())
        return True

    def _look(self) -> None:
        """Update the free space, unless it was updated recently."""
        now_s = time.monotonic()
        if now_s < self._next_look_s or self._journal_store is None:
            return
        self._next_look_s = now_s + _POLL_INTERVAL_S
        made = ArchiveStatus(folder=str(self.folder), commit=self._commits.percentiles())
        try:
            made.free_bytes = shutil.disk_usage(self.folder).free
            made.room_bytes = made.free_bytes // 2
            volume = self._journal_store.volume
            if volume is not None:
                made.recording = volume.path.name.removesuffix(SUFFIX)
                made.journal_bytes = volume.path.stat().st_size
                made.room_bytes = volume.journal.appendable_bytes()
        except (OSError, DataError, ArgumentError):  # Storing raises the specific error.
            pass
        self._snapshot = made
