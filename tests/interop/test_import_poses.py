"""``ertis import poses``, and poses in ``ertis info`` and ``ertis export``."""

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.storage import open_recording, write_energyscapes, write_recording
from tests.files import SMALL, image, noise
from tests.pages import page, run_code_here
from tests.storage.test_storage_poses import SECOND_NS, TIMES_NS, drive, sensors


def run(*arguments, code=0):
    done = CliRunner().invoke(cli, [str(each) for each in arguments])
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


def write_text(path, trajectory, *, offset_s=0):
    """Write a trajectory as text, independently of the package."""
    lines = ["# timestamp tx ty tz qx qy qz qw\n"]
    for time_ns, position_m, rotation in zip(
        trajectory.time_ns, trajectory.position_m, trajectory.rotation_xyzw, strict=True
    ):
        whole, rest = divmod(int(time_ns) + offset_s * SECOND_NS, SECOND_NS)
        numbers = " ".join(f"{number:.12f}" for number in (*position_m, *rotation))
        lines.append(f"{whole}.{rest:09d} {numbers}\n")
    path.write_text("".join(lines))
    return path


@pytest.fixture
def recording(tmp_path):
    return write_recording(tmp_path / "REC.h5", sensors("left", "right", delay_ns=10_000_000))


@pytest.fixture
def trajectory(tmp_path):
    return write_text(tmp_path / "TRAJ.tum", drive())


def test_import_poses_interpolates_the_trajectory_for_all_sensors(recording, trajectory, tmp_path):
    before = recording.read_bytes()
    done = run("import", "poses", recording, trajectory, "-o", tmp_path / "OUT.h5", "--json")
    assert recording.read_bytes() == before
    wanted = drive().at(sorted([*TIMES_NS, *(time_ns + 10_000_000 for time_ns in TIMES_NS)]))
    reported = json.loads(done.stdout)
    assert reported["poses"] == 6
    assert reported["path_length_m"] == pytest.approx(wanted.length_m, abs=1e-6)
    assert done.stderr == f"{tmp_path / 'OUT.h5'}: 6 poses, {wanted.length_m:.2f} m\n"
    for place, name in enumerate(("left", "right")):
        with open_recording(tmp_path / "OUT.h5", sensor=name) as posed:
            np.testing.assert_allclose(posed.trajectory.position_m, wanted.position_m[place::2], rtol=0, atol=1e-9)
            np.testing.assert_allclose(
                posed.trajectory.rotation_xyzw, wanted.rotation_xyzw[place::2], rtol=0, atol=1e-9
            )


def test_import_poses_replaces_the_recording_by_default(recording, trajectory):
    run("import", "poses", recording, trajectory, "--quiet")
    with open_recording(recording, sensor="left") as posed:
        assert len(posed.trajectory) == 3
    done = run("import", "poses", recording, trajectory, code=1)
    assert "REC.h5 has poses already (source 'file'); keep them, or replace them (--force)" in done.stderr
    run("import", "poses", recording, trajectory, "--force")
    assert sorted(path.name for path in recording.parent.iterdir()) == ["REC.h5", "TRAJ.tum"]


def test_import_poses_shifts_the_clock_of_the_trajectory(recording, trajectory, tmp_path):
    shifted = write_text(tmp_path / "late.tum", drive(), offset_s=100)
    run("import", "poses", recording, trajectory, "-o", tmp_path / "a.h5")
    run("import", "poses", recording, shifted, "-o", tmp_path / "b.h5", "--offset-s", "-100")
    with open_recording(tmp_path / "a.h5", sensor="left") as a, open_recording(tmp_path / "b.h5", sensor="left") as b:
        assert np.array_equal(a.trajectory.position_m, b.trajectory.position_m)


@pytest.mark.parametrize(("offset_s", "remedy"), [("nan", "use a finite number"), ("1e30", "use a number from -4e")])
def test_import_poses_refuses_offsets_of_no_clock(recording, trajectory, offset_s, remedy):
    done = run("import", "poses", recording, trajectory, "--offset-s", offset_s, code=2)
    assert done.stderr.startswith(f"ertis: error: --offset-s is {float(offset_s):g}; {remedy}")


