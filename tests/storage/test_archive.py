"""Durability of the archive: each acknowledged item is stored exactly once, even if the disk fails."""

import select
import shutil
import time
import zlib
from datetime import datetime

import pytest

from ertis_numba.base.errors import ArgumentError, DataError, DiskFullError, ErtisError, JournalInUseError
from ertis_numba.frames import SequenceGap
from ertis_numba.journal import SUFFIX, Journal, JournalPose, JournalSensor, seal_in_subprocess
from ertis_numba.network.central_node import Archive, _recent_poses, _volumes
from ertis_numba.network.central_node._received_items import (
    Forgotten,
    ReceivedItem,
    Remark,
    Resumed,
    SealedOne,
    SealingFailed,
    SensorSession,
    StorageFault,
    Stored,
    StoredDuplicate,
)
from ertis_numba.network.central_node._volumes import journal_name
from ertis_numba.storage import open_recording, sensor_names
from ertis_numba.storage.sealing import seal
from tests.central import stored, wanted
from tests.journals import EPOCH, TINY, create, entries

SOURCE, RIGHT = JournalSensor.from_settings("left", TINY), JournalSensor.from_settings("right", TINY)
RUN = SensorSession("left", EPOCH)
WAIT_S = 60.0


def item_of(entry, source=SOURCE):
    stamp = entry.measurement.stamp
    entry.crc32 = zlib.crc32(entry.measurement.data.data)
    return ReceivedItem(
        SensorSession(stamp.sensor, stamp.session_id),
        stamp.sequence,
        stamp.sequence,
        entry,
        source,
        time.monotonic(),
        b"",
    )


def gap_of(first, last, reason="lost", sensor="left"):
    return ReceivedItem(
        SensorSession(sensor, EPOCH), first, last, SequenceGap(sensor, first, last, reason, EPOCH), SOURCE, 0.0, b""
    )


def seal_here(journal, *, rests=None, **options):  # noqa: ARG001  the signature of the replaced function
    """Seal a journal as `ertis_numba.journal.seal_in_subprocess` does, but in this process, which is faster."""
    try:
        return seal(journal, **options)
    except JournalInUseError:
        raise
    except (ErtisError, OSError) as error:
        raise DataError(str(error)) from error


@pytest.fixture
def sealing_processes():
    """Let the archive start its sealing processes in a test."""


@pytest.fixture(autouse=True)
def _sealing(request, monkeypatch):
    if "sealing_processes" not in request.fixturenames:
        monkeypatch.setattr("ertis_numba.network.central_node._sealing.seal_in_subprocess", seal_here)


class Opened:
    """An open archive and its events."""

    def __init__(self, folder, **options):
        self.archive = Archive(folder, **{"seal": False} | options)
        self.events = []

    def __enter__(self):
        self.fd = self.archive.open()
        return self

    def __exit__(self, *_):
        self.archive.close()
        self.events += self.archive.read()

    def give(self, *items):
        for item in items:
            self.archive.offer(item)

    def until(self, kind, test=lambda _: True):
        """Wait for an event of a kind, including earlier events."""
        end_s = time.monotonic() + WAIT_S
        seen = 0
        while True:
            for event in self.events[seen:]:
                if isinstance(event, kind) and test(event):
                    return event
            seen = len(self.events)
            assert time.monotonic() < end_s, f"no {kind} among {self.events}"
            select.select([self.fd], [], [], 1.0)
            self.events += self.archive.read()

    def until_stored(self, number):
        self.until(Stored, lambda event: event.items[-1].last >= number)


def stored_numbers(opened):
    """Sequence numbers stored_numbers as stored, in order of the reports."""
    return [item.last for event in opened.events if isinstance(event, Stored) for item in event.items]


def from_zero(count, first=0, **options):
    return entries(count, first=first, **options)


def test_archive_stores_in_order_and_reports_each_item_once(tmp_path):
    given = from_zero(40)
    with Opened(tmp_path) as opened:
        opened.give(*map(item_of, given), gap_of(40, 44), *map(item_of, from_zero(2, 45)))
        opened.until_stored(46)
        assert opened.archive.acked_through(RUN) == 46
    assert stored_numbers(opened) == [*range(40), 44, 45, 46]
    assert stored(tmp_path) == (wanted([*given, *from_zero(2, 45)]), [("left", EPOCH, 40, 44, "lost")])


