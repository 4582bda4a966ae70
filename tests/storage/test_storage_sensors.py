"""Several sensors in one file, each with its own settings, rows, mounting and checksums."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from ertis_numba.base.errors import ArgumentError, DataError
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array
from ertis_numba.storage import (
    RecordingWriter,
    open_energyscapes,
    open_recording,
    sensor_names,
    write_energyscapes,
    write_recording,
)
from tests.files import SMALL, image, line, noise, open_dataset

TURNED = (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5))


def of(sensor, measurements):
    return [replace(m, stamp=replace(m.stamp, sensor=sensor)) for m in measurements]


def two(settings=SMALL):
    """Alternating measurements of two sensors; the second is a line of 8 microphones with one measurement less."""
    right, left = of("right", noise(settings)), of("left", noise(line(8, 8), 2, seed=2))
    return [right[0], left[0], left[1], right[1], right[2]]


def test_sensors_are_read_back_unchanged(tmp_path):
    path = write_recording(tmp_path / "rec.h5", two())
    assert sensor_names(path) == ("right", "left")  # as they came
    for name, wanted in (("right", SMALL), ("left", line(8, 8))):
        given = [m for m in two() if m.stamp.sensor == name]
        with open_recording(path, sensor=name) as recording:
            assert (recording.sensor, recording.sensors) == (name, ("right", "left"))
            assert recording.stamps() == [m.stamp for m in given]
            for back, measurement in zip(recording, given, strict=True):
                assert np.array_equal(back.data, measurement.data)
                assert back.stamp == measurement.stamp
            assert recording.settings.replace(array=wanted.array) == wanted
    with open_dataset(path, group="/sensors/left", engine="netcdf4") as data:
        assert data["pdm"].shape == (2, 40_960)


def test_energyscapes_of_several_sensors_are_read_back(tmp_path):
    path = write_recording(tmp_path / "rec.h5", two())
    with open_recording(path, sensor="right") as right, open_recording(path, sensor="left") as left:
        pipelines = {"right": Pipeline(right.settings), "left": Pipeline(left.settings)}
        images = [pipelines[m.stamp.sensor].process(m) for m in two()]
        write_energyscapes(tmp_path / "img.h5", images, recording=[right, left])
        digest = right.sha256()
    assert sensor_names(tmp_path / "img.h5") == ("right", "left")
    for name in ("right", "left"):
        with open_energyscapes(tmp_path / "img.h5", sensor=name) as back:
            given = [image for image in images if image.stamp.sensor == name]
            assert back.attributes["recording_sha256"] == digest
            assert [np.array_equal(one.amplitude, other.amplitude) for one, other in zip(back, given, strict=True)] == [
                True
            ] * len(given)


def test_each_sensor_has_its_own_gaps_and_sessions(tmp_path):
    given = two()
    given[2] = replace(given[2], stamp=replace(given[2].stamp, sequence=20, session_id=3))
    given.append(replace(given[2], stamp=replace(given[2].stamp, sequence=22)))
    write_recording(tmp_path / "rec.h5", given)
    with open_recording(tmp_path / "rec.h5", sensor="left") as left:
        assert [(gap.first, gap.last, gap.session_id) for gap in left.gaps] == [(21, 21, 3)]
    with open_recording(tmp_path / "rec.h5", sensor="right") as right:
        assert right.gaps == ()
    with h5py.File(tmp_path / "rec.h5") as file:
        assert file["sensors/left/session_id"][:].tolist() == [0, 3, 3]
        assert file["sensors/right/session_id"][:].tolist() == [0, 0, 0]


def uuid_of(path, sensor):
    with open_recording(path, sensor=sensor) as recording:
        return recording.uuid


def test_identity_covers_all_sensors(tmp_path):
    given = two()
    first = write_recording(tmp_path / "a.h5", given)
    sorted_by_name = write_recording(tmp_path / "b.h5", sorted(given, key=lambda m: m.stamp.sensor))
    renamed = write_recording(tmp_path / "c.h5", [*of("other", given[1:3]), given[0], *given[3:]])
    fewer = write_recording(tmp_path / "d.h5", given[:-1])
    assert uuid_of(first, "left") == uuid_of(first, "right") == uuid_of(sorted_by_name, "right")
    assert len({uuid_of(path, "right") for path in (first, renamed, fewer)}) == 3


def write_and_spoil(path):
    with RecordingWriter(path) as writer:
        for measurement in two():
            writer.write(measurement)
        writer._file["sensors/right/pdm"][0, 5] ^= 1  # noqa: SLF001  a fault between memory and disk


def test_written_sensors_are_all_verified(tmp_path):
    with pytest.raises(DataError, match="measurement 0 has CRC-32"):
        write_and_spoil(tmp_path / "rec.h5")
    assert not list(tmp_path.iterdir())


def test_a_damaged_sensor_leaves_the_others_readable(tmp_path):
    path = write_recording(tmp_path / "rec.h5", two())
    with h5py.File(path, "r+") as file:
        file["sensors/left/sequence"][0] += 1
    with pytest.raises(DataError, match="the content of sensor left has SHA-256"):
        open_recording(path, sensor="left")
    with open_recording(path, sensor="right") as recording:
        assert len(list(recording)) == 3


def test_mounting_is_kept(tmp_path):
    path = write_recording(tmp_path / "rec.h5", two(), mounting={"left": ((1.0, -2.0, 0.5), TURNED)})
    with open_recording(path, sensor="left") as left, open_recording(path, sensor="right") as right:
        assert left.translation_m.tolist() == [1.0, -2.0, 0.5]
        assert left.rotation_xyzw.tolist() == list(TURNED)
        assert left.rotation_xyzw.dtype == np.float64
        assert (right.translation_m, right.rotation_xyzw) == (None, None)  # none was given


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"settings": SMALL},
            "settings are given for one sensor, but there are measurements of right and left; remove settings,",
        ),
        (
            {"mounting": {"a": ((0, 0, 0), TURNED)}},
            "mounting is given for sensor 'a', which has no measurement",
        ),
        ({"mounting": {"left": ((0, 0), TURNED)}}, r"translation_m of sensor left has shape \(2,\); pass shape \(3,\)"),
        ({"mounting": {"left": ((0, 0, np.inf), TURNED)}}, r"translation_m of sensor left holds inf at \[2\]; pass"),
        ({"mounting": {"left": ((0, 0, 0), (0, 0, 1))}}, r"rotation_xyzw of sensor left has shape \(3,\); pass shape"),
        ({"mounting": {"left": ((0, 0, 0), (0, 0, 1, 1))}}, "rotation_xyzw of sensor left has length 1.41421; use a"),
    ],
)
def test_options_for_other_sensors_are_refused(tmp_path, options, message):
    with pytest.raises(ArgumentError, match=message):
        write_recording(tmp_path / "rec.h5", two(), **options)
    assert not list(tmp_path.iterdir())


def test_other_array_settings_within_a_sensor_are_refused(tmp_path):
    given = two()
    given[3] = replace(given[3], settings=SMALL.replace(array=Array(layout="eRTIS_v2")))
    with pytest.raises(ArgumentError, match="other array settings"):
        write_recording(tmp_path / "rec.h5", given)


def test_readers_of_different_recordings_are_not_mixed(tmp_path):
    for seed in (1, 2):
        write_recording(tmp_path / f"{seed}.h5", noise(seed=seed))
    with (
        open_recording(tmp_path / "1.h5") as first,
        open_recording(tmp_path / "2.h5") as second,
        pytest.raises(ArgumentError, match=r"2.h5 is not the same recording as .*1.h5; write one file for each"),
    ):
        write_energyscapes(tmp_path / "img.h5", [image()], recording=[first, second])


def test_damaged_sensor_names_are_reported(tmp_path):
    path = write_recording(tmp_path / "rec.h5", noise())
    with h5py.File(path, "r+") as file:
        del file["sensors"]
    with pytest.raises(DataError, match=r"rec.h5 is damaged or cut short"):
        sensor_names(path)
