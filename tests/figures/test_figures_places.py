"""Plots show reflectors, echoes, sweeps, microphones and beams at their positions."""

from pathlib import Path

import numpy as np
import pytest

from ertis_numba import figures
from ertis_numba.base.errors import ArgumentError
from ertis_numba.figures._array import pattern_db, width_deg
from ertis_numba.figures._captions import of_image
from ertis_numba.figures._microphone_traces import echoes, signals
from ertis_numba.figures._signals import spectrogram
from ertis_numba.frames import Measurement, Peak
from ertis_numba.geometry import unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Array, Call, Settings
from ertis_numba.storage import open_recording
from tests.cases import words_of
from tests.figures.test_figures_kinds import ONE, SETTINGS, STAMP, heard, solid
from tests.files import image


def brightest(axes):
    """Position of the brightest pixel of the raster, in the coordinates of its axes."""
    shown = axes.images[0]
    values = np.ma.filled(shown.get_array(), -np.inf)
    row, column = np.unravel_index(np.nanargmax(values), values.shape)
    left, right, bottom, top = shown.get_extent()
    return (
        left + (column + 0.5) * (right - left) / values.shape[1],
        bottom + (row + 0.5) * (top - bottom) / values.shape[0],
    )


def with_reflector(azimuth_deg, elevation_deg, range_m):
    """Dark hemisphere with one reflector as wide as a beam, and the bin of its centre."""
    given = solid(3000, range_m=np.linspace(0.5, 5.0, 600))
    looks = unit_vectors(given.azimuth_rad, given.elevation_rad)
    middle = looks[np.argmax(looks @ unit_vectors(np.radians(azimuth_deg), np.radians(elevation_deg)))]
    beam = np.exp(-0.5 * (np.linalg.norm(looks - middle, axis=1) / 0.05) ** 2)
    pulse = np.exp(-0.5 * ((given.range_m - range_m) / 0.01) ** 2)
    amplitude = (beam[:, None] * pulse + 1e-4).astype(np.float32)
    return given.replace(amplitude=amplitude), range_m * middle


def test_slices_show_a_reflector_at_its_position():
    given, (ahead_m, left_m, up_m) = with_reflector(25.0, 12.0, 3.0)
    figure = figures.slices(given, height_m=float(up_m), left_m=float(left_m))
    level, upright = figure.axes[:2]
    assert brightest(level) == pytest.approx((left_m, ahead_m), abs=0.03)
    assert brightest(upright) == pytest.approx((ahead_m, up_m), abs=0.03)
    assert level.get_xlim()[0] > level.get_xlim()[1]  # y is to the left
    # Elsewhere there is nothing of it.
    other = figures.slices(given, height_m=float(up_m) + 1.0, left_m=float(left_m) - 1.0)
    assert [np.nanmax(axes.images[0].get_array()) for axes in other.axes[:2]] == pytest.approx([-40, -40], abs=1)


def test_slices_list_the_reflectors_in_their_planes_only():
    inside = Peak(azimuth_deg=20.0, elevation_deg=0.0, range_m=3.0, level_db=0.0)
    outside = Peak(azimuth_deg=-33.0, elevation_deg=40.0, range_m=3.0, level_db=-3.0)
    figure = figures.slices(solid(), peaks=[outside, inside])
    listed = "\n".join(text.get_text() for text in figure.texts)
    assert "+20.0°" in listed
    assert "33.0°" not in listed


@pytest.mark.parametrize("azimuth_deg", [0.0, 35.0])
def test_slices_show_a_single_direction_as_a_narrow_beam(azimuth_deg):
    """It is as wide as in a sector plot and does not fill the plane."""
    (axes, *_) = figures.slices(image([azimuth_deg], range_m=np.linspace(0.5, 5.0, 600))).axes
    (shown,) = axes.images
    rows, columns = np.nonzero(~np.ma.getmaskarray(np.ma.masked_invalid(shown.get_array())))
    (left, right, bottom, top), (height, width) = shown.get_extent(), shown.get_array().shape
    left_m = left + (columns + 0.5) * (right - left) / width
    ahead_m = bottom + (rows + 0.5) * (top - bottom) / height
    assert len(rows) > 1000
    assert np.degrees(np.arctan2(left_m, ahead_m)) == pytest.approx(azimuth_deg, abs=1.01)
    assert np.hypot(left_m, ahead_m).max() > 4.9