def test_archive_returns_items_out_of_order(tmp_path):
    given = from_zero(3)
    with Opened(tmp_path) as opened:
        opened.give(item_of(given[0]), item_of(given[2]), item_of(given[1]))
        opened.until_stored(1)
    assert [event.item.first for event in opened.events if isinstance(event, Forgotten)] == [2]
    assert stored(tmp_path)[0] == wanted(given[:2])


def test_archive_stores_other_sensors_beside_an_invalid_item(tmp_path):
    others = from_zero(2, sensor="right")
    bad = item_of(
        from_zero(1)[0],
        JournalSensor.from_settings("left", TINY.replace(recording=TINY.recording.replace(n_samples=8192))),
    )
    with Opened(tmp_path) as opened:
        right = JournalSensor.from_settings("right", TINY)
        opened.give(item_of(others[0], right), bad, item_of(others[1], right))
        opened.until_stored(1)
    assert [event.reason for event in opened.events if isinstance(event, Forgotten)] != [""]
    assert stored(tmp_path)[0] == wanted(others)


def test_archive_returns_items_after_an_invalid_one(tmp_path):
    given = from_zero(3)
    given[1:2] = from_zero(1, 1, settings=TINY.replace(recording=TINY.recording.replace(n_samples=8192)))
    others = from_zero(2, sensor="right")
    with Opened(tmp_path) as opened:
        right = JournalSensor.from_settings("right", TINY)
        opened.archive._store(  # noqa: SLF001  all of them in one batch
            opened.archive._journal_store,  # noqa: SLF001
            [*map(item_of, given), *(item_of(other, right) for other in others)],
        )
        assert opened.archive.acked_through(RUN) == 0
    back = [(event.item.first, bool(event.reason)) for event in opened.events if isinstance(event, Forgotten)]
    assert back == [(1, True), (2, False)]
    assert stored(tmp_path)[0] == wanted([given[0], *others])


def test_archive_finds_repeated_number_without_full_search(tmp_path, monkeypatch):
    given, (other,) = from_zero(3), from_zero(1, 1, seed=2)
    again = [item_of(from_zero(3)[1]), item_of(other), item_of(from_zero(1, 9)[0])]
    for item in again:
        item.again = True
    with Opened(tmp_path) as opened:
        opened.give(*map(item_of, given))
        opened.until_stored(2)
        index = Journal.index
        looked = []
        monkeypatch.setattr(Journal, "index", lambda *which: (looked.append(which), index(*which))[1])
        opened.give(again[0], again[2])
        opened.until(StoredDuplicate, lambda event: event.item is again[2])
        assert looked == []
        opened.give(again[1])
        opened.until(StoredDuplicate, lambda event: event.item is again[1])
    assert [event.differs for event in opened.events if isinstance(event, StoredDuplicate)] == [False, False, True]


def test_archive_writes_consecutive_gaps_in_one_transaction(tmp_path, monkeypatch):
    notes, commits = Journal.note_gaps, []
    monkeypatch.setattr(Journal, "note_gaps", lambda journal, gaps: (commits.append(len(gaps)), notes(journal, gaps)))
    with Opened(tmp_path) as opened:
        opened.archive._store(  # noqa: SLF001
            opened.archive._journal_store,  # noqa: SLF001
            [*(gap_of(number, number) for number in range(20)), *map(item_of, from_zero(1, 20)), gap_of(21, 21)],
        )
    assert commits == [20, 1]
    assert stored(tmp_path) == (
        wanted(from_zero(1, 20)),
        [("left", EPOCH, number, number, "lost") for number in (*range(20), 21)],
    )


def test_two_mountings_of_a_sensor_become_two_recordings(tmp_path):
    moved = JournalSensor.from_settings("left", TINY, translation_m=(1.0, 0.0, 0.0))
    first, second = from_zero(2)
    with Opened(tmp_path) as opened:
        opened.archive._store(opened.archive._journal_store, [item_of(first), item_of(second, moved)])  # noqa: SLF001
    assert len(list(tmp_path.glob(f"*{SUFFIX}"))) == 2


def test_archive_reports_an_ended_storage_thread(tmp_path, monkeypatch):
    with Opened(tmp_path) as opened:
        assert opened.archive.stuck == ""
        monkeypatch.setattr(Archive, "_store", lambda *_: False)
        opened.give(item_of(from_zero(1)[0]))
        opened.archive._thread.join(WAIT_S)  # noqa: SLF001
        assert "the storage thread has ended because of an internal error" in opened.archive.stuck


