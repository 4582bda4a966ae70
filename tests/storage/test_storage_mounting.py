"""Energyscape files and files made from them keep the mounting of each sensor if it is known."""

import csv
import pickle

import h5py
import numpy as np
import plyfile
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError, DamagedError
from ertis_numba.campaign import Campaign
from ertis_numba.frames import PointCloud
from ertis_numba.journal import Journal, JournalEntry
from ertis_numba.network.messages import Hello, decode, encode
from ertis_numba.storage import open_energyscapes, open_recording, write_energyscapes, write_recording
from ertis_numba.storage.sealing import seal
from ertis_numba.storage.truth import GroundTruth
from tests.campaigns import InlinePool
from tests.files import SMALL, echoes, image, noise
from tests.storage.test_storage_sensors import TURNED, of

pytestmark = pytest.mark.usefixtures("sound_unchecked")

PLACES = {"left": ((0.1, 0.3, -0.2), TURNED), "right": ((0.1, -0.3, 0.4), (0.0, 0.0, 0.0, 1.0))}


def images(*sensors):
    return [image().replace(stamp=m.stamp) for sensor in sensors for m in of(sensor, noise(SMALL, 1))]


def run(*arguments):
    done = CliRunner().invoke(cli, [*map(str, arguments)])
    assert done.exit_code == 0, (arguments, done.stderr, done.exception)


def place_of(path, sensor):
    with open_energyscapes(path, sensor=sensor) as reader:
        return reader.translation_m, reader.rotation_xyzw


@pytest.fixture
def recorded(tmp_path):
    """Recording of a platform with two sensors."""
    both = [*of("left", echoes(SMALL, 2)), *of("right", echoes(SMALL, 2, [(15.0, 0.7)]))]
    return write_recording(tmp_path / "rec.h5", both, mounting=PLACES)


@pytest.mark.parametrize("many", [False, True])
def test_processing_keeps_mountings(recorded, tmp_path, many):
    made = tmp_path / "img.h5"
    if many:  # a folder is worked on by other code
        run("process", recorded.parent, "-o", tmp_path / "out", "--quiet", "--device", "cpu", "--workers", "1")
        (made,) = (tmp_path / "out").glob("*.energy.h5")
    else:
        run("process", recorded, "-o", made, "--quiet")
    for sensor, (translation_m, rotation_xyzw) in PLACES.items():
        kept = place_of(made, sensor)
        np.testing.assert_array_equal(kept[0], translation_m)
        np.testing.assert_array_equal(kept[1], rotation_xyzw)


def test_export_of_images_equals_export_of_their_recording(recorded, tmp_path):
    run("process", recorded, "-o", tmp_path / "img.h5", "--quiet")
    for name, source in (("a", recorded), ("b", tmp_path / "img.h5")):
        run("export", source, "-o", tmp_path / f"{name}.csv", "--top", 5)
    run("export", tmp_path / "img.h5", "-o", tmp_path / "c.ply", "--top", 5)
    run("export", tmp_path / "img.h5", "-o", tmp_path / "d.npz", "--sensor", "left")  # which has no place for it
    there, here = ([*csv.DictReader((tmp_path / f"{name}.csv").read_text().splitlines())] for name in "ab")
    assert {row["sensor"] for row in here} == {"left", "right"}
    assert here == there
    assert "frame base_link" in plyfile.PlyData.read(tmp_path / "c.ply").comments


def test_unknown_mounting_is_not_stored(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", images("left"))
    assert place_of(path, "left") == (None, None)
    with h5py.File(path) as file:
        assert not {"translation_m", "rotation_xyzw"} & file["sensors/left"].attrs.keys()
        assert file["sensors/left"].attrs["mounting"] == b"unknown"
    run("export", path, "-o", tmp_path / "a.ply")
    assert "frame left" in plyfile.PlyData.read(tmp_path / "a.ply").comments


def test_given_mounting_overrides_the_recording(recorded, tmp_path):
    given = {"left": ((5.0, 6.0, 7.0), (0.0, 0.0, 1.0, 0.0))}
    with open_recording(recorded, sensor="left") as left, open_recording(recorded, sensor="right") as right:
        path = write_energyscapes(
            tmp_path / "img.h5", images("left", "right", "third"), recording=[left, right], mounting=given
        )
    assert place_of(path, "left")[0].tolist() == [5.0, 6.0, 7.0]
    assert place_of(path, "right")[0].tolist() == list(PLACES["right"][0])
    assert place_of(path, "third") == (None, None)


@pytest.mark.parametrize(
    ("given", "reported"),
    [
        ({"left": ((0.0, 0.0), TURNED)}, "translation_m of sensor left"),
        ({"left": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0))}, "rotation_xyzw of sensor left has length 2"),
        ({"back": PLACES["left"]}, "mounting is given for sensor 'back', which has no measurement"),
    ],
)
def test_impossible_mountings_are_refused(tmp_path, given, reported):
    with pytest.raises(ArgumentError, match=reported):
        write_energyscapes(tmp_path / "img.h5", images("left"), mounting=given)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("spoil", "reported"),
    [
        (lambda attributes: attributes.pop("rotation_xyzw"), "damaged or cut short .*rotation_xyzw"),
        (lambda attributes: attributes.modify("rotation_xyzw", np.full(4, np.nan)), "rotation_xyzw of sensor left"),
    ],
)
def test_half_a_mounting_is_damage(tmp_path, spoil, reported):
    path = write_energyscapes(tmp_path / "img.h5", images("left"), mounting={"left": PLACES["left"]})
    with h5py.File(path, "r+") as file:
        spoil(file["sensors/left"].attrs)
    with pytest.raises(DamagedError, match=f"img.h5.*{reported}"):
        open_energyscapes(path)


