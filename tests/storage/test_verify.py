"""All missing or damaged parts are found and reported."""

import json
import shutil
from dataclasses import replace

import h5py
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import DataError
from ertis_numba.journal import Journal
from ertis_numba.storage import RecordingWriter, open_recording, write_energyscapes, write_recording
from ertis_numba.storage._gaps import UNKNOWN
from ertis_numba.storage._rows import RowReader
from ertis_numba.storage.sealing import seal
from ertis_numba.storage.verify import verify
from tests.files import image
from tests.journal.test_journal_damage import spoil
from tests.journals import EPOCH, crashed, create, entries


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == code, (done.stdout, done.stderr, done.exception)
    return done


def measurements(*sequences, sensor="left"):
    """Measurements of one sensor with the given numbers, in this order."""
    made = {sequence: entries(1, sensor=sensor, first=sequence, seed=sequence)[0] for sequence in sequences}
    return [made[sequence].measurement for sequence in sequences]


@pytest.fixture
def recording(tmp_path):
    """Recording with its own gap and two noted ones."""
    with RecordingWriter(tmp_path / "rec.h5") as writer:
        for measurement in measurements(10, 11, 12, 14, 15, 18):
            writer.write(measurement)
        writer.note_gap("left", 13, 13, "footer", EPOCH)
        writer.note_gap("left", 19, 21, "the sensor was unplugged", EPOCH)
    return tmp_path / "rec.h5"


def flip(path, *rows, sensor="left"):
    """Flip a bit in some measurements of a recording."""
    with h5py.File(path, "r+") as file:
        for row in rows:
            file[f"sensors/{sensor}/pdm"][row, 5] ^= 1


def test_intact_recording_is_reported_as_intact(tmp_path):
    path = write_recording(tmp_path / "rec.h5", measurements(1, 2, 3))
    (report,) = verify(path)
    assert (report.sensor, report.measurements, report.is_intact) == ("left", 3, True)
    assert run("verify", path).stdout == f"{path}  left: 3 measurements, whole\n"
    assert run("verify", path, "--quiet").stdout == ""


def test_gaps_and_damaged_measurements_are_reported(recording):
    flip(recording, 0, 2, 3, 4)
    (report,) = verify(recording)
    assert [(gap.first, gap.last, gap.reason) for gap in report.gaps] == [
        (13, 13, "footer"),
        (16, 17, "not among the measurements given"),
        (19, 21, "the sensor was unplugged"),
    ]
    assert [(item.index, item.sequence) for item in report.damaged] == [(0, 10), (2, 12), (3, 14), (4, 15)]
    assert all("has CRC-32" in item.reason for item in report.damaged)
    done = run("verify", recording, code=3)
    assert done.stdout == (
        f"{recording}  left: 6 measurements, 6 missing (13: footer; 16 to 17: not among the measurements given; "
        "19 to 21: the sensor was unplugged), 4 damaged (at 0, 2 to 4)\n"
    )
    reported = json.loads(run("verify", recording, "--json", code=3).stdout)["files"][0]
    assert (reported["whole"], reported["sensors"][0]["missing"], len(reported["sensors"][0]["damaged"])) == (
        False,
        6,
        4,
    )


@pytest.fixture
def unnumbered(monkeypatch):
    """Write as a program that gives numbers in any order."""
    monkeypatch.setattr(RecordingWriter, "_numbered", False)


@pytest.mark.usefixtures("unnumbered")
def test_falling_numbers_are_reported(tmp_path):
    path = write_recording(tmp_path / "rec.h5", measurements(1, 2, 4, 3, 4))
    (report,) = verify(path)
    assert report.out_of_order == (3,)
    assert "1 out of order (at 3)" in run("verify", path, code=3).stdout


@pytest.mark.usefixtures("unnumbered")
def test_repeated_numbers_are_reported(tmp_path):
    write_recording(tmp_path / "rec.h5", measurements(1, 2, 2, 3))
    done = run("verify", tmp_path / "rec.h5", code=3)
    assert "whole" not in done.stdout


def test_numbers_may_restart_in_a_new_session(tmp_path):
    with create(tmp_path, entries(2, first=8, session_id=1)) as journal:
        journal.append(entries(2, first=0, session_id=2))
    assert verify(journal.path)[0].is_intact
    given = measurements(8, 9, 0, 1)
    given[2:] = [replace(m, stamp=replace(m.stamp, session_id=2**62)) for m in given[2:]]
    assert verify(write_recording(tmp_path / "rec.h5", given))[0].is_intact