@pytest.mark.usefixtures("sealing_processes")
def test_archive_seals_full_recordings_while_storing(tmp_path):
    given = from_zero(600)
    with Opened(tmp_path, seal=True, rotate_bytes=1e6) as opened:
        for begin in range(0, 600, 100):
            opened.give(*map(item_of, given[begin : begin + 100]))
            opened.until_stored(begin + 99)
        opened.until(SealedOne)
    assert opened.archive.status().sealing == 0
    assert opened.archive.status().sealed == len(list(tmp_path.glob("*.h5"))) >= 2
    assert not list(tmp_path.glob(f"*{SUFFIX}"))
    assert sorted(stored(tmp_path)[0]) == sorted(wanted(given))


def pose_of(timestamp_ns, **more):
    fields = {"sensors": ("left",), "position_m": (1.0, 2.0, 3.0), "rotation_xyzw": (0.0, 0.0, 0.0, 1.0)}
    return JournalPose(timestamp_ns=timestamp_ns, **fields | more)


def test_archive_rotates_recording_full_of_poses(tmp_path):
    """A measurement is so small that only the poses can exceed the limit of 1 MB."""
    given = from_zero(2)
    with Opened(tmp_path, rotate_bytes=1e6) as opened:
        opened.give(item_of(given[0]))
        opened.until_stored(0)
        for number in range(4000):
            opened.archive.offer_pose(pose_of(number, covariance=bytes(288)))
        end_s = time.monotonic() + WAIT_S
        while opened.archive._journal_store.volume is not None:  # noqa: SLF001
            assert time.monotonic() < end_s
            select.select([opened.fd], [], [], 0.05)
        opened.give(item_of(given[1]))
        opened.until_stored(1)
    first, _ = sorted(tmp_path.glob(f"*{SUFFIX}"))
    with Journal.open(first) as journal:
        assert (len(journal), len(journal.read_poses()[0])) == (1, 4000)


def test_archive_stores_poses_of_known_sensors_only(tmp_path, monkeypatch):
    """The pose of a sensor may arrive before its first measurement, when the journal already has other poses."""
    monkeypatch.setattr(_recent_poses, "_KEPT_S", 600.0)
    with Opened(tmp_path) as opened:
        for time_ns, sensors in enumerate([("unknown",), ("left",), ("right",), ("unknown", "left")]):
            opened.archive.offer_pose(pose_of(time_ns, sensors=sensors))
        opened.give(item_of(from_zero(1)[0]))
        opened.until_stored(0)
        end_s = time.monotonic() + WAIT_S
        while opened.archive._journal_store.volume.posed != {"left"}:  # noqa: SLF001
            assert time.monotonic() < end_s
            select.select([opened.fd], [], [], 0.05)
        opened.give(item_of(from_zero(1, sensor="right")[0], RIGHT))
        opened.until(Stored, lambda event: event.items[-1].run.sensor == "right")
    (path,) = tmp_path.glob(f"*{SUFFIX}")
    with Journal.open(path) as journal:
        assert [pose.timestamp_ns for pose in journal.read_poses()[0]] == [1, 3, 2]


def test_archive_stores_poses_once_disk_has_space_again(tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    with Opened(tmp_path) as opened:
        opened.give(item_of(from_zero(1)[0]))
        opened.until_stored(0)
        with monkeypatch.context() as patch:
            patch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=1_000_000))
            opened.archive.offer_pose(pose_of(5))
            assert "has 1.0 MB free" in opened.until(StorageFault).text
        opened.until(Resumed)
    (path,) = tmp_path.glob(f"*{SUFFIX}")  # The disk did not fail, so the journal was kept.
    with Journal.open(path) as journal:
        assert (len(journal), journal.read_poses()[0]) == (1, [pose_of(5)])


def test_archive_rotates_recording_after_its_time_limit(tmp_path, monkeypatch):
    with Opened(tmp_path) as opened:
        opened.give(item_of(from_zero(1)[0]))
        opened.until_stored(0)
        monkeypatch.setattr(opened.archive, "_rotate_s", 0.0)
        while opened.archive._journal_store.volume is not None:  # noqa: SLF001
            select.select([opened.fd], [], [], 0.05)
        monkeypatch.undo()
        opened.give(item_of(from_zero(1, 1)[0]))
        opened.until_stored(1)
    assert len(list(tmp_path.glob(f"*{SUFFIX}"))) == 2


