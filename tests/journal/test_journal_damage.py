"""Damaged journals are refused in one line, and a full disk removes nothing."""

import re
import sqlite3
import zlib

import numpy as np
import pytest

from ertis_numba.base.errors import DamagedError, DataError, FormatVersionError, JournalInUseError
from ertis_numba.journal import Journal
from ertis_numba.journal._database import PAGE_BYTES, Database
from ertis_numba.journal._tables import row_crc32
from ertis_numba.settings import Recording
from ertis_numba.storage.sealing import seal
from ertis_numba.storage.verify import verify
from tests.files import line
from tests.journals import EPOCH, crashed, create, entries, python, same
from tests.pages import path_of

SPOIL = """
import sqlite3, sys
connection = sqlite3.connect(sys.argv[1])
for statement in sys.argv[2:]:
    connection.execute(statement)
connection.commit()
"""


def spoil(path, *statements):
    """Change a journal by SQL, as a failing disk could."""
    done = python(SPOIL, path, *statements)
    assert not done.stderr


DAMAGED = {
    "words": ("UPDATE measurements SET words = zeroblob(4096) WHERE id = 2", "measurement 11 of .* has CRC-32"),
    "fewer words": ("UPDATE measurements SET words = x'00' WHERE id = 2", "measurement 11 of sensor left has CRC-32"),
    "time": (
        "UPDATE measurements SET timestamp_ns = 7 WHERE id = 2",
        (
            "the record of measurement 11 of sensor left has CRC-32 4077814677, but should have 1377004288: "
            "the journal is damaged"
        ),
    ),
    "type of the words": (
        "UPDATE measurements SET words = 'text' WHERE id = 2",
        "measurement 11 of sensor left has CRC-32",
    ),
    "air": (
        "UPDATE measurements SET temperature_c = 7 WHERE id = 2",
        "the record of measurement 11 of sensor left has",
    ),
}


@pytest.mark.parametrize("name", DAMAGED)
def test_damaged_measurement_leaves_others_readable(tmp_path, name):
    statement, message = DAMAGED[name]
    create(tmp_path).close()
    spoil(tmp_path / "rec.h5.journal", statement)
    with Journal.open(tmp_path / "rec.h5.journal") as journal:
        keys = journal.index()
        with pytest.raises(DamagedError, match=message):
            journal.entry(keys[1])
        wanted = entries()
        assert same(journal.entry(keys[0]), wanted[0])
        assert same(journal.entry(keys[2]), wanted[2])


UNREADABLE = {
    "header": ("DELETE FROM journal", "it has no header; copy it again if you can"),
    "target": ("UPDATE journal SET target = x'00'", "the record of the journal has CRC-32"),
    "settings": ("UPDATE sensors SET settings = ''", "the record of a sensor has CRC-32"),
    "sensor": ("DELETE FROM sensors", "it has no sensor 1; copy it again if you can"),
    "row": (
        "UPDATE measurements SET id = 9 WHERE id = 3",
        "it lists 3 measurements and has 9; copy it again if you can",
    ),
    "row in the middle": (
        "DELETE FROM measurements WHERE id = 2",
        "it lists 2 measurements and has 3; copy it again if you can",
    ),
    "gap": ("UPDATE gaps SET reason = 'y'", "the record of a gap has CRC-32"),
}


@pytest.mark.parametrize("name", UNREADABLE)
def test_damaged_journal_is_refused(tmp_path, name):
    statement, message = UNREADABLE[name]
    with create(tmp_path) as journal:
        journal.note_gap("left", 1, 1, "x", session_id=7)
    spoil(tmp_path / "rec.h5.journal", statement)
    with pytest.raises(DamagedError, match=message), Journal.open(tmp_path / "rec.h5.journal") as journal:
        _ = journal.gaps


