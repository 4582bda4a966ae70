"""``plot(image, ax=…)`` draws into axes of the caller's figure."""

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import ertis_numba as ertis
from ertis_numba.geometry import direction_grid
from ertis_numba.settings import Processing
from tests.files import image

SOLID = direction_grid(Processing(directions="3d:200"))


def axes_of(count=1, **options):
    figure = Figure(figsize=(4 * count, 3))
    FigureCanvasAgg(figure)
    return figure.subplots(1, count, **options)


def drawn(axes):
    axes.figure.canvas.draw()
    return np.asarray(axes.figure.canvas.buffer_rgba())


@pytest.mark.parametrize("azimuth_deg", [np.linspace(-90, 90, 37), np.linspace(-180, 175, 72), [-5.0, 5.0]])
def test_planar_image_is_drawn_as_a_sector_to_scale(azimuth_deg):
    axes = axes_of()
    given = image(azimuth_deg)
    assert ertis.plot(given, ax=axes) is axes
    before = axes.get_position(original=True).bounds
    assert len(drawn(axes).reshape(-1, 4))
    assert axes.get_position(original=True).bounds == before
    assert axes.get_aspect() == 1
    (raster,) = axes.images
    assert raster.get_clim() == (-40, 0)
    left, right, bottom, top = raster.get_extent()
    assert (left, right, bottom, top) == (*axes.get_xlim(), *axes.get_ylim())
    assert top == pytest.approx(5.0, rel=0.01)


def test_image_with_elevations_is_drawn_as_a_map():
    axes = axes_of()
    solid = image(np.degrees(SOLID.azimuth_rad), np.degrees(SOLID.elevation_rad))
    ertis.plot(solid, ax=axes, dynamic_range_db=30, side_lobes=True)
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("azimuth (°)", "elevation (°)")
    assert axes.get_xlim()[0] > axes.get_xlim()[1]  # Positive azimuths, towards +y, are on the left.
    assert axes.images[-1].get_clim() == (-30, 0)
    assert len(drawn(axes).reshape(-1, 4))


def test_image_of_one_direction_is_drawn_as_a_curve():
    axes = axes_of()
    given = image([0.0])
    ertis.plot(given, ax=axes)
    (curve,) = axes.lines
    assert np.array_equal(curve.get_xdata(), given.range_m)
    assert curve.get_ydata() == pytest.approx(np.maximum(given.level_db[0], -40), abs=1e-4)
    assert axes.get_xlabel() == "range (m)"


def test_peaks_are_marked_and_other_axes_stay_empty():
    axes, other = axes_of(2)
    ertis.plot(image(), ax=axes, peaks=ertis.find_peaks(image(), top=1), font="serif")
    assert "1" in {text.get_text() for text in axes.texts}
    assert not [*other.images, *other.lines, *other.texts]
    figure = axes.figure
    bar = figure.colorbar(axes.images[-1], ax=axes)
    assert (bar.vmin, bar.vmax) == (-40, 0)
    figure.canvas.draw()


def test_plot_without_axes_draws_a_page():
    page = ertis.plot(image(), theme="light")
    assert isinstance(page, Figure)
    assert [axes.get_ylabel() for axes in page.axes] == ["", "dB re strongest"]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ertis.plot(image(), ax=Figure()), "ax is of type Figure; pass rectilinear Axes"),
        (lambda: ertis.plot(image(), ax=axes_of(2)), "ax is of type ndarray; pass rectilinear Axes"),
        (
            lambda: ertis.plot(image(), ax=axes_of(subplot_kw={"projection": "polar"})),
            "ax is polar axes; pass rectilinear Axes, such as matplotlib.pyplot.subplots returns",
        ),
        (lambda: ertis.plot(image().amplitude, ax=axes_of()), "image is of type ndarray; pass an "),
        (lambda: ertis.plot(image(), ax=axes_of(), theme="blue"), "theme 'blue' is unknown"),
        (lambda: ertis.plot(image(), ax=axes_of(), dynamic_range_db=0), "dynamic_range_db is 0"),
        (lambda: ertis.plot(3), "image is of type int; pass an "),
    ],
)
def test_plot_refuses_unusable_arguments_in_one_line(call, message):
    with pytest.raises(ertis.ArgumentError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)