def make_commits_fail(monkeypatch, *, times, before=True, error=None):
    """Make commits fail before or after the journal writes the data."""
    append, left = Journal.append, [times]

    def fails(journal, given):
        if left[0] and not before:
            append(journal, given)
        if left[0]:
            left[0] -= 1
            raise error or DataError("the disk fails")
        append(journal, given)

    monkeypatch.setattr(Journal, "append", fails)
    monkeypatch.setattr("ertis_numba.network.central_node._archive._AGAIN_S", 0.01)


@pytest.mark.parametrize("before", [True, False])
@pytest.mark.parametrize("times", [1, 4])
def test_archive_retries_failed_commit_without_duplicates(before, times, tmp_path, monkeypatch):
    make_commits_fail(monkeypatch, times=times, before=before)
    given = from_zero(3)
    with Opened(tmp_path) as opened:
        opened.give(*map(item_of, given))
        opened.until_stored(2)
        opened.until(Resumed)
    assert [type(event) for event in opened.events if not isinstance(event, Stored)][:2] == [StorageFault, Resumed]
    assert sorted(stored_numbers(opened)) == [0, 1, 2]
    assert sorted(stored(tmp_path)[0]) == sorted(wanted(given))


def test_archive_retries_after_an_input_output_error(tmp_path, monkeypatch):
    make_commits_fail(monkeypatch, times=3, error=OSError(5, "Input/output error"))
    with Opened(tmp_path) as opened:
        opened.give(*map(item_of, from_zero(2)))
        opened.until_stored(1)
    faults = [event.text for event in opened.events if isinstance(event, StorageFault)]
    assert faults == ["[Errno 5] Input/output error"]


def test_archive_replaces_a_removed_journal(tmp_path, monkeypatch):
    monkeypatch.setattr("ertis_numba.network.central_node._archive._AGAIN_S", 0.01)
    with Opened(tmp_path) as opened:
        opened.give(item_of(from_zero(1)[0]))
        opened.until_stored(0)
        (path,) = tmp_path.glob(f"*{SUFFIX}")
        path.unlink()
        opened.give(item_of(from_zero(1, 1)[0]))
        opened.until_stored(1)
    assert "removed or replaced" in opened.until(StorageFault).text
    assert stored(tmp_path)[0] == wanted(from_zero(1, 1))


def test_rows_of_a_failed_journal_are_stored_in_a_new_one(tmp_path, monkeypatch):
    """After a failed sync a journal can show rows that never reach the disk."""
    given = from_zero(3)
    with Opened(tmp_path) as opened:
        opened.give(item_of(given[0]))
        opened.until_stored(0)
        make_commits_fail(monkeypatch, times=1, before=False)
        opened.give(item_of(given[1]))
        opened.until_stored(1)
        opened.give(item_of(given[2]))
        opened.until_stored(2)
        paths = sorted(tmp_path.glob(f"*{SUFFIX}"))
        with Journal.open(paths[0]) as failed:
            assert [key.sequence for key in failed.index()] == [0]
    with Journal.open(paths[1]) as follower:
        assert [key.sequence for key in follower.index()] == [1, 2]
    assert stored_numbers(opened) == [0, 1, 2]
    assert sorted(stored(tmp_path)[0]) == sorted(wanted(given))


def test_journal_that_fails_before_any_acknowledgement_is_removed(tmp_path, monkeypatch):
    make_commits_fail(monkeypatch, times=3, before=False)
    with Opened(tmp_path) as opened:
        opened.give(item_of(from_zero(1)[0]))
        opened.until_stored(0)
        assert len(list(tmp_path.glob(f"*{SUFFIX}"))) == 1
    assert stored(tmp_path)[0] == wanted(from_zero(1))


def test_archive_keeps_its_journal_when_disk_is_full(tmp_path, monkeypatch):
    given = from_zero(2)
    with Opened(tmp_path) as opened:
        opened.give(item_of(given[0]))
        opened.until_stored(0)
        make_commits_fail(monkeypatch, times=3, error=DiskFullError("the disk is full"))
        opened.give(item_of(given[1]))
        opened.until_stored(1)
    assert len(list(tmp_path.glob(f"*{SUFFIX}"))) == 1
    assert stored(tmp_path)[0] == wanted(given)