def test_import_poses_reports_both_spans_and_changes_nothing(recording, tmp_path):
    before = recording.read_bytes()
    late = write_text(tmp_path / "late.tum", drive(), offset_s=100)
    done = run("import", "poses", recording, late, "-o", tmp_path / "OUT.h5", code=1)
    assert done.stderr == (
        f"ertis: error: {recording}: the poses cover 1700000099.123 to 1700000101.223 s, but the measurements of "
        "sensor left cover 1700000000.123 to 1700000000.223 s; use poses of this time, or correct the offset of "
        "their clock (--offset-s)\n"
    )
    assert recording.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["REC.h5", "late.tum"]


def test_import_poses_adds_to_all_recordings_of_a_folder_or_none(tmp_path, trajectory):
    folder = tmp_path / "RUNS"
    folder.mkdir()
    for name in ("a", "b"):
        write_recording(folder / f"{name}.h5", noise())
    write_energyscapes(folder / "c.energy.h5", [image()])
    before = {path: path.read_bytes() for path in folder.iterdir()}
    done = run("import", "poses", folder, trajectory, "-o", tmp_path / "POSED", "--json")
    outputs = [json.loads(line)["output"] for line in done.stdout.splitlines()]
    assert outputs == [str(tmp_path / "POSED" / f"{name}.h5") for name in ("a", "b")]
    done = run("import", "poses", folder, trajectory, "-o", tmp_path / "POSED", code=1)
    assert "exists; choose another name" in done.stderr
    assert {path: path.read_bytes() for path in folder.iterdir()} == before

    run("import", "poses", folder / "b.h5", trajectory)
    first = (folder / "a.h5").read_bytes()
    assert "b.h5 has poses already" in run("import", "poses", folder, trajectory, code=1).stderr
    assert (folder / "a.h5").read_bytes() == first
    run("import", "poses", folder, trajectory, "--force")
    with open_recording(folder / "a.h5") as posed:
        assert posed.trajectory is not None


def test_import_poses_states_poses_between_distant_ones(recording, tmp_path):
    """The middle of three measurements of each sensor lies beside a pose; the others lie in intervals above 1 s."""
    near = drive().at([TIMES_NS[0] - SECOND_NS, TIMES_NS[1], TIMES_NS[-1] + SECOND_NS])
    done = run("import", "poses", recording, write_text(tmp_path / "few.tum", near), "-o", tmp_path / "OUT.h5")
    assert f"note: 5 of 6 poses interpolated between poses of {tmp_path / 'few.tum'} more than a second" in done.stderr
    done = run("import", "poses", recording, write_text(tmp_path / "all.tum", drive()), "-o", tmp_path / "ALL.h5")
    assert "note" not in done.stderr


def test_import_poses_reads_tables_and_refuses_other_topics(recording, tmp_path):
    table = tmp_path / "TRAJ.csv"
    first_ns, last_ns = TIMES_NS[0] - SECOND_NS, TIMES_NS[-1] + SECOND_NS
    table.write_text(f"time_ns,x_m,y_m,yaw_deg\n{first_ns},0,0,0\n{last_ns},2.1,0,0\n")
    done = run("import", "poses", recording, table, "--topic", "/odom", code=1)
    assert "is not an .mcap file and has no topics; remove the topic (--topic)" in done.stderr
    run("import", "poses", recording, table)
    with open_recording(recording, sensor="left") as posed:
        np.testing.assert_allclose(posed.trajectory.position_m[:, 0], [1.0, 1.05, 1.1], rtol=0, atol=1e-9)
    assert "none.tum does not exist" in run("import", "poses", recording, "none.tum", code=1).stderr


