"""Ledger of a folder, and the process that examines recordings for it."""

import json
import re
import zlib

import pytest

from ertis_numba.base.errors import DataError, FormatVersionError, JournalInUseError
from ertis_numba.frames import SequenceGap
from ertis_numba.journal import seal_in_subprocess
from ertis_numba.network.central_node._ledger import Ledger, Lock, read_acked_through
from ertis_numba.network.central_node._received_items import SensorSession
from tests.journals import EPOCH, create, entries


def test_saved_ledger_is_read_back(tmp_path):
    acked_through = {SensorSession("left", 2**62): 7, SensorSession("left", 3): -1, SensorSession("right", 3): 2**62}
    ledger = Ledger(tmp_path)
    assert (ledger.is_new, ledger.acked_through, ledger.open, ledger.unsealed) == (True, {}, [], [])
    gaps = [SequenceGap("left", 0, 2**62, "ring overflow", 2**63 - 1)]
    ledger.save(acked_through, open_=["a"], unsealed=["b", "c"], gaps=gaps)
    read = Ledger(tmp_path)
    assert (read.is_new, read.acked_through, read.open, read.unsealed) == (False, acked_through, ["a"], ["b", "c"])
    assert read.gaps == ledger.gaps == gaps


@pytest.mark.parametrize(
    "content",
    [
        b"{",
        b'{"settled": 1}',
        b'{"version": 3, "news": 1}',
        b"",
        b"\xff",
        b'{"settled": {"left": {"x": 1}}}',
        b'{"settled": {"l\xff": {"1": 1}}}',
        b'{"gaps": [["left", "1", 5, 4, "x"]]}',
    ],
)
def test_unreadable_ledger_is_reported_and_ignored(content, tmp_path):
    (tmp_path / ".ertis-ledger").write_bytes(content)
    read = Ledger(tmp_path)
    assert re.fullmatch(r"\S+\.ertis-ledger is damaged: [^\n]*read again from the recordings .*", read.damage)
    assert (read.is_new, read.acked_through, read.open, read.unsealed, read.gaps) == (False, {}, [], [], [])


def test_ledger_of_a_newer_version_is_refused(tmp_path):
    text = b'["ertis-ledger",4]'
    (tmp_path / ".ertis-ledger").write_bytes(b"%08x %s\n" % (zlib.crc32(text), text))
    with pytest.raises(FormatVersionError, match="has version 4, but this package reads 3; update ertis-numba"):
        Ledger(tmp_path)


SETTLED = {SensorSession("left", 2**62): 7, SensorSession("left", 3): 5, SensorSession("right", 3): 2**62}


def saved(folder):
    gaps = [SequenceGap("left", 0, 9, "ring overflow", 4)]
    Ledger(folder).save(SETTLED, open_=["a.h5.journal"], unsealed=["b.h5.journal"], gaps=gaps)
    return (folder / ".ertis-ledger"), gaps


def test_flipped_bit_of_a_ledger_is_detected_and_raises_no_number(tmp_path):
    path, gaps = saved(tmp_path)
    whole = path.read_bytes()
    for bit in range(8 * len(whole)):
        damaged = bytearray(whole)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        read = Ledger(tmp_path)
        assert read.damage, damaged
        assert read.acked_through.items() <= SETTLED.items()
        assert {*read.open} <= {"a.h5.journal"}
        assert {*read.gaps} <= {*gaps}


def test_truncated_ledger_is_detected(tmp_path):
    path, _ = saved(tmp_path)
    whole = path.read_bytes()
    for n_bytes in range(len(whole)):
        path.write_bytes(whole[:n_bytes])
        assert Ledger(tmp_path).damage


def test_ledger_keeps_the_newest_sessions_of_each_sensor(tmp_path):
    acked_through = {
        SensorSession(sensor, session_id): session_id for session_id in range(2_000) for sensor in ("left", "right")
    }
    ledger = Ledger(tmp_path)
    ledger.save(acked_through, open_=[], unsealed=[])
    assert (tmp_path / ".ertis-ledger").stat().st_size < 10_000
    kept = Ledger(tmp_path).acked_through
    assert list(kept) == list(ledger.acked_through)
    assert {run.session_id for run in kept} == set(range(2_000 - 64, 2_000))


def test_ledger_that_cannot_be_opened_is_refused(tmp_path):
    (tmp_path / ".ertis-ledger").mkdir()
    with pytest.raises(DataError, match="make it readable"):
        Ledger(tmp_path)


def test_folder_belongs_to_one_central_node(tmp_path):
    lock = Lock(tmp_path)
    with pytest.raises(JournalInUseError, match="in use by another central node"):
        Lock(tmp_path)
    lock.release()
    lock.release()
    Lock(tmp_path).release()
    with pytest.raises(DataError, match="choose a writable folder"):
        Lock(tmp_path / "none")


def test_recordings_are_examined_in_a_process(tmp_path):
    with create(tmp_path, [*entries(3), *entries(2, session_id=9), *entries(1, sensor="right")]) as journal:
        journal.note_gap("left", 20, 29, "lost", session_id=EPOCH)
    seal_in_subprocess(journal.path)
    assert read_acked_through([tmp_path / "rec.h5"]) == {
        SensorSession("left", EPOCH): 29,
        SensorSession("left", 9): 11,
        SensorSession("right", EPOCH): 10,
    }
    assert read_acked_through([]) == {}


def test_unreadable_recording_is_reported(tmp_path):
    (tmp_path / "bad.h5").write_text(json.dumps([]))
    with pytest.raises(DataError, match=r"recordings cannot be read .*bad\.h5"):
        read_acked_through([tmp_path / "bad.h5"])
