"""Journals after a failed sync: opening rewrites the log and deletes unacknowledged rows."""

import errno
import json
import os
import stat
from pathlib import Path

import pytest

from ertis_numba.base.errors import DamagedError, DataError
from ertis_numba.journal import Journal, seal_in_subprocess
from ertis_numba.journal._limit import read_limit
from ertis_numba.storage import open_recording
from tests.journals import EPOCH, crashed, create, entries, same


def numbers(journal):
    return [key.sequence for key in journal.index()]


def failing_sync(monkeypatch, *, folders):
    """Let the next ``os.fsync`` of a folder or of a file fail."""
    fsync, left = os.fsync, [1]

    def fails(descriptor):
        is_folder = stat.S_ISDIR(os.fstat(descriptor).st_mode)
        if left[0] and is_folder == folders:
            left[0] -= 1
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        fsync(descriptor)

    monkeypatch.setattr(os, "fsync", fails)


def test_open_deletes_rows_above_the_limit(tmp_path):
    path = crashed(tmp_path, entries(5))
    Journal.abandon(path, {("left", EPOCH): 12})
    with Journal.open(path) as journal:
        assert numbers(journal) == [10, 11, 12]
        assert len(journal) == 3
        assert all(same(*pair) for pair in zip(journal.entries(), entries(5)[:3], strict=True))
        journal.append(entries(1, first=13))
    assert sorted(each.name for each in tmp_path.iterdir()) == ["rec.h5.journal"]
    with Journal.open(path) as journal:
        assert numbers(journal) == [10, 11, 12, 13]


def test_open_deletes_unacknowledged_gaps_and_sessions(tmp_path):
    with create(tmp_path) as journal:
        journal.note_gap("left", 13, 13, "kept", session_id=EPOCH)
        journal.note_gap("left", 14, 15, "given up", session_id=EPOCH)
        journal.append(entries(2, first=0, session_id=EPOCH + 1))
    Journal.abandon(journal.path, {("left", EPOCH): 13})
    with Journal.open(journal.path) as journal:
        assert numbers(journal) == [10, 11, 12]
        assert [gap.reason for gap in journal.gaps] == ["kept"]


def test_recording_of_a_limited_journal_holds_acknowledged_measurements(tmp_path):
    path = crashed(tmp_path, entries(4))
    Journal.abandon(path, {("left", EPOCH): 11})
    sealed = seal_in_subprocess(path)
    assert sealed.measurements == 2
    with open_recording(sealed.recording, sensor="left") as recording:
        assert [measurement.stamp.sequence for measurement in recording] == [10, 11]
    assert sorted(each.name for each in tmp_path.iterdir()) == ["rec.h5"]


def test_abandon_without_acknowledgements_removes_the_journal(tmp_path):
    path = crashed(tmp_path)
    Journal.abandon(path, {})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("text", ["", "[]", '{"runs": [["left", 5, 12]], "crc32": 1}', '{"runs": [[1]], "crc32": 0}'])
def test_open_refuses_a_damaged_limit(tmp_path, text):
    path = crashed(tmp_path)
    path.with_name(f"{path.name}-limit").write_text(text)
    with pytest.raises(DamagedError, match=r"rec\.h5\.journal-limit is damaged; remove it to seal all rows in rec"):
        Journal.open(path)


def test_one_flipped_bit_in_a_limit_is_refused_or_harmless(tmp_path):
    path = crashed(tmp_path)
    Journal.abandon(path, {("left", EPOCH): 11})
    limit = path.with_name(f"{path.name}-limit")
    sound = limit.read_bytes()
    assert json.loads(sound)["runs"] == [["left", EPOCH, 11]]
    for place in range(8 * len(sound)):
        spoilt = bytearray(sound)
        spoilt[place // 8] ^= 1 << place % 8
        limit.write_bytes(spoilt)
        try:
            assert read_limit(path) == {("left", EPOCH): 11}
        except DamagedError:
            continue


@pytest.mark.parametrize("moment", ["log", "between"])
def test_open_writes_the_log_again_and_syncs_it(tmp_path, monkeypatch, moment):
    """The previous process may have ended before its sync, or its sync may have failed."""
    path = crashed(tmp_path, moment=moment)
    synced = set()
    fsync = os.fsync
    monkeypatch.setattr(
        os, "fsync", lambda number: (synced.add(str(Path(f"/proc/self/fd/{number}").readlink())), fsync(number))
    )
    with Journal.open(path) as journal:
        assert len(journal) == 3
    end = "-wal" if moment == "log" else "-journal"
    assert {f"{path}{end}", str(tmp_path)} <= synced


def test_open_raises_if_the_log_cannot_be_synced(tmp_path, monkeypatch):
    path = crashed(tmp_path)
    failing_sync(monkeypatch, folders=False)
    with pytest.raises(DataError, match="Input/output error"):
        Journal.open(path)
    with Journal.open(path) as journal:
        assert len(journal) == 3


def test_append_fails_if_the_folder_of_the_log_cannot_be_synced(tmp_path, monkeypatch):
    """SQLite syncs the folder of a new log but ignores an error of this sync."""
    with create(tmp_path) as journal:
        pass
    more = entries(1, first=20)
    with Journal.open(journal.path) as journal:
        failing_sync(monkeypatch, folders=True)
        with pytest.raises(DataError, match="Input/output error; check the disk: what was committed before is safe"):
            journal.append(more)
        journal.append(more)
        assert numbers(journal) == [10, 11, 12, 20]


def test_append_fails_if_the_old_log_may_reappear(tmp_path, monkeypatch):
    with create(tmp_path) as journal:
        journal._database.use_rollback_journal()  # noqa: SLF001  a commit of 4 MB would have the same effect
        failing_sync(monkeypatch, folders=True)
        more = entries(1, first=20)
        with pytest.raises(DataError, match="Input/output error"):
            journal.append(more)
        assert numbers(journal) == [10, 11, 12]
        journal.append(more)


def test_failed_create_leaves_no_file(tmp_path, monkeypatch):
    failing_sync(monkeypatch, folders=True)
    with pytest.raises(DataError, match="Input/output error"):
        create(tmp_path, [])
    assert not list(tmp_path.iterdir())
    create(tmp_path).close()