def older(path, **changes):
    """Convert a file to the format before the attribute ``mounting``."""
    with h5py.File(path, "r+") as file:
        attributes = file["sensors/left"].attrs
        del attributes["mounting"]
        for name, value in changes.items():
            attributes[name] = value
    return path


ORIGIN = {"translation_m": np.zeros(3), "rotation_xyzw": np.array([0.0, 0.0, 0.0, 1.0])}


def test_recordings_without_a_mounting_are_exported_in_the_sensors_own_frame(tmp_path):
    path = write_recording(tmp_path / "rec.h5", of("left", noise(SMALL, 1)))
    with open_recording(path) as recording:
        assert (recording.translation_m, recording.rotation_xyzw) == (None, None)
    done = CliRunner().invoke(cli, ["export", str(path), "-o", str(tmp_path / "a.ply"), "--top", "3"])
    assert done.exit_code == 0, done.stderr
    assert "note: the mounting of sensor left is unknown; the export uses the frame of the sensor" in done.stderr
    assert "frame left" in plyfile.PlyData.read(tmp_path / "a.ply").comments
    info = CliRunner().invoke(cli, ["info", str(path), "--json"])
    assert '"mounting": "unknown"' in info.stdout


def test_sensors_without_mounting_are_not_combined(tmp_path):
    both = [*of("left", noise(SMALL, 1)), *of("right", noise(SMALL, 1, seed=2))]
    path = write_recording(tmp_path / "rec.h5", both)
    command = ["export", str(path), "-o", str(tmp_path / "a.ply"), "--top", "3"]
    done = CliRunner().invoke(cli, command)
    assert done.exit_code == 1
    assert "the mountings of sensors left, right on their platform are unknown" in done.stderr
    (tmp_path / "where.toml").write_text('[[sensors]]\nname = "left"\n[[sensors]]\nname = "right"\nyaw_deg = 90.0\n')
    given = write_recording(tmp_path / "given.h5", both, mounting=PLACES)
    for file in (tmp_path / "where.toml", given):
        run(*command, "--mounting", file, "--force")
        assert "frame base_link" in plyfile.PlyData.read(tmp_path / "a.ply").comments
    done = CliRunner().invoke(cli, [*command, "--mounting", str(path), "--force"])
    assert done.exit_code == 1
    assert "rec.h5 contains no mounting of a sensor; use a scene" in done.stderr


@pytest.mark.parametrize(("sensors", "count"), [(("left",), 0), (("left", "right"), 1)])
def test_processing_keeps_that_a_mounting_is_unknown(tmp_path, sensors, count):
    """A note says so if there are several images, which could be combined."""
    path = write_recording(tmp_path / "rec.h5", [each for name in sensors for each in of(name, noise(SMALL, 1))])
    done = CliRunner().invoke(cli, ["process", str(path), "-o", str(tmp_path / "img.h5"), "--device", "cpu"])
    assert done.exit_code == 0, done.stderr
    assert done.stderr.count("note: the mounting of sensors left, right is unknown") == count
    assert done.stderr.count("note: the mounting of") == count
    assert place_of(tmp_path / "img.h5", "left") == (None, None)


@pytest.mark.parametrize("simulated", [False, True])
def test_the_origin_of_older_recordings_is_unknown_unless_simulated(tmp_path, simulated):
    truth = {"left": GroundTruth(scene="", seed=1, reflectors=((),))} if simulated else None
    path = older(write_recording(tmp_path / "rec.h5", of("left", noise(SMALL, 1)), truth=truth), **ORIGIN)
    with open_recording(path) as recording:
        assert (recording.translation_m is not None) == simulated


def test_mountings_of_older_files_are_kept(tmp_path):
    given = {"left": PLACES["left"]}
    path = older(write_recording(tmp_path / "rec.h5", of("left", noise(SMALL, 1)), mounting=given))
    with open_recording(path) as recording:
        assert recording.translation_m.tolist() == list(PLACES["left"][0])


