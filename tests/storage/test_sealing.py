"""Sealing of journals into recordings, also after kills and next to existing files."""

import itertools
import json
import shutil
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest

from ertis_numba.base import atomic_files
from ertis_numba.base.errors import ArgumentError, DataError, JournalInUseError
from ertis_numba.settings import Air
from ertis_numba.storage import RecordingWriter, open_recording, sensor_names, write_recording
from ertis_numba.storage._gaps import UNKNOWN, SequenceNumbers
from ertis_numba.storage.sealing import seal
from ertis_numba.storage.sealing_process import IN_USE, NO_MEASUREMENTS, main
from ertis_numba.storage.verify import verify
from tests.faults import kills
from tests.journal.test_journal_damage import spoil
from tests.journals import ENVIRONMENT, EPOCH, TINY, crashed, create, entries, python

TURNED = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))


def two_sensors(folder):
    """Write a journal with alternating measurements of two sensors, several gaps, and a third sensor without data."""
    left, right = entries(5), entries(2, sensor="right", first=0, seed=2)
    warm = TINY.replace(air=Air(temperature_c=31.5))
    left[1] = replace(left[1], measurement=replace(left[1].measurement, settings=warm))
    given = [left[0], right[0], left[1], right[1], left[4]]
    with create(folder, []) as journal:
        journal.add_sensor("left", TINY, firmware="1.2.3", translation_m=(1, -2, 0.5), rotation_xyzw=TURNED)
        journal.add_sensor("absent", TINY)
        journal.append(given[:1])
        journal.add_sensor("right", TINY)
        for entry in given[1:]:
            journal.append([entry])
        journal.note_gap("left", 12, 12, "footer", session_id=EPOCH)
        journal.note_gap("left", 7, 9, "the sensor was unplugged", session_id=EPOCH)
        journal.note_gap("right", 2, 5, "it never arrived", session_id=EPOCH)
        journal.note_gap("absent", 0, 5, "it never arrived", session_id=EPOCH)
    return journal.path, [entry.measurement for entry in given]


def test_journal_is_sealed_into_a_recording(tmp_path):
    path, given = two_sensors(tmp_path)
    sealed = seal(path)
    assert (sealed.recording, sealed.measurements, sealed.missing, sealed.damaged) == (tmp_path / "rec.h5", 5, 9, 0)
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]
    assert sensor_names(tmp_path / "rec.h5") == ("left", "right")
    with open_recording(tmp_path / "rec.h5", sensor="left") as left:
        assert [(gap.first, gap.last, gap.reason) for gap in left.gaps] == [
            (7, 9, "the sensor was unplugged"),
            (12, 12, "footer"),
            (13, 13, UNKNOWN),
        ]
        assert (left.firmware, left.translation_m.tolist()) == ("1.2.3", [1.0, -2.0, 0.5])
        assert left.rotation_xyzw.tolist() == list(TURNED)
        assert left.attributes["source"] == "test"
        assert left.attributes["history"] == (
            "sealed from rec.h5.journal; sensor absent has no measurement; 0 to 5: it never arrived"
        )
        back = list(left)
    with open_recording(tmp_path / "rec.h5", sensor="right") as right:
        assert [(gap.first, gap.last, gap.reason) for gap in right.gaps] == [(2, 5, "it never arrived")]
        back += list(right)
    for came, wanted in zip(back, [given[i] for i in (0, 2, 4, 1, 3)], strict=True):
        assert (came.stamp, came.settings.air) == (wanted.stamp, wanted.settings.air)
        assert np.array_equal(came.data, wanted.data)


def test_sealed_recording_equals_a_directly_written_one(tmp_path):
    given = [entry.measurement for entry in entries()]
    write_recording(tmp_path / "at_once.h5", given)
    seal(crashed(tmp_path))
    with open_recording(tmp_path / "at_once.h5") as one, open_recording(tmp_path / "rec.h5") as other:
        assert one.uuid == other.uuid


