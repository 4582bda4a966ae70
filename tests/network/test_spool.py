"""Spooled measurements of a sensor node reach the central node, however either of them ends."""

import shutil
import signal
import sqlite3
import subprocess
import sys
from dataclasses import replace

import pytest

from ertis_numba.base.errors import ArgumentError, DataError, NetworkError
from ertis_numba.journal import LOST, Journal, JournalEntry
from ertis_numba.journal._database import PAGE_BYTES
from ertis_numba.network.sensor_node import _disk_spool as disk, _link as link, _outgoing_sessions as runs
from ertis_numba.storage import open_recording
from ertis_numba.storage.sealing import seal
from tests.journals import ENVIRONMENT, EPOCH, TINY, create, entries
from tests.sending import IMPATIENT, KEY, SOON_S, Node, has_all, impatient, until
from tests.stand_in import StandIn

__all__ = ["impatient"]  # a fixture

N_BYTES = TINY.recording.n_samples
NOBODY = "tcp://127.0.0.1:1"


@pytest.fixture(autouse=True)
def swept_often(monkeypatch):
    monkeypatch.setattr(disk, "_SWEEP_S", 0.01)


def journals(folder):
    return sorted(folder.glob("*.journal"))


def kept(folder, given, **options):
    """Leave measurements in a spool, as a node without a central node does."""
    with Node(NOBODY, spool=folder, **options) as node:
        node.append(given)


def test_measurements_are_durable_before_they_are_sent(tmp_path):
    given = entries(5)
    with Node(NOBODY, spool=tmp_path / "spool") as node:
        assert node.is_durable
        assert node.append(given) == given
        node.note_gap("left", 15, 16, "footer", session_id=EPOCH)
        for path in (tmp_path / "spool").iterdir():  # as if the process were killed here
            shutil.copy(path, tmp_path)
    (path,) = journals(tmp_path)
    assert path.name.endswith(f"Z-{EPOCH:016x}.h5.journal")
    with Journal.open(path) as journal:
        assert [entry.measurement.stamp.sequence for entry in journal.entries()] == [10, 11, 12, 13, 14]
        assert [(gap.first, gap.last, gap.reason) for gap in journal.gaps] == [(15, 16, "footer")]
    sealed = seal(path)
    assert (sealed.measurements, sealed.missing) == (5, 2)
    assert open_recording(sealed.recording).firmware == "1.2.3"


def test_acknowledged_measurements_leave_the_disk(tmp_path):
    given = entries(30)
    with StandIn() as central, Node(central.address, spool=tmp_path) as node:
        node.append(given[:29])
        assert node.flush(SOON_S)
        (path,) = journals(tmp_path)
        (journal,) = node._spool._journals.values()  # noqa: SLF001  nobody else can open it
        until(lambda: len(journal) == 0)
        node.append(given[29:])
        assert node.flush(SOON_S)
        assert path.exists()
    assert has_all(central, given)
    assert not list(tmp_path.iterdir())


def test_earlier_sessions_are_sent_first(tmp_path, monkeypatch):
    for module, name in ((link, "_GREET_AGAIN_S"), (runs, "_PATIENCE_S")):  # A busy machine answers late.
        monkeypatch.setattr(module, name, SOON_S)
    old, older, new = entries(5, session_id=2), entries(5, session_id=1), entries(5, session_id=3)
    kept(tmp_path, older)
    journals(tmp_path)[0].rename(tmp_path / "20200101T000000Z-1.h5.journal")
    kept(tmp_path, old)
    with StandIn(window=1) as central, Node(central.address, spool=tmp_path) as node:
        node.append(new)
        assert node.flush(SOON_S)
        assert node.counts["left"].stored == 15
        notes = list(node.notes.queue)
    for session_id, given in enumerate((older, old, new), 1):
        assert has_all(central, given, ("left", session_id))
    assert [hello.session_id for hello, _ in central.hellos.queue] == [1, 2, 3]
    assert not journals(tmp_path)
    assert notes == []


def test_session_continues_after_a_restart(tmp_path):
    given = entries(10)
    kept(tmp_path, given[:5])
    with Node(NOBODY, spool=tmp_path) as node:
        with pytest.raises(ArgumentError, match="measurement 14 of sensor left follows 14"):
            node.append(given[4:])
        node.append(given[5:])
        assert len(journals(tmp_path)) == 1
        assert node.unacked == 10
    with StandIn() as central, Node(central.address, spool=tmp_path) as node:
        assert node.flush(SOON_S)
    assert has_all(central, given)


@IMPATIENT
def test_stored_measurements_with_lost_acks_are_not_sent_again(tmp_path):
    """Measurements that the central node has are removed from the disk instead."""
    given = entries(8)
    kept(tmp_path / "a", given)
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    with StandIn() as central:
        for folder in ("a", "b"):
            with Node(central.address, spool=tmp_path / folder) as node:
                assert node.flush(SOON_S)
    assert has_all(central, given)
    assert central.resent == 0
    assert not journals(tmp_path / "b")


