"""Energyscape files know where their sensors are, if somebody said it, and so does what is made of them."""

import csv

import h5py
import numpy as np
import plyfile
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.errors import ArgumentError, DamagedError
from ertis_numba.storage import open_energyscapes, open_recording, write_energyscapes, write_recording
from tests.files import SMALL, image, noise
from tests.test_storage_sensors import TURNED, of

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
    """A recording of a platform with two sensors."""
    both = [*of("left", noise(SMALL, 2)), *of("right", noise(SMALL, 2, seed=2))]
    return write_recording(tmp_path / "rec.h5", both, mounting=PLACES)


@pytest.mark.parametrize("many", [False, True])
def test_processing_keeps_where_sensors_are(recorded, tmp_path, many):
    made = tmp_path / "img.h5"
    if many:  # a folder is worked on by other code
        run("process", recorded.parent, "-o", tmp_path / "out", "--quiet", "--device", "cpu")
        (made,) = (tmp_path / "out").glob("*.energy.h5")
    else:
        run("process", recorded, "-o", made, "--quiet")
    for sensor, (translation_m, rotation_xyzw) in PLACES.items():
        kept = place_of(made, sensor)
        np.testing.assert_array_equal(kept[0], translation_m)
        np.testing.assert_array_equal(kept[1], rotation_xyzw)


def test_an_export_of_images_is_that_of_their_recording(recorded, tmp_path):
    run("process", recorded, "-o", tmp_path / "img.h5", "--quiet")
    for name, source in (("a", recorded), ("b", tmp_path / "img.h5")):
        run("export", source, "-o", tmp_path / f"{name}.csv", "--top", 5)
    run("export", tmp_path / "img.h5", "-o", tmp_path / "c.ply", "--top", 5)
    run("export", tmp_path / "img.h5", "-o", tmp_path / "d.npz", "--sensor", "left")  # which has no place for it
    there, here = ([*csv.DictReader((tmp_path / f"{name}.csv").read_text().splitlines())] for name in "ab")
    assert {row["sensor"] for row in here} == {"left", "right"}
    assert here == there
    assert "frame base_link" in plyfile.PlyData.read(tmp_path / "c.ply").comments


def test_what_nobody_said_is_not_in_the_file(tmp_path):
    path = write_energyscapes(tmp_path / "img.h5", images("left"))
    assert place_of(path, "left") == (None, None)
    with h5py.File(path) as file:
        assert not {"translation_m", "rotation_xyzw"} & file["sensors/left"].attrs.keys()
    run("export", path, "-o", tmp_path / "a.ply")
    assert "frame left" in plyfile.PlyData.read(tmp_path / "a.ply").comments


def test_what_is_given_counts_more_than_the_recording(recorded, tmp_path):
    given = {"left": ((5.0, 6.0, 7.0), (0.0, 0.0, 1.0, 0.0))}
    with open_recording(recorded, sensor="left") as left, open_recording(recorded, sensor="right") as right:
        path = write_energyscapes(
            tmp_path / "img.h5", images("left", "right", "third"), recording=[left, right], mounting=given
        )
    assert place_of(path, "left")[0].tolist() == [5.0, 6.0, 7.0]
    assert place_of(path, "right")[0].tolist() == list(PLACES["right"][0])
    assert place_of(path, "third") == (None, None)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"left": ((0.0, 0.0), TURNED)}, "translation_m of sensor left"),
        ({"left": ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 2.0))}, "rotation_xyzw of sensor left has length 2"),
        ({"back": PLACES["left"]}, "mounting is given for sensor 'back', of which no measurement came"),
    ],
)
def test_mountings_that_cannot_be(tmp_path, given, told):
    with pytest.raises(ArgumentError, match=told):
        write_energyscapes(tmp_path / "img.h5", images("left"), mounting=given)
    assert not [*tmp_path.iterdir()]


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda attributes: attributes.pop("rotation_xyzw"), "damaged or cut short .*rotation_xyzw"),
        (lambda attributes: attributes.modify("rotation_xyzw", np.full(4, np.nan)), "rotation_xyzw of sensor left"),
    ],
)
def test_half_a_mounting_is_damage(tmp_path, spoil, told):
    path = write_energyscapes(tmp_path / "img.h5", images("left"), mounting={"left": PLACES["left"]})
    with h5py.File(path, "r+") as file:
        spoil(file["sensors/left"].attrs)
    with pytest.raises(DamagedError, match=f"img.h5.*{told}"):
        open_energyscapes(path)
