"""The ledger keeps what a folder holds, and a process of its own reads it from recordings."""

import json

import pytest

from ertis_numba.errors import DataError, InUseError
from ertis_numba.journal import Gap, seal_apart
from ertis_numba.network.central_node._items import Run
from ertis_numba.network.central_node._ledger import Ledger, Lock, look
from tests.journals import EPOCH, create, entries


def test_what_is_saved_is_read(tmp_path):
    settled = {Run("left", 2**62): 7, Run("left", 3): -1, Run("right", 3): 2**62}
    ledger = Ledger(tmp_path)
    assert (ledger.is_new, ledger.settled, ledger.open, ledger.unsealed) == (True, {}, [], [])
    gaps = [Gap("left", 0, 2**62, "ring overflow", 2**63 - 1)]
    ledger.save(settled, open_=["a"], unsealed=["b", "c"], gaps=gaps)
    read = Ledger(tmp_path)
    assert (read.is_new, read.settled, read.open, read.unsealed) == (False, settled, ["a"], ["b", "c"])
    assert read.gaps == ledger.gaps == gaps


def test_a_ledger_of_version_1_is_read(tmp_path):
    (tmp_path / ".ertis-ledger").write_text(
        '{"version": 1, "settled": {"left": {"3": 7}}, "open": ["a"], "unsealed": []}'
    )
    read = Ledger(tmp_path)
    assert (read.settled, read.open, read.gaps) == ({Run("left", 3): 7}, ["a"], [])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", "is damaged"),
        ('{"settled": 1}', "is damaged"),
        ('{"version": 3, "news": 1}', "has version 3"),
        ("", "is damaged"),
    ],
)
def test_a_ledger_that_cannot_be_used_is_refused(content, message, tmp_path):
    (tmp_path / ".ertis-ledger").write_text(content)
    with pytest.raises(DataError, match=message):
        Ledger(tmp_path)


def test_a_ledger_that_cannot_be_read_is_refused(tmp_path):
    (tmp_path / ".ertis-ledger").mkdir()
    with pytest.raises(DataError, match="allow reading it"):
        Ledger(tmp_path)


def test_a_folder_is_for_one(tmp_path):
    lock = Lock(tmp_path)
    with pytest.raises(InUseError, match="in use by another central node"):
        Lock(tmp_path)
    lock.release()
    lock.release()
    Lock(tmp_path).release()
    with pytest.raises(DataError, match="give a folder that can be written"):
        Lock(tmp_path / "none")


def test_recordings_are_looked_at(tmp_path):
    with create(tmp_path, [*entries(3), *entries(2, epoch=9), *entries(1, sensor="right")]) as journal:
        journal.note_gap("left", 20, 29, "lost", epoch=EPOCH)
    seal_apart(journal.path)
    assert look([tmp_path / "rec.h5"]) == {Run("left", EPOCH): 29, Run("left", 9): 11, Run("right", EPOCH): 10}
    assert look([]) == {}


def test_a_recording_that_cannot_be_looked_at_is_told(tmp_path):
    (tmp_path / "bad.h5").write_text(json.dumps([]))
    with pytest.raises(DataError, match=r"recordings cannot be looked at .*bad\.h5"):
        look([tmp_path / "bad.h5"])
