"""Angles that an array cannot observe appear nowhere: tables, plots, exports, points."""

import json
import shlex

import numpy as np
import pytest
from click.testing import CliRunner
from ertis_cli.main import cli

import ertis_numba as ertis
from ertis_numba import figures
from ertis_numba.base.errors import ArgumentError
from ertis_numba.geometry import Grid, direction_grid, direction_note, load_layout, observable_angles
from ertis_numba.interop import export
from ertis_numba.settings import Array, Processing
from ertis_numba.storage import write_energyscapes
from tests.analysis.test_detect import image_of
from tests.files import SMALL, image

MM = 1e-3
LINES = {
    "y": [(0, 3 * MM * k, 0) for k in range(16)],
    "z": [(0, 0, 3 * MM * k) for k in range(16)],
    "x": [(3 * MM * k, 0, 0) for k in range(16)],
    "inclined": [(0, 2 * MM * k, 2 * MM * k) for k in range(16)],
}
ONE = [(0.0, 0.0, 0.0)]
SPHERE = Grid(*np.radians(np.random.default_rng(1).uniform((-180, -90), (180, 90), (200, 2)).T))
AHEAD = direction_grid(Processing(directions="3d:200"))


def array_of(positions_m, **changes):
    return Array(positions_m=tuple(tuple(map(float, place)) for place in positions_m), **changes)


@pytest.mark.parametrize(
    ("array", "grid", "angles", "note"),
    [
        (array_of(ONE), AHEAD, (False, False), "has one microphone; its images show ranges but no directions"),
        (array_of([(0, 0.01, 0)] * 3), AHEAD, (False, False), "has 3 microphones at the same position"),
        (array_of(LINES["y"]), AHEAD, (True, False), "on a horizontal line; the elevation is unknown"),
        (array_of(LINES["x"]), AHEAD, (True, False), "left and right cannot be distinguished"),
        (array_of(LINES["z"]), AHEAD, (False, True), "on a vertical line; the azimuth is unknown"),
        (array_of(LINES["inclined"]), AHEAD, (False, False), "on an inclined line"),
        (Array(), AHEAD, (True, True), None),
        (Array(), SPHERE, (True, True), "in a plane, so it cannot distinguish the two sides"),
        (array_of([(0, 0, 0), (0.01, 0, 0), (0, 0.01, 0), (0, 0, 0.01)]), SPHERE, (True, True), None),
        (
            Array(disabled=tuple(range(1, len(load_layout("eRTIS_v3D1").enabled)))),
            AHEAD,
            (False, False),
            "has one microphone",
        ),
    ],
)
def test_positions_determine_the_observable_angles(array, grid, angles, note):
    seen = observable_angles(array, grid)
    assert seen[:2] == angles
    assert (note is None and seen.note is None) or note in seen.note


SPATIAL = array_of([(0, 0, 0), (0.01, 0, 0), (0, 0.01, 0), (0, 0, 0.01)])


@pytest.mark.parametrize(
    ("array", "directions", "is_passive", "note"),
    [
        (Array(), "3d:200", False, None),
        (Array(), "3d:200", True, "sound from behind this plane appears in front of it"),
        (SPATIAL, "3d:200", True, None),
        (SPATIAL, "2d:31", True, "directions at one elevation, 0°"),
        (Array(), "2d:31", True, "locate it; it also has its microphones in a plane, so sound from behind"),
        (Array(), "2d:1", False, "one direction, azimuth 0°, elevation 0°, so sound from elsewhere appears there"),
        (Array(), ((10.0, 5.0), (10.0, 5.0)), False, "one direction, azimuth 10°, elevation 5°"),
        (array_of(LINES["y"]), "2d:31", True, "on a horizontal line; the elevation is unknown"),
        (array_of(ONE), "2d:31", True, "has one microphone"),
    ],
)
def test_note_names_directions_that_a_grid_cannot_show(array, directions, is_passive, note):
    text = direction_note(array, direction_grid(Processing(directions=directions)), is_passive=is_passive)
    assert text is None if note is None else note in text


def heard_by(positions_m, reflectors, *, directions):
    """Image of echoes as an array hears them."""
    settings = ertis.Settings().replace(array=array_of(positions_m))
    return image_of(reflectors, directions=directions, range_m=(0.9, 1.3), settings=settings)


