"""Sensors whose microphones are on a line: no file, message or table states a place that they do not observe."""

import shlex

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba.base.errors import ArgumentError
from ertis_numba.interop import export
from ertis_numba.interop.ros_messages import points_message
from ertis_numba.storage import RecordingWriter, write_energyscapes
from tests.small_platforms import HEIGHT_M, images_of, mounted, rendered, settings_of

MM = 1e-3
LINES = {
    "horizontal": [(0.0, 3 * MM * mic, 0.0) for mic in range(16)],
    "inclined": [(0.0, 2 * MM * mic, 2 * MM * mic) for mic in range(16)],
}
ABOVE_DEG = 35.0
MOUNTINGS = mounted(2)


def line_settings(kind, directions="2d:91"):
    made = settings_of(directions)
    return made.replace(array=made.array.replace(layout="line", positions_m=tuple(LINES[kind])))


def places_above():
    """A reflector ahead of each sensor, 35° above the plane, and one beside it in the plane."""
    up = np.radians(ABOVE_DEG)
    ahead = np.array([0.2 + 1.6 * np.cos(up), 0.0, HEIGHT_M + 1.6 * np.sin(up)])
    return np.array([ahead, (1.4, 0.5, HEIGHT_M), (0.3, 1.7, HEIGHT_M)])


def heard(settings):
    return rendered(MOUNTINGS, settings, places_above(), np.zeros(3), diameter_m=0.0, random=np.random.default_rng(3))


@pytest.fixture(scope="module")
def fused():
    settings = line_settings("horizontal")
    return ertis.fuse(images_of(heard(settings), settings).values(), MOUNTINGS, emitter_diameter_m=0.0)


def test_export_of_fused_lines_states_no_uncertainty_that_is_too_small(fused, tmp_path):
    image = fused.image
    (path,) = export(tmp_path / "points.csv", [image])
    rows = np.genfromtxt(path, delimiter=",", names=True, dtype=None, encoding="utf-8")
    listed_m = np.stack([rows["x_m"], rows["y_m"], rows["z_m"]], axis=1)
    away_m = np.linalg.norm(listed_m[:, None] - places_above(), axis=2)
    assert away_m[:, 0].min() > 0.5  # The place of the reflector above the plane is nowhere.
    assert away_m.min(axis=0)[1:].max() < 0.02
    assert np.isinf(rows["uncertainty_across_m"]).all()


def test_peaks_of_fused_lines_have_no_elevation(fused):
    peaks = ertis.find_peaks(fused.image)
    assert peaks
    assert np.isnan([peak.elevation_deg for peak in peaks]).all()


@pytest.mark.parametrize(
    ("kind", "directions", "remedy"),
    [
        ("horizontal", "3d:300", "the elevation is unknown.*process with 2d:N directions"),
        ("inclined", "3d:300", "on an inclined line.*use an array with microphones in a plane"),
        ("inclined", "2d:31", "on an inclined line.*use an array with microphones in a plane"),
    ],
)
def test_fusion_and_odometry_refuse_arrays_without_places(kind, directions, remedy):
    settings = line_settings(kind, directions)
    images = images_of({"front": np.zeros((6400, 16), np.float32)}, settings)
    with pytest.raises(ArgumentError, match=f"sensor front .*{remedy}"):
        ertis.fuse(images.values(), MOUNTINGS)
    with pytest.raises(ArgumentError, match=f"sensor front .*{remedy}"):
        ertis.Odometry(MOUNTINGS).add(images.values())


def test_points_of_a_line_have_no_uncertainty_that_is_too_small():
    settings = line_settings("horizontal")
    image = images_of({"front": heard(settings)["front"]}, settings)["front"]
    cloud = ertis.PointExtractor(settings)(image)
    assert len(cloud)
    assert np.isinf(cloud.uncertainty_m[:, 1]).all()
    sent = np.frombuffer(points_message(cloud)["data"], "<f4").reshape(len(cloud), -1)
    assert np.isinf(sent[:, 5]).all()


@pytest.fixture
def files(tmp_path):
    """Recording and image of two sensors with microphones on a horizontal line."""
    settings = line_settings("horizontal")
    recording = tmp_path / "lines.h5"
    with RecordingWriter(recording, mounting=MOUNTINGS) as writer:
        for name, signal in heard(settings).items():
            for number in range(2):
                stamp = ertis.Stamp(
                    sensor=name, sequence=number, sync_count=number, timestamp_ns=10**18 + 10**8 * number
                )
                writer.write(ertis.Measurement(signal, settings, stamp))
    return recording, write_energyscapes(tmp_path / "one.h5", [*images_of(heard(settings), settings).values()])


def test_commands_that_state_places_note_the_unknown_elevation(files, tmp_path):
    recording, images = files
    commands = [
        f"fuse {recording} -o {tmp_path / 'fused.h5'} --emitter-diameter 0",
        f"peaks {tmp_path / 'fused.h5'}",
        f"export {tmp_path / 'fused.h5'} -o {tmp_path / 'fused.ply'}",
        f"export {recording} -o {tmp_path / 'points.csv'}",
        f"export {images} --sensor front -o {tmp_path / 'points.pcd'}",
        f"odometry {recording} -o {tmp_path / 'path.tum'}",  # It has too few reflectors.
    ]
    for command in commands:
        done = CliRunner().invoke(cli, shlex.split(command))
        assert done.exit_code == command.startswith("odometry"), (command, done.stderr, done.exception)
        assert "has its microphones on a horizontal line; the elevation is unknown" in done.stderr, command
