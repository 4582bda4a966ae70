"""Journals on full, small and failing disks."""

import resource
import shutil
import subprocess
import sys

import pytest

from ertis_numba.base.errors import DataError, DiskFullError
from ertis_numba.journal import Journal, JournalPose
from ertis_numba.journal._database import Database
from tests.journals import ENVIRONMENT, EPOCH, TINY, create, entries, same


def test_journal_leaves_enough_space_to_seal(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    with create(tmp_path) as journal:
        with monkeypatch.context() as patch:
            patch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=9_400_000))
            with pytest.raises(DataError, match=r"has 9.4 MB free, but 9.\d MB are needed to seal rec.h5.journal"):
                journal.append(entries(1, first=20))
            assert journal.appendable_bytes() == 0
        assert len(journal) == len(journal.index()) == 3
        journal.append(entries(1, first=20))  # enough space is free again
        assert usage.free / 4 < journal.appendable_bytes() < usage.free / 2


def test_poses_leave_enough_space_to_seal(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    poses = [
        JournalPose(("left",), number, (1.0, 2.0, 3.0), (0.0, 0.0, 0.0, 1.0), bytes(288)) for number in range(1000)
    ]
    with create(tmp_path) as journal:
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=10**9))
        room = journal.appendable_bytes()
        with monkeypatch.context() as patch:
            patch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=9_400_000))
            with pytest.raises(
                DiskFullError, match=r"has 9.4 MB free, but 1\d.\d MB are needed to seal rec.h5.journal"
            ):
                journal.append_poses(poses)
        assert not journal.read_poses()[0]
        journal.append_poses(poses)  # enough space is free again
        assert len(journal.read_poses()[0]) == 1000
        assert 0 < journal.appendable_bytes() < room  # The recording will contain poses.


def test_size_of_poses_is_close_to_that_in_a_journal(tmp_path):
    poses = [
        JournalPose(("left", "right"), 10**18 + number, (1.1, 2.2, 3.3), (0.5,) * 4, bytes(288), "odometry")
        for number in range(20_000)
    ]
    with create(tmp_path) as journal:
        journal.free_log()
        before_bytes = journal.path.stat().st_size
        journal.append_poses(poses)
        journal.free_log()
        grown_bytes = journal.path.stat().st_size - before_bytes
    assert 0.9 < sum(pose.n_bytes for pose in poses) / grown_bytes < 1.1


APPEND = """
import sys
from pathlib import Path
from ertis_numba.base.errors import DataError
from ertis_numba.journal import Journal, _free_space
from ertis_numba.settings import Recording, Settings
from tests.journals import create, entries, same
settings = Settings(recording=Recording(n_samples=32_768))
given = entries(200, settings=settings)
if "unguarded" in sys.argv:
    _free_space.require_free_space = lambda *_, **__: None
journal = create(Path(sys.argv[1]), [])
journal.add_sensor("left", settings)
ballast = Path(sys.argv[1], "ballast")
ballast.write_bytes(bytes(1_000_000))
for number, entry in enumerate(given):
    try:
        journal.append([entry])
    except DataError as error:
        print(number, error, flush=True)
        break
ballast.unlink()
if "freed" in sys.argv:
    journal.append([given[number]])
    number += 1
assert all(same(*pair) for pair in zip(journal.entries(), given[:number], strict=True))
journal.close()
with Journal.open(journal.path) as journal:
    assert all(same(*pair) for pair in zip(journal.entries(), given[:number], strict=True))
"""


def test_failing_disk_is_reported(tmp_path):
    """A limit on the file size stands in for a disk that rejects writes."""
    done = subprocess.run(
        [sys.executable, "-c", APPEND, tmp_path, "unguarded"],
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (3_000_000, 3_000_000)),
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, "")
    number, _, message = done.stdout.partition(" ")
    assert int(number) > 10
    assert "rec.h5.journal cannot be written or read (disk I/O error); check the disk: what was" in message


