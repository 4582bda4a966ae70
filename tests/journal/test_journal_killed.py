"""Journals of running and of killed processes."""

import signal
import subprocess
import sys

import pytest

from ertis_numba.base.errors import JournalInUseError
from ertis_numba.journal import Journal
from ertis_numba.journal._database import PAGE_BYTES
from ertis_numba.storage.sealing import seal
from tests.faults import kills
from tests.journals import ENVIRONMENT, TINY, crashed, create, entries, python, same

OPEN = """
import sys
from ertis_numba.base.errors import JournalInUseError
from ertis_numba.journal import Journal
try:
    Journal.open(sys.argv[1])
except JournalInUseError as error:
    print(error)
"""


def test_open_journal_is_locked_for_other_processes(tmp_path):
    message = "is in use by another process, a capture or its sealing; wait until that has ended"
    with create(tmp_path) as journal:
        with pytest.raises(JournalInUseError, match=message):
            Journal.open(journal.path)
        assert message in python(OPEN, journal.path).stdout
        journal.append(entries(1, first=20))
    assert python(OPEN, journal.path).stdout == ""


HOLD = """
import sys, time
from tests.journals import create
from pathlib import Path
journal = create(Path(sys.argv[1]))
print("ready", flush=True)
time.sleep(60)
"""


def test_killed_process_holds_no_lock(tmp_path):
    with subprocess.Popen(
        [sys.executable, "-c", HOLD, tmp_path], env=ENVIRONMENT, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout.readline() == "ready\n"
        with pytest.raises(JournalInUseError):
            Journal.open(tmp_path / "rec.h5.journal")
        process.send_signal(signal.SIGKILL)
    with Journal.open(tmp_path / "rec.h5.journal") as journal:
        assert all(same(*pair) for pair in zip(journal.entries(), entries(), strict=True))
        journal.append(entries(1, first=20))
        assert len(journal) == 4


@pytest.mark.parametrize("moment", ["file", "file and log", "tables"])
def test_kill_during_creation_leaves_a_usable_or_no_journal(tmp_path, moment):
    """A kill can leave an empty file, a database without tables, or tables without a sensor."""
    path = tmp_path / "rec.h5.journal"
    if moment == "tables":
        create(tmp_path, []).close()
    else:
        path.touch()
    if moment == "file and log":
        assert not python(
            "import sqlite3, sys; sqlite3.connect(sys.argv[1]).execute('PRAGMA journal_mode = WAL')", path
        ).stderr
        assert path.stat().st_size
    with Journal.open(path) as journal:
        assert (len(journal), dict(journal.sensors), journal.target) == (0, {}, tmp_path / "rec.h5")
        journal.add_sensor("left", TINY)
        journal.append(entries())
    with Journal.open(path) as journal:
        assert len(journal) == 3


@pytest.mark.parametrize("moment", ["between", "commit", "log"])
def test_journal_of_a_killed_process_is_complete(tmp_path, moment):
    path = crashed(tmp_path, moment=moment)
    log, begin = (path.with_name(f"{path.name}{end}") for end in ("-wal", "-journal"))
    if moment == "log":
        assert log.stat().st_size > 2 * PAGE_BYTES
    else:
        assert begin.read_bytes()[:8] == (bytes(8) if moment == "between" else b"\xd9\xd5\x05\xf9\x20\xa1\x63\xd7")
    with Journal.open(path) as journal:
        assert len(journal) == 3
        assert all(same(*pair) for pair in zip(journal.entries(), entries(), strict=True))
        journal.append(entries(1, first=20))
        assert log.exists() == (moment == "log")
    assert [path.name for path in tmp_path.iterdir()] == ["rec.h5.journal"]
    with Journal.open(path) as journal:
        assert [key.sequence for key in journal.index()] == [10, 11, 12, 20]


@pytest.mark.parametrize("moment", ["between", "commit", "log"])
def test_journal_of_a_killed_process_is_sealed(tmp_path, moment):
    sealed = seal(crashed(tmp_path, moment=moment))
    assert (sealed.measurements, sealed.missing, sealed.damaged) == (3, 0, 0)
    assert [path.name for path in tmp_path.iterdir()] == ["rec.h5"]


def test_killed_processes_lose_nothing(tmp_path):
    found = kills.appending(tmp_path, seed=1, count=20)
    assert found["told"] > 40
    assert {name: found[name] for name in ("lost", "wrong", "unexpected")} == {"lost": 0, "wrong": 0, "unexpected": 0}
