"""Poses of the platform in recordings: round trips, interpolation, errors, and files without poses."""

import json
from dataclasses import replace

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli
from scipy.spatial.transform import Rotation

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError, DamagedError, ForeignDataError
from ertis_numba.storage import (
    RecordingWriter,
    open_recording,
    platform_trajectory,
    recorded_trajectory,
    write_recording,
)
from ertis_numba.storage.schema import POSES, RECORDING, content_sha256
from ertis_numba.storage.verify import verify
from tests.files import SMALL, noise, open_dataset

TIMES_NS = [measurement.stamp.timestamp_ns for measurement in noise()]
SECOND_NS = 10**9


def drive(*, covariance=True, source="file", begin_ns=TIMES_NS[0] - SECOND_NS, end_ns=TIMES_NS[-1] + SECOND_NS):
    """A drive along a bend, with a pose every 70 ms."""
    time_ns = np.append(np.arange(begin_ns, end_ns, 70_000_000), end_ns)
    elapsed_s = (time_ns - begin_ns)[:, None] / SECOND_NS
    covariances = elapsed_s[:, :, None] * np.diag([1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6])
    return ertis.Trajectory(
        time_ns,
        elapsed_s * [0.5, 0.1, -0.01],
        Rotation.from_rotvec(elapsed_s * [0.1, 0.2, 0.7]).as_quat(),
        covariances if covariance else None,
        source,
    )


def restamped(measurement, **changes):
    return replace(measurement, stamp=replace(measurement.stamp, **changes))


def sensors(*names, delay_ns=0):
    """Measurements of several sensors, each sensor later than the one before."""
    return [
        restamped(each, sensor=name, timestamp_ns=each.stamp.timestamp_ns + place * delay_ns)
        for place, name in enumerate(names)
        for each in noise(SMALL)
    ]


def same_poses(first, second):
    assert np.array_equal(first.time_ns, second.time_ns)
    assert np.array_equal(first.position_m, second.position_m)
    assert np.array_equal(first.rotation_xyzw, second.rotation_xyzw)
    assert first.source == second.source
    if first.covariance is None or second.covariance is None:
        assert first.covariance is second.covariance
    else:
        assert np.array_equal(first.covariance, second.covariance)


@pytest.fixture
def plain(tmp_path):
    """A recording of two sensors without poses."""
    return write_recording(tmp_path / "plain.h5", sensors("left", "right", delay_ns=10_000_000), source="test")


@pytest.mark.parametrize("covariance", [True, False])
def test_written_poses_are_those_of_the_trajectory_at_the_measurements(tmp_path, covariance):
    given = drive(covariance=covariance)
    path = write_recording(tmp_path / "rec.h5", noise(), poses=given)
    with open_recording(path) as recording:
        found = recording.trajectory
    wanted = given.at(TIMES_NS)
    assert found.time_ns.tolist() == TIMES_NS
    assert found.source == "file"
    np.testing.assert_allclose(found.position_m, wanted.position_m, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.rotation_xyzw, wanted.rotation_xyzw, rtol=0, atol=1e-12)
    assert (found.covariance is not None) == covariance
    if covariance:
        np.testing.assert_allclose(found.covariance, wanted.covariance, rtol=1e-12, atol=0)


def test_poses_at_the_times_of_measurements_keep_their_bits(tmp_path):
    given = drive().at(TIMES_NS)
    with open_recording(write_recording(tmp_path / "rec.h5", noise(), poses=given)) as recording:
        same_poses(recording.trajectory, given)


def test_copy_of_a_recording_keeps_poses(tmp_path):
    first = write_recording(tmp_path / "rec.h5", noise(), poses=drive())
    with open_recording(first) as recording:
        copy = write_recording(tmp_path / "copy.h5", recording)
        part = write_recording(tmp_path / "part.h5", recording[1:], poses=recording.trajectory)
        with open_recording(copy) as copied, open_recording(part) as cut:
            same_poses(copied.trajectory, recording.trajectory)
            assert copied.uuid == recording.uuid
            same_poses(cut.trajectory, recording.trajectory.at(TIMES_NS[1:]))


