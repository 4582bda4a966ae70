"""Damaged logs of a journal: every lost measurement is reported."""

import shutil

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.journal import LOST, TALLY, Journal
from ertis_numba.journal._database import PAGE_BYTES
from ertis_numba.journal._log import read_log
from ertis_numba.settings import Recording
from ertis_numba.storage.sealing import seal
from ertis_numba.storage.verify import verify
from tests.journals import EPOCH, TINY, crashed, create, entries, same

FRAME_BYTES = PAGE_BYTES + 24
COUNT = 12
LARGE = TINY.replace(recording=Recording(n_samples=65_536))  # rows larger than a page, so each row has pages of its own


def log_of(path):
    return path.with_name(f"{path.name}-wal")


def tally_of(path):
    return path.with_name(f"{path.name}{TALLY}")


def flip(path, place):
    content = bytearray(path.read_bytes())
    content[place] ^= 1
    path.write_bytes(content)


def stored(path):
    with Journal.open(path) as journal:
        assert journal.source == "test"
        return [entry.measurement.stamp.sequence for entry in journal.entries()], journal.gaps


@pytest.mark.parametrize("counted", [True, False])
@pytest.mark.parametrize("place", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_flipped_bit_in_the_log_loses_one_measurement_at_most(tmp_path, place, counted):
    given = entries(COUNT)
    path = crashed(tmp_path, given)
    if not counted:  # a power cut leaves no tally
        tally_of(path).unlink()
    flip(log_of(path), int(place * log_of(path).stat().st_size))
    with Journal.open(path) as journal:
        numbers = {entry.measurement.stamp.sequence: entry for entry in journal.entries()}
        gaps = [(gap.first, gap.last, gap.reason) for gap in journal.gaps]
    lost = [number for number in range(10, 10 + COUNT) if number not in numbers]
    assert len(lost) <= 1
    assert gaps == [(number, number, LOST) for number in lost]
    assert all(same(came, given[number - 10]) for number, came in numbers.items())


@pytest.mark.parametrize("counted", [True, False])
def test_flipped_bit_in_samples_is_reported_by_recover_and_verify(tmp_path, counted):
    given = entries(COUNT, settings=LARGE)
    path = crashed(tmp_path, given, settings=LARGE)
    if not counted:
        tally_of(path).unlink()
    words = given[4].measurement.data.tobytes()
    flip(log_of(path), log_of(path).read_bytes().rindex(words[-64:]))
    done = CliRunner().invoke(cli, ["import", "journals", str(path)])
    assert done.exit_code == 3, done.stderr
    assert "11 measurements, 1 missing, up to 1 of them stored, then lost in the journal's damaged log" in done.stderr
    checked = CliRunner().invoke(cli, ["verify", str(tmp_path / "rec.h5")])
    assert checked.exit_code == 3
    assert f"left: 11 measurements, 1 missing (14: {LOST})" in checked.stdout
    assert sorted(item.name for item in tmp_path.iterdir()) == ["rec.h5", "rec.h5.journal-wal.damaged"]


@pytest.mark.parametrize(
    ("damaged", "code", "reported"),
    [
        ("checksum", 0, "4 measurements, 999987 missing"),  # all rows are rescued
        ("words", 3, "3 measurements, 1 missing, up to 1 of them stored, then lost"),
        ("end", 3, "3 measurements, 999988 missing, up to 999988 of them stored, then lost"),
    ],
)
def test_numbers_that_a_sensor_skips_are_not_reported_as_stored(tmp_path, damaged, code, reported):
    given = [*entries(3, settings=LARGE), *entries(1, first=1_000_000, settings=LARGE)]
    path = crashed(tmp_path, given, settings=LARGE)
    n_bytes = log_of(path).stat().st_size
    if damaged == "end":
        with log_of(path).open("r+b") as file:
            file.truncate(n_bytes - 100)
    elif damaged == "words":
        flip(log_of(path), log_of(path).read_bytes().rindex(given[-1].measurement.data.tobytes()[-64:]))
    else:
        flip(log_of(path), n_bytes - FRAME_BYTES + 20)
    done = CliRunner().invoke(cli, ["import", "journals", str(path)])
    assert done.exit_code == code
    ending = " in the journal's damaged log" if code else ""
    assert f"rec.h5: {reported}{ending}\n" in done.stderr


def test_copy_of_a_damaged_log_replaces_no_earlier_copy(tmp_path):
    earlier = tmp_path / "rec.h5.journal-wal.damaged"
    earlier.write_bytes(b"of another journal")
    copies = []
    for number in (1, 2):
        folder = tmp_path / str(number)
        folder.mkdir()
        path = crashed(folder, entries(COUNT, seed=number))
        flip(log_of(path), log_of(path).stat().st_size // 2)
        copies.append(log_of(path).read_bytes())
        for _ in range(2):  # a second copy of the same damage must not be kept
            for item in folder.iterdir():
                shutil.copy(item, tmp_path)
            Journal.open(tmp_path / path.name).close()
            for end in ("", "-wal", TALLY):
                (tmp_path / f"{path.name}{end}").unlink(missing_ok=True)
    kept = {item.name: item.read_bytes() for item in tmp_path.glob("*.damaged")}
    assert kept == {
        earlier.name: b"of another journal",
        "rec.h5.journal-wal.2.damaged": copies[0],
        "rec.h5.journal-wal.3.damaged": copies[1],
    }


def test_damaged_last_commit_is_detected_by_the_tally(tmp_path):
    """Without the tally, a damaged last commit looks like a torn one."""
    given = entries(COUNT, settings=LARGE)
    path = crashed(tmp_path, given, settings=LARGE)
    words = given[-1].measurement.data.tobytes()
    flip(log_of(path), log_of(path).read_bytes().rindex(words[-64:]))
    numbers, gaps = stored(path)
    assert numbers == list(range(10, 9 + COUNT))
    assert [(gap.sensor, gap.first, gap.last, gap.reason) for gap in gaps] == [("left", 9 + COUNT, 9 + COUNT, LOST)]


def test_log_damaged_in_its_first_transaction_keeps_the_source(tmp_path):
    path = crashed(tmp_path, entries(COUNT))
    flip(log_of(path), 32 + FRAME_BYTES - 3)
    assert read_log(path).n_read == 0
    numbers, gaps = stored(path)
    assert numbers == list(range(10, 10 + COUNT))
    assert gaps == ()


@pytest.mark.parametrize("cut", ["last", "half", "header", "all", "gone"])
def test_truncated_log_is_detected(tmp_path, cut):
    path = crashed(tmp_path, entries(COUNT))
    n_bytes = log_of(path).stat().st_size
    if cut == "gone":
        log_of(path).unlink()
    else:
        with log_of(path).open("r+b") as file:
            file.truncate({"last": n_bytes - 100, "half": n_bytes // 2, "header": 20, "all": 0}[cut])
    if cut in {"last", "half"}:
        numbers, gaps = stored(path)
        assert [(gap.sensor, gap.first, gap.last, gap.reason) for gap in gaps] == [
            ("left", 10 + len(numbers), 9 + COUNT, LOST)
        ]
        assert seal(path).lost == COUNT - len(numbers)
        assert not verify(tmp_path / "rec.h5")[0].is_intact
        return
    for _ in range(2):
        with pytest.raises(DataError, match=r"has lost all its measurements.*12 numbers of sensor left"):
            seal(path)
        with pytest.raises(DataError, match=r"has lost measurements.*12 numbers of sensor left"):
            verify(path)


def test_damaged_log_header_loses_nothing(tmp_path):
    for place in (0, 10, 17, 26):
        folder = tmp_path / str(place)
        folder.mkdir()
        path = crashed(folder, entries(COUNT))
        flip(log_of(path), place)
        assert stored(path) == (list(range(10, 10 + COUNT)), ())


def test_torn_end_of_a_log_is_not_damage(tmp_path):
    """After a power cut, the last transaction may be torn; it was neither synced nor acknowledged."""
    path = crashed(tmp_path, entries(COUNT))
    tally_of(path).unlink()
    flip(log_of(path), log_of(path).stat().st_size - FRAME_BYTES - 3000)
    assert read_log(path).n_lost_commits == 0
    numbers, gaps = stored(path)
    assert (numbers, gaps) == (list(range(10, 10 + COUNT - 1)), ())
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5.journal"]


def test_remains_of_two_torn_ends_are_not_damage(tmp_path):
    """Frames of an earlier torn transaction follow the end of the log and carry its salts."""
    path = crashed(tmp_path, entries(COUNT))
    tally_of(path).unlink()
    content = bytearray(log_of(path).read_bytes())
    end = 32 + (read_log(path).n_frames - 3) * FRAME_BYTES
    content[end + 4 : end + 8] = (9).to_bytes(4, "big")  # a torn commit of one frame overwrites one of three
    content[end + 16] ^= 1
    log_of(path).write_bytes(content)
    log = read_log(path)
    assert log.n_frames - 4 == log.n_read
    assert log.n_lost_commits == 0


def test_repair_changes_nothing_in_an_undamaged_log(tmp_path):
    path = crashed(tmp_path, entries(COUNT))
    log = read_log(path)
    assert (log.n_read, log.n_lost_commits) == (log.n_frames, 0)
    assert log.repaired == log.content[: len(log.repaired)]
    assert len(log.content) - len(log.repaired) < FRAME_BYTES


def test_tally_is_removed_with_the_log(tmp_path):
    with create(tmp_path) as journal:
        assert tally_of(journal.path).exists()
        journal.note_gap("left", 13, 20, "x", session_id=EPOCH)
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5.journal"]


@pytest.mark.parametrize("killed", [False, True])
def test_discarded_measurements_are_not_reported_missing(tmp_path, killed):
    (tmp_path / "running").mkdir()
    with create(tmp_path / "running", entries(COUNT)) as journal:
        journal.discard("left", EPOCH, 9 + COUNT)
        if killed:
            for item in (tmp_path / "running").iterdir():
                shutil.copy(item, tmp_path)
    if not killed:
        shutil.copy(journal.path, tmp_path)
    assert stored(tmp_path / "rec.h5.journal") == ([], ())


def test_tally_of_another_journal_is_ignored(tmp_path):
    (tmp_path / "other").mkdir()
    other = crashed(tmp_path / "other", entries(COUNT), target="other")
    create(tmp_path, entries(2)).close()
    shutil.copy(tally_of(other), tmp_path)
    assert stored(tmp_path / "rec.h5.journal") == ([10, 11], ())


def test_tally_of_another_journal_is_removed_on_append(tmp_path):
    (tmp_path / "other").mkdir()
    other = crashed(tmp_path / "other", entries(COUNT), target="other")
    create(tmp_path, entries(2)).close()
    shutil.copy(tally_of(other), tmp_path)
    (tmp_path / "killed").mkdir()
    with Journal.open(tmp_path / "rec.h5.journal") as journal:
        journal.append(entries(3)[2:])
        for item in tmp_path.glob("rec*"):
            shutil.copy(item, tmp_path / "killed")
    assert stored(tmp_path / "killed" / "rec.h5.journal") == ([10, 11, 12], ())


def test_damaged_tally_changes_nothing(tmp_path):
    path = crashed(tmp_path, entries(COUNT))
    whole = tally_of(path).read_bytes()
    rng = np.random.default_rng(3)
    for number in range(20):
        folder = tmp_path / str(number)
        folder.mkdir()
        for item in tmp_path.glob("rec*"):
            shutil.copy(item, folder)
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] ^= 1 << int(rng.integers(8))
        tally_of(folder / path.name).write_bytes(damaged)
        assert stored(folder / path.name) == (list(range(10, 10 + COUNT)), ())


@pytest.mark.parametrize("place", [0.1, 0.3, 0.5, 0.7, 0.9, 0.99])
def test_flipped_bit_in_a_checkpointed_log_loses_nothing(tmp_path, place):
    """SQLite would overwrite new pages of the main file with the old pages before the damage."""
    killed = tmp_path / "killed"
    killed.mkdir()
    with create(tmp_path, entries(COUNT, settings=LARGE), settings=LARGE) as journal:
        vars(journal)["_database"].execute("PRAGMA wal_checkpoint(FULL)")
        for item in tmp_path.glob("rec*"):
            shutil.copy(item, killed)
    path = killed / "rec.h5.journal"
    flip(log_of(path), int(place * log_of(path).stat().st_size))
    verify(path)
    (report,) = verify(path)  # the first verification must not change the journal
    assert report.measurements + sum(gap.last - gap.first + 1 for gap in report.gaps) >= COUNT
    assert report.measurements - len(report.damaged) >= COUNT - 1


@pytest.mark.parametrize("place", [0.2, 0.4, 0.6])
def test_damaged_log_keeps_later_pages_of_the_main_file(tmp_path, place):
    """The log begins after a checkpoint, so its first part lacks the pages that only later commits change.

    Ten rows fill one page and begin the next. The last rows begin a third page, which changes the root page.
    """
    given = entries(18)
    killed = tmp_path / "killed"
    killed.mkdir()
    with create(tmp_path, given[:10]) as journal:
        journal.free_log()
        for entry in given[10:]:
            journal.append([entry])
        vars(journal)["_database"].execute("PRAGMA wal_checkpoint(FULL)")
        for item in tmp_path.glob("rec*"):
            shutil.copy(item, killed)
    path = killed / "rec.h5.journal"
    flip(log_of(path), int(place * log_of(path).stat().st_size))
    with Journal.open(path) as journal:
        assert len(journal) == len(given)
    (report,) = verify(path)
    assert report.measurements == len(given)
    assert len(report.damaged) <= 1


def test_log_without_its_journal_is_set_aside(tmp_path):
    path = crashed(tmp_path, entries(COUNT))
    log = log_of(path).read_bytes()
    path.unlink()
    for number in (1, 2):
        with create(tmp_path, entries(2)) as journal:
            kept = f"rec.h5.journal-wal.{number}.orphaned"
            assert journal.remark == f"rec.h5.journal-wal had no journal and is kept as {kept}"
        assert (tmp_path / kept).read_bytes() == log
        assert stored(path) == ([10, 11], ())
        path.unlink()
        log_of(path).write_bytes(log)


def test_journal_that_exists_keeps_its_log(tmp_path):
    path = crashed(tmp_path, entries(COUNT))
    with pytest.raises(ArgumentError, match="exists from an interrupted capture"):
        create(tmp_path)
    assert stored(path)[0] == list(range(10, 10 + COUNT))