def test_slices_beside_a_single_direction_show_nothing():
    with pytest.raises(ArgumentError, match="height_m is 0, where the image shows nothing; use a plane that crosses"):
        figures.slices(image([0.0], [30.0]))


def test_projection_shows_a_reflector_at_its_position():
    given, place_m = with_reflector(-40.0, 20.0, 2.0)
    (axes, *_) = figures.projection(given).axes
    elevation_deg = np.degrees(np.arcsin(place_m[2] / 2.0))
    assert brightest(axes) == pytest.approx((np.degrees(np.arctan2(place_m[1], place_m[0])), elevation_deg), abs=1.0)


def test_polar_takes_the_strongest_elevation():
    given, place_m = with_reflector(30.0, 30.0, 3.0)
    (axes, *_) = figures.polar(given).axes
    azimuth_rad = np.arctan2(place_m[1], place_m[0])
    assert brightest(axes) == pytest.approx((-3 * np.sin(azimuth_rad), 3 * np.cos(azimuth_rad)), abs=0.12)


def test_reflectors_are_marked_in_their_planes():
    given, (ahead_m, left_m, up_m) = with_reflector(25.0, 12.0, 3.0)
    azimuth_deg, elevation_deg = np.degrees([np.arctan2(left_m, ahead_m), np.arcsin(up_m / 3)])
    peak = Peak(azimuth_deg=azimuth_deg, elevation_deg=elevation_deg, range_m=3.0, level_db=0.0)
    figure = figures.slices(given, height_m=float(up_m), peaks=[peak])  # the upright plane is elsewhere
    rings = [[line.get_xydata()[0] for line in axes.lines if line.get_marker() == "o"] for axes in figure.axes[:2]]
    np.testing.assert_allclose(rings[0], [[left_m, ahead_m]], atol=1e-9)
    assert rings[1] == []


@pytest.mark.parametrize(("start_hz", "stop_hz"), [(50_000.0, 25_000.0), (20_000.0, 80_000.0)])
def test_spectrogram_ridge_follows_the_sweep(start_hz, stop_hz):
    settings = SETTINGS.replace(call=Call(start_frequency_hz=start_hz, stop_frequency_hz=stop_hz))
    delay_s = 9e-3
    power, frequency_hz, times_s = spectrogram(signals(heard(1, delay_s, settings=settings)), settings)
    middle = (times_s > delay_s + 0.3e-3) & (times_s < delay_s + 2.2e-3)
    ridge_hz = frequency_hz[np.argmax(power[:, middle], axis=0)]
    share = (times_s[middle] - delay_s) / settings.call.duration_s
    swept_hz = 1 / (1 / start_hz + share * (1 / stop_hz - 1 / start_hz))
    assert np.count_nonzero(middle) > 20
    np.testing.assert_allclose(ridge_hz, swept_hz, rtol=0.04)


def test_signals_plot_shows_the_signals():
    measurement = heard()
    settings = measurement.settings
    given = signals(measurement)
    emitted = 0.5 * call_at(settings.call, given.axis - 9e-3)
    assert given.values.shape[0] == 32
    # Each bit is random, of which the low pass leaves a part: the mean over microphones is clean.
    np.testing.assert_allclose(given.values.mean(axis=0), emitted, atol=0.2)
    traces, spectra = figures.signals(measurement).axes[:2]
    assert len(traces.collections[0].get_segments()) == 32
    for row, segment in enumerate(traces.collections[0].get_segments()):
        inside = (segment[:, 0] > 9.2) & (segment[:, 0] < 11.3)
        height = np.abs(segment[:, 1] - row)
        assert height[inside].mean() > 1.3 * height[~inside].mean()
    across_ms, _ = brightest(spectra)
    assert 9.0 <= across_ms <= 11.6
    assert len(figures.signals(measurement, microphone=5).axes[0].collections[0].get_segments()) == 1


