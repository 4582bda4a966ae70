"""Files of every release stay readable, with all their contents."""

import tarfile

import h5py
import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba import Settings
from ertis_numba.base.errors import FormatVersionError
from ertis_numba.journal import Journal
from tests import release_files as kept
from tests.pages import ROOT

ARCHIVES = sorted((ROOT / "tests" / "kept").glob("*.tar.gz"))


@pytest.fixture(params=ARCHIVES, ids=lambda path: path.name.removesuffix(".tar.gz"))
def folder(request, tmp_path):
    """Return a folder with the files of a release."""
    with tarfile.open(request.param) as archive:
        archive.extractall(tmp_path, filter="data")
    return tmp_path


def same(measurement, sensor, index):
    assert np.array_equal(measurement.data, kept.samples(index))
    assert measurement.stamp == kept.stamp(sensor, index)
    assert measurement.settings == kept.SETTINGS


def test_recordings_of_releases_are_read(folder):
    for sensor, gaps, mounting in (("left", [kept.GAP], (0.1, 0.2, 0.3)), ("right", [], None)):
        with ertis.open_recording(folder / "recording.h5", sensor=sensor) as recording:
            for index, measurement in enumerate(recording):
                same(measurement, sensor, index)
            assert [(gap.sensor, gap.first, gap.last, gap.reason, gap.session_id) for gap in recording.gaps] == gaps
            assert np.array_equal(recording.translation_m, mounting)
            assert np.array_equal(recording.rotation_xyzw, kept.ROTATION_XYZW if mounting else None)
    with ertis.open_recording(folder / "recording_with_poses.h5") as recording:
        poses = recording.trajectory
        for name in ("time_ns", "position_m", "rotation_xyzw"):
            assert np.array_equal(getattr(poses, name), getattr(kept.poses(), name))


def test_images_and_maps_of_releases_are_read(folder):
    with ertis.open_energyscapes(folder / "images.h5") as images:
        for index, image in enumerate(images):
            assert np.array_equal(image.amplitude, kept.amplitude(index))
            assert np.array_equal(image.azimuth_rad, kept.AZIMUTH_RAD)
            assert np.array_equal(image.elevation_rad, kept.ELEVATION_RAD)
            assert np.array_equal(image.range_m, kept.RANGE_M)
            assert image.stamp == kept.stamp("left", index)
    with ertis.open_acoustic_maps(folder / "sound.h5") as sounds:
        (sound,) = sounds
    assert np.array_equal(sound.power, kept.acoustic_map().power)
    assert np.array_equal(sound.band_hz, kept.BAND_HZ)
    place = ertis.read_map(folder / "map.h5")
    assert np.array_equal(place.log_odds, kept.LOG_ODDS)
    assert (place.origin_m, place.cell_m, place.time_ns) == ((-1.0, 2.0), 0.5, kept.START_NS)


def test_journals_of_releases_are_read_and_sealed(folder):
    with Journal.open(folder / "recording.h5.journal") as journal:
        for index, entry in enumerate(journal.entries()):
            same(entry.measurement, "left", index)
    (folder / "recording.h5").unlink()
    done = CliRunner().invoke(cli, ["import", "journals", str(folder)])
    assert done.exit_code == 0, done.output
    with ertis.open_recording(folder / "recording.h5") as recording:
        for index, measurement in enumerate(recording):
            same(measurement, "left", index)


def test_settings_and_scenes_of_releases_are_read(folder):
    assert Settings.load(folder / "settings.toml") == kept.SETTINGS
    assert ertis.load_scene(folder / "scene.toml").points == kept.scene().points


def test_files_of_releases_pass_verification(folder):
    files = ["recording.h5", "recording_with_poses.h5", "images.h5", "sound.h5", "map.h5"]
    done = CliRunner().invoke(cli, ["verify", *(str(folder / name) for name in files)])
    assert "damage" not in done.output
    assert all(name in done.output for name in files)


@pytest.mark.parametrize("name", ["recording.h5", "images.h5", "sound.h5", "map.h5"])
def test_readers_ignore_what_a_later_release_may_add_and_refuse_a_later_version(folder, name):
    openers = {
        "recording.h5": lambda path: ertis.open_recording(path, sensor="left"),
        "images.h5": ertis.open_energyscapes,
        "sound.h5": ertis.open_acoustic_maps,
        "map.h5": ertis.read_map,
    }
    with h5py.File(folder / name, "a") as file:
        file.attrs["added_later"] = "text"
        group = file.get("sensors/left", file)
        group.attrs["added_later"] = 3
        group.create_dataset("added_later", data=np.arange(3))
    read = openers[name](folder / name)
    if name != "map.h5":
        assert len(read)
        read.close()
    with h5py.File(folder / name, "a") as file:
        file.attrs["ertis_format_version"] = 1000
    with pytest.raises(FormatVersionError, match="has format version 1000, but this package reads up to"):
        openers[name](folder / name)
