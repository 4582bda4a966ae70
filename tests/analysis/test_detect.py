"""Peak detection in images computed from closed forms."""

import math

import numpy as np
import pytest

from ertis_numba.analysis.detect import find_peaks
from ertis_numba.analysis.noise import noise_of
from ertis_numba.analysis.points import PointExtractor
from ertis_numba.analysis.side_lobes import without_side_lobes
from ertis_numba.base.errors import ArgumentError
from ertis_numba.frames import Energyscape
from ertis_numba.frames.level_codes import LevelCodes
from ertis_numba.geometry import direction_grid, microphones, unit_vectors
from ertis_numba.geometry.air import sound_speed_m_s
from ertis_numba.geometry.waveform import matched_filter_spectrum
from ertis_numba.settings import Processing, Recording, Settings


def image_of(reflectors, *, directions="2d:181", range_m=(0.8, 1.6), noise=0.0, errors_m=0.0, settings=None):
    """Return the image of ideal far reflectors: (azimuth, elevation in degrees, range in m, amplitude).

    Microphone positions have errors with standard deviation ``errors_m``.
    """
    settings = (settings or Settings()).replace(processing=Processing(directions=directions, range_m=range_m))
    grid = direction_grid(settings.processing)
    looks = unit_vectors(grid.azimuth_rad, grid.elevation_rad)
    positions_m = microphones(settings.array).enabled_positions_m
    speed_m_s = sound_speed_m_s(settings.air)
    ranges_m = np.arange(*range_m, speed_m_s / 90_000)
    matched = matched_filter_spectrum(settings, n_fft=2048, decimation=10)
    wave_1_m = 2 * np.pi * (matched.first_bin + np.arange(len(matched.values))) * 450_000 / 2048 / speed_m_s
    power = np.abs(matched.values) ** 2 / np.sum(np.abs(matched.values) ** 2)
    beams = np.zeros((len(grid), len(ranges_m)), dtype=complex)
    for azimuth_deg, elevation_deg, reflector_m, amplitude in reflectors:
        source = unit_vectors(np.radians([azimuth_deg]), np.radians([elevation_deg]))
        actual_m = positions_m + errors_m * np.random.default_rng(2).standard_normal(positions_m.shape)
        paths_m = looks @ positions_m.T - source @ actual_m.T  # (direction, mic)
        turned, turn = np.exp(-1j * wave_1_m[0] * paths_m), np.exp(-1j * (wave_1_m[1] - wave_1_m[0]) * paths_m)
        pattern = np.empty((len(looks), len(wave_1_m)), dtype=complex)
        for place in range(len(wave_1_m)):  # from each wave number to the next one by a multiplication
            pattern[:, place] = turned.mean(axis=1)
            turned *= turn
        shape = np.exp(2j * wave_1_m[:, None] * (ranges_m - reflector_m)) * power[:, None]
        beams += amplitude * pattern @ shape
    amplitude = np.abs(beams + noise * np.random.default_rng(1).standard_normal(beams.shape))
    return Energyscape(amplitude.astype(np.float32), grid.azimuth_rad, grid.elevation_rad, ranges_m, settings)


def test_find_peaks_lists_one_reflector_once():
    (peak,) = find_peaks(image_of([(12.34, 0, 1.2345, 1.0)]))
    assert peak.azimuth_deg == pytest.approx(12.34, abs=0.05)
    assert peak.elevation_deg == pytest.approx(0, abs=1e-6)
    assert peak.range_m == pytest.approx(1.2345, abs=2e-4)
    assert peak.level_db == 0


def test_find_peaks_sorts_reflectors_by_level():
    reflectors = [(-40, 0, 0.95, 0.5), (3.3, 0, 1.3, 1.0), (55.5, 0, 1.45, 0.6), (3.3, 0, 1.1, 0.25)]
    peaks = find_peaks(image_of(reflectors, noise=0.002), min_level_db=-20)
    expected = sorted(reflectors, key=lambda reflector: -reflector[3])
    assert len(peaks) == len(expected)
    for peak, (azimuth_deg, _, range_m, amplitude) in zip(peaks, expected, strict=True):
        assert peak.azimuth_deg == pytest.approx(azimuth_deg, abs=0.7)
        assert peak.range_m == pytest.approx(range_m, abs=2e-3)
        assert peak.level_db == pytest.approx(20 * np.log10(amplitude), abs=0.7)


