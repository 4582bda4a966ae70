"""A journal holds every acknowledged measurement bit by bit, however the process ends."""

import re
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.frames import Measurement, SequenceGap
from ertis_numba.journal import TABLES, VERSION, Journal
from ertis_numba.journal._database import LOG_BYTES, PAGE_BYTES
from ertis_numba.settings import Array, Recording, Settings
from tests.files import line
from tests.journals import EPOCH, TINY, both, create, entries, python, same
from tests.pages import path_of

COUNTS = Path("/proc/self/io")


def test_journal_preserves_measurements(tmp_path):
    given = both()
    with create(tmp_path, given) as journal:
        assert all(entry.crc32 is not None for entry in given)
    with Journal.open(journal.path) as journal:
        assert len(journal) == 5
        assert (journal.target, journal.source) == (tmp_path / "rec.h5", "test")
        assert list(journal.sensors) == ["left", "right"]
        assert all(same(*pair) for pair in zip(journal.entries(), given, strict=True))
        right = [given[1], given[4]]
        assert all(same(*pair) for pair in zip(journal.entries("right"), right, strict=True))
        assert [key[1:] for key in journal.index("right")] == [("right", EPOCH, 0), ("right", EPOCH, 1)]
        assert not next(journal.entries()).measurement.data.flags.writeable
    assert [path.name for path in tmp_path.iterdir()] == ["rec.h5.journal"]


@pytest.mark.parametrize("settings", [line(40, 8), line(4, 16), line(70, 64), TINY.replace(array=Array())])
def test_journal_stores_all_sample_types(tmp_path, settings):
    settings = settings.replace(recording=Recording(n_samples=2048))
    given = entries(2, settings=settings)
    with create(tmp_path, given, settings=settings) as journal:
        back = list(journal.entries())
    for came, wanted in zip(back, given, strict=True):
        assert came.measurement.data.dtype == wanted.measurement.data.dtype
        assert np.array_equal(came.measurement.data, wanted.measurement.data)


def test_journal_needs_no_layout_file(tmp_path):
    layout = tmp_path / "layout.csv"
    layout.write_text("y_mm, z_mm\n0, 0\n10, 0\n0, 10\n")
    settings = TINY.replace(array=Array(layout=str(layout)))
    with create(tmp_path, [], settings=settings) as journal:
        journal.add_sensor("left", settings, firmware="3.1.4", translation_m=(1, -2, 0.1), rotation_xyzw=(1, 0, 0, 0))
    layout.unlink()
    with Journal.open(journal.path) as journal:
        sensor = journal.sensors["left"]
    assert sensor.settings.array.positions_m[1][1] - sensor.settings.array.positions_m[0][1] == pytest.approx(0.01)
    assert (sensor.translation_m, sensor.rotation_xyzw) == ((1.0, -2.0, 0.1), (1.0, 0.0, 0.0, 0.0))
    assert sensor.firmware == "3.1.4"


def test_journal_stores_gaps(tmp_path):
    with create(tmp_path) as journal:
        journal.note_gap("left", 3, 3, "footer", session_id=EPOCH)
        journal.note_gap("left", 0, 2**63 - 1, "the sensor was unplugged", session_id=2**63 - 1)
    with Journal.open(journal.path) as journal:
        assert journal.gaps == (
            SequenceGap("left", 3, 3, "footer", EPOCH),
            SequenceGap("left", 0, 2**63 - 1, "the sensor was unplugged", 2**63 - 1),
        )


def test_journal_stores_negative_zero(tmp_path):
    """SQLite stores -0.0 as 0.0, so the CRC-32 of a row must not distinguish them."""
    with create(tmp_path, []) as journal:
        journal.add_sensor("left", TINY, translation_m=(-0.0, -1.0, 0.0))
    with Journal.open(journal.path) as journal:
        assert journal.sensors["left"].translation_m == (0.0, -1.0, 0.0)


def test_numbers_must_rise_within_a_session(tmp_path):
    given = entries(3)
    with create(tmp_path, given) as journal:
        for late in (given[2], given[0]):
            with pytest.raises(
                ArgumentError,
                match=r"measurement 1[02] of sensor left follows 12; pass increasing numbers, or another session_id",
            ):
                journal.append([late])
        journal.append(entries(1, first=0, session_id=9))
        journal.append(entries(1, first=13))
    with Journal.open(journal.path) as journal:
        with pytest.raises(ArgumentError, match="measurement 13 of sensor left follows 13"):
            journal.append(entries(1, first=13))
        assert [key.sequence for key in journal.index()] == [10, 11, 12, 0, 13]