def test_sealed_recording_is_not_written_again(tmp_path):
    path, _ = two_sensors(tmp_path)
    shutil.copy(path, tmp_path / "kept")
    first = seal(path)
    before = (tmp_path / "rec.h5").stat()
    assert seal(path) == first  # As after a kill between removing the journal and returning.
    shutil.copy(tmp_path / "kept", path)
    (tmp_path / "rec.h5.sealing.part").touch()
    (tmp_path / "rec.h5.12345678.part").touch()  # A partial file of another process.
    assert seal(path) == first
    after = (tmp_path / "rec.h5").stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)
    assert sorted(item.name for item in tmp_path.iterdir()) == ["kept", "rec.h5", "rec.h5.12345678.part"]


def test_missing_journal_is_refused(tmp_path):
    seal(crashed(tmp_path))
    (tmp_path / "rec.h5").rename(tmp_path / "typo.h5")
    write_recording(tmp_path / "rec.h5", [entry.measurement for entry in entries()])
    (tmp_path / "text.h5").write_text("mine")
    for name in ("typo.h5", "rec.h5", "text.h5", "none.h5"):
        with pytest.raises(DataError, match=f"{name}.journal: No such file or directory; choose a journal"):
            seal(tmp_path / f"{name}.journal")


def write_with_gap(path, given, *, sensor="left", reason="footer"):
    """Write a recording with a gap after its last measurement."""
    with RecordingWriter(path) as writer:
        for measurement in given:
            writer.write(measurement)
        writer.note_gap(sensor, 20, 20, reason)


OTHERS = {
    "no recording": lambda path, _: path.write_bytes(b"mine"),
    "one less": lambda path, given: write_recording(path, given[:-1]),
    "one more": lambda path, given: write_recording(path, [*given, entries(9)[8].measurement]),
    "another sensor": lambda path, given: write_recording(path, [*given, entries(1, sensor="right")[0].measurement]),
    "other words": lambda path, given: write_recording(
        path, [*given[:-1], replace(given[-1], data=given[-1].data ^ 1)]
    ),
    "another time": lambda path, given: write_recording(
        path, [*given[:-1], replace(given[-1], stamp=replace(given[-1].stamp, timestamp_ns=7))]
    ),
    "another place": lambda path, given: write_recording(path, given, mounting={"left": ((1, 0, 0), (0, 0, 0, 1))}),
    "another gap": write_with_gap,
}


@pytest.mark.parametrize("name", OTHERS)
def test_file_with_other_content_is_not_replaced(tmp_path, name):
    with create(tmp_path, []) as journal:
        journal.add_sensor("left", TINY)
        journal.append(entries())
    OTHERS[name](tmp_path / "rec.h5", [entry.measurement for entry in entries()])
    before = (tmp_path / "rec.h5").read_bytes()
    with pytest.raises(DataError, match=r"rec.h5 exists with other content than .*rec.h5.journal; move it, or"):
        seal(journal.path)
    assert (tmp_path / "rec.h5").read_bytes() == before
    assert seal(journal.path, overwrite=True).measurements == 3
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]


@pytest.mark.parametrize("tables", [True, False])
def test_empty_journal_is_removed(tmp_path, tables, capsys):
    path = tmp_path / "rec.h5.journal"
    if tables:
        with create(tmp_path, []) as journal:
            journal.add_sensor("left", TINY)
    else:
        path.touch()
    assert main([str(path)]) == NO_MEASUREMENTS
    assert capsys.readouterr().err == f"{path}: no measurement was captured\n"
    assert not list(tmp_path.iterdir())


def test_damaged_measurement_becomes_a_gap_and_the_journal_is_kept(tmp_path, capsys):
    create(tmp_path).close()
    path = tmp_path / "rec.h5.journal"
    spoil(path, "UPDATE measurements SET words = zeroblob(4096) WHERE id = 2")
    shutil.copy(path, tmp_path / "kept")
    assert main([str(path)]) == 0
    reported = capsys.readouterr()
    assert reported.out == f"{tmp_path / 'rec.h5'}\n"
    assert reported.err == f"1 measurement is damaged; the journal is kept as {path}.damaged\n"
    with open_recording(tmp_path / "rec.h5") as recording:
        assert [stamp.sequence for stamp in recording.stamps()] == [10, 12]
        assert [(gap.first, gap.last, gap.reason) for gap in recording.gaps] == [(11, 11, "damaged in the journal")]
    shutil.move(tmp_path / "kept", path)
    assert seal(path).set_aside == tmp_path / "rec.h5.journal.2.damaged"  # As after a kill before that.