def test_find_peaks_interpolates_azimuth_and_elevation():
    reflectors = [(-21.7, 13.2, 1.0, 1.0), (30.1, -41.0, 1.3, 0.5)]
    peaks = find_peaks(image_of(reflectors, directions="3000", range_m=(0.9, 1.4)), min_level_db=-12)
    assert len(peaks) == 2
    for peak, (azimuth_deg, elevation_deg, range_m, _) in zip(peaks, reflectors, strict=True):
        assert peak.azimuth_deg == pytest.approx(azimuth_deg, abs=0.5)
        assert peak.elevation_deg == pytest.approx(elevation_deg, abs=0.5)
        assert peak.range_m == pytest.approx(range_m, abs=1e-3)


def test_find_peaks_separates_reflectors_1_5_beam_widths_apart():
    peaks = find_peaks(image_of([(0, 0, 1.2, 1.0), (12, 0, 1.2, 0.9)]), min_level_db=-6)
    # The first side lobe of each reflector shifts the main lobe of the other.
    assert [peak.azimuth_deg for peak in peaks] == pytest.approx([0, 12], abs=1.5)


@pytest.mark.parametrize("errors_m", [0.0, 8e-4])
def test_find_peaks_ignores_side_lobes_of_an_imperfect_array(errors_m):
    """Position errors of half a millimetre raise side lobes above their prediction."""
    strong, other = (12.0, 20.0, 1.2, 1.0), (-35.0, -10.0, 1.21, 0.5)
    image = image_of([strong], directions="3d:1500", range_m=(1.05, 1.35), noise=1e-4, errors_m=errors_m)
    assert len(find_peaks(image, min_level_db=-20)) == 1
    both = image_of([strong, other], directions="3d:1500", range_m=(1.05, 1.35), noise=1e-4, errors_m=errors_m)
    assert [peak.azimuth_deg for peak in find_peaks(both, min_level_db=-20)] == pytest.approx([12.0, -35.0], abs=1.5)


def test_find_peaks_keeps_weak_reflectors_of_coherence_factor():
    linear = image_of([(0.0, 0.0, 1.2, 1.0), (40.0, 0.0, 1.2, 0.6)], range_m=(1.05, 1.35))
    settings = linear.settings.replace(processing=linear.settings.processing.replace(weighting="coherence_factor"))
    image = linear.replace(amplitude=linear.amplitude**2, settings=settings)
    assert [round(peak.azimuth_deg) for peak in find_peaks(image, min_level_db=-12)] == [0, 40]


def test_find_peaks_with_false_alarm_ignores_rounding_errors():
    image = image_of([(10.0, 0.0, 1.2, 1e-9)])
    assert len(find_peaks(image, false_alarm=None)) == 1
    assert find_peaks(image, false_alarm=1e-3) == []


def test_without_side_lobes_keeps_only_main_lobes():
    image = image_of([(12.0, 20.0, 1.2, 1.0)], directions="3d:1500", range_m=(1.05, 1.35), noise=1e-4)
    dark = without_side_lobes(image)
    bright = dark.amplitude.max(axis=1) > 0.02
    source = unit_vectors(np.radians([12.0]), np.radians([20.0]))
    apart_deg = np.degrees(np.arccos(unit_vectors(image.azimuth_rad, image.elevation_rad) @ source[0]))
    assert apart_deg[bright].max() < 20
    assert apart_deg[image.amplitude.max(axis=1) > 0.02].max() > 60
    assert dark.amplitude.max() == image.amplitude.max()