@pytest.mark.skipif(not Path("/sys/kernel").is_dir(), reason="only Linux has folders that root cannot write either")
def test_import_poses_reports_a_folder_without_write_permission_in_one_line(recording, trajectory, monkeypatch):
    monkeypatch.setattr("ertis_numba.storage.poses.require_free_space", lambda *_, **__: None)  # /sys has none
    done = run("import", "poses", recording, trajectory, "-o", "/sys/m.h5", code=1)
    assert done.stderr == (
        "ertis: error: /sys/m.h5 cannot be written (Permission denied); check the permissions of the file and its "
        "folder, or choose another\n"
    )


def test_import_poses_refuses_a_folder_without_recordings(tmp_path, trajectory):
    folder = tmp_path / "IMAGES"
    folder.mkdir()
    write_energyscapes(folder / "c.h5", [image()])
    done = run("import", "poses", folder, trajectory, code=1)
    assert "contains energyscape files only; choose a folder with recordings" in done.stderr


def test_export_writes_poses_that_read_back(recording, trajectory, tmp_path):
    run("import", "poses", recording, trajectory)
    done = run("export", recording, "-o", tmp_path / "OUT.tum", "--json")
    assert json.loads(done.stdout)["poses"] == 6
    assert "OUT.tum: 6 poses, " in done.stderr
    wanted = ertis.storage.recorded_trajectory(recording)
    found = ertis.read_trajectory(tmp_path / "OUT.tum")
    assert found.time_ns.tolist() == wanted.time_ns.tolist()
    np.testing.assert_allclose(found.position_m, wanted.position_m, rtol=0, atol=1e-8)
    run("export", recording, "--format", "tum", "--sensor", "left", "-o", tmp_path / "LEFT.txt")
    assert ertis.read_trajectory(tmp_path / "LEFT.txt").time_ns.tolist() == TIMES_NS
    assert "OUT.tum exists" in run("export", recording, "-o", tmp_path / "OUT.tum", code=1).stderr


def test_export_of_poses_refuses_what_it_cannot_write(recording, trajectory, tmp_path):
    done = run("export", recording, "-o", tmp_path / "OUT.tum", code=1)
    assert (
        f"{recording} has no poses; add them to its recording with 'ertis import poses RECORDING TRAJ.tum'"
        in done.stderr
    )
    run("import", "poses", recording, trajectory)
    done = run("export", recording, "-o", tmp_path / "OUT.tum", "--top", "3", code=2)
    assert "option --top is given, but format 'tum' does not have it; leave it out" in done.stderr
    write_energyscapes(tmp_path / "IMG.h5", [image()])
    done = run("export", tmp_path / "IMG.h5", "-o", tmp_path / "OUT.tum", code=1)
    assert "IMG.h5 has no poses; add them to its recording" in done.stderr
    assert not (tmp_path / "OUT.tum").exists()


def test_commands_and_code_of_the_page_run(tmp_path, monkeypatch):
    """The section of the page on motion; its recording has as many measurements as the code needs."""
    section = page("motion").split("## Store poses in recordings")[1].split("\n## ")[0]
    many = noise(SMALL, 21)
    (tmp_path / "RUNS").mkdir()
    write_recording(tmp_path / "RUNS" / "a.h5", many)
    write_recording(tmp_path / "REC.h5", many)
    write_text(tmp_path / "TRAJ.tum", drive(end_ns=many[-1].stamp.timestamp_ns + SECOND_NS))
    monkeypatch.chdir(tmp_path)
    (commands,) = re.findall(r"```sh\n(.*?)```", section, re.DOTALL)
    for command in commands.splitlines():
        done = CliRunner().invoke(cli, shlex.split(command, comments=True)[1:])
        assert done.exit_code == 0, (command, done.stderr, done.exception)
    (code,) = re.findall(r"```py\n(.*?)```", section, re.DOTALL)
    Path("POSED.h5").unlink()
    write_recording(tmp_path / "REC.h5", many, overwrite=True)
    assert run_code_here(tmp_path, code).endswith(" file\n")
    with open_recording("PART.h5") as part, open_recording("COPY.h5") as copy:
        assert part.trajectory.time_ns.tolist() == copy.trajectory.time_ns.tolist()[10:20]
