"""Plots show the content of each kind of image at its position."""

import io

import matplotlib.colors
import numpy as np
import pytest
from matplotlib.figure import Figure

from ertis_numba.base.errors import ArgumentError
from ertis_numba.figures import _sampling, plot
from ertis_numba.frames import Peak
from ertis_numba.geometry import direction_grid, unit_vectors
from ertis_numba.settings import Processing
from tests.files import image

PEAKS = [
    Peak(azimuth_deg=30.0, elevation_deg=0.0, range_m=2.5, level_db=0.0),
    Peak(azimuth_deg=-20.0, elevation_deg=5.0, range_m=3.5, level_db=-12.0),
]


def solid(name, azimuth_deg=(-45.0, 45.0), elevation_deg=(-45.0, 45.0)):
    grid = direction_grid(
        Processing(directions=name, azimuth_limits_deg=azimuth_deg, elevation_limits_deg=elevation_deg)
    )
    return image(np.degrees(grid.azimuth_rad), np.degrees(grid.elevation_rad))


IMAGES = {
    "narrow": image(np.linspace(-20, 20, 9)),
    "full circle": image(np.linspace(-180, 180, 73)),
    "unsorted": image([40.0, -10.0, 0.0, 25.0]),
    "two directions": image([0.0, 1.0]),
    "same direction twice": image([10.0, 10.0]),
    "one direction": image([12.0]),
    "one direction, raised": image([12.0], [30.0]),
    "one range": image(range_m=[1.0]),
    "one direction, one range": image([0.0], range_m=[1.0]),
    "two ranges": image(range_m=[1.0, 1.5]),
    "from the sensor on": image(range_m=np.linspace(0.0, 0.3, 50)),
    "many ranges": image(range_m=np.linspace(0.2, 40.0, 4001)),
    "solid angle": solid("3d:200"),
    "hemisphere": solid("3d:300", (-90.0, 90.0), (-90.0, 90.0)),
    "one elevation": image(np.linspace(-30, 30, 7), np.full(7, 20.0)),
    "one azimuth": image(np.zeros(5), np.linspace(-30, 30, 5)),
    "two raised directions": image([0.0, 10.0], [5.0, 5.0]),
    "silence": image().replace(amplitude=np.zeros((37, 400), np.float32)),
}


def drawn(figure):
    """Pixels of a figure, at a low resolution for speed."""
    assert isinstance(figure, Figure)
    figure.set_dpi(40)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())


@pytest.mark.parametrize("name", IMAGES)
def test_every_image_can_be_drawn(name):
    assert drawn(plot(IMAGES[name], peaks=PEAKS)).std() > 10


@pytest.mark.parametrize(("theme", "page"), [("dark", "#0b0d12"), ("light", "#ffffff")])
def test_every_theme_is_drawn(theme, page):
    assert matplotlib.colors.to_hex(drawn(plot(image(), theme=theme))[0, 0, :3] / 255) == page


@pytest.fixture(scope="module")
def picture():
    return plot(image(), peaks=PEAKS)


@pytest.mark.parametrize("kind", ["png", "svg", "pdf"])
def test_every_format_is_written(picture, kind):
    file = io.BytesIO()
    picture.savefig(file, format=kind)
    assert len(file.getvalue()) > 10_000


def brightest_m(figure):
    """Position of the brightest pixel of the last raster, in the coordinates of its axes."""
    shown = [axes.images[0] for axes in figure.axes if axes.images and axes.get_label() != "<colorbar>"][-1]
    values = np.ma.filled(shown.get_array(), -np.inf)
    row, column = np.unravel_index(np.nanargmax(values), values.shape)
    left, right, bottom, top = shown.get_extent()
    return (
        left + (column + 0.5) * (right - left) / values.shape[1],
        bottom + (row + 0.5) * (top - bottom) / values.shape[0],
    )


@pytest.mark.parametrize(("azimuth_deg", "range_m"), [(-60.0, 1.0), (0.0, 4.5), (45.0, 3.0)])
def test_reflector_is_drawn_at_its_position(azimuth_deg, range_m):
    given = image()
    amplitude = np.full_like(given.amplitude, 1e-4)
    amplitude[
        np.argmin(np.abs(np.degrees(given.azimuth_rad) - azimuth_deg)), np.argmin(np.abs(given.range_m - range_m))
    ] = 1
    across_m, ahead_m = brightest_m(plot(given.replace(amplitude=amplitude)))
    azimuth_rad = np.radians(azimuth_deg)
    assert across_m == pytest.approx(-range_m * np.sin(azimuth_rad), abs=0.03)  # left is positive azimuth
    assert ahead_m == pytest.approx(range_m * np.cos(azimuth_rad), abs=0.03)


def test_reflector_between_pixels_is_drawn():
    level_db = np.full((3, 4001), -40.0, dtype=np.float32)
    level_db[1, 1234] = 0.0
    range_m, joined_db = _sampling.join_ranges(np.linspace(0.0, 40.0, 4001), level_db)
    assert joined_db.shape == (3, len(range_m))
    assert len(range_m) <= 501
    assert range_m[np.argmax(joined_db[1])] == pytest.approx(12.34, abs=0.05)
    assert joined_db.max() == 0.0


def test_sphere_raster_is_blank_without_directions():
    given = solid("3d:200")
    directions = unit_vectors(given.azimuth_rad, given.elevation_rad)
    raster = _sampling.sphere_raster(
        given.amplitude.max(axis=1),
        directions,
        azimuth_rad=np.radians([0.0, 80.0]),
        elevation_rad=np.radians([0.0]),
    )
    assert np.isfinite(raster[0, 0])
    assert np.isnan(raster[0, 1])


def test_caption_names_the_settings(picture):
    texts = " ".join(text.get_text() for text in picture.texts)
    for word in ("measurement 0", "eRTIS_v3D1", "call 25–50 kHz", "37 directions", "method fast", "20 °C", "+30.0°"):
        assert word in texts


def test_plot_refuses_invalid_arguments():
    with pytest.raises(ArgumentError, match="dynamic_range_db is 0; use a number above 0"):
        plot(image(), dynamic_range_db=0)
    with pytest.raises(ArgumentError, match="theme 'drak' is unknown "):
        plot(image(), theme="drak")