def test_archive_stops_although_the_disk_fails(tmp_path, monkeypatch):
    make_commits_fail(monkeypatch, times=10**9)
    with Opened(tmp_path) as opened:
        opened.give(item_of(from_zero(1)[0]))
        opened.until(StorageFault)
    monkeypatch.undo()
    assert stored_numbers(opened) == []
    with Opened(tmp_path) as opened:
        assert opened.archive.acked_through(RUN) == -1


def test_measurements_before_a_fault_are_sealed_at_the_end(tmp_path, monkeypatch):
    first, second = (item_of(entry) for entry in from_zero(2))
    with Opened(tmp_path, seal=True) as opened:
        opened.give(first)
        opened.until_stored(0)
        make_commits_fail(monkeypatch, times=10**9)
        opened.give(second)
        opened.until(StorageFault)
    assert [type(event) for event in opened.events if isinstance(event, Resumed | SealedOne)] == [SealedOne]
    assert not list(tmp_path.glob("*.journal"))
    assert stored_numbers(opened) == [0]


def test_journals_left_by_a_crash_are_registered_and_sealed(tmp_path):
    given, left = from_zero(3), tmp_path / "left"
    left.mkdir()
    tmp_path = tmp_path / "running"
    with Opened(tmp_path) as opened:
        opened.give(*map(item_of, given))
        opened.until_stored(2)
        for path in tmp_path.iterdir():
            shutil.copy(path, left)
    with Opened(left, seal=True) as opened:
        assert opened.archive.acked_through(RUN) == 2
        opened.until(SealedOne)
    assert stored(left)[0] == wanted(given)


def gaps_in(folder):
    """Gaps in all recordings of a folder: sensor, first number, last number and reason."""
    found = set()
    for path in sorted(folder.glob("*.h5")):
        for sensor in sensor_names(path):
            with open_recording(path, sensor=sensor) as recording:
                found |= {(sensor, gap.first, gap.last, gap.reason) for gap in recording.gaps}
    return found


@pytest.mark.parametrize("how", ["ends", "killed"])
def test_gap_before_any_measurement_is_in_the_next_recording(tmp_path, how):
    """The gap's journal contains no measurement, so sealing it creates no recording."""
    with Opened(tmp_path, seal=how == "ends") as opened:
        opened.give(gap_of(0, 4, "ring overflow"))
        opened.until_stored(4)
        if how == "killed":
            for path in tmp_path.iterdir():
                shutil.copy(path, tmp_path / f"{path.name}.left")
    for path in tmp_path.glob("*.left"):  # the state before the ledger marked the journal as complete
        path.replace(path.with_suffix(""))
    with Opened(tmp_path, seal=True) as opened:
        opened.give(*map(item_of, from_zero(2, 5)))
        opened.until_stored(6)
    assert not list(tmp_path.glob(f"*{SUFFIX}"))
    assert gaps_in(tmp_path) == {("left", 0, 4, "ring overflow")}
    with Opened(tmp_path, seal=True) as opened:  # a stored_numbers gap is not repeated
        opened.give(*map(item_of, from_zero(1, 7)))
        opened.until_stored(7)
    recordings = sorted(tmp_path.glob("*.h5"))
    assert len(recordings) == 2
    with open_recording(recordings[-1], sensor="left") as recording:
        assert not recording.gaps


def test_journal_names_within_one_second_keep_their_order(tmp_path, monkeypatch):
    class Stopped(datetime):
        @classmethod
        def now(cls, tz=None):
            return cls(2026, 1, 2, 3, 4, 5, tzinfo=tz)

    monkeypatch.setattr(_volumes, "datetime", Stopped)
    stem = "runs_20260102T030405Z"
    assert journal_name(tmp_path, "runs") == f"{stem}.h5{SUFFIX}"
    assert journal_name(tmp_path, "runs", taken=[f"{stem}.h5{SUFFIX}"]) == f"{stem}_002.h5{SUFFIX}"
    (tmp_path / f"{stem}_002.h5").touch()  # the first journal was sealed without a recording
    assert journal_name(tmp_path, "runs") == f"{stem}_003.h5{SUFFIX}"
    assert journal_name(tmp_path, "runs", end="_conflicts") == f"{stem}_conflicts.h5{SUFFIX}"
    (tmp_path / f"{stem}_003.h5{SUFFIX}").touch()
    assert journal_name(tmp_path, "runs") == f"{stem}_004.h5{SUFFIX}"
    assert journal_name(tmp_path, "run") == f"run_20260102T030405Z.h5{SUFFIX}"


