"""Plots of directions all around, behind the sensor and with gaps, and of large, small and single ranges."""

import numpy as np
import pytest

from ertis_numba import figures
from ertis_numba.figures._captions import number, span
from ertis_numba.figures._microphone_traces import MicrophoneTraces
from ertis_numba.figures._signals import spectrogram
from ertis_numba.frames import Peak
from ertis_numba.geometry import unrolled_rad
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Array, Call, Recording, Settings
from tests.files import image

REAR = np.concatenate([np.arange(-180, -99, 3), np.arange(100, 178, 3)])


def shown_at(axes, azimuth_deg, range_m=3.0):
    """Levels that a sector shows at given positions; NaN where it is blank."""
    (shown,) = axes.images
    values = np.ma.filled(shown.get_array(), np.nan)
    left, right, bottom, top = shown.get_extent()
    azimuth_rad = np.radians(np.asarray(azimuth_deg, dtype=float))
    row = np.floor((range_m * np.cos(azimuth_rad) - bottom) / (top - bottom) * values.shape[0]).astype(int)
    column = np.floor((-range_m * np.sin(azimuth_rad) - left) / (right - left) * values.shape[1]).astype(int)
    inside = (row >= 0) & (row < values.shape[0]) & (column >= 0) & (column < values.shape[1])
    return np.where(inside, values[np.where(inside, row, 0), np.where(inside, column, 0)], np.nan)


def names_of(axes):
    return [text.get_text() for text in axes.texts]


@pytest.mark.parametrize(
    ("azimuth_deg", "closed_deg", "first_deg", "last_deg"),
    [
        (np.linspace(-90, 90, 37), 7.5, -90, 90),
        (np.arange(100, 261, 2), 3.0, 100, 260),
        (np.arange(200, 341), 1.5, -160, -20),
        (np.linspace(120, 180, 7), 15.0, 120, 180),
        (np.arange(0, 358, 3), 4.5, -177, 180),
        (REAR, 4.5, 100, 258),
        ([170, -170], 0.0, 170, 190),
        ([-90, 90], 0.0, -90, 90),
        ([-90, 0, 90], 135.0, -90, 90),
    ],
)
def test_azimuths_are_continuous_except_at_the_widest_gap(azimuth_deg, closed_deg, first_deg, last_deg):
    given = np.radians(np.asarray(azimuth_deg, dtype=float))
    moved_deg = np.degrees(unrolled_rad(given, np.radians(closed_deg)))
    assert (moved_deg.min(), moved_deg.max()) == pytest.approx((first_deg, last_deg))
    turns = (moved_deg - azimuth_deg) / 360
    np.testing.assert_allclose(turns, np.rint(turns), atol=1e-9)


@pytest.mark.parametrize("azimuth_deg", [np.arange(100, 261, 2), REAR])
def test_polar_plot_shows_directions_behind_the_sensor_only(azimuth_deg):
    (axes, *_) = figures.polar(image(azimuth_deg)).axes
    assert np.isfinite(shown_at(axes, (101, 140, 178.5, 180, -178.5, -140, -102))).all()
    assert np.isnan(shown_at(axes, (97, 90, 30, 0, -60, -90, -96))).all()
    assert [name for name in names_of(axes) if "°" in name] == ["+120°", "+150°", "+180°", "−150°", "−120°"]


@pytest.mark.parametrize("azimuth_deg", [np.arange(-180, 178, 3), np.arange(0, 358, 3)])
def test_polar_plot_has_no_gap_between_last_and_first_direction(azimuth_deg):
    (axes, *_) = figures.polar(image(azimuth_deg)).axes
    assert np.isfinite(shown_at(axes, np.arange(-180, 180, 0.7))).all()
    assert "+180°" in names_of(axes)
    assert "−180°" not in names_of(axes)


def test_polar_plot_is_blank_between_distant_directions():
    (two, *_) = figures.polar(image([-30.0, 30.0])).axes
    assert np.isnan(shown_at(two, (-28, -15, 0, 15, 28))).all()
    assert np.isfinite(shown_at(two, (-29.5, 29.5))).all()
    (gap, *_) = figures.polar(image([*range(-60, -19, 4), *range(20, 61, 4)])).axes
    assert np.isfinite(shown_at(gap, (-58, -22, -16, 16, 22, 58))).all()
    assert np.isnan(shown_at(gap, (-14, 0, 14))).all()
    (coarser_behind, *_) = figures.polar(image([*range(-180, -30, 10), *range(-30, 30, 2), *range(30, 180, 10)])).axes
    assert np.isfinite(shown_at(coarser_behind, np.arange(-180, 180, 0.7))).all()