def test_sensors_have_their_own_poses(tmp_path):
    poses = {"left": drive(source="left car"), "right": drive(covariance=False, source="right car")}
    path = write_recording(tmp_path / "rec.h5", sensors("left", "right", "third"), poses=poses)
    for name, given in poses.items():
        with open_recording(path, sensor=name) as recording:
            assert recording.trajectory.source == given.source
            assert (recording.trajectory.covariance is None) == (given.covariance is None)
    with open_recording(path, sensor="third") as recording:
        assert recording.trajectory is None
    with pytest.raises(ArgumentError, match="poses is given for sensor 'east', which has no measurement"):
        write_recording(tmp_path / "b.h5", noise(), poses={"east": drive()})


def test_measurements_out_of_order_and_at_equal_times_have_poses(tmp_path):
    measurements = noise()
    again = restamped(measurements[0], sequence=99)
    path = write_recording(tmp_path / "rec.h5", [*measurements[::-1], again], poses=drive())
    with open_recording(path) as recording, h5py.File(path) as file:
        assert recording.trajectory.time_ns.tolist() == TIMES_NS
        stored = file["sensors/eRTIS-7/pose_position"][:]
        assert np.array_equal(stored[[2, 1, 0]], recording.trajectory.position_m)
        assert np.array_equal(stored[2], stored[3])


def test_added_poses_change_nothing_else(plain, tmp_path):
    before = plain.read_bytes()
    path = ertis.add_poses(plain, drive(), output=tmp_path / "posed.h5")
    assert path == tmp_path / "posed.h5"
    assert plain.read_bytes() == before
    with h5py.File(plain) as old, h5py.File(path) as new:
        for name in old["sensors"]:
            for variable, dataset in old["sensors"][name].items():
                assert new["sensors"][name][variable][()].tobytes() == dataset[()].tobytes()
            added = {*new["sensors"][name]} - {*old["sensors"][name]}
            assert added == {*(variable.name for variable in POSES), "quaternion", "pose_row", "pose_column"}
        assert old.attrs["ertis_format_version"] == 3
        assert new.attrs["ertis_format_version"] == 4
        assert new.attrs["history"] == b"poses added (source 'file')"
        assert new.attrs["source"] == b"test"
    assert all(report.is_intact for report in verify(path))


def test_added_poses_equal_written_ones(plain, tmp_path):
    """The content, and thus the UUID, does not depend on the way in which poses came into a file."""
    written = write_recording(
        tmp_path / "written.h5", sensors("left", "right", delay_ns=10_000_000), source="test", poses=drive()
    )
    assert ertis.add_poses(plain, drive()) == plain
    for name in ("left", "right"):
        with open_recording(plain, sensor=name) as added, open_recording(written, sensor=name) as other:
            same_poses(added.trajectory, other.trajectory)
            assert added.uuid == other.uuid
    assert list(plain.parent.glob("*.part")) == []


@pytest.mark.parametrize("covariance", [True, False])
def test_poses_can_be_replaced(plain, tmp_path, covariance):
    ertis.add_poses(plain, drive(source="first"))
    with pytest.raises(ArgumentError, match=r"plain.h5 has poses already \(source 'first'\); keep them, or rep"):
        ertis.add_poses(plain, drive())
    ertis.add_poses(plain, drive(covariance=covariance, source="second"), replace=True)
    written = tmp_path / "written.h5"
    write_recording(
        written,
        sensors("left", "right", delay_ns=10_000_000),
        poses=drive(covariance=covariance, source="second"),
    )
    with open_recording(plain, sensor="left") as found, open_recording(written, sensor="left") as wanted:
        same_poses(found.trajectory, wanted.trajectory)
        assert found.uuid == wanted.uuid
    assert all(report.is_intact for report in verify(plain))


def test_xarray_opens_poses(tmp_path):
    path = write_recording(tmp_path / "rec.h5", noise(), poses=drive())
    with open_dataset(path, group="/sensors/eRTIS-7", engine="h5netcdf") as data:
        assert data["pose_position"].dims == ("time", "axis")
        assert data["pose_covariance"].dims == ("time", "pose_row", "pose_column")
        assert data["pose_position"].attrs["units"] == "m"


def test_files_without_poses_keep_their_version_and_checksum(tmp_path):
    path = write_recording(tmp_path / "rec.h5", noise())
    with h5py.File(path) as file, open_recording(path) as recording:
        group = file["sensors/eRTIS-7"]
        assert recording.trajectory is None
        assert file.attrs["ertis_format_version"] == 3
        assert {*group}.isdisjoint(variable.name for variable in POSES)
        assert group.attrs["content_sha256"].decode() == content_sha256(group, RECORDING)