@pytest.mark.parametrize("count", [1, 3])
def test_deleting_the_first_measurements_is_permitted(tmp_path, count):
    create(tmp_path).close()
    spoil(tmp_path / "rec.h5.journal", f"DELETE FROM measurements WHERE id <= {count}")
    with Journal.open(tmp_path / "rec.h5.journal") as journal:
        journal.append(entries(1, first=13))
        assert [entry.measurement.stamp.sequence for entry in journal.entries()] == [10, 11, 12, 13][count:]
        assert len(journal) == 4 - count


def root_page(path, tree):
    """Number of the first page of a table or an index."""
    reported = python(
        "import sqlite3, sys\n"
        "connection = sqlite3.connect(sys.argv[1])\n"
        "print(*connection.execute('SELECT rootpage FROM sqlite_schema WHERE name = ?', sys.argv[2:]).fetchone())",
        path,
        tree,
    )
    return int(reported.stdout)


@pytest.mark.parametrize("discarded", [0, 3])
@pytest.mark.parametrize("tree", ["key", "measurements"])
def test_rows_missing_from_one_index_are_detected(tmp_path, tree, discarded):
    """SQLite accepts a page with a smaller number of cells."""
    settings = line(8, 8).replace(recording=Recording(n_samples=64))
    with create(tmp_path, entries(20 + discarded, settings=settings), settings=settings) as journal:
        if discarded:
            journal.discard("left", EPOCH, 9 + discarded)
    path = tmp_path / "rec.h5.journal"
    root = root_page(path, tree)
    damaged = bytearray(path.read_bytes())
    page = (root - 1) * PAGE_BYTES
    damaged[page + 3 : page + 5] = (19).to_bytes(2, "big")
    path.write_bytes(damaged)
    with pytest.raises(DamagedError, match="is damaged: it lists"):
        Journal.open(path)


@pytest.mark.parametrize("discarded", [0, 1])
def test_unreadable_page_is_damage_and_the_rest_is_sealed(tmp_path, discarded):
    """Its content is lost permanently; the rest is sealed."""
    with create(tmp_path, entries(20 + discarded, first=10 - discarded)) as journal:
        if discarded:
            journal.discard("left", EPOCH, 9)
    path = tmp_path / "rec.h5.journal"
    damaged = bytearray(path.read_bytes())
    root = memoryview(damaged)[(root_page(path, "measurements") - 1) * PAGE_BYTES :]
    second = int.from_bytes(root[14:16], "big")  # of the cells, after a header of 12 bytes and the place of the first
    leaf = int.from_bytes(root[second : second + 4], "big")
    damaged[(leaf - 1) * PAGE_BYTES] = 0  # no kind of page
    root.release()
    path.write_bytes(damaged)
    with Journal.open(path) as journal:
        keys = journal.index()
        with pytest.raises(DamagedError, match=r"rec.h5.journal is damaged \(database disk image is malformed\); copy"):
            journal.entry(keys[10])
    sealed = seal(path)
    assert 3 < sealed.damaged == sealed.missing < 10
    assert sealed.measurements == 20 - sealed.damaged


def test_row_checksum_follows_the_documentation(tmp_path):
    """The row is built by hand as docs/reference/formats.md says."""
    create(tmp_path, entries(1)).close()
    reported = python(
        "import sqlite3, sys\n"
        "(row,) = sqlite3.connect(sys.argv[1]).execute('SELECT epoch, sequence, row_crc32 FROM measurements')\n"
        "(header,) = sqlite3.connect(sys.argv[1]).execute('SELECT created, row_crc32 FROM journal')\n"
        "print(*row, *header)",
        tmp_path / "rec.h5.journal",
    ).stdout.split()
    assert (reported[0], reported[1]) == ("5", "10")
    header = b"B\x06\0\0\0rec.h5" + b"T\x04\0\0\0test" + b"T\x14\0\0\0" + reported[3].encode()
    assert zlib.crc32(header) == int(reported[4])
    row = b"I\x03\0\0\0-12" + b"R\x08\0\0\0\0\0\0\0\0\0\xf8\xbf" + b"N\0\0\0\0" + b"T\x02\0\0\0\xc3\xa9"
    assert row_crc32((-12, -1.5, None, "é")) == zlib.crc32(row)
    page = path_of("formats").read_text("utf-8")
    example, check = re.search(r"`([0-9a-f ]{20,})` and the CRC-32 `([0-9a-f]{8})`", page).groups()
    assert row_crc32((7, "a")) == zlib.crc32(bytes.fromhex(example)) == int(check, 16)