@pytest.mark.parametrize("column", ["sequence", "epoch"])
def test_measurement_with_a_damaged_number_does_not_prevent_sealing(tmp_path, column):
    create(tmp_path).close()
    path = tmp_path / "rec.h5.journal"
    spoil(path, f"UPDATE measurements SET {column} = -5 WHERE id = 3")
    assert not verify(path)[0].gaps
    sealed = seal(path)
    assert (sealed.measurements, sealed.damaged, sealed.missing) == (2, 1, 0)


def test_journal_of_damaged_measurements_is_kept(tmp_path):
    create(tmp_path, [*entries(2), *entries(1, sensor="right")]).close()
    path = tmp_path / "rec.h5.journal"
    spoil(path, "UPDATE measurements SET words = zeroblob(4096) WHERE sensor = 1")
    shutil.copy(path, tmp_path / "kept")
    for _ in range(2):  # The second pass finds the recording already written.
        sealed = seal(path)
        assert (sealed.measurements, sealed.damaged) == (1, 2)
        assert sensor_names(tmp_path / "rec.h5") == ("right",)
        shutil.copy(tmp_path / "kept", path)
    spoil(path, "UPDATE measurements SET words = zeroblob(4096)")
    (tmp_path / "rec.h5").unlink()
    with pytest.raises(DataError, match=r"rec.h5.journal: all 3 measurements are damaged; copy it again if you can"):
        seal(path)
    assert path.exists()
    assert not (tmp_path / "rec.h5").exists()


def test_journal_in_use_is_not_sealed(tmp_path, capsys):
    with create(tmp_path) as journal:
        with pytest.raises(JournalInUseError, match="is in use by another process"):
            seal(journal.path)
        assert main([str(journal.path), "--json"]) == IN_USE
        assert json.loads(capsys.readouterr().out)["in_use"] is True
        assert len(list(journal.entries())) == 3


def test_sealing_without_free_space_is_refused(tmp_path, monkeypatch, capsys):
    path = crashed(tmp_path)
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(atomic_files.shutil, "disk_usage", lambda _: usage._replace(free=5_000_000))
    assert main([str(path)]) == 1
    wanted = "has 5.0 MB free, but 8.0 MB are needed for the next data, including a reserve of 8 MB; free some space"
    assert wanted in capsys.readouterr().err
    monkeypatch.undo()
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5.journal"]
    assert seal(path).measurements == 3


def test_sealing_into_an_unwritable_folder_is_refused(tmp_path):
    create(tmp_path).close()
    (tmp_path / "rec.h5").mkdir()
    with pytest.raises(ArgumentError, match=r"output .*rec.h5 is a folder; choose"):
        seal(tmp_path / "rec.h5.journal")
    assert (tmp_path / "rec.h5.journal").exists()


@pytest.mark.parametrize("target", ["../victim.h5", "{}/victim.h5", "link.h5"])
def test_sealing_writes_nothing_outside_the_folder_of_the_journal(tmp_path, target):
    (tmp_path / "in").mkdir()
    (tmp_path / "victim.h5").write_text("precious")
    (tmp_path / "in" / "link.h5").symlink_to(tmp_path / "victim.h5")
    create(tmp_path / "in", target=target.format(tmp_path)).close()
    assert seal(tmp_path / "in" / "rec.h5.journal", overwrite=True).recording == tmp_path / "in" / "rec.h5"
    assert (tmp_path / "victim.h5").read_text() == "precious"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "victim.h5"]


@pytest.mark.parametrize("name", ["rec.h5", "rec.h5.sealing.part"])
def test_sealing_follows_no_link(tmp_path, name):
    (tmp_path / "in").mkdir()
    (tmp_path / "victim").write_text("precious")
    (tmp_path / "in" / name).symlink_to(tmp_path / "victim")
    create(tmp_path / "in").close()
    with suppress(ArgumentError):
        seal(tmp_path / "in" / "rec.h5.journal", overwrite=True)
    assert (tmp_path / "victim").read_text() == "precious"


