"""What is missing or damaged is found and told, all of it; what a crash has left is recovered."""

import json
from dataclasses import replace

import h5py
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.errors import DataError
from ertis_numba.journal import Journal
from ertis_numba.storage import RecordingWriter, write_energyscapes, write_recording
from ertis_numba.storage.verify import verify
from tests.files import image
from tests.journals import crashed, create, entries
from tests.test_journal_damage import spoil


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, [str(argument) for argument in arguments])
    assert done.exit_code == code, (done.stdout, done.stderr, done.exception)
    return done


def measurements(*sequences, sensor="left"):
    """Measurements of one sensor with these numbers, in this order."""
    made = {sequence: entries(1, sensor=sensor, first=sequence, seed=sequence)[0] for sequence in sequences}
    return [made[sequence].measurement for sequence in sequences]


@pytest.fixture
def recording(tmp_path):
    """A recording with a gap of its own and two that somebody noted."""
    with RecordingWriter(tmp_path / "rec.h5") as writer:
        for measurement in measurements(10, 11, 12, 14, 15, 18):
            writer.write(measurement)
        writer.note_gap("left", 13, 13, "footer")
        writer.note_gap("left", 19, 21, "the sensor was unplugged")
    return tmp_path / "rec.h5"


def flip(path, *rows, sensor="left"):
    """Change a bit in some measurements of a recording."""
    with h5py.File(path, "r+") as file:
        for row in rows:
            file[f"sensors/{sensor}/pdm"][row, 5] ^= 1


def test_whole(tmp_path):
    path = write_recording(tmp_path / "rec.h5", measurements(1, 2, 3))
    (report,) = verify(path)
    assert (report.sensor, report.measurements, report.whole) == ("left", 3, True)
    assert run("verify", path).stdout == f"{path}  left: 3 measurements, whole\n"
    assert run("verify", path, "--quiet").stdout == ""


def test_gaps_and_all_damaged_measurements_are_told(recording):
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
    told = json.loads(run("verify", recording, "--json", code=3).stdout)["files"][0]
    assert (told["whole"], told["sensors"][0]["missing"], len(told["sensors"][0]["damaged"])) == (False, 6, 4)


def test_disorder_is_told(tmp_path):
    path = write_recording(tmp_path / "rec.h5", measurements(1, 2, 4, 3, 4))
    (report,) = verify(path)
    assert report.disordered == (3,)
    assert "1 out of order (at 3)" in run("verify", path, code=3).stdout


def test_numbers_that_start_again(tmp_path):
    with create(tmp_path, entries(2, first=8, epoch=1)) as journal:
        journal.append(entries(2, first=0, epoch=2))
    assert verify(journal.path)[0].whole
    given = measurements(8, 9, 0, 1)
    given[2:] = [replace(m, stamp=replace(m.stamp, sync_count=m.stamp.sequence)) for m in given[2:]]
    assert verify(write_recording(tmp_path / "rec.h5", given))[0].whole


def test_one_sensor_of_two_cannot_be_read(tmp_path):
    path = write_recording(tmp_path / "rec.h5", [*measurements(1, 2), *measurements(1, sensor="right")])
    with h5py.File(path, "r+") as file:
        file["sensors/right/sequence"][0] = 7
    left, right = verify(path)
    assert (left.whole, right.whole) == (True, False)
    assert "the content of sensor right has SHA-256" in right.fault
    assert "right: " in run("verify", path, code=3).stdout
    with h5py.File(path, "r+") as file:
        file["sensors/left/sequence"][0] = 7
    with pytest.raises(DataError, match="the content of sensor left has SHA-256"):
        verify(path)


def test_journals(tmp_path):
    path = crashed(tmp_path, [*entries(2), *entries(1, sensor="right")])
    assert [report.whole for report in verify(path)] == [True, True]
    with Journal.open(path) as journal:
        journal.note_gap("left", 12, 13, "footer")
    spoil(path, "UPDATE measurements SET words = x'00' WHERE id <= 2")
    left, right = verify(path)
    assert right.whole
    assert [(item.index, item.sequence) for item in left.damaged] == [(0, 10), (1, 11)]
    assert [(gap.first, gap.last, gap.reason) for gap in left.gaps] == [
        (10, 11, "damaged in the journal"),
        (12, 13, "footer"),
    ]


