"""Directions given as an array: processing, storage, messages, and refusal of unusable ones."""

import math

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

from ertis_numba.base.errors import ArgumentError, SettingsError
from ertis_numba.geometry import direction_grid, received_settings
from ertis_numba.pipeline import Pipeline
from ertis_numba.settings import Array, Processing, Settings
from ertis_numba.storage import open_energyscapes, open_recording, write_energyscapes, write_recording
from tests.cases import SHORT, noise

ANGLES_DEG = np.array([[-30.0, 0.0], [0.0, 10.0], [12.5, -45.0], [200.0, 90.0]])


def listed(directions):
    return SHORT.replace(processing=SHORT.processing.replace(directions=directions))


@pytest.mark.parametrize("kind", [np.asarray, np.float32, list, lambda each: each.tolist()])
def test_directions_may_be_any_kind_of_list(kind):
    grid = direction_grid(Processing(directions=kind(ANGLES_DEG)))
    np.testing.assert_allclose(np.degrees(grid.azimuth_rad), ANGLES_DEG[:, 0])
    np.testing.assert_allclose(np.degrees(grid.elevation_rad), ANGLES_DEG[:, 1])


@pytest.mark.parametrize("elevation_deg", [0.0, 25.0])
@pytest.mark.parametrize("method", ["fast", "paper"])
def test_image_of_listed_directions_is_that_of_the_same_grid(method, elevation_deg):
    grid = np.column_stack([np.linspace(-90, 90, 7), np.full(7, elevation_deg)])
    named = SHORT.replace("processing.elevation_deg", elevation_deg)
    images = [
        Pipeline(each.replace(processing=each.processing.replace(method=method)), predict=False).process(noise(each))
        for each in (named, listed(grid))
    ]
    assert images[0].is_planar == (elevation_deg == 0)
    np.testing.assert_allclose(images[1].azimuth_rad, images[0].azimuth_rad)
    np.testing.assert_array_equal(images[1].amplitude, images[0].amplitude)


def test_listed_directions_survive_files(tmp_path):
    settings = listed(ANGLES_DEG)
    assert Settings.from_toml(settings.to_toml()) == settings
    write_recording(tmp_path / "rec.h5", [noise(settings)])
    with open_recording(tmp_path / "rec.h5") as recording:
        read = recording[0]
    assert read.settings.processing.directions == tuple(map(tuple, ANGLES_DEG.tolist()))
    image = Pipeline(read.settings, predict=False).process(read)
    write_energyscapes(tmp_path / "image.h5", [image])
    with open_energyscapes(tmp_path / "image.h5") as images:
        assert images.settings.processing.directions == read.settings.processing.directions
        np.testing.assert_allclose(np.degrees(images[0].elevation_rad), ANGLES_DEG[:, 1], atol=1e-5)


def test_listed_directions_of_other_machines_are_accepted():
    settings = received_settings(listed(ANGLES_DEG).to_toml(), "a sensor")
    assert len(direction_grid(settings.processing)) == len(ANGLES_DEG)


def test_longest_list_of_directions_fits_into_a_recording_and_a_message(tmp_path):
    rng = np.random.default_rng(1)
    settings = listed(rng.uniform(-90, 90, (1000, 2)))
    text = settings.to_toml()
    assert received_settings(text.encode(), "a sensor") == settings
    write_recording(tmp_path / "rec.h5", [noise(settings)])
    with open_recording(tmp_path / "rec.h5") as recording:
        assert recording.settings.processing == settings.processing


def test_longest_lists_of_the_largest_array_fit_into_settings():
    rng = np.random.default_rng(1)
    array = Array(
        layout="large",
        positions_m=rng.uniform(-1, 1, (1024, 3)),
        enabled=(True,) * 1024,
        gain=rng.uniform(0.5, 2, 1024),
        delay_s=rng.uniform(-1e-6, 1e-6, 1024),
    )
    settings = listed(rng.uniform(-90, 90, (1000, 2))).replace(array=array)
    settings = settings.replace(processing=settings.processing.replace(array_weights=rng.uniform(0, 1, 1024)))
    assert Settings.from_toml(settings.to_toml()) == settings


def test_settings_file_may_list_directions(tmp_path):
    (tmp_path / "s.toml").write_text("processing.directions = [[-30, 0], [0.0, 10.0]]\n")
    write_recording(tmp_path / "rec.h5", [noise(SHORT)])
    arguments = ["process", str(tmp_path / "rec.h5"), "--settings", str(tmp_path / "s.toml")]
    arguments += ["-o", str(tmp_path / "image.h5"), "--quiet"]
    done = CliRunner().invoke(cli, arguments)
    assert done.exit_code == 0, done.output
    with open_energyscapes(tmp_path / "image.h5") as images:
        np.testing.assert_allclose(np.degrees(images[0].azimuth_rad), [-30, 0])
    done = CliRunner().invoke(cli, [*arguments, "--force", "--azimuth=-10:10"])
    assert done.exit_code == 2
    assert "limits need a grid, but directions is a list of 2; add --directions 2d:N or 3d:N" in done.stderr


@pytest.mark.parametrize(
    ("directions", "message"),
    [
        (np.zeros((4, 3)), r"processing.directions has shape \(4, 3\); use azimuth and elevation"),
        (np.zeros(4), r"processing.directions has shape \(4,\); use azimuth and elevation"),
        (np.zeros((2, 2, 2)), r"processing.directions has shape \(2, 2, 2\); use azimuth and elevation"),
        (np.zeros((0, 2)), "processing.directions lists 0 directions; use 1 to 1000"),
        (np.zeros((1001, 2)), "processing.directions lists 1001 directions; use 1 to 1000, or more of them in a CSV"),
        ([[0.0, 0.0], [0.0, math.nan]], r"elevation of processing.directions\[1\] in degrees is nan; use a finite"),
        ([[math.inf, 0.0]], r"azimuth of processing.directions\[0\] in degrees is inf; use a finite number"),
        ([[0.0, 91.0]], r"elevation of processing.directions\[0\] in degrees is 91; use a number from -90 to 90"),
        ([[361.0, 0.0]], r"azimuth of processing.directions\[0\] in degrees is 361; use a number from -360 to 360"),
        (90, "processing.directions is 90; use text or a list"),
        ([["0", "1"]], r"processing.directions\[0\]\[0\] is '0'; use a number"),
    ],
)
def test_unusable_directions_are_refused_in_one_line(directions, message):
    with pytest.raises(ArgumentError, match=message) as caught:
        listed(directions)
    assert "\n" not in str(caught.value)


def test_unusable_directions_of_a_file_name_the_key():
    with pytest.raises(SettingsError, match=r"elevation of processing\.directions"):
        Settings.from_toml("processing.directions = [[0.0, 91.0]]")