def test_memory_is_bounded_while_the_disk_keeps_everything(tmp_path):
    given = entries(20)
    with StandIn() as central:
        address = central.address
    with Node(address, spool=tmp_path, ring_bytes=3 * N_BYTES) as node:
        node.append(given)
        items = node._spool.runs[KEY].items  # noqa: SLF001  nobody else can tell
        assert sum(item.entry is not None for item in items) == 3
        with central:
            assert node.flush(SOON_S)
    assert has_all(central, given)


def test_full_spool_refuses_new_measurements(tmp_path):
    given = entries(200)
    with StandIn() as central:
        address = central.address
    with Node(address, spool=tmp_path, spool_bytes=10 * N_BYTES) as node:
        assert node.append(given[:12]) == given[:10]
        for entry in given[12:150]:
            assert node.append([entry]) == []
        assert (node.counts["left"].accepted, node.counts["left"].refused) == (10, 140)
    with Node(address, spool=tmp_path, spool_bytes=10 * N_BYTES) as node:  # it knows what was refused
        assert node._spool.runs[KEY].following == 160  # noqa: SLF001  nobody else can tell
        with central:
            assert node.flush(SOON_S)
            assert node.append(given[150:]) == given[150:160]
            assert node.flush(SOON_S)
    assert [*central.held[KEY]] == [*range(10, 20), *range(160, 170)]
    assert {reason for *_, reason in central.gaps[KEY]} == {disk.SPOOL_FULL}
    assert sum(last - first + 1 for first, last, _ in central.gaps[KEY]) == 180


@pytest.mark.parametrize("text", ["the disk is full", "the disk fails"])
def test_spool_survives_a_disk_that_is_full_for_a_while(tmp_path, monkeypatch, text):
    given = entries(9)
    append, note_gaps = Journal.append, Journal.note_gaps

    def fail(*_arguments, **_options):
        raise DataError(text)

    with StandIn() as central, Node(central.address, spool=tmp_path) as node:
        node.append(given[:3])
        with monkeypatch.context() as patch:
            patch.setattr(Journal, "append", fail)
            patch.setattr(Journal, "note_gaps", fail)
            for entry in given[3:6]:
                assert node.append([entry]) == []
            node.note_gap("left", 16, 16, "footer", session_id=EPOCH)
        assert (Journal.append, Journal.note_gaps) == (append, note_gaps)
        assert node.append(given[7:]) == given[7:]
        assert node.flush(SOON_S)
        assert list(node.notes.queue) == [text]
    assert [*central.held[KEY]] == [10, 11, 12, 17, 18]
    reported = {number: reason for first, last, reason in central.gaps[KEY] for number in range(first, last + 1)}
    assert reported == dict.fromkeys((13, 14, 15), disk.SPOOL_FULL) | {16: "footer"}
    assert not journals(tmp_path)


def test_damaged_measurements_of_the_spool_become_gaps(tmp_path):
    given = entries(20, first=0)
    kept(tmp_path, given)
    (path,) = journals(tmp_path)
    with sqlite3.connect(path) as connection:
        connection.execute("UPDATE measurements SET words = zeroblob(4096) WHERE sequence IN (3, 4)")
    connection.close()
    with StandIn() as central, Node(central.address, spool=tmp_path) as node:
        assert node.flush(SOON_S)
        counts = node.counts["left"]
        assert "measurement 3 of sensor left has CRC-32" in node.notes.get(timeout=SOON_S)
    assert [*central.held[KEY]] == [0, 1, 2, *range(5, 20)]
    assert [gap for gap in central.gaps[KEY] if gap[1] >= 0] == [(3, 3, disk.DAMAGED), (4, 4, disk.DAMAGED)]
    assert (counts.accepted, counts.stored, counts.damaged, counts.unacked) == (20, 18, 2, 0)


def test_unsendable_journals_stay_in_the_spool(tmp_path):
    """Cases: locked, truncated, with unsendable numbers, and duplicate. An empty one is removed."""
    given = entries(4, session_id=7)
    kept(tmp_path, given)
    (path,) = journals(tmp_path)
    shutil.copy(path, tmp_path / "z_copy.h5.journal")
    (tmp_path / "a_empty.h5.journal").touch()
    create(tmp_path, entries(1, first=2**48 + 1), name="c_far.h5").close()
    (tmp_path / "b_short.h5.journal").write_bytes(path.read_bytes()[: 2 * PAGE_BYTES])
    with (
        create(tmp_path, name="used.h5") as used,
        StandIn() as central,
        Node(central.address, spool=tmp_path) as node,
    ):
        assert node.flush(SOON_S)
        notes = list(node.notes.queue)
        assert used.path.exists()
    assert has_all(central, given, ("left", 7))
    assert [path.name for path in journals(tmp_path)] == [
        "b_short.h5.journal", "c_far.h5.journal", "used.h5.journal", "z_copy.h5.journal"
    ]  # fmt: skip
    assert "measurements in b_short.h5.journal are not sent" in notes[0]
    assert f"measurements in c_far.h5.journal are not sent: sequence number {2**48 + 1} is above {2**48}" in notes[1]
    assert "has sessions that another journal has, too; move it elsewhere" in notes[2]