def test_projection_marks_reflectors_behind_the_sensor():
    """Labels are from -180 to 180°, for any convention of the directions."""
    peaks = [Peak(azimuth_deg=at_deg, elevation_deg=0.0, range_m=2.0, level_db=0.0) for at_deg in (-142.0, 157.0)]
    figure = figures.projection(image(np.arange(100, 261, 2)), peaks=peaks)
    (axes, *_) = figure.axes
    rings = [line.get_xdata()[0] for line in axes.lines if line.get_marker() == "o"]
    assert sorted(rings) == pytest.approx([157.0, 218.0])
    figure.draw_without_rendering()
    assert {"−150", "180", "150"} <= {text.get_text() for text in axes.get_xticklabels()}


def test_spectrogram_of_a_long_record_shows_all_echoes():
    """All 20 sweeps in 2.6 s are complete, although a column is longer than a sweep."""
    recording = Recording(encoding="float32", sample_rate_hz=192e3, n_samples=500_000)
    settings = Settings(recording=recording, array=Array(layout="one", positions_m=((0.0, 0.0, 0.0),)), call=Call())
    time_s = np.arange(500_000) / settings.signal_rate_hz
    starts_s = 0.05 + 0.123 * np.arange(20)
    signal = sum(call_at(settings.call, time_s - start_s) for start_s in starts_s)
    given = MicrophoneTraces(np.asarray(signal, dtype=np.float32)[None], time_s, np.array([0]))
    power, frequency_hz, times_s = spectrogram(given, settings)
    assert len(times_s) == 600
    swept = power[(frequency_hz > 28e3) & (frequency_hz < 46e3)]
    for start_s in starts_s:
        near = swept[:, np.abs(times_s - start_s - 1.25e-3) < 6e-3].max(axis=1)
        assert 10 * np.log10(near.min() / power.max()) > -9


@pytest.mark.parametrize(("length_m", "wanted"), [(1.0, "0.344°"), (2.0, "0.172°"), (10.9, "0.0315°")])
def test_beam_width_of_a_large_array_matches_the_formula(length_m, wanted):
    """It is 0.886 λ / (N d) for a line with uniform weights."""
    positions_m = tuple((0.0, y_m, 0.0) for y_m in np.linspace(-length_m / 2, length_m / 2, 64))
    settings = Settings(array=Array(layout="line", positions_m=positions_m, word_bits=32))
    axes = figures.array(settings, frequencies_hz=[50e3]).axes[1]
    assert axes.get_legend().get_texts()[0].get_text() == f"50 kHz: {wanted}"


@pytest.mark.parametrize(
    ("value", "digits", "wanted"),
    [
        (1300.4, 3, "1300"),
        (10_900.0, 3, "10900"),
        (2604.17, 4, "2604"),
        (0.5, 3, "0.5"),
        (4.998, 3, "5"),
        (1e-5, 6, "0.00001"),
        (123.456, 6, "123.456"),
        (0.0, 3, "0"),
        (100.0, 3, "100"),
    ],
)
def test_numbers_have_no_exponents(value, digits, wanted):
    assert number(value, digits) == wanted


def test_intervals_include_their_end():
    assert span(np.array([5.0, 600.0, 1299.6])) == "5–1300"
    assert span(np.array([3.0, 3.0011])) == "3–3.001"
    assert span(np.array([3.0])) == "3"


@pytest.mark.parametrize("draw", [figures.polar, figures.slices])
def test_single_range_is_visible(draw):
    figure = draw(image(range_m=[3.0]))
    assert "3 m in 1 range ·" in " ".join(text.get_text() for text in figure.texts).replace("\n", " · ")
    assert np.isfinite(figure.axes[0].images[0].get_array()).mean() > 0.005


@pytest.mark.parametrize(
    ("range_m", "wanted"), [(123.4, "123.40 m"), (4.4, "4.40 m"), (0.044, "0.0440 m"), (0.0033, "0.00330 m")]
)
def test_listed_ranges_have_three_digits(range_m, wanted):
    peaks = [Peak(azimuth_deg=0.0, elevation_deg=0.0, range_m=share * range_m, level_db=0.0) for share in (1, 0.5)]
    figure = figures.plot(image(range_m=np.linspace(range_m / 9, range_m * 1.1, 50)), peaks=peaks)
    (listed,) = [text.get_text() for text in figure.texts if text.get_text().startswith(" #")]
    assert wanted in listed
    first, second = listed.splitlines()[1:]
    assert first.index(" m ") == second.index(" m ")


def test_last_range_ring_has_a_label():
    """The last range of 0.5 to 5 m is less than a pixel before 5 m."""
    assert "5 m" in names_of(figures.plot(image(range_m=np.linspace(0.5, 4.998, 300))).axes[0])
    assert "5 m" not in names_of(figures.plot(image(range_m=np.linspace(0.5, 4.95, 300))).axes[0])