def test_several_files_and_such_that_cannot_be_read(tmp_path, recording):
    images = write_energyscapes(tmp_path / "img.h5", [image()])
    with create(tmp_path, name="used.h5") as journal:
        done = run("verify", tmp_path / "none", images, journal.path, recording, code=1)
    assert "none: No such file or directory; give a recording or a journal" in done.stderr
    assert "is an energyscape file, wanted a recording" in done.stderr
    assert "used.h5.journal is in use by another process" in done.stderr
    assert done.stdout.startswith(f"{recording}  left: 6 measurements")
    told = json.loads(run("verify", images, recording, "--json", code=1).stdout)["files"]
    assert ["error" in file for file in told] == [True, False]


def test_a_recording_without_a_sensor(recording):
    with h5py.File(recording, "r+") as file:
        del file["sensors/left"]
    with pytest.raises(DataError, match=r"rec.h5 holds no sensor; copy it again"):
        verify(recording)


def test_recover_a_folder(tmp_path):
    (tmp_path / "sub").mkdir()
    crashed(tmp_path)
    crashed(tmp_path, entries(1), name="b.h5")
    (tmp_path / "c.h5.journal").touch()
    with create(tmp_path, name="used.h5"):
        done = run("recover", tmp_path)
    assert sorted(done.stderr.splitlines()) == [
        f"{tmp_path}/b.h5: 1 measurement, 0 missing",
        f"{tmp_path}/c.h5.journal: no measurement was captured; removed",
        f"{tmp_path}/rec.h5: 3 measurements, 0 missing",
        f"{tmp_path}/used.h5.journal: in use by a running capture; left alone",
    ]
    assert done.stdout == ""
    assert sorted(path.name for path in tmp_path.iterdir()) == ["b.h5", "rec.h5", "sub", "used.h5.journal"]
    assert verify(tmp_path / "rec.h5")[0].whole


def test_recover_what_cannot_be_sealed(tmp_path):
    path = crashed(tmp_path)
    (tmp_path / "rec.h5").write_text("mine")
    crashed(tmp_path, name="b.h5")
    done = run("recover", tmp_path, "--json", "--quiet", code=1)
    assert done.stderr == (
        f"ertis: error: {tmp_path}/rec.h5 exists and holds something else than {path}; move it, or give --force\n"
    )
    told = json.loads(done.stdout)["journals"]
    assert [(report.get("measurements"), "error" in report) for report in told] == [(3, False), (None, True)]
    assert run("recover", path, "--force", "--quiet").stderr == ""
    assert verify(tmp_path / "rec.h5")[0].whole


def test_recover_damaged_measurements(tmp_path):
    create(tmp_path).close()
    path = tmp_path / "rec.h5.journal"
    spoil(path, "UPDATE measurements SET words = x'00' WHERE id = 1")
    told = f"2 measurements, 1 missing, of which 1 damaged; the journal is kept as {path}.damaged"
    assert told in run("recover", path).stderr


def test_recover_nothing(tmp_path):
    assert run("recover", tmp_path).stderr == f"no journal in {tmp_path}\n"
    assert run("recover", tmp_path, "--quiet").stderr == ""
    assert json.loads(run("recover", tmp_path, "--json").stdout) == {"journals": []}
    assert "none.journal: No such file or directory" in run("recover", tmp_path / "none.journal", code=1).stderr


def test_recover_from_a_folder_with_a_module_in_it(tmp_path, monkeypatch):
    crashed(tmp_path)
    (tmp_path / "h5py.py").write_text("raise SystemExit('the wrong one')")
    monkeypatch.chdir(tmp_path)
    assert run("recover", ".").stderr == "rec.h5: 3 measurements, 0 missing\n"