@pytest.mark.parametrize("times", [1, 2])
def test_commit_that_fails_at_its_sync_can_be_repeated(tmp_path, monkeypatch, times):
    """The sync at the end of a commit may fail although the rows are written; a retry must succeed."""
    more, right = entries(1, first=20), entries(1, sensor="right")
    with create(tmp_path) as journal:
        execute, left = Database.execute, [0]

        def fail(self, statement, values=()):
            rows = execute(self, statement, values)
            if statement == "COMMIT" and left[0]:
                left[0] -= 1
                raise DataError("the disk fails")
            return rows

        monkeypatch.setattr(Database, "execute", fail)
        acts = (
            lambda: journal.append(more),
            lambda: journal.add_sensor("right", TINY),
            lambda: journal.note_gap("left", 30, 31, "x", session_id=EPOCH),
        )
        for act in acts:
            left[0] = times
            with pytest.raises(DataError, match="the disk fails"):
                act()
            act()
        journal.append(right)
    with Journal.open(tmp_path / "rec.h5.journal") as journal:
        assert all(same(*pair) for pair in zip(journal.entries(), [*entries(), *more, *right], strict=True))
        assert (list(journal.sensors), len(journal.gaps)) == (["left", "right"], 1)


ON_A_SMALL_DISK = """
mount -t tmpfs -o size=20m ertis "$1" || exit 99
shift
exec "$@"
"""


def on_a_small_disk(folder, code, *arguments):
    """Run Python code with a disk of 20 MB at ``folder``; user namespaces make this possible without root."""
    unshare = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", ON_A_SMALL_DISK, "sh", folder]
    command = [*unshare, sys.executable, "-c", code, folder, *arguments]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=False)
    if done.returncode == 99 or "unshare: " in done.stderr:
        pytest.skip(f"this system gives nobody a file system of his own: {done.stderr.strip()}")
    assert (done.returncode, done.stderr) == (0, "")
    number, _, message = done.stdout.partition(" ")
    return int(number), message


@pytest.mark.skipif(shutil.which("unshare") is None, reason="only Linux has namespaces")
def test_full_disk_keeps_stored_measurements(tmp_path):
    number, message = on_a_small_disk(tmp_path, APPEND, "unguarded", "freed")
    assert number > 60
    assert "rec.h5.journal has no room on its disk; free some space: what was committed before is safe" in message


LEFT = """
import os, sys
from pathlib import Path
from ertis_numba.base.errors import DataError
from ertis_numba.journal import Journal
from tests.journals import crashed, entries, same
folder = Path(sys.argv[1])
given = entries(100)
path = crashed(folder, given, moment="log")
log = path.with_name(path.name + "-wal")
held = log.read_bytes()
with (folder / "ballast").open("wb", buffering=0) as file:
    try:
        while file.write(bytes(4096)):
            pass
    except OSError:
        pass
for act in (lambda journal: journal._database.use_rollback_journal(), Journal.set_aside):
    with Journal.open(path) as journal:
        assert all(same(*pair) for pair in zip(journal.entries(), given, strict=True))
        try:
            act(journal)
        except DataError as error:
            print(len(given), error, flush=True)
        else:
            raise AssertionError
        if act is not Journal.set_aside:
            journal._database.execute("PRAGMA shrink_memory")  # from the files, what is in memory proves nothing
            assert all(same(*pair) for pair in zip(journal.entries(), given, strict=True))
    assert log.read_bytes()[:len(held)] == held, act
if "freed" in sys.argv:
    (folder / "ballast").unlink()
    with Journal.open(path) as journal:
        journal._database.use_rollback_journal()
        assert not log.exists()
        assert all(same(*pair) for pair in zip(journal.entries(), given, strict=True))
else:
    with Journal.open(path) as journal:
        journal.remove()
    assert os.listdir(folder) == ["ballast"]
"""


@pytest.mark.skipif(shutil.which("unshare") is None, reason="only Linux has namespaces")
@pytest.mark.parametrize("freed", [False, True])
def test_full_disk_keeps_the_log(tmp_path, freed):
    """The journal is read from its log until there is space to merge the log into the main file."""
    number, message = on_a_small_disk(tmp_path, LEFT, *["freed"] * freed)
    assert number == 100
    assert "rec.h5.journal has no room on its disk; free some space: what was committed before is safe" in message


SEAL = """
import os
from ertis_numba.storage import open_recording
from ertis_numba.storage.sealing import seal
sealed = seal(journal.path)
with open_recording(sealed.recording) as recording:
    assert [m.data.tobytes() for m in recording] == [entry.measurement.data.tobytes() for entry in given[:number]]
assert os.listdir(sys.argv[1]) == ["rec.h5"]
"""


@pytest.mark.skipif(shutil.which("unshare") is None, reason="only Linux has namespaces")
def test_journal_on_a_small_disk_can_be_sealed_there(tmp_path):
    number, message = on_a_small_disk(tmp_path, APPEND + SEAL)
    assert number > 10
    assert "MB free, but" in message
    assert "its content is safe: end the capture, or free some space" in message