def test_line_of_microphones_lists_the_azimuth_at_elevation_0():
    true_deg = np.degrees(np.arcsin(np.sin(np.radians(40)) * np.cos(np.radians(30))))
    image = heard_by(LINES["y"], [(40, 30, 1.1, 1.0)], directions="3d:1500")
    (peak,) = ertis.find_peaks(image, min_level_db=-10)
    assert peak.azimuth_deg == pytest.approx(true_deg, abs=2.5)
    assert np.isnan(peak.elevation_deg)
    assert peak.range_m == pytest.approx(1.1, abs=2e-3)


@pytest.mark.parametrize(
    ("positions_m", "known"), [(LINES["z"], "elevation_deg"), (LINES["inclined"], None), (ONE, None)]
)
def test_unknown_angles_are_not_listed(positions_m, known):
    (peak,) = ertis.find_peaks(heard_by(positions_m, [(20, 10, 1.1, 1.0)], directions="3d:600"), min_level_db=-10)
    for name in ("azimuth_deg", "elevation_deg"):
        assert np.isnan(getattr(peak, name)) == (name != known)
    assert np.isnan(peak.grid_error_deg) == (known is None)  # There is no direction that could be in error.
    assert peak.range_m == pytest.approx(1.1, abs=2e-3)
    if known is not None:
        assert peak.elevation_deg == pytest.approx(10, abs=1.5)


@pytest.fixture
def one(tmp_path):
    """File with an image of one microphone."""
    image = heard_by(ONE, [(20, 0, 1.1, 1.0)], directions="2d:91")
    return image, write_energyscapes(tmp_path / "one.h5", [image])


def run(command, code=0):
    done = CliRunner().invoke(cli, shlex.split(command))
    assert done.exit_code == code, (done.stderr, done.exception)
    return done


def test_table_has_a_dash_for_unknown_angles(one):
    _, path = one
    done = run(f"peaks {path} --top 1")
    assert "grid_error_deg" not in done.stdout
    assert done.stdout.splitlines()[1].split()[2:5] == ["–", "–", "1.100"]
    assert done.stderr.count("has one microphone; its images show ranges but no directions") == 1
    (row,) = json.loads(run(f"peaks {path} --top 1 --json").stdout)["peaks"]
    assert (row["azimuth_deg"], row["elevation_deg"], round(row["range_m"], 2)) == (None, None, 1.1)


def test_plot_of_one_microphone_is_a_curve_over_range(one, tmp_path):
    image, path = one
    figure = figures.plot(image, peaks=ertis.find_peaks(image))
    assert [axes.get_xlabel() for axes in figure.axes if axes.get_xlabel()] == ["range (m)"]
    texts = " ".join(text.get_text() for text in figure.findobj(lambda each: hasattr(each, "get_text")))
    assert "no direction" in texts
    assert "–" in texts
    for kind in ("polar", "projection", "slices"):
        with pytest.raises(ArgumentError, match=r"has one microphone; .* draw a curve over range"):
            getattr(figures, kind)(image)
    stated = run(f"plot {path} --kind polar -o {tmp_path / 'polar.png'}", code=1).stderr
    assert "draw a curve over range with ertis.plot ('ertis plot --kind image'" in stated
    assert not (tmp_path / "polar.png").exists()


@pytest.mark.parametrize("ending", ["csv", "ply", "pcd"])
def test_points_of_one_microphone_are_refused(one, tmp_path, ending):
    image, _ = one
    target = tmp_path / f"points.{ending}"
    with pytest.raises(ArgumentError, match=rf"has one microphone; .* so format '{ending}' cannot place points"):
        export(target, [image])
    assert not target.exists()
    assert len(ertis.PointExtractor(image.settings)(image)) == 0


@pytest.mark.parametrize("ending", ["csv", "ply", "pcd"])
def test_points_of_an_inclined_line_are_refused(tmp_path, ending):
    positions_m = tuple((0.0, 0.004 * mic, 0.004 * mic) for mic in range(8))
    inclined = image(settings=SMALL.replace(array=Array(layout="inclined", positions_m=positions_m, word_bits=8)))
    with pytest.raises(ArgumentError, match=rf"on an inclined line; .* so format '{ending}' cannot place points"):
        export(tmp_path / f"points.{ending}", [inclined])
    assert not (tmp_path / f"points.{ending}").exists()


def test_angles_of_one_microphone_are_nan_in_npz(one, tmp_path):
    image, _ = one
    export(tmp_path / "one.npz", [image])
    with np.load(tmp_path / "one.npz") as found:
        assert np.isnan(found["azimuth_rad"]).all()
        assert np.isnan(found["elevation_rad"]).all()
        assert found["range_m"] == pytest.approx(image.range_m)