def test_journal_of_a_capture_in_the_spool_is_sent(tmp_path):
    given = entries(4)
    create(tmp_path, given).close()
    with StandIn() as central, Node(central.address, (), spool=tmp_path) as node:
        assert node.flush(SOON_S)
    assert has_all(central, given)


def test_missing_spool_folder_is_refused(tmp_path):
    (tmp_path / "file").touch()
    with (
        pytest.raises(NetworkError, match=r"choose a writable spool folder \(spool\)"),
        Node(NOBODY, spool=tmp_path / "file"),
    ):
        pass


SEND = """
import sys
from pathlib import Path
from ertis_numba.network.sensor_node import SensorNode
from tests.journals import TINY, entries
address, folder, session_id = sys.argv[1], sys.argv[2], int(sys.argv[3])
with SensorNode(address, spool=folder) as node:
    for sensor in ("left", "right"):
        node.add_sensor(sensor, TINY)
    for number in range(10**9):
        for sensor in ("left", "right"):
            kept = node.append(entries(1, sensor=sensor, first=number, session_id=session_id, seed=number))
            print(sensor, number, kept[0].crc32, flush=True)
"""


@IMPATIENT
def test_killed_sensor_and_central_nodes_lose_nothing(tmp_path):
    """All measurements that a node reported as kept arrive once."""
    accepted = {}
    with StandIn() as central:
        for session_id in range(3):
            command = [sys.executable, "-c", SEND, central.address, tmp_path, str(session_id)]
            with subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True) as process:
                for number, reported in enumerate(process.stdout):
                    if reported.endswith("\n"):
                        sensor, sequence, crc32 = reported.split()
                        accepted[sensor, session_id, int(sequence)] = int(crc32)
                    if number == 30 + 34 * session_id:
                        process.send_signal(signal.SIGKILL)
                    elif number in (10, 20):
                        central.stop()
                        central.start()
        with Node(central.address, (), spool=tmp_path) as node:
            assert node.flush(SOON_S)
    arrived = {
        (*key, number): message.crc32 for key, held in central.held.items() for number, (message, _) in held.items()
    }
    assert accepted.items() <= arrived.items()
    assert len(arrived) <= len(accepted) + 6  # kept, but killed before the report
    assert central.wrong == []
    assert not journals(tmp_path)


def test_gap_kept_only_in_memory_is_reported_after_a_restart(tmp_path):
    """The node was killed before its journal stored the reason."""
    kept(tmp_path, [*entries(2, first=0), *entries(2, first=5)])
    with StandIn() as central, Node(central.address, (), spool=tmp_path) as node:
        assert node.flush(SOON_S)
    assert central.gaps[KEY] == [(2, 4, runs.NEVER_GIVEN)]


def test_old_measurement_is_sent_unchanged(tmp_path):
    (given,) = entries(1)
    stamp = replace(given.measurement.stamp, timestamp_ns=-5, timestamp_uncertainty_ns=2**32 - 1, sync_count=-(2**63))
    given = JournalEntry(replace(given.measurement, stamp=stamp), monotonic_ns=-1)
    kept(tmp_path, [given])
    with StandIn() as central, Node(central.address, (), spool=tmp_path) as node:
        assert node.flush(SOON_S)
    assert has_all(central, [given])


def test_damaged_log_of_a_spool_is_reported_and_becomes_a_gap(tmp_path):
    given = entries(6)
    with Node(NOBODY, spool=tmp_path / "running") as node:
        for entry in given:
            node.append([entry])
        shutil.copytree(tmp_path / "running", tmp_path / "killed")
    (log,) = (tmp_path / "killed").glob("*-wal")
    with log.open("r+b") as file:
        file.truncate(log.stat().st_size - PAGE_BYTES)
    notes = []
    spool = disk.DiskSpool(tmp_path / "killed", 10**9, None, on_note=notes.append)
    spool.open()
    (run,) = spool.runs.values()
    assert [(item.first, item.reason) for item in run.items] == [
        *((number, "") for number in range(10, 15)),
        (15, LOST),
    ]
    spool.close()
    assert [note.partition(" was damaged")[2] for note in notes] == ["; up to 1 stored measurements are lost"]