@pytest.mark.parametrize(("directions", "azimuth_deg"), [("2d:91", 97.0), ("1850", 50.0)])
def test_find_peaks_stays_inside_the_grid(directions, azimuth_deg):
    image = image_of([(azimuth_deg, 0, 1.2, 1.0)], directions=directions, range_m=(1.1, 1.3))
    edge_deg = np.degrees(image.azimuth_rad).max()
    assert all(peak.azimuth_deg <= edge_deg + 1e-9 for peak in find_peaks(image))


def test_find_peaks_limits_by_top_and_min_level():
    image = image_of([(-40, 0, 0.95, 0.5), (3, 0, 1.3, 1.0), (50, 0, 1.1, 0.2)])
    assert len(find_peaks(image, top=2)) == 2
    assert len(find_peaks(image, min_level_db=-10)) == 2
    assert len(find_peaks(image, top=None, min_level_db=-16)) == 3


@pytest.mark.parametrize("shape", [(181, 210), (1, 1), (1, 5), (2, 2), (3, 1)])
def test_find_peaks_accepts_silence_and_small_images(shape):
    image = image_of([])
    small = image.replace(
        amplitude=np.zeros(shape, np.float32),
        azimuth_rad=image.azimuth_rad[: shape[0]],
        elevation_rad=image.elevation_rad[: shape[0]],
        range_m=image.range_m[: shape[1]],
    )
    assert find_peaks(small) == []
    amplitude = small.amplitude.copy()
    amplitude[0, shape[1] // 2] = 1
    found = find_peaks(small.replace(amplitude=amplitude), false_alarm=None)
    assert len(found) == (1 if shape[1] != 2 else len(found))
    assert all(np.isfinite([peak.azimuth_deg, peak.range_m, peak.level_db]).all() for peak in found)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [({"top": 0}, "top is 0; use a whole number of at least 1"), ({"min_level_db": 3.0}, "min_level_db is 3")],
)
def test_find_peaks_rejects_invalid_arguments(arguments, match):
    with pytest.raises(ArgumentError, match=match):
        find_peaks(image_of([]), **arguments)


def test_noise_below_the_lowest_level_yields_no_reflectors():
    """Zeros of 8-bit levels are noise below the floor, so the lowest level takes its place."""
    settings = Settings(recording=Recording(encoding="float32"))
    given = image_of([], settings=settings)
    noise = np.random.default_rng(8).rayleigh(size=given.amplitude.shape) * 4e-7
    levels = LevelCodes(-122.0)
    amplitude = levels.decode(levels.encode(noise.astype(np.float32)))
    rounded = given.replace(amplitude=amplitude, level_step_db=levels.step_db)
    assert np.median(amplitude) == 0
    assert amplitude.any()
    assert find_peaks(rounded) == []
    assert noise_of(rounded) == pytest.approx(10 ** (-122 / 20) / math.sqrt(math.log(2)), rel=0.01)
    assert find_peaks(rounded.replace(level_step_db=0.0))


@pytest.mark.parametrize("directions", ["2d:181", "3d:600"])
def test_rounded_levels_yield_one_reflector_without_a_bias(directions):
    """Of an area of equal levels, the middle counts, not the bin with the lowest number."""
    levels, errors_deg = LevelCodes(-122.0), []
    for azimuth_deg in np.random.default_rng(4).uniform(-40, 40, 12):
        given = image_of([(azimuth_deg, 0, 1.2345, 1.0)], directions=directions)
        amplitude = levels.decode(levels.encode(given.amplitude))
        rounded = given.replace(amplitude=amplitude, level_step_db=levels.step_db)
        (peak,) = find_peaks(rounded, min_level_db=-6)
        cloud = PointExtractor(rounded.settings, min_level_db=-6)(rounded)
        assert len(cloud) == 1
        assert peak.range_m == pytest.approx(1.2345, abs=1e-3)
        errors_deg.append(peak.azimuth_deg - azimuth_deg)
    assert np.abs(errors_deg).max() < 1.5
    assert abs(np.mean(errors_deg)) < 0.25