def test_gaps_of_two_sessions_are_reported(tmp_path):
    """Each session has its own numbers, even if both use the same ones."""
    with create(tmp_path, [*entries(1, first=0, session_id=9), *entries(1, first=3, session_id=9)]) as journal:
        journal.append([*entries(2, first=0, session_id=4), *entries(1, first=3, session_id=4)])
        journal.note_gap("left", 2, 2, "footer", session_id=4)
        journal.note_gap("left", 2, 2, "it never arrived", session_id=9)
        journal.note_gap("left", 0, 1, "it was silent", session_id=3)
    spoil(journal.path, "UPDATE measurements SET words = x'00' WHERE id = 3")
    wanted = [
        (1, 1, UNKNOWN, 9),
        (2, 2, "it never arrived", 9),
        (0, 0, "damaged in the journal", 4),
        (2, 2, "footer", 4),
        (0, 1, "it was silent", 3),
    ]
    (report,) = verify(journal.path)
    assert [(gap.first, gap.last, gap.reason, gap.session_id) for gap in report.gaps] == wanted
    shutil.copy(journal.path, tmp_path / "kept")
    seal(journal.path)
    shutil.move(tmp_path / "kept", journal.path)
    before = (tmp_path / "rec.h5").stat().st_ino
    seal(journal.path)  # killed in between
    assert (tmp_path / "rec.h5").stat().st_ino == before
    (report,) = verify(tmp_path / "rec.h5")
    assert [(gap.first, gap.last, gap.reason, gap.session_id) for gap in report.gaps] == wanted
    assert (report.out_of_order, report.damaged) == ((), ())


def test_sealed_recording_of_two_sessions_is_intact(tmp_path):
    given = [*entries(2, first=8, session_id=2**63 - 1), *entries(3, first=0, session_id=1)]
    create(tmp_path, given).close()
    path = seal(tmp_path / "rec.h5.journal").recording
    assert verify(path)[0].is_intact
    with open_recording(path) as recording:
        assert recording.stamps() == [measurement.stamp for measurement in recording]
        assert recording.stamps() == [entry.measurement.stamp for entry in given]


def test_disk_error_is_not_reported_as_damage(tmp_path, monkeypatch):
    path = write_recording(tmp_path / "rec.h5", measurements(1, 2))

    def fail(*_):
        raise OSError("Can't read data (file read failed: time = now, errno = 5, error message = 'Input/output error')")

    monkeypatch.setattr(RowReader, "row", fail)
    with pytest.raises(DataError, match=r"rec.h5 cannot be read \(Input/output error\); check the disk"):
        verify(path)


def test_unreadable_sensor_leaves_the_other_verified(tmp_path):
    path = write_recording(tmp_path / "rec.h5", [*measurements(1, 2), *measurements(1, sensor="right")])
    with h5py.File(path, "r+") as file:
        file["sensors/right/sequence"][0] = 7
    left, right = verify(path)
    assert (left.is_intact, right.is_intact) == (True, False)
    assert "the content of sensor right has SHA-256" in right.fault
    assert "right: " in run("verify", path, code=3).stdout
    with h5py.File(path, "r+") as file:
        file["sensors/left/sequence"][0] = 7
    with pytest.raises(DataError, match="the content of sensor left has SHA-256"):
        verify(path)


def test_journals_are_verified(tmp_path):
    path = crashed(tmp_path, [*entries(2), *entries(1, sensor="right")])
    assert [report.is_intact for report in verify(path)] == [True, True]
    with Journal.open(path) as journal:
        journal.note_gap("left", 12, 13, "footer", session_id=EPOCH)
    spoil(path, "UPDATE measurements SET words = x'00' WHERE id <= 2")
    left, right = verify(path)
    assert right.is_intact
    assert [(item.index, item.sequence) for item in left.damaged] == [(0, 10), (1, 11)]
    assert [(gap.first, gap.last, gap.reason) for gap in left.gaps] == [
        (10, 11, "damaged in the journal"),
        (12, 13, "footer"),
    ]


def test_several_and_unreadable_files_are_reported(tmp_path, recording):
    images = write_energyscapes(tmp_path / "img.h5", [image()])
    with create(tmp_path, name="used.h5") as journal:
        done = run("verify", tmp_path / "none", images, journal.path, recording, code=1)
    assert "none: No such file or directory; choose a recording or a journal" in done.stderr
    assert "is an energyscape file, wanted a recording" in done.stderr
    assert "used.h5.journal is in use by another process" in done.stderr
    assert done.stdout.startswith(f"{recording}  left: 6 measurements")
    reported = json.loads(run("verify", images, recording, "--json", code=1).stdout)["files"]
    assert ["error" in file for file in reported] == [True, False]


def test_recording_without_a_sensor_is_refused(recording):
    with h5py.File(recording, "r+") as file:
        del file["sensors/left"]
    with pytest.raises(DataError, match=r"rec\.h5 contains no sensor; copy it again"):
        verify(recording)