def test_uncovered_measurements_are_refused_with_both_spans(plain):
    before = plain.read_bytes()
    late = drive(begin_ns=TIMES_NS[1])
    spans = r"the poses cover 1700000000\.173 to 1700000001\.223 s, but the measurements of sensor {} cover "
    with pytest.raises(ArgumentError, match=spans.format("left") + r"1700000000\.123 to 1700000000\.223 s; use poses"):
        ertis.add_poses(plain, late)
    assert plain.read_bytes() == before
    writer = RecordingWriter(plain.parent / "new.h5", poses=late)
    with pytest.raises(ArgumentError, match=spans.format("eRTIS-7") + r"1700000000\.123 to 1700000000\.123 s"), writer:
        writer.write(noise()[0])
    assert [path.name for path in plain.parent.iterdir()] == ["plain.h5"]


def test_measurements_without_times_cannot_have_poses(tmp_path):
    path = write_recording(tmp_path / "rec.h5", [restamped(noise()[0], timestamp_ns=0)])
    with pytest.raises(ArgumentError, match="the times of the measurements of sensor eRTIS-7 are unknown; poses need"):
        ertis.add_poses(path, drive())


def test_broken_link_in_the_place_of_an_axis_is_replaced(plain):
    with h5py.File(plain, "r+") as file:
        file["sensors/left/quaternion"] = h5py.SoftLink("/nowhere")
    ertis.add_poses(plain, drive())
    assert recorded_trajectory(plain, sensor="left") is not None


def test_links_in_the_place_of_poses_and_axes_are_refused(plain, tmp_path):
    other = write_recording(tmp_path / "other.h5", noise(), poses=drive())
    with h5py.File(plain, "r+") as file:
        file["sensors/left/pose_position"] = h5py.ExternalLink(str(other), "/sensors/eRTIS-7/pose_position")
    with pytest.raises(ForeignDataError, match="pose_position is a link into the file"):
        ertis.add_poses(plain, drive())
    with h5py.File(plain, "r+") as file:
        del file["sensors/left/pose_position"], file["sensors/left/axis"]
        file["sensors/left/axis"] = h5py.ExternalLink(str(other), "/sensors/eRTIS-7/axis")
    with pytest.raises(ForeignDataError, match="axis is a link into the file"):
        ertis.add_poses(plain, drive())


WRONG = {
    "poses are of type list; pass a Trajectory, or a dictionary with a Trajectory": [1, 2],
    "poses are of type str; pass a Trajectory, or a dictionary with a Trajectory": {"eRTIS-7": "a.tum"},
    "the source of poses has 1025 bytes; the limit is 1024": drive(source="x" * 1025),
}


@pytest.mark.parametrize("message", WRONG)
def test_writer_refuses_other_things_than_poses(tmp_path, message):
    with pytest.raises(ArgumentError, match=message):
        write_recording(tmp_path / "rec.h5", noise(), poses=WRONG[message])
    assert list(tmp_path.iterdir()) == []


def test_add_poses_refuses_other_things_than_a_trajectory(plain):
    with pytest.raises(ArgumentError, match="trajectory is of type str; pass a Trajectory"):
        ertis.add_poses(plain, "a.tum")


def test_add_poses_never_overwrites_without_request(plain, tmp_path):
    (tmp_path / "old.h5").write_bytes(b"old")
    with pytest.raises(ArgumentError, match=r"old.h5 exists; choose another name"):
        ertis.add_poses(plain, drive(), output=tmp_path / "old.h5")
    with pytest.raises(ArgumentError, match=r"plain.h5 is the input itself"):
        ertis.add_poses(plain, drive(), output=plain, overwrite=True)
    assert (tmp_path / "old.h5").read_bytes() == b"old"
    ertis.add_poses(plain, drive(), output=tmp_path / "old.h5", overwrite=True)
    assert recorded_trajectory(tmp_path / "old.h5") is not None


def test_failure_while_poses_are_added_leaves_the_recording(plain, monkeypatch):
    before = plain.read_bytes()

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("ertis_numba.storage.poses.write_poses", fail)
    with pytest.raises(ertis.DataError, match=r"plain.h5 cannot be written \(.*No space left.*\); free some space"):
        ertis.add_poses(plain, drive())
    assert plain.read_bytes() == before
    assert [path.name for path in plain.parent.iterdir()] == ["plain.h5"]


