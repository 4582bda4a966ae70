"""Poses in a journal: damaged ones are reported wherever damaged measurements are."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.journal import Journal, JournalPose, PosesAround
from ertis_numba.journal._database import Database
from ertis_numba.journal._poses import pose_blocks, trajectory_through
from ertis_numba.storage.sealing import seal
from ertis_numba.storage.verify import verify as verified
from tests.journal.test_journal_damage import spoil
from tests.journals import create, entries


def poses_at(given, **changes):
    """Poses at the times of measurements."""
    fields = {"position_m": (1.0, 2.0, 3.0), "rotation_xyzw": (0.0, 0.0, 0.0, 1.0), "source": "odometry"} | changes
    times_ns = [entry.measurement.stamp.timestamp_ns for entry in given]
    return [JournalPose(sensors=("left",), timestamp_ns=time_ns, **fields) for time_ns in times_ns]


def journal_with_poses(folder, **changes):
    given = entries(4)
    with create(folder, given) as journal:
        journal.append_poses(poses_at(given, **changes))
    return journal.path, given


@pytest.mark.parametrize(
    ("statement", "reported", "left"),
    [
        ("UPDATE poses SET x_m = 7 WHERE id = 2", "1 pose is damaged", (0, 2, 3)),
        ("UPDATE poses SET source = x'00' WHERE id < 3", "2 poses are damaged", (2, 3)),
        ("UPDATE poses SET row_crc32 = 0", "4 poses are damaged", ()),
    ],
)
def test_damaged_poses_are_reported_and_the_journal_is_kept(tmp_path, statement, reported, left):
    path, given = journal_with_poses(tmp_path)
    spoil(path, statement)
    with Journal.open(path) as journal:
        assert journal.read_poses() == ([poses_at(given)[number] for number in left], 4 - len(left))
    sealed = seal(path)
    aside = tmp_path / "rec.h5.journal.damaged"
    assert (sealed.pose_damage, sealed.damaged, sealed.set_aside) == (reported, 0, aside)
    assert reported in sealed.remark
    assert aside.exists()
    with ertis.open_recording(tmp_path / "rec.h5") as recording:
        assert recording.attributes["history"] == f"sealed from rec.h5.journal; {reported}"
        assert len(recording) == 4
        assert (recording.trajectory is None) == (not left)


def test_poses_that_cannot_be_used_are_reported(tmp_path):
    path, _ = journal_with_poses(tmp_path, rotation_xyzw=(0.0, 0.0, 0.0, 2.0))
    sealed = seal(path)
    assert sealed.pose_damage.startswith("poses were left out: rotation_xyzw has length 2")
    assert sealed.set_aside == tmp_path / "rec.h5.journal.damaged"


def test_recover_reports_damaged_poses(tmp_path):
    path, _ = journal_with_poses(tmp_path)
    spoil(path, "UPDATE poses SET x_m = 7 WHERE id = 2")
    done = CliRunner().invoke(cli, ["import", "journals", str(path), "--json"])
    assert done.exit_code == 3
    assert f"4 measurements, 0 missing, 1 pose is damaged; the journal is kept as {path}.damaged" in done.stderr
    (report,) = json.loads(done.stdout)["journals"]
    assert report["pose_damage"] == "1 pose is damaged"


@pytest.mark.parametrize(("offset_s", "count"), [(0, 0), (2, 2), (1000, 4)])
def test_recover_counts_measurements_without_a_pose(tmp_path, offset_s, count):
    """The poses begin at the third measurement, or long after the last."""
    given = entries(4)
    times_ns = [entry.measurement.stamp.timestamp_ns for entry in given]
    step_ns = times_ns[1] - times_ns[0]
    poses = [replace(pose, timestamp_ns=pose.timestamp_ns + offset_s * step_ns) for pose in poses_at(given)]
    with create(tmp_path, given) as journal:
        journal.append_poses(poses)
    done = CliRunner().invoke(cli, ["import", "journals", str(journal.path), "--json"])
    assert done.exit_code == 0
    without = f", {count} without a pose" if count else ""
    assert done.stderr == f"{tmp_path / 'rec.h5'}: 4 measurements{without}, 0 missing\n"
    assert json.loads(done.stdout)["journals"][0]["without_pose"] == count


@pytest.mark.parametrize("count", [1, 2])
def test_verify_reports_damaged_poses(tmp_path, count):
    path, _ = journal_with_poses(tmp_path)
    assert all(report.is_intact for report in verified(path))
    spoil(path, f"UPDATE poses SET x_m = 7 WHERE id <= {count}")
    (report,) = verified(path)
    assert report.remark == ("1 pose is damaged" if count == 1 else "2 poses are damaged")
    assert not report.is_intact
    done = CliRunner().invoke(cli, ["verify", str(path)])
    assert done.exit_code == 3
    assert f"4 measurements, {report.remark}" in done.stdout


def test_verify_and_recovery_report_bytes_that_changed_in_a_pose(tmp_path):
    path, _ = journal_with_poses(tmp_path)
    with Journal.open(path) as journal:
        journal.free_log()
    content = bytearray(path.read_bytes())
    place = content.rindex(b"odometry")
    content[place] ^= 0x20
    path.write_bytes(content)
    assert [report.remark for report in verified(path)] == ["1 pose is damaged"]
    assert seal(path).pose_damage == "1 pose is damaged"


def test_verify_and_recovery_report_poses_that_were_cut_off(tmp_path):
    """The last page of the file holds the end of the table of poses."""
    given = entries(4)
    with create(tmp_path, given) as journal:
        journal.append_poses(poses_at(given) * 100)
        journal.free_log()
    content = journal.path.read_bytes()
    journal.path.write_bytes(content[:-4096] + bytes(4096))
    (report,) = verified(journal.path)
    assert "poses cannot be read" in report.remark or "poses are damaged" in report.remark
    sealed = seal(journal.path)
    assert sealed.measurements == 4
    assert sealed.pose_damage


@pytest.mark.parametrize("with_covariance", [True, False])
def test_poses_around_times_interpolate_as_all_poses_do(with_covariance):
    """Poses arrive in blocks, not always in order, with repeated times and a gap; some times are those of poses."""
    draws = np.random.default_rng(1)
    times_ns = np.concatenate([draws.integers(0, 3 * 10**9, 900), draws.integers(5 * 10**9, 7 * 10**9, 900)])
    rotations = draws.normal(size=(1800, 4))
    rotations /= np.linalg.norm(rotations, axis=1)[:, None]
    poses = [
        JournalPose(
            ("left",),
            int(time_ns),
            tuple(draws.normal(size=3)),
            tuple(rotation),
            (np.eye(6) * draws.uniform(1, 2)).tobytes() if with_covariance else b"",
            "odometry",
        )
        for time_ns, rotation in zip(times_ns, rotations, strict=True)
    ]
    poses += [replace(pose, position_m=(9.0, 9.0, 9.0)) for pose in poses[:5]]
    wanted_ns = np.sort(np.concatenate([draws.integers(-(10**8), 7 * 10**9, 40), times_ns[::400]]))
    around, everything = PosesAround(wanted_ns, max_gap_s=1.0), trajectory_through(poses, max_gap_s=1.0)
    for first in range(0, len(poses), 50):
        around.add(poses[first : first + 50])
    found = around.trajectory()
    assert len(found) < 2 * len(wanted_ns) + 3
    is_covered = everything.covers(wanted_ns)
    assert 0 < is_covered.sum() < len(wanted_ns)
    assert np.array_equal(found.covers(wanted_ns), is_covered)
    one, other = found.at(wanted_ns[is_covered]), everything.at(wanted_ns[is_covered])
    for name in ("position_m", "rotation_xyzw", "covariance", "source"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_poses_are_read_in_blocks(tmp_path):
    path, given = journal_with_poses(tmp_path)
    spoil(path, "UPDATE poses SET x_m = 7 WHERE id = 2")
    database = Database(path, empty=False)
    blocks = list(pose_blocks(database, path, n_max=3))
    database.close()
    assert [(len(poses), n_damaged) for poses, n_damaged in blocks] == [(2, 1), (1, 0)]
    assert [pose for poses, _ in blocks for pose in poses] == [poses_at(given)[number] for number in (0, 2, 3)]


def test_damaged_poses_of_a_damaged_log_are_reported(tmp_path):
    """The pose is in the damaged commit only, which a later commit of a measurement follows."""
    given = entries(4)
    (tmp_path / "running").mkdir()
    with create(tmp_path / "running", given[:3]) as journal:
        journal.append_poses(poses_at(given))
        journal.append(given[3:])
        for path in (tmp_path / "running").iterdir():
            shutil.copy(path, tmp_path)
    path = tmp_path / journal.path.name
    log = path.with_name(f"{path.name}-wal")
    content = bytearray(log.read_bytes())
    content[content.rindex(b"odometry")] ^= 1
    log.write_bytes(content)
    with Journal.open(path) as journal:
        assert journal.damage == "damaged poses: 1"
        assert (len(journal), len(journal.read_poses()[0])) == (4, 3)
    assert "also lost: damaged poses: 1" in seal(path).remark


def test_poses_after_a_damaged_commit_are_recovered_once(tmp_path):
    """The main file contains the first poses; the log contains the others after a damaged measurement."""
    given = entries(4)
    poses = poses_at(given)
    (tmp_path / "running").mkdir()
    with create(tmp_path / "running", given[:2]) as journal:
        journal.append_poses(poses[:2])
        journal.free_log()
        journal.append(given[2:3])
        journal.append_poses(poses[2:])
        journal.append(given[3:])
        for path in (tmp_path / "running").iterdir():
            shutil.copy(path, tmp_path)
    path = tmp_path / journal.path.name
    log = path.with_name(f"{path.name}-wal")
    content = log.read_bytes()
    words = given[2].measurement.data.tobytes()[:64]
    assert words in content
    log.write_bytes(content.replace(words, bytes(64)))
    with Journal.open(path) as journal:
        assert journal.read_poses() == (poses, 0)
        assert [entry.measurement.stamp.sequence for entry in journal.entries()] == [10, 11, 13]