def test_signals_show_echoes_beside_a_louder_direct_sound():
    with open_recording(Path(__file__).parents[2] / "data" / "synthetic" / "reflectors.h5") as recording:
        measurement = recording[0]
    traces, spectra = figures.signals(measurement).axes[:2]
    for row, segment in enumerate(traces.collections[0].get_segments()):
        time_ms, height = segment[:, 0], np.abs(segment[:, 1] - row)
        direct, echo, noise = ((time_ms > low) & (time_ms < high) for low, high in ((0.5, 2), (7.5, 8.5), (31, 36)))
        assert height[echo].mean() > 0.3 * height[direct].mean()
        assert height[noise].mean() < 0.4 * height[echo].mean()
    assert spectra.get_ylim()[1] == pytest.approx(measurement.settings.signal_rate_hz / 2e3, rel=0.01)


def test_matched_filter_plot_has_the_echo_at_its_range():
    measurement = heard(32, 9e-3)
    at_m = sound_speed_m_s(measurement.settings.air) * 9e-3 / 2
    given = echoes(measurement)
    assert given.values.shape == (32, len(given.axis))
    assert given.axis[np.argmax(given.values, axis=1)] == pytest.approx(at_m, abs=1.5e-3)
    assert given.values.max(axis=1) == pytest.approx(0.5, abs=0.05)
    upper, lower = figures.matched_filter(measurement).axes[:2]
    curve = upper.lines[0]
    assert curve.get_xdata()[np.argmax(curve.get_ydata())] == pytest.approx(at_m, abs=2e-3)
    assert brightest(lower)[0] == pytest.approx(at_m, abs=5e-3)


def test_matched_filter_plot_removes_the_calibration():
    late_s, gain = (0.0, 40e-6), (1.0, 0.5)
    array = Array(layout="two", positions_m=((0, 0, 0), (0, 0.01, 0)), gain=gain, delay_s=late_s, word_bits=32)
    settings = SETTINGS.replace(array=array)
    time_s = np.arange(settings.recording.n_samples) / settings.recording.sample_rate_hz
    both = [0.6 * own * call_at(settings.call, time_s - 9e-3 - delay) for own, delay in zip(gain, late_s, strict=True)]
    given = echoes(Measurement(words_of(np.stack(both)), settings, STAMP))
    assert given.values.max(axis=1) == pytest.approx([0.6, 0.6], abs=0.05)
    assert np.ptp(given.axis[np.argmax(given.values, axis=1)]) < 2e-3


@pytest.mark.parametrize(("frequency_hz", "wanted_deg"), [(25e3, 10.7), (40e3, 6.7), (50e3, 5.35), (80e3, 3.3)])
def test_drawn_beam_width_is_that_of_the_array(frequency_hz, wanted_deg):
    """The drawn line of eRTIS_v3D1 with uniform weights falls to half the power at this width."""
    axes = figures.array(Settings(), frequencies_hz=[frequency_hz]).axes[1]
    assert width_deg(*axes.lines[0].get_data(), 0.0) == pytest.approx(wanted_deg, abs=0.06)
    assert f"{frequency_hz / 1e3:g} kHz" in axes.get_legend().get_texts()[0].get_text()


def test_beam_width_of_the_mean_power_of_the_band():
    axes = figures.array(Settings()).axes[1]
    reported = [text.get_text() for text in axes.get_legend().get_texts()]
    assert reported[2].startswith("25–50 kHz, mean power: 7.")
    assert width_deg(*axes.lines[2].get_data(), 0.0) == pytest.approx(7.1, abs=0.1)


def test_beam_pattern_of_a_line_equals_the_formula():
    """sin(Nψ/2) / (N sin(ψ/2)), whose first side lobe is at −13.15 dB for 16 microphones, steered to 20°."""
    count, spacing_m, frequency_hz = 16, 0.004, 40e3
    array = Array(layout="line", positions_m=tuple((0.0, spacing_m * mic, 0.0) for mic in range(count)), word_bits=16)
    settings = Settings(array=array)
    angle_deg = np.linspace(-90, 90, 721)
    level_db = pattern_db(settings, [frequency_hz], angle_deg, 0 * angle_deg, azimuth_deg=20, elevation_deg=0)
    wave_m = sound_speed_m_s(settings.air) / frequency_hz
    psi = 2 * np.pi * spacing_m / wave_m * (np.sin(np.radians(angle_deg)) - np.sin(np.radians(20)))
    wanted = np.abs(np.sinc(count * psi / 2 / np.pi) / np.sinc(psi / 2 / np.pi))
    np.testing.assert_allclose(10 ** (level_db / 20), wanted, atol=1e-5)
    assert angle_deg[np.argmax(level_db)] == pytest.approx(20)