def test_recorded_trajectory_joins_the_poses_of_all_sensors(plain):
    assert recorded_trajectory(plain) is None
    ertis.add_poses(plain, drive())
    found = recorded_trajectory(plain)
    times_ns = sorted([*TIMES_NS, *(time_ns + 10_000_000 for time_ns in TIMES_NS)])
    assert found.time_ns.tolist() == times_ns
    np.testing.assert_allclose(found.position_m, drive().at(times_ns).position_m, rtol=0, atol=1e-12)
    np.testing.assert_allclose(found.covariance, drive().at(times_ns).covariance, rtol=1e-12)
    assert recorded_trajectory(plain, sensor="right").time_ns.tolist() == times_ns[1::2]


def test_recorded_trajectory_joins_equal_poses_of_equal_times(tmp_path):
    reverse = drive().replace(rotation_xyzw=-drive().rotation_xyzw, covariance=None)
    path = write_recording(tmp_path / "rec.h5", sensors("left", "right"), poses={"left": drive(), "right": reverse})
    assert recorded_trajectory(path).time_ns.tolist() == TIMES_NS
    assert recorded_trajectory(path).covariance is None  # One sensor has none.


def test_recorded_trajectory_refuses_different_platforms(tmp_path):
    other = drive().replace(position_m=drive().position_m + 1)
    path = write_recording(tmp_path / "rec.h5", sensors("left", "right"), poses={"left": drive(), "right": other})
    with pytest.raises(ArgumentError, match=r"sensors left and right have different poses at \d+ ns; choose one sen"):
        recorded_trajectory(path)


def spoiled(path, name, value):
    """Change poses in a file, and state the checksum of the changed content."""
    with h5py.File(path, "r+") as file:
        group = file["sensors/eRTIS-7"]
        if value is None:
            for axis in group[name].dims:
                for scale in axis.values():
                    axis.detach_scale(scale)
            del group[name]
        else:
            group[name][0] = value
        content = content_sha256(group, (*RECORDING, *POSES))
        group.attrs.modify("content_sha256", np.bytes_(content))


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("pose_position", np.nan, r"the poses of sensor eRTIS-7 are damaged \(position_m"),
        ("pose_rotation", 2.0, r"the poses of sensor eRTIS-7 are damaged \(rotation_xyzw has length 4"),
        ("pose_rotation", None, "'pose_position' for sensor eRTIS-7, but not all of its poses; copy it again"),
        ("pose_source", None, "'pose_position' for sensor eRTIS-7, but not all of its poses; copy it again"),
    ],
)
def test_damaged_poses_are_refused(tmp_path, name, value, message):
    path = write_recording(tmp_path / "rec.h5", noise(), poses=drive())
    spoiled(path, name, value)
    with pytest.raises(DamagedError, match=message):
        open_recording(path)


def test_flipped_bit_in_the_poses_is_found(tmp_path):
    path = write_recording(tmp_path / "rec.h5", noise(), poses=drive())
    with h5py.File(path, "r+") as file:
        file["sensors/eRTIS-7/pose_position"][1, 0] += 1e-9
    with pytest.raises(DamagedError, match="the content of sensor eRTIS-7 has SHA-256"):
        open_recording(path)


def test_poses_with_too_few_rows_are_refused(tmp_path):
    path = write_recording(tmp_path / "rec.h5", noise(), poses=drive())
    with h5py.File(path, "r+") as file:
        file["sensors/eRTIS-7/pose_position"].resize(2, axis=0)
    with pytest.raises(DamagedError):
        open_recording(path)


def test_info_command_reports_poses(plain):
    def reported(*options):
        done = CliRunner().invoke(cli, ["info", str(plain), *options])
        assert done.exit_code == 0, done.exception
        return done.stdout

    assert ["poses", "0"] in [line.split() for line in reported().splitlines()]
    ertis.add_poses(plain, drive())
    (left, _) = json.loads(reported("--json"))["sensors"]
    assert (left["poses"], left["poses_source"]) == (3, "file")
    assert left["path_length_m"] == pytest.approx(drive().at(TIMES_NS).length_m, abs=1e-3)
    lines = [line.split() for line in reported().splitlines()]
    assert ["poses", "source", "file"] in lines
    assert ["path", "length", str(left["path_length_m"]), "m"] in lines