def test_gap_of_sensor_without_data_is_in_its_next_recording(tmp_path):
    with Opened(tmp_path, seal=True) as opened:
        right = ReceivedItem(
            SensorSession("right", EPOCH), 0, 4, SequenceGap("right", 0, 4, "ring overflow", EPOCH), RIGHT, 0.0, b""
        )
        opened.give(right, *map(item_of, from_zero(2)))
        opened.until_stored(1)
    with Opened(tmp_path, seal=True) as opened:
        opened.give(*map(item_of, from_zero(1, 2)))
        opened.until_stored(2)
    assert ("right", 0, 4, "ring overflow") not in gaps_in(tmp_path)
    with Opened(tmp_path, seal=True) as opened:
        opened.give(item_of(*from_zero(1, 5, sensor="right"), RIGHT))
        opened.until(Stored)
    assert ("right", 0, 4, "ring overflow") in gaps_in(tmp_path)


def test_archive_reads_a_folder_without_ledger(tmp_path):
    with Opened(tmp_path, seal=True) as opened:
        opened.give(*map(item_of, from_zero(3)))
        opened.until_stored(2)
    (tmp_path / ".ertis-ledger").unlink()
    create(tmp_path, from_zero(2, 3), name="other.h5").close()
    with Opened(tmp_path) as opened:
        assert opened.archive.acked_through(RUN) == 4


def test_archive_refuses_to_open_with_a_locked_journal(tmp_path):
    with create(tmp_path, from_zero(2)), pytest.raises(JournalInUseError, match="in use by another process"):
        Archive(tmp_path).open()
    with Opened(tmp_path) as opened:  # the failed open has released the folder
        assert opened.archive.acked_through(RUN) == 1


def test_archive_retries_failed_sealing(tmp_path, monkeypatch):
    monkeypatch.setattr("ertis_numba.network.central_node._sealing._AGAIN_S", 0.05)
    with Opened(tmp_path) as opened:
        opened.give(item_of(from_zero(1)[0]))
        opened.until_stored(0)
    (path,) = tmp_path.glob(f"*{SUFFIX}")
    in_the_way = path.with_name(path.name.removesuffix(SUFFIX))
    in_the_way.write_text("something else")
    with Opened(tmp_path, seal=True) as opened:
        assert "exists with other content" in opened.until(SealingFailed).text
        assert opened.archive.status().sealing_failed >= 1
        in_the_way.unlink()
        opened.until(SealedOne)
    assert opened.archive.status().sealing == 0


def test_journal_recovered_by_another_process_counts_as_sealed(tmp_path, monkeypatch):
    def seals(journal, **options):
        seal_here(journal, **options)
        raise JournalInUseError("somebody else has it")

    with Opened(tmp_path) as opened:
        opened.give(item_of(from_zero(1)[0]))
        opened.until_stored(0)
    monkeypatch.setattr("ertis_numba.network.central_node._sealing.seal_in_subprocess", seals)
    with Opened(tmp_path, seal=True) as opened:
        pass
    assert not [event for event in opened.events if isinstance(event, SealingFailed)]
    assert (opened.archive.status().sealing, opened.archive.status().sealing_failed) == (0, 0)
    assert stored(tmp_path)[0] == wanted(from_zero(1))


@pytest.mark.usefixtures("sealing_processes")  # this process reports too little free space
@pytest.mark.parametrize(("share", "rests"), [(0.5, 4.0), (2.0, 0.5)], ids=["room", "scarce"])
def test_sealing_rests_less_when_free_space_is_scarce(tmp_path, monkeypatch, share, rests):
    asked = []

    def seals(journal, **options):
        asked.append(options["rests"])
        return seal_in_subprocess(journal, **options)

    with Opened(tmp_path) as opened:
        opened.give(item_of(from_zero(1)[0]))
        opened.until_stored(0)
    (path,) = tmp_path.glob(f"*{SUFFIX}")
    usage = shutil.disk_usage(tmp_path)._replace(free=int(4 * path.stat().st_size / share))
    monkeypatch.setattr("ertis_numba.network.central_node._sealing.seal_in_subprocess", seals)
    monkeypatch.setattr("ertis_numba.network.central_node._sealing.shutil.disk_usage", lambda _: usage)
    with Opened(tmp_path, seal=True) as opened:
        opened.until(SealedOne)
    assert asked == [rests]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"name": "a/b"}, "sensor name"),
        ({"rotate_bytes": 1}, "size of a recording is 1"),
        ({"rotate_s": 0}, "time of a recording is 0"),
    ],
)
def test_archive_refuses_invalid_options(options, message, tmp_path):
    with pytest.raises(ArgumentError, match=message):
        Archive(tmp_path, **options)