def test_temporary_read_error_is_not_damage(tmp_path, monkeypatch):
    """A later attempt may succeed, so nothing is sealed and nothing is removed."""
    create(tmp_path).close()
    path = tmp_path / "rec.h5.journal"
    execute = Database.execute

    def fail(self, statement, values=()):
        if values != (2,):
            return execute(self, statement, values)
        error = sqlite3.OperationalError("disk I/O error")
        error.sqlite_errorcode = sqlite3.SQLITE_IOERR_READ
        with self._translate_errors():
            raise error

    with monkeypatch.context() as patch:
        patch.setattr(Database, "execute", fail)
        for act in (seal, verify):
            with pytest.raises(DataError, match=r"rec.h5.journal cannot be written or read \(disk I/O error\)"):
                act(path)
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5.journal"]
    assert seal(path).damaged == 0


def test_exchanged_measurement_is_detected(tmp_path):
    create(tmp_path).close()
    with Journal.open(tmp_path / "rec.h5.journal") as journal:
        key = journal.index()[1]
        for wrong in (key._replace(place=99), key._replace(sequence=12)):
            with pytest.raises(DataError, match=r"has lost the record of measurement 1\d of sensor left"):
                journal.entry(wrong)


def test_single_flipped_bit_is_always_detected(tmp_path):
    """For any bit, reading returns the original or raises a `DataError` of one line."""
    given = entries(4)
    create(tmp_path, given).close()
    path = tmp_path / "rec.h5.journal"
    whole = path.read_bytes()
    rng = np.random.default_rng(5)
    refusals = []
    used = np.flatnonzero(np.frombuffer(whole, np.uint8))  # most of the rest is not used
    for place in rng.choice(used, 250):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << rng.integers(0, 8)
        path.write_bytes(damaged)
        try:
            with Journal.open(path) as journal:
                assert (journal.target, journal.source) == (tmp_path / "rec.h5", "test")
                assert journal.sensors["left"].firmware == "1.2.3"
                assert all(same(*pair) for pair in zip(journal.entries(), given, strict=True))
        except DataError as error:
            refusals.append(str(error))
    assert len(refusals) > 100
    assert all(str(path) in refusal and "\n" not in refusal for refusal in refusals)


CUT = [("log", 0), ("log", 1), ("log", 4096), ("commit", 0), ("commit", 4096), ("commit", 3 * PAGE_BYTES)]


@pytest.mark.parametrize(("moment", "n_bytes"), CUT)
def test_truncated_journal_keeps_its_log(tmp_path, moment, n_bytes):
    """SQLite would delete the log, or fill the file with zeros."""
    path = crashed(tmp_path, moment=moment)
    log = path.with_name(f"{path.name}{'-wal' if moment == 'log' else '-journal'}")
    before = log.read_bytes()
    with path.open("r+b") as file:
        file.truncate(n_bytes)
    for use in (Journal.open, seal):
        with pytest.raises(DamagedError, match=r"bytes, but its log .* needs at least \d+: it was truncated"):
            use(path)
    assert (path.stat().st_size, log.read_bytes()) == (n_bytes, before)