def test_trajectory_of_a_platform_does_not_depend_on_the_order_of_its_recordings(tmp_path):
    by_name = {"front": sensors("front"), "left": sensors("right", "left", delay_ns=10_000_000)[len(TIMES_NS) :]}
    files = [write_recording(tmp_path / f"{name}.h5", several) for name, several in by_name.items()]
    for path in files:
        ertis.add_poses(path, drive())
    files.append(write_recording(tmp_path / "back.h5", sensors("back")))
    found = platform_trajectory(files)
    assert found.time_ns.tolist() == sorted([*TIMES_NS, *(time_ns + 10_000_000 for time_ns in TIMES_NS)])
    same_poses(platform_trajectory(files[::-1]), found)
    assert platform_trajectory(files[2:]) is None


def test_trajectory_of_a_platform_refuses_recordings_of_different_drives(tmp_path):
    files = [write_recording(tmp_path / f"{name}.h5", sensors(name)) for name in ("front", "left")]
    ertis.add_poses(files[0], drive())
    ertis.add_poses(files[1], drive(source="other"))
    with pytest.raises(ArgumentError, match=r"front.h5 from 'file' and .*left.h5 from 'other'; use one trajectory"):
        platform_trajectory(files)
    ertis.add_poses(files[1], drive().replace(position_m=drive().position_m + 1), replace=True)
    with pytest.raises(ArgumentError, match=r"front.h5 and .*left.h5 have different poses at \d+ ns; use one traj"):
        platform_trajectory(files)


def test_measurements_outside_a_trajectory_with_gaps_have_no_pose(tmp_path):
    """The poses cover all measurements but the second; files of images, copies and both sensors keep this."""
    measured = sensors("left", "right")
    early = drive(end_ns=TIMES_NS[0] + 1)
    late = drive(begin_ns=TIMES_NS[1] + SECOND_NS, end_ns=TIMES_NS[1] + 9 * SECOND_NS)
    measured = [
        restamped(each, timestamp_ns=each.stamp.timestamp_ns + (2 * SECOND_NS if number % 3 == 2 else 0))
        for number, each in enumerate(measured)
    ]
    columns = {
        name: np.concatenate([getattr(early, name), getattr(late, name)])
        for name in ("time_ns", "position_m", "rotation_xyzw", "covariance")
    }
    given = ertis.Trajectory(**columns, source="application", max_gap_s=1.0)
    path = write_recording(tmp_path / "rec.h5", measured, poses=given)
    covered_ns = [each.stamp.timestamp_ns for each in measured[:3] if given.covers([each.stamp.timestamp_ns])[0]]
    assert len(covered_ns) == 2
    with h5py.File(path) as file:
        for name in ("pose_position", "pose_rotation", "pose_covariance"):
            column = file["sensors/left"][name][:]
            assert np.isnan(column[1]).all()
            assert np.isfinite(column[[0, 2]]).all()
    for sensor in ("left", "right"):
        with open_recording(path, sensor=sensor) as recording:
            same_poses(recording.trajectory, given.at(covered_ns))
            assert recording.trajectory.max_gap_s == 1.0
            copy = write_recording(tmp_path / f"{sensor}.h5", recording)
            with open_recording(copy) as copied:
                same_poses(copied.trajectory, recording.trajectory)
    assert recorded_trajectory(path).max_gap_s == 1.0
    assert not recorded_trajectory(path).covers([measured[1].stamp.timestamp_ns])[0]
    assert all(report.is_intact for report in verify(path))


def test_part_of_a_pose_cannot_be_missing(tmp_path):
    path = write_recording(tmp_path / "rec.h5", noise(), poses=drive())
    with h5py.File(path, "r+") as file:
        file["sensors/eRTIS-7/pose_position"][1, 0] = np.nan
    with pytest.raises(DamagedError, match="poses of sensor eRTIS-7 are damaged"):
        open_recording(path)


def test_poses_that_cover_no_measurement_are_refused(plain):
    far = drive(begin_ns=TIMES_NS[-1] + 9 * SECOND_NS, end_ns=TIMES_NS[-1] + 19 * SECOND_NS).replace(max_gap_s=1.0)
    with pytest.raises(ArgumentError, match="no measurement of sensor left is within the poses; use poses for this"):
        ertis.add_poses(plain, far)