def test_archive_refuses_a_folder_that_cannot_be_created(tmp_path):
    with pytest.raises(DataError, match="choose a writable folder"):
        Archive(tmp_path / "no" / "folder").open()


def test_different_measurement_with_a_stored_number_is_kept_after_rotation(tmp_path):
    given, (other,) = from_zero(3), from_zero(1, 1, seed=2)
    again = [item_of(entry) for entry in (given[1], other)]
    for item in again:
        item.again = True
    with Opened(tmp_path, seal=True) as opened:
        opened.give(*map(item_of, given))
        opened.until_stored(2)
        opened.archive._journal_store.rotate()  # noqa: SLF001  as when it is full
        opened.give(*again)
        opened.until(StoredDuplicate, lambda event: event.item is again[1])
    assert [event.differs for event in opened.events if isinstance(event, StoredDuplicate)] == [False, True]
    assert sorted(stored(tmp_path)[0]) == sorted(wanted([*given, other]))


@pytest.mark.parametrize("killed", [False, True])
def test_repeated_measurement_is_compared_after_a_restart(tmp_path, killed):
    given, (other,) = from_zero(30), from_zero(1, 28, seed=2)
    again = [item_of(entry) for entry in (given[29], other)]
    for item in again:
        item.again = True
    folder = tmp_path / "a"
    with Opened(folder) as opened:
        opened.give(*map(item_of, given))
        opened.until_stored(29)
        if killed:
            shutil.copytree(folder, tmp_path / "b")
    with Opened(tmp_path / "b" if killed else folder) as opened:
        opened.give(*again)
        opened.until(StoredDuplicate, lambda event: event.item is again[1])
    assert [event.differs for event in opened.events if isinstance(event, StoredDuplicate)] == [False, True]


def test_repeated_measurement_without_a_known_checksum_is_kept(tmp_path):
    given, (other,) = from_zero(30), from_zero(1, 1, seed=2)
    item = item_of(other)
    item.again = True
    with Opened(tmp_path) as opened:
        opened.give(*map(item_of, given))
        opened.until_stored(29)
    with Opened(tmp_path) as opened:
        opened.give(item)
        assert opened.until(StoredDuplicate).differs
    assert len(list(tmp_path.glob("*_conflicts.h5.journal"))) == 1


@pytest.mark.parametrize("place", [3, 30, -10])
def test_damaged_ledger_is_reported_once_and_rebuilt(tmp_path, place):
    with Opened(tmp_path, seal=True) as opened:
        opened.give(*map(item_of, from_zero(6)))
        opened.until_stored(5)
    ledger = tmp_path / ".ertis-ledger"
    content = bytearray(ledger.read_bytes())
    content[place] ^= 0x80
    ledger.write_bytes(content)
    with Opened(tmp_path) as opened:
        assert opened.archive.acked_through(RUN) == 5
        assert ".ertis-ledger is damaged: 1 of " in opened.until(Remark).text
    with Opened(tmp_path) as opened:
        assert opened.archive.acked_through(RUN) == 5
    assert not any(isinstance(event, Remark) for event in opened.events)


def test_flipped_digit_of_a_ledger_discards_no_measurement(tmp_path):
    with Opened(tmp_path, seal=True) as opened:
        opened.give(*map(item_of, from_zero(6)))
        opened.until_stored(5)
    ledger = tmp_path / ".ertis-ledger"
    assert b",5]" in ledger.read_bytes()
    ledger.write_bytes(ledger.read_bytes().replace(b",5]", b",9]"))
    with Opened(tmp_path) as opened:
        opened.give(*map(item_of, from_zero(4, 6)))
        opened.until_stored(9)
    assert sorted(stored(tmp_path)[0]) == sorted(wanted([*from_zero(6), *from_zero(4, 6)]))
