"""Recovery of a disk after a power cut with the commands' functions, and comparison with acknowledged data."""

import random
import zlib
from collections.abc import Callable, Set as AbstractSet
from pathlib import Path

from ertis_bench.network.diary import DiaryKey, Row
from ertis_bench.network.processes import ask
from ertis_bench.network.sent import Sent
from ertis_bench.network_trials.oracle import Archived, compare, read_folder

from ertis_numba.base.errors import ErtisError
from ertis_numba.journal import SUFFIX
from ertis_numba.network.central_node._journal_store import JournalStore
from ertis_numba.network.central_node._ledger import Ledger
from ertis_numba.network.central_node._received_items import SensorSession
from ertis_numba.network.sensor_node._disk_spool import DiskSpool
from ertis_numba.storage.sealing import seal

__all__ = ["Found", "recover_archive", "recover_capture", "recover_spool"]

Found = dict[str, int]
"""Counts that must be 0: ``lost``, ``twice``, ``wrong``, and ``failed`` for failures of the recovery itself."""

_SPOOL_RING_BYTES = 1  # Almost no memory, so that all measurements are read from the disk.


def recover_capture(disk: Path, sent: Sent, sent_crc32: AbstractSet[int] | None, *, by_command: bool) -> Found:
    """Recover a capture as ``ertis import journals`` does."""
    failed = _recover(disk, by_command=by_command)
    archived = _read(disk)
    found = compare(sent, archived, sent.kept)
    strange = sum(
        sent_crc32 is not None and row.crc32 not in sent_crc32 for rows in archived.rows.values() for row in rows
    )
    return _found(found, failed=failed, unexpected=strange)


def recover_archive(disk: Path, sent: Sent, rng: random.Random, *, by_command: bool) -> Found:
    """Recover the recordings of a central node, by starting the node or by ``ertis import journals``."""
    folder = disk / "recordings"
    if not folder.is_dir():
        return _found(compare(sent, Archived(), sent.acked()), failed=0)
    acked_through: dict[SensorSession, int] = {}
    if by_command or rng.random() < 0.3:
        failed = _recover(folder, by_command=by_command)
    else:
        failed, acked_through = _open_archive(folder)
    archived = _read(folder)
    found = compare(sent, archived, sent.acked())
    # A sensor node discards measurements that are reported as stored.
    claimed = {
        DiaryKey(run.sensor, run.session_id, sequence)
        for run, last in acked_through.items()
        for sequence in range(last + 1)
    }
    lost = sum(key not in archived.rows and archived.reason(key) is None for key in claimed - sent.acked())
    found["lost"] += lost
    return _found(found, failed=failed)


def _read(folder: Path) -> Archived:
    """Read recordings. Of all other files, only a journal may be missing."""
    archived = read_folder(folder)
    archived.left_over = [name for name in archived.left_over if name.endswith(SUFFIX)]
    return archived


def _open_archive(folder: Path) -> tuple[int, dict[SensorSession, int]]:
    """Open a folder as a central node does, and return the number of errors and the known sessions."""
    try:
        journal_store = JournalStore(folder, "recording", Ledger(folder), lambda _: None)
        acked_through = dict(journal_store.acked_through)
        journals = journal_store.hand_on()
        journal_store.close()
    except (ErtisError, OSError):
        return 1, {}
    return sum(_fails(seal, path) for path in journals), acked_through


def _recover(folder: Path, *, by_command: bool) -> int:
    """Seal all journals of a folder, and return the number of errors."""
    if by_command:
        return int(ask("import", "journals", str(folder), "--quiet").returncode != 0)
    return sum(_fails(seal, path) for path in sorted(folder.glob(f"*{SUFFIX}")))


def _fails(act: Callable[[Path], object], path: Path) -> bool:
    try:
        act(path)
    except (ErtisError, OSError):
        return True
    return False


def recover_spool(disk: Path, sent: Sent) -> Found:
    """Open a spool as a sensor node does at its start, and search for all measurements that the central node lacks."""
    notes: list[str] = []
    held: dict[DiaryKey, list[Row]] = {}
    folder = disk / "spool"
    if folder.is_dir():
        spool = DiskSpool(folder, _SPOOL_RING_BYTES, None, on_note=notes.append)
        spool.open()
        try:
            for run in spool.runs.values():
                for item in list(run.items):
                    entry = spool.entry(item, run)
                    if entry is not None:
                        stamp, words = entry.measurement.stamp, entry.measurement.data
                        key = DiaryKey(stamp.sensor, stamp.session_id, stamp.sequence)
                        held.setdefault(key, []).append(
                            Row(zlib.crc32(words.data), stamp.sync_count, stamp.timestamp_ns)
                        )
        finally:
            spool.close()
    promised = sent.kept - sent.acked()
    found = compare(sent, Archived(rows=held), promised)
    found["silent"] = 0  # Numbers that the central node has acknowledged are missing from the spool as intended.
    return _found(found, failed=len(notes))


def _found(found: dict[str, int], *, failed: int, unexpected: int | None = None) -> Found:
    wrong = found["wrong"] + found["broken"] + (found["unexpected"] if unexpected is None else unexpected)
    return {
        "lost": found["lost"] + found["missing"],
        "twice": found["twice"],
        "wrong": wrong,
        "failed": failed,
        "left_over": found["left_over"],
    }
