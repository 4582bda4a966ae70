"""Removal of journals and of acknowledged measurements in them."""

import subprocess
import sys
import threading

import pytest

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.journal import VERSION, Journal
from ertis_numba.settings import Recording
from ertis_numba.storage import open_recording
from ertis_numba.storage.sealing import seal
from tests.files import line
from tests.journals import ENVIRONMENT, EPOCH, both, crashed, create, entries, same


def version(path):
    return int.from_bytes(path.read_bytes()[60:64], "big")  # user version in the header of an SQLite file


def test_acknowledged_measurements_can_be_discarded(tmp_path):
    """Discarding affects one sensor, although its rows lie between rows of other sensors."""
    given = both()
    with create(tmp_path, given) as journal:
        for last, run in ((9, EPOCH), (11, EPOCH), (50, EPOCH + 1)):
            journal.note_gap("left", 3, last, "x", session_id=run)
        assert journal.find("left", EPOCH, 12)[1:] == ("left", EPOCH, 12)
        assert journal.discard("left", EPOCH, 10) == 1
        assert journal.discard("left", EPOCH, 9) == 0
        assert len(journal) == 4
        with pytest.raises(DataError, match="has no measurement 10 of sensor left; copy it again if you can"):
            journal.find("left", EPOCH, 10)
        with pytest.raises(ArgumentError, match=r"sensor 'top' is not in .*; add it first"):
            journal.discard("top", EPOCH, 10)
        with pytest.raises(ArgumentError, match="measurement 12 of sensor left follows 12"):
            journal.append(entries(1, first=12))
    assert version(journal.path) == VERSION
    with Journal.open(journal.path) as journal:
        assert len(journal) == 4
        assert [same(*pair) for pair in zip(journal.entries(), given[1:], strict=True)] == [True] * 4
        assert [(gap.last, gap.session_id) for gap in journal.gaps] == [(11, EPOCH), (50, EPOCH + 1)]
        journal.discard("left", EPOCH, 11)  # keeps 12, between 0 and 1 of the right sensor
        assert [key[1:] for key in journal.index()] == [("right", EPOCH, 0), ("left", EPOCH, 12), ("right", EPOCH, 1)]
        assert journal.discard("left", EPOCH, 99) + journal.discard("right", EPOCH, 99) == 3
        journal.append(entries(1, first=100))
    with Journal.open(journal.path) as journal:
        assert [entry.measurement.stamp.sequence for entry in journal.entries()] == [100]


def test_journal_without_discards_has_version_3(tmp_path):
    with create(tmp_path) as journal:
        assert version(journal.path) in (0, 3)
    assert version(journal.path) == 3


def test_remaining_measurements_are_sealed(tmp_path):
    with create(tmp_path, both()) as journal:
        journal.discard("left", EPOCH, 10)
        journal.discard("right", EPOCH, 0)
    sealed = seal(journal.path)
    assert (sealed.measurements, sealed.missing, sealed.damaged) == (3, 0, 0)
    assert [measurement.stamp.sequence for measurement in open_recording(sealed.recording, sensor="left")] == [11, 12]


def test_discarded_space_is_reused(tmp_path):
    """New rows use the space of discarded rows, so the file does not grow."""
    settings = line(32, 32).replace(recording=Recording(n_samples=65_536))
    given = entries(60, settings=settings)
    with create(tmp_path, given[:10], settings=settings) as journal:
        for number, entry in enumerate(given[10:], 10):
            journal.append([entry])
            journal.discard("left", EPOCH, entry.measurement.stamp.sequence - 10)
            assert len(journal) == 10, number
    assert journal.path.stat().st_size < 20 * 4 * 65_536


DISCARD = """
import sys
from pathlib import Path
from ertis_numba.journal import Journal
from tests.journals import EPOCH, entries
with Journal.open(Path(sys.argv[1])) as journal:
    if sys.argv[3] == "once":
        journal._database.use_rollback_journal()
    for number in range(int(sys.argv[2]), 10**9):
        for sensor in ("left", "right"):
            journal.append(entries(1, sensor=sensor, first=number))
            journal.discard(sensor, EPOCH, number - 5)
            print(sensor, number, flush=True)
"""


@pytest.mark.parametrize("how", ["log", "once"])
def test_kill_during_discard_keeps_other_measurements(tmp_path, how):
    """Appended measurements stay until they are discarded; discarded ones never reappear."""
    create(tmp_path, both()).close()
    path, last = tmp_path / "rec.h5.journal", {"left": 12, "right": 12}
    for _ in range(4):
        with subprocess.Popen(
            [sys.executable, "-c", DISCARD, path, str(max(last.values()) + 2), how],
            env=ENVIRONMENT,
            stdout=subprocess.PIPE,
            text=True,
        ) as process:
            for line_, _number in zip(process.stdout, range(25), strict=False):
                sensor, number = line_.split()
                last[sensor] = int(number)
            process.kill()
            for line_ in process.stdout:
                if line_.endswith("\n"):
                    sensor, number = line_.split()
                    last[sensor] = int(number)
        with Journal.open(path) as journal:
            held = {name: [key.sequence for key in journal.index(name)] for name in last}
            assert len(list(journal.entries())) == len(journal)
        for sensor, numbers in held.items():
            assert set(range(max(numbers[0], last[sensor] - 4), last[sensor] + 1)) <= set(numbers)
            assert numbers[0] >= last[sensor] - 4
            last[sensor] = numbers[-1]


@pytest.mark.parametrize("act", [Journal.remove, Journal.set_aside])
def test_remove_waits_for_the_lock(tmp_path, act):
    with create(tmp_path) as journal:
        thread = threading.Thread(target=act, args=(journal,))
        with journal._lock:  # noqa: SLF001  an append of another thread holds this lock
            thread.start()
            thread.join(0.05)
            assert thread.is_alive()
            assert journal.path.exists()
            journal.append(entries(1, first=20))
        thread.join()
        assert not journal.path.exists()


@pytest.mark.parametrize("moment", ["between", "commit", "log"])
@pytest.mark.parametrize("aside", [False, True])
def test_remove_deletes_all_files(tmp_path, aside, moment):
    with Journal.open(crashed(tmp_path, moment=moment)) as journal:
        journal.append(entries(1, first=20))
        left = [journal.set_aside().name] if aside else journal.remove() or []
    assert [path.name for path in tmp_path.iterdir()] == left
    if aside:
        crashed(tmp_path, [*entries(), *entries(1, first=20)], moment=moment)
        with Journal.open(tmp_path / "rec.h5.journal") as journal:
            assert journal.set_aside().name == "rec.h5.journal.2.damaged"
        assert len(list(tmp_path.iterdir())) == 2
        for path in tmp_path.iterdir():
            with Journal.open(path) as journal:
                assert len(list(journal.entries())) == 4


@pytest.mark.parametrize("act", [Journal.remove, Journal.set_aside])
def test_close_keeps_files_of_a_newer_journal(tmp_path, monkeypatch, act):
    """A new journal of the same name has a log of the same name, which closing the old one must not delete."""
    with Journal.open(crashed(tmp_path, moment="between")) as journal, monkeypatch.context() as patch:
        journal.append(entries(1, first=20))
        log = tmp_path / "rec.h5.journal-journal"
        patch.setattr(Journal, "close", lambda self: (log.write_text("new"), self._database.close()))
        act(journal)
    assert log.read_text() == "new"