def test_the_origin_remains_known_if_it_was_given(tmp_path):
    given = {"left": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))}
    path = write_recording(tmp_path / "rec.h5", of("left", noise(SMALL, 1)), mounting=given)
    with open_recording(path) as recording:
        assert recording.translation_m.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("value", ["maybe", 3])
def test_a_mounting_of_another_kind_is_damage(tmp_path, value):
    path = write_recording(tmp_path / "rec.h5", of("left", noise(SMALL, 1)))
    with h5py.File(path, "r+") as file:
        file["sensors/left"].attrs["mounting"] = value
    with pytest.raises(DamagedError, match=r"attribute mounting is .*wanted 'given' or 'unknown'"):
        open_recording(path)


def test_journals_keep_that_a_mounting_is_unknown(tmp_path):
    with Journal.create(tmp_path / "rec.h5.journal", target="rec.h5") as journal:
        journal.add_sensor("left", SMALL)
        journal.append([JournalEntry(each, 0) for each in of("left", noise(SMALL, 1))])
    with Journal.open(tmp_path / "rec.h5.journal") as journal:
        assert (journal.sensors["left"].translation_m, journal.sensors["left"].rotation_xyzw) == (None, None)
    assert seal(tmp_path / "rec.h5.journal").recording == tmp_path / "rec.h5"
    with open_recording(tmp_path / "rec.h5") as recording:
        assert recording.translation_m is None


def test_point_clouds_of_an_unknown_mounting_have_no_place_on_a_platform():
    cloud = PointCloud(np.ones((1, 3), np.float32), np.ones(1, np.float32), SMALL)
    with pytest.raises(ArgumentError, match="the mounting of sensor 'sensor' is unknown"):
        cloud.on_platform_m()


@pytest.mark.parametrize("place", [None, (1.0, 2.0, 3.0)])
def test_mountings_are_sent_over_the_network(place):
    rotation = None if place is None else (0.0, 0.0, 0.0, 1.0)
    hello = Hello(
        sensor="a", session_id=1, next_sequence=0, settings_crc32=0, translation_m=place, rotation_xyzw=rotation
    )
    assert decode(encode(hello)) == hello
    assert Hello(sensor="a", session_id=1, next_sequence=0, settings_crc32=0).translation_m is None


def test_processing_refuses_a_picture_as_output(tmp_path):
    path = write_recording(tmp_path / "rec.h5", of("left", noise(SMALL, 1)))
    done = CliRunner().invoke(cli, ["process", str(path), "-o", str(tmp_path / "x.png")])
    assert done.exit_code == 2
    assert "x.png is a picture" in done.stderr
    assert "'ertis plot'" in done.stderr
    assert not (tmp_path / "x.png").exists()


def test_process_accepts_missing_mountings(tmp_path):
    both = [*of("left", noise(SMALL, 1)), *of("right", noise(SMALL, 1, seed=2))]
    given = write_recording(tmp_path / "given.h5", both, mounting=PLACES)
    unknown = write_recording(tmp_path / "rec.h5", both)
    run("process", unknown, "-o", tmp_path / "img.h5", "--mounting", given)
    for sensor, place in PLACES.items():
        for held, wanted in zip(place_of(tmp_path / "img.h5", sensor), place, strict=True):
            np.testing.assert_allclose(held, wanted)
    bare = CliRunner().invoke(cli, ["process", str(unknown), "-o", str(tmp_path / "b.h5"), "--mounting", str(unknown)])
    assert bare.exit_code == 1
    assert "contains no mounting of a sensor" in bare.stderr


def test_process_repeats_images_for_another_mounting(tmp_path, monkeypatch):
    pool = InlinePool()  # Its tasks arrive as at a worker process, which would start slowly.
    monkeypatch.setattr(pool, "submit", lambda task: InlinePool.submit(pool, pickle.loads(pickle.dumps(task))))
    monkeypatch.setattr(Campaign, "_pool", lambda _: pool)
    moved = {"left": ((0.2, 0.3, -0.2), TURNED), "right": PLACES["right"]}
    both = [*of("left", noise(SMALL, 1)), *of("right", noise(SMALL, 1, seed=2))]
    unknown = write_recording(tmp_path / "rec.h5", both)
    folder = f"{tmp_path / 'many'}/"
    for name, mounting in {"first": PLACES, "other": moved}.items():
        given = write_recording(tmp_path / f"{name}.h5", both, mounting=mounting)
        run("process", unknown, "-o", folder, "--mounting", given, "--workers", "1", "--force")
        for sensor, place in mounting.items():
            for held, wanted in zip(place_of(tmp_path / "many" / "rec.energy.h5", sensor), place, strict=True):
                np.testing.assert_allclose(held, wanted)
