"""Journals of the earlier format, without behaviour, that killed processes left."""

import pytest

from ertis_numba.frames import SequenceGap
from ertis_numba.journal import LOST, Journal, JournalSensor, _contents, _database, _rows, _tables
from ertis_numba.storage import open_recording
from ertis_numba.storage.sealing import seal
from tests.journal.test_journal_log import COUNT, flip, log_of
from tests.journals import EPOCH, crashed, entries, same

FORMER = tuple(column for column in _tables.TABLES["measurements"] if column.name != "behaviour")


def former_row(sensor, entry, sensor_id):
    """Row of a measurement in version 1."""
    *values, _, crc32, words = sensor.entry_values(entry)
    numbered = (sensor_id, *values, crc32)
    return (*numbered, _tables.row_crc32(numbered), words)


def former_journal(folder, given, moment="log"):
    """Journal of version 1 that a killed process left."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(_tables.TABLES, "measurements", FORMER)
        patch.setattr(_rows, "_INSERTION", _tables.insert_statement("measurements"))
        patch.setattr(JournalSensor, "entry_row", former_row)
        for module in (_tables, _contents, _database):
            patch.setattr(module, "COMPLETE_VERSION", 1)
        return crashed(folder, given, moment=moment)


@pytest.mark.parametrize("moment", ["log", "between"])
def test_former_journal_is_sealed(tmp_path, moment):
    given = entries(COUNT)
    path = former_journal(tmp_path, given, moment)
    with Journal.open(path) as journal:
        assert all(same(came, wanted) for came, wanted in zip(journal.entries(), given, strict=True))
    seal(path)
    with open_recording(tmp_path / "rec.h5") as recording:
        assert recording.stamps() == [entry.measurement.stamp for entry in given]
        assert {stamp.behaviour for stamp in recording.stamps()} == {"unknown"}


@pytest.mark.parametrize("place", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_damaged_log_of_a_former_journal_loses_one_measurement_at_most(tmp_path, place):
    given = entries(COUNT)
    path = former_journal(tmp_path, given)
    flip(log_of(path), int(place * log_of(path).stat().st_size))
    with Journal.open(path) as journal:
        numbers = {entry.measurement.stamp.sequence: entry for entry in journal.entries()}
        lost = [number for number in range(10, 10 + COUNT) if number not in numbers]
        assert list(journal.gaps) == [SequenceGap("left", number, number, LOST, EPOCH) for number in lost]
    assert len(lost) <= 1
    assert all(same(came, given[number - 10]) for number, came in numbers.items())