def test_append_stores_all_or_nothing(tmp_path, monkeypatch):
    with create(tmp_path) as journal:
        with pytest.raises(ArgumentError, match="follows 21"):
            journal.append([*entries(2, first=20), *entries(1, first=5)])
        execute = journal._database.execute  # noqa: SLF001  nobody else can ask

        def fail_at_21(statement, values=()):
            if values and values[2:3] == (21,):
                raise DataError("the disk fails")
            return execute(statement, values)

        with monkeypatch.context() as patch:
            patch.setattr(journal._database, "execute", fail_at_21)  # noqa: SLF001  nobody else can ask
            with pytest.raises(DataError, match="the disk fails"):
                journal.append(entries(3, first=20))
        journal.append([])
        journal.append(entries(2, first=20))
        assert [key.sequence for key in journal.index()] == [10, 11, 12, 20, 21]
        assert len(journal) == 5


BAD = {
    "unknown sensor": (
        lambda journal: journal.append(entries(1, sensor="right")),
        "sensor 'right' is not in .*rec.h5.journal; add it first",
    ),
    "gap of it": (
        lambda journal: journal.note_gap("right", 1, 2, "x", session_id=1),
        "sensor 'right' is not in .*; add it first",
    ),
    "entries of it": (lambda journal: list(journal.entries("right")), "sensor 'right' is not in .*; add it first"),
    "gap backwards": (
        lambda journal: journal.note_gap("left", 2, 1, "x", session_id=1),
        "last missing sequence number is 1; use",
    ),
    "gap of no run": (
        lambda journal: journal.note_gap("left", 1, 2, "x", session_id=-1),
        "session_id is -1; use a whole number from 0",
    ),
    "no reason": (
        lambda journal: journal.note_gap("left", 1, 2, "", session_id=1),
        "reason of a gap is ''; use a line of 1 to 64",
    ),
    "two lines": (
        lambda journal: journal.note_gap("left", 1, 2, "a\nb", session_id=1),
        "reason of a gap is .*; use a line",
    ),
    "long reason": (
        lambda journal: journal.note_gap("left", 1, 2, "é" * 33, session_id=1),
        "reason of a gap is .*; use a line",
    ),
    "sensor twice": (
        lambda journal: journal.add_sensor("left", TINY),
        r"sensor 'left' is in .* already; use a different name for each sensor",
    ),
    "name": (lambda journal: journal.add_sensor("a/b", TINY), "sensor name 'a/b' cannot name a group in a file"),
    "mounting": (
        lambda journal: journal.add_sensor("b", TINY, rotation_xyzw=(0, 0, 1, 1)),
        "rotation_xyzw of sensor b has length 1.41421; use a unit quaternion",
    ),
    "directions": (
        lambda journal: journal.add_sensor("b", TINY.replace(processing=TINY.processing.replace(directions="x.csv"))),
        "processing.directions is the file x.csv, but a recording cannot contain",
    ),
    "size": (
        lambda journal: journal.add_sensor("b", Settings(recording=Recording(n_samples=2**28))),
        "a measurement of sensor b has 1074 MB, but the limit of a journal is 999 MB; use fewer samples",
    ),
    "settings": (
        lambda journal: journal.append(entries(1, settings=TINY.replace(recording=Recording(n_samples=4097)))),
        "a measurement has other recording settings than sensor left; add a sensor for it",
    ),
    "shape": (
        lambda journal: journal.append([spoilt(words=np.zeros(7, np.uint8))]),
        r"a measurement of sensor left has shape \(7,\); pass shape \(4096,\)",
    ),
    "type": (
        lambda journal: journal.append([spoilt(words=np.zeros(4096, np.int16))]),
        "a measurement of sensor left contains int16; pass uint8",
    ),
    "session_id": (
        lambda journal: journal.append([spoilt(session_id=2**63)]),
        "session_id is 9223372036854775808; use a whole number from 0",
    ),
    "stamp": (
        lambda journal: journal.append([spoilt(timestamp_uncertainty_ns=2**32)]),
        "timestamp_uncertainty_ns is 4294967296; use a whole number from 0",
    ),
}


def spoilt(words=None, **changes):
    """Measurement that does not match the others."""
    (entry,) = entries(1, first=99)
    measurement = entry.measurement
    stamp = replace(measurement.stamp, **changes)
    return replace(entry, measurement=Measurement(measurement.data if words is None else words, TINY, stamp))


@pytest.mark.parametrize("name", BAD)
def test_journal_refuses_unstorable_measurements(tmp_path, name):
    act, message = BAD[name]
    with create(tmp_path) as journal:
        with pytest.raises(ArgumentError, match=message):
            act(journal)
        assert (len(journal.index()), list(journal.sensors), journal.gaps) == (3, ["left"], ())


def test_sender_crc_is_stored_and_compared(tmp_path):
    (entry,) = entries(1)
    entry.crc32 = 0x1234
    with (
        create(tmp_path, [entry]) as journal,
        pytest.raises(
            DataError,
            match="measurement 10 of sensor left has CRC-32 69a8cc9f, but its record states 00001234",
        ),
    ):
        next(journal.entries())


def test_threads_share_a_journal(tmp_path):
    names = ["left", "right", "front"]
    with create(tmp_path, []) as journal:

        def work(name):
            journal.add_sensor(name, TINY)
            for entry in entries(8, sensor=name):
                journal.append([entry])
                journal.note_gap(name, 0, 1, "x", session_id=EPOCH)

        threads = [threading.Thread(target=work, args=(name,)) for name in names]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        for name in names:
            assert [key.sequence for key in journal.index(name)] == list(range(10, 18))