def test_copy_without_its_log_is_intact_or_damaged(tmp_path):
    """Data of a commit during the copy are original or damaged, and nothing is invented."""
    path = crashed(tmp_path, moment="commit")
    path.with_name(f"{path.name}-journal").unlink()
    n_damaged = 0
    with Journal.open(path) as journal:
        keys = journal.index()
        for key in keys:
            try:
                assert same(journal.entry(key), entries()[key.place - 1])
            except DamagedError:
                n_damaged += 1
    assert 0 < n_damaged <= len(keys)
    (tmp_path / "b").mkdir()
    path = crashed(tmp_path / "b", moment="between")
    path.with_name(f"{path.name}-journal").unlink()
    with Journal.open(path) as journal:
        assert all(same(*pair) for pair in zip(journal.entries(), entries(), strict=True))


def test_removed_journal_refuses_measurements(tmp_path):
    with create(tmp_path, entries(2)) as journal:
        journal.path.unlink()
        with pytest.raises(
            JournalInUseError, match="was removed or replaced by another process; check the folder again"
        ):
            journal.append(entries(1, first=20))


def test_unusable_settings_of_a_journal_are_reported(tmp_path):
    """A newer version that did not raise its version number could write them."""
    create(tmp_path).close()
    row = ("left", "[air]\nwind_m_s = 3.0\n", "", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # its mounting is unknown
    spoil(
        tmp_path / "rec.h5.journal",
        f"UPDATE sensors SET settings = '{row[1]}', firmware = '', row_crc32 = {row_crc32(row)}",
    )
    with Journal.open(tmp_path / "rec.h5.journal") as journal:
        assert not journal.sensors
        reason, count = journal.unusable["left"]
    assert "rec.h5.journal: settings of sensor left, air: unknown key `wind_m_s`" in reason
    assert count == 3


FOREIGN = {
    "nothing": (None, "No such file or directory; choose a journal left by 'ertis capture'"),
    "text": (b"abc" * 1000, "is not a journal .*; choose a file that 'ertis capture' left"),
    "empty file of another name": (b"", "choose a journal left by 'ertis capture'"),
}


@pytest.mark.parametrize("name", FOREIGN)
def test_other_files_are_refused_as_journals(tmp_path, name):
    content, message = FOREIGN[name]
    path = tmp_path / "rec.db"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DataError, match=message):
        Journal.open(path)
    assert content is None or path.read_bytes() == content


def test_foreign_database_is_not_changed(tmp_path):
    path = tmp_path / "their.journal"
    spoil(path, "CREATE TABLE x (y)")
    before = path.read_bytes()
    with pytest.raises(
        DataError, match="is an SQLite file, but not a journal; choose a journal left by 'ertis capture'"
    ):
        Journal.open(path)
    assert path.read_bytes() == before


@pytest.mark.parametrize("again", [True, False])
def test_journal_sealed_meanwhile_by_another_process(tmp_path, monkeypatch, again):
    create(tmp_path).close()
    path = tmp_path / "rec.h5.journal"
    execute = Database.execute

    def too_late(self, statement, values=()):
        if statement == "BEGIN EXCLUSIVE":
            path.unlink()
            if again:
                (tmp_path / "new").touch()  # made while the old one is open: it is another file for sure
                (tmp_path / "new").rename(path)
        return execute(self, statement, values)

    monkeypatch.setattr(Database, "execute", too_late)
    with pytest.raises(JournalInUseError, match="was removed or replaced by another process; check the folder again"):
        Journal.open(path)
    assert path.exists() == again


def test_newer_journal_version_is_refused(tmp_path):
    create(tmp_path).close()
    spoil(tmp_path / "rec.h5.journal", "PRAGMA user_version = 5")
    with pytest.raises(FormatVersionError, match="has format version 5, but this package reads up to 4; update"):
        Journal.open(tmp_path / "rec.h5.journal")


def test_journal_in_an_unwritable_folder_is_refused(tmp_path):
    with pytest.raises(DataError, match="No such file or directory; choose a writable folder"):
        Journal.create(tmp_path / "none" / "rec.h5.journal", target="rec.h5")
