"""Reference imaging against physics: synthetic echoes, noise gain, beam widths and a real measurement."""

import importlib.metadata

import numpy as np
import pytest

from ertis_numba.geometry import microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import call_at
from ertis_numba.settings import Array, Call, Recording, Settings
from tests import reference
from tests.cases import SHORT, noise, words_of

SPEED_M_S = 343.0  # The beam widths in physics.md use this speed.


def directions_of(azimuth_deg):
    azimuth_rad = np.radians(np.atleast_1d(np.asarray(azimuth_deg, dtype=np.float64)))
    return unit_vectors(azimuth_rad, np.zeros_like(azimuth_rad))


def received(settings: Settings, path_m):
    """Return the samples of one echo of amplitude 0.9 for path lengths of shape (mic,)."""
    time_s = np.arange(settings.recording.n_samples) / settings.recording.sample_rate_hz
    arrival_s = np.asarray(path_m) / sound_speed_m_s(settings.air)
    return words_of(0.9 * call_at(settings.call, time_s - arrival_s[:, None]))


@pytest.mark.parametrize("call", [Call(), Call(start_frequency_hz=80e3, stop_frequency_hz=20e3)])
def test_plane_wave_has_its_amplitude_and_position(call):
    settings = SHORT.replace(call=call)
    positions_m = microphones(settings.array).enabled_positions_m
    words = received(settings, 2 * 0.7 - positions_m @ directions_of(25.0)[0])
    range_m = 0.7 + np.arange(-40, 41) * 1e-4
    azimuth_deg = 25.0 + np.arange(-5, 6)
    image = reference.exact(words, settings, directions_of(azimuth_deg), range_m)
    direction, distance = np.unravel_index(np.argmax(image), image.shape)
    assert azimuth_deg[direction] == 25.0
    assert range_m[distance] == pytest.approx(0.7, abs=2e-4)
    assert image.max() == pytest.approx(0.9, rel=0.01)


def test_near_point_requires_spherical_delays():
    settings = SHORT
    positions_m = microphones(settings.array).enabled_positions_m
    point_m = 0.3 * directions_of(10.0)[0]
    words = received(settings, 0.3 + np.linalg.norm(point_m - positions_m, axis=1))
    plane, spherical = (
        reference.exact(words, settings, directions_of(10.0), [0.3], spherical=spherical)[0, 0]
        for spherical in (False, True)
    )
    assert spherical == pytest.approx(0.9, rel=0.01)
    assert plane < 0.96 * spherical


def test_spherical_delays_of_a_small_array_are_plane():
    tiny = SHORT.replace(array=Array(layout="pair", positions_m=((0.0, 1e-4, 0.0), (0.0, -1e-4, 0.0)), word_bits=8))
    plane, spherical = (
        reference.exact(noise(tiny).data, tiny, directions_of([-40.0, 40.0]), [1.5], spherical=spherical)
        for spherical in (False, True)
    )
    assert reference.error_db(plane, spherical) < -80


def test_gain_of_32_microphones_on_white_noise_is_15_db():
    settings = Settings(recording=Recording(n_samples=163_840))
    range_m = np.linspace(0.2, 5.5, 750)
    power = np.mean(reference.exact(noise(settings).data, settings, directions_of(0.0), range_m) ** 2)
    single = Settings(array=Array(layout="one", positions_m=((0.0, 0.0, 0.0),), word_bits=8))
    power_1 = np.mean(
        [reference.exact(noise(single, seed).data, single, directions_of(0.0), range_m) ** 2 for seed in range(4)]
    )
    assert 10 * np.log10(power_1 / power) == pytest.approx(15.05, abs=0.3)


def beam_width_deg(frequency_hz, weights=None):
    """Return the half-power width of the azimuth cut, with power averaged over frequencies."""
    azimuth_deg = np.linspace(-15, 15, 3001)
    path_m = directions_of(azimuth_deg) @ microphones(Array(layout="eRTIS_v3D1")).enabled_positions_m.T
    wave_1_m = 2 * np.pi * np.asarray(frequency_hz) / SPEED_M_S
    power = np.average([np.abs(np.exp(1j * k * path_m).mean(axis=1)) ** 2 for k in wave_1_m], axis=0, weights=weights)
    wide = azimuth_deg[power > power.max() / 2]
    return wide[-1] - wide[0]


@pytest.mark.parametrize(
    ("frequency_hz", "width_deg"),
    [([25e3], 10.7), ([40e3], 6.7), ([50e3], 5.35), ([80e3], 3.3), (np.linspace(25e3, 50e3, 101), 7.1)],
)
def test_beam_pattern_has_the_width_of_the_formula(frequency_hz, width_deg):
    assert beam_width_deg(frequency_hz) == pytest.approx(width_deg, rel=0.01)


def test_image_beam_has_the_width_of_the_beam_pattern():
    positions_m = microphones(SHORT.array).enabled_positions_m
    words = received(SHORT, 2 * 0.7 - positions_m @ directions_of(0.0)[0])
    azimuth_deg = np.linspace(-6, 6, 121)
    image = reference.exact(words, SHORT, directions_of(azimuth_deg), 0.7 + np.arange(-60, 61) * 5e-4)
    amplitude = np.sum(image**2, axis=1)  # Summing over ranges also sums over the band.
    wide = azimuth_deg[amplitude > amplitude.max() / 2]
    # A hyperbolic sweep has spectral power in proportion to 1 / f², and the matched filter weights by it again.
    frequency_hz = np.linspace(25e3, 50e3, 101)
    expected_deg = beam_width_deg(frequency_hz, weights=frequency_hz**-4.0)
    assert wide[-1] - wide[0] == pytest.approx(expected_deg, abs=0.3)


@pytest.fixture(scope="module")
def real_words():
    path = importlib.metadata.distribution("rtisdev").locate_file("rtisdev/simulate.bin")
    return np.fromfile(str(path), dtype="<u4")


def test_real_measurement_is_sharp_with_its_own_channels_only(real_words):
    range_m = np.arange(0.8, 5.0, 0.0076)
    peak_over_rms = {}
    for layout in ("eRTIS_v3D1", "eRTIS_v2"):
        image = reference.exact(
            real_words, Settings(array=Array(layout=layout)), directions_of(np.linspace(-90, 90, 61)), range_m
        )
        peak_over_rms[layout] = image.max() / np.sqrt(np.mean(image**2))
    assert peak_over_rms["eRTIS_v3D1"] > 3 * peak_over_rms["eRTIS_v2"]


def test_whole_sample_delays_cost_21_db_on_the_real_measurement(real_words):
    settings, range_m = Settings(), np.arange(0.5, 5.0, 0.0076)
    directions = directions_of(np.linspace(-90, 90, 91))
    exact = reference.exact(real_words, settings, directions, range_m)
    rounded = reference.exact(real_words, settings, directions, range_m, delay_rate_hz=450e3)
    assert reference.error_db(rounded, exact) == pytest.approx(-21.7, abs=0.7)