def test_commit_reaches_the_disk_and_the_log_stays_small(tmp_path):
    with create(tmp_path, entries(1)) as journal:
        wanted = {"synchronous": 2, "journal_mode": "wal", "locking_mode": "exclusive"}
        assert {name: journal._database.execute(f"PRAGMA {name}")[0][0] for name in wanted} == wanted  # noqa: SLF001  nobody else can ask
        journal.add_sensor("right", Settings())
        largest = 0
        for entry in entries(20, sensor="right", settings=Settings()):
            journal.append([entry])
            largest = max(largest, (tmp_path / "rec.h5.journal-wal").stat().st_size)
        assert LOG_BYTES / 2 < largest < LOG_BYTES + 1_000_000
        assert not (tmp_path / "rec.h5.journal-shm").exists()


def test_large_commits_bypass_the_log(tmp_path):
    log, begin = (tmp_path / f"rec.h5.journal{end}" for end in ("-wal", "-journal"))
    given = entries(24, settings=Settings())
    wanted = {"synchronous": 2, "journal_mode": "delete", "locking_mode": "exclusive"}
    with create(tmp_path, given[:2], settings=Settings()) as journal:
        assert log.exists()
        for number in (2, 10, 18):
            journal.append(given[number : number + 8])
            assert not log.exists()
            assert begin.read_bytes()[:28] == bytes(28)  # what SQLite takes for nothing to be rolled back
            assert begin.stat().st_size < 10 * PAGE_BYTES
        assert {name: journal._database.execute(f"PRAGMA {name}")[0][0] for name in wanted} == wanted  # noqa: SLF001  nobody else can ask
    assert [path.name for path in tmp_path.iterdir()] == ["rec.h5.journal"]
    with Journal.open(journal.path) as journal:
        assert all(same(*pair) for pair in zip(journal.entries(), given, strict=True))
        assert not log.exists()  # and it remains so


@pytest.mark.skipif(not COUNTS.exists(), reason="only Linux counts what a process writes")
def test_samples_are_written_once(tmp_path):
    given = entries(32, settings=Settings())
    words_bytes = sum(entry.measurement.data.nbytes for entry in given)
    with create(tmp_path, [], settings=Settings()) as journal:
        journal.add_sensor("left", Settings())
        before = written_bytes()
        for number in range(0, 32, 8):
            journal.append(given[number : number + 8])
        assert words_bytes < written_bytes() - before < 1.25 * words_bytes


def written_bytes():
    return int(re.search(r"wchar: (\d+)", COUNTS.read_text())[1])


@pytest.mark.parametrize("target", ["../b/other.h5", "/tmp/other.h5", "other.h5", "..", "", "a/../../other.h5"])
def test_recording_is_named_after_its_journal_file(tmp_path, target):
    with create(tmp_path, target=target) as journal:
        assert journal.target == tmp_path / "rec.h5"
    with Journal.open(journal.path) as journal:
        assert journal.target == tmp_path / "rec.h5"


@pytest.mark.parametrize("target", ["../b/other.h5", "/tmp/other.h5", "other.h5", "..", "", "a\\other.h5"])
def test_recording_of_a_renamed_journal_stays_in_its_folder(tmp_path, target):
    create(tmp_path, target=target).close()
    renamed = (tmp_path / "rec.h5.journal").rename(tmp_path / "renamed")
    with Journal.open(renamed) as journal:
        assert journal.target == tmp_path / ("other.h5" if "other" in target else "renamed.h5")


def test_existing_journal_is_never_overwritten(tmp_path):
    create(tmp_path).close()
    with pytest.raises(
        ArgumentError, match=r"rec.h5.journal exists from an interrupted capture; run 'ertis import journals"
    ):
        create(tmp_path)
    with Journal.open(tmp_path / "rec.h5.journal") as journal:
        assert len(journal) == 3


def test_closed_journal_refuses_operations(tmp_path):
    journal = create(tmp_path)
    journal.close()
    journal.close()
    with pytest.raises(DataError, match=r"rec.h5.journal is closed; open it again"):
        journal.append(entries(1, first=20))


def test_journal_loads_no_hdf5():
    done = python("import ertis_numba.journal, sys; print(*sys.modules)")
    assert not {"h5py", "scipy", "numba", "ertis_numba.storage"} & set(done.stdout.split())


def test_journal_tables_are_documented():
    page = path_of("formats").read_text("utf-8")
    page = page[page.index("## Journal") :]
    assert f"version {VERSION}" in page
    for table, columns in TABLES.items():
        reported = re.findall(rf"^\| `{table}` \| `(\w+)` \| (\w+) \|([^|]*)\|", page, re.MULTILINE)
        assert [(name, kind, units.strip()) for name, kind, units in reported] == [
            (column.name, column.kind, column.units) for column in columns
        ]