@pytest.mark.parametrize("options", [(), ("--rests", "0.5")], ids=["at once", "in steps"])
def test_sealing_runs_in_its_own_process(tmp_path, options):
    path, _ = two_sensors(tmp_path)
    code = "import runpy; runpy.run_module('ertis_numba.storage.sealing_process', run_name='__main__')"
    done = python(code, path, "--json", *options)
    assert (done.returncode, done.stderr) == (0, "")
    *progress, result = map(json.loads, done.stdout.splitlines())
    assert progress == [{"done": number + 1, "of": 5} for number in range(5)]
    assert (result["recording"], result["measurements"], result["missing"]) == (str(tmp_path / "rec.h5"), 5, 9)
    assert python(code, path).stdout == f"{tmp_path / 'rec.h5'}\n"
    done = python(code, tmp_path / "none.journal")
    assert (done.returncode, done.stdout) == (1, "")
    assert (
        done.stderr
        == f"{tmp_path / 'none.journal'}: No such file or directory; choose a journal left by 'ertis capture'\n"
    )


def test_sealing_process_continues_without_its_parent(tmp_path):
    path = crashed(tmp_path)
    command = [sys.executable, "-m", "ertis_numba.storage.sealing_process", "--json", str(path)]
    with subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        process.stderr.close()
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5"]


def test_sealing_can_be_interrupted(tmp_path, monkeypatch):
    path = crashed(tmp_path)

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(RecordingWriter, "write", interrupt)
    assert main([str(path)]) == 130
    assert [item.name for item in tmp_path.iterdir()] == ["rec.h5.journal"]


def test_killed_sealing_processes_leave_no_broken_file(tmp_path):
    found = kills.sealing(tmp_path, seed=1, count=10)
    assert found["late"] < 5
    assert {name: found[name] for name in ("broken", "different", "left_over")} == {
        "broken": 0,
        "different": 0,
        "left_over": 0,
    }


def naive_gaps(numbers, noted):
    """Return gaps by checking every number in turn."""
    reasons = {}
    for first, last, reason in sorted(noted, key=lambda item: item[0]):
        for number in range(first, last + 1):
            reasons.setdefault(number, reason)
    for number in range(min(numbers), max(numbers)):
        reasons.setdefault(number, UNKNOWN)
    return {number: reason for number, reason in reasons.items() if number not in numbers}


def test_gaps_equal_a_naive_count():
    rng = np.random.default_rng(3)
    for _ in range(300):
        present = np.flatnonzero(rng.random(40) < rng.random()).tolist() or [7]
        noted = []
        for _ in range(rng.integers(0, 6)):
            first = int(rng.integers(0, 45))
            noted.append((first, first + int(rng.integers(0, 12)), str(rng.choice(["a", "b"]))))
        numbers = SequenceNumbers()
        for number in present:
            numbers.add(number)
        missing = numbers.missing(noted)
        reported = {number: reason for first, last, reason in missing for number in range(first, last + 1)}
        assert reported == naive_gaps(set(present), noted)
        assert sum(last - first + 1 for first, last, _ in missing) == len(reported)
        for before, after in itertools.pairwise(missing):
            assert before[1] < after[0]
            assert before[1] + 1 < after[0] or before[2] != after[2]  # Adjacent gaps of one reason are merged.


def test_gaps_are_counted_per_session():
    numbers = SequenceNumbers()
    for number in (5, 6, 0, 1, 4):
        numbers.add(number)
    assert numbers.missing([(6, 7, "footer")]) == [(2, 3, UNKNOWN), (6, 7, "footer")]


@pytest.mark.parametrize(
    ("sensor", "reason", "message"),
    [
        ("left", "x" * 65, "reason of a gap is .*; use a line of 1 to 64 bytes"),
        ("right", "x", "a gap is given for sensor 'right', which has no measurement"),
    ],
)
def test_unstorable_gaps_are_refused(tmp_path, sensor, reason, message):
    with pytest.raises(ArgumentError, match=message):
        write_with_gap(tmp_path / "rec.h5", [entries(1)[0].measurement], sensor=sensor, reason=reason)
    assert not list(tmp_path.iterdir())


def test_firmware_of_a_sensor_without_measurements_is_stored(tmp_path):
    with (
        pytest.raises(ArgumentError, match="firmware is given for sensor 'right', which has no measurement"),
        RecordingWriter(tmp_path / "rec.h5", firmware={"right": "1"}) as writer,
    ):
        writer.write(entries(1)[0].measurement)