def test_layout_plot_shows_the_microphone_positions():
    (axes, *_) = figures.array(Settings()).axes
    drawn_mm = axes.lines[0].get_xydata()
    assert drawn_mm.shape == (32, 2)
    assert drawn_mm.mean(axis=0) == pytest.approx([0, 0], abs=1e-9)
    assert np.ptp(drawn_mm, axis=0) == pytest.approx([83.1930 - 16.7401, 49.0132 - 11.4385])
    assert axes.get_xlim()[0] > axes.get_xlim()[1]  # y is to the left
    (left, right), (low, high) = axes.get_xlim(), axes.get_ylim()
    assert (left - right) / axes.bbox.width == pytest.approx((high - low) / axes.bbox.height)  # one scale
    assert {text.get_text() for text in axes.texts} <= {str(channel) for channel in range(32)}
    assert len(axes.texts) > 24


def test_single_microphone_has_no_beam_pattern():
    axes = figures.array(Settings(array=ONE)).axes[1]
    assert np.abs(axes.lines[0].get_ydata()).max() < 1e-9
    assert ": none" in axes.get_legend().get_texts()[0].get_text()


def words_of_page(figure):
    return " ".join(text.get_text() for text in [*figure.texts, *(axes.title for axes in figure.axes)])


@pytest.mark.parametrize("draw", [figures.plot, figures.polar, figures.projection, figures.slices])
def test_plot_of_an_empty_image_states_this(draw):
    """Colours alone would not show it."""
    given = image()
    assert "silence: all values are 0" in words_of_page(draw(given.replace(amplitude=np.zeros_like(given.amplitude))))


def test_heading_of_a_faint_image_states_this():
    given = image()
    assert not any("silence" in part or "full scale" in part for part in of_image(given).title)
    faint = given.amplitude * np.float32(1e-6 / given.amplitude.max())
    assert "the strongest is −120 dB of full scale" in of_image(given.replace(amplitude=faint)).title


def test_constant_bits_are_reported_in_the_plot():
    still = heard()
    still = Measurement(np.zeros_like(still.data), still.settings, still.stamp)
    assert "dB of full scale" in words_of_page(figures.matched_filter(still))
    assert "dB of full scale" not in words_of_page(figures.matched_filter(heard()))


@pytest.mark.parametrize("look", [{}, {"theme": "paper"}, {"theme": "paper", "columns": 1}])
@pytest.mark.parametrize("count", [0, 9])
def test_flat_picture_keeps_its_colour_bar_and_list(look, count):
    """The map of a planar image is a strip, which is useless without the list."""
    peaks = [Peak(azimuth_deg=10.0 * n, elevation_deg=0.0, range_m=1.0, level_db=-n) for n in range(count)]
    figure = figures.projection(image(), peaks=peaks, **look)
    figure.draw_without_rendering()
    scale = next(axes for axes in figure.axes if "dB re" in axes.get_xlabel() + axes.get_ylabel())
    length = max(scale.bbox.width, scale.bbox.height)
    label = scale.xaxis.label if scale.get_xlabel() else scale.yaxis.label
    extent = label.get_window_extent()
    assert max(extent.width, extent.height) < length
    listed = [text.get_text() for text in figure.texts if text.get_text().startswith(" #")]
    assert [len(rows.splitlines()) for rows in listed] == [count + 1] * bool(count)
    if count:
        (text,) = [text for text in figure.texts if text.get_text().startswith(" #")]
        assert text.get_window_extent().y0 > 0


def test_matched_filter_panels_share_the_0_db_reference():
    """It is the strongest microphone; the mean of all is below it."""
    given = heard()
    figure = figures.matched_filter(given)
    upper, lower, scale = figure.axes
    assert upper.get_ylabel() == scale.get_ylabel() == "dB re strongest"
    assert lower.images[0].get_array().max() == pytest.approx(0.0, abs=0.01)
    values = echoes(given).values
    mean_db = 20 * np.log10(np.sqrt(np.mean(values.astype(float) ** 2, axis=0)).max() / values.max())
    assert upper.lines[0].get_ydata().max() == pytest.approx(mean_db, abs=0.01)
    assert "mean of 32 microphones" in words_of_page(figure)
